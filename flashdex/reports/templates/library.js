(() => {
  const table = document.getElementById("recordings"), body = table.tBodies[0];
  const rows = [...body.rows], texts = rows.map((r) => r.textContent.toLowerCase());
  const words = document.getElementById("words");
  const status = document.getElementById("status");
  const shown = document.getElementById("shown");
  const filter = () => {
    const parts = words.value.toLowerCase().split(" ").filter(Boolean);
    let count = 0;
    rows.forEach((row, i) => {
      const fits = (!status.value || row.dataset.status === status.value)
        && parts.every((part) => texts[i].includes(part));
      row.hidden = !fits;
      count += fits;
    });
    shown.textContent = `${count} of ${rows.length} recordings`;
  };
  words.addEventListener("input", filter);
  status.addEventListener("change", filter);
  for (const button of document.querySelectorAll("button[data-code]"))
    button.addEventListener("click", () => {
      words.value = button.dataset.code;
      status.value = "";
      filter();
      words.scrollIntoView();
    });
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    head.firstElementChild.addEventListener("click", () => {
      const sign = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
      for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
      const keyed = [...body.rows].map((row) => [row.cells[column].textContent, row]);
      keyed.sort(([a], [b]) => {
        if (!a || !b) return !a - !b;  // what was not measured stands last
        const gap = Number(a) - Number(b);
        return sign * (Number.isNaN(gap) ? a.localeCompare(b) : gap);
      });
      body.append(...keyed.map(([, row]) => row));
    });
  });
  filter();
})();
