"""The table of all recordings of a library: sorted and filtered in the browser."""

from __future__ import annotations

from collections.abc import Container, Sequence

from flashdex.reports.library.cards import STATUS_CLASS, card_id
from flashdex.reports.library.facts import (
    CODES,
    STATUSES,
    RecordingFacts,
    columns_of,
    count_codes,
)
from flashdex.reports.page import Html, joined, safe, tag
from flashdex.reports.page import table as plain_table
from flashdex.reports.run.terminal import shorten

MAX_REASON = 600  # characters; report.csv has all of them
# Reads what the table shows and writes text only: no name becomes markup.
SCRIPT = """
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
"""
STYLE = """
.list { max-height: 80vh; overflow: auto; border: 1px solid #ccc; }
.list th { position: sticky; top: 0; background: #fff; z-index: 1; }
.list td:nth-child(3), .list th:nth-child(3) { min-width: 22em; text-align: left;
  overflow-wrap: anywhere; }
.list td:first-child { min-width: 14em; max-width: 22em; overflow-wrap: anywhere;
  position: sticky; left: 0; background: #fff; }
.list td { unicode-bidi: isolate; } tr[hidden] { display: none !important; }
th button, button.code { font: inherit; color: inherit; background: none; border: 0;
  padding: 0; cursor: pointer; text-align: inherit; text-decoration: underline dotted; }
th[aria-sort="ascending"] button::after { content: " \\2191"; }
th[aria-sort="descending"] button::after { content: " \\2193"; }
.find { display: flex; flex-wrap: wrap; gap: 10px; align-items: center;
  margin: 8px 0; }
.find input, .find select { font: inherit; padding: 3px 6px; }
.find input { flex: 1 1 16em; max-width: 32em; }
@media screen and (min-width: 761px) {
  .codes td:last-child, .codes th:last-child { text-align: left; width: 60%; } }
@media screen and (max-width: 760px) {
  .list thead { position: static; } .list tr { display: table-row; }
  .list td { display: table-cell; padding: 5px 6px;
    border-bottom: 1px solid #ddd; }
  .list td:not(:first-child)::before { content: none; }
}
@media print { .list { max-height: none; overflow: visible; } .find { display: none; } }
"""


def recordings_table(
    facts: Sequence[RecordingFacts], *, cards: Container[int | None]
) -> Html:
    """Every column of ``report.csv``, with fields to search and sort by.

    Args:
        facts: recordings, in the order shown at first.
        cards: rows of the library that have a card on the page.
    """
    columns = columns_of(facts)
    names = ["motion", "status", "reason", *columns]
    heads = [tag("th", tag("button", _breakable(n), type="button")) for n in names]
    body = [_row(one, columns, has_card=one.row in cards) for one in facts]
    head = tag("thead", tag("tr", *heads))
    table = tag("table", head, tag("tbody", joined(body)), id="recordings")
    return joined([_fields(len(facts)), tag("div", table, class_="list")])


def code_table(facts: Sequence[RecordingFacts]) -> Html:
    """Recordings of each status by code, with what the code means.

    Args:
        facts: recordings.
    """
    counts = count_codes(facts)
    if not counts:
        return tag("p", "No recording was remarked on.", class_="soft")
    names = ["code", *reversed(STATUSES), "meaning"]
    rows = []
    for code, by_status in counts.items():
        button = tag("button", code, type="button", class_="code", data_code=code)
        rows.append([button, *by_status.values(), CODES.get(code, "")])
    return tag("div", plain_table(names, rows), class_="codes")


def _row(one: RecordingFacts, columns: Sequence[str], *, has_card: bool) -> Html:
    name = _breakable(one.name)
    if has_card and one.row is not None:
        name = tag("a", name, href=f"#{card_id(one.row)}")
    cells = [
        tag("td", name),
        tag("td", one.status, class_=STATUS_CLASS.get(one.status, "")),
        tag("td", shorten(one.reason, MAX_REASON)),
        *(tag("td", one.figures.get(column, "")) for column in columns),
    ]
    return tag("tr", *cells, data_status=one.status)


def _fields(total: int) -> Html:
    options = [Html('<option value="">all</option>')]
    options += [tag("option", status, value=status) for status in STATUSES]
    words = Html(
        '<input id="words" type="search" placeholder="part of a name, code, object ..."'
        ' aria-label="search">'
    )
    select = tag("select", *options, id="status", aria_label="status")
    shown = tag("span", f"{total} recordings", id="shown", class_="soft")
    return tag("div", words, select, shown, class_="find")


def _breakable(name: str) -> Html:
    """Long names may be broken after an underscore."""
    return Html(safe(name).replace("_", "_<wbr>"))
