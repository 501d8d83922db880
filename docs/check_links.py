"""Check that every relative link and anchor in the Markdown pages leads somewhere."""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LINK = re.compile(r"(?<!!)\[[^\]]*\]\(([^)\s]+)\)|!\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)


def pages() -> list[Path]:
    """Return the Markdown files of the repository."""
    found = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("*/README.md")]
    return sorted(set(found))


def anchors(page: Path) -> set[str]:
    """Return the anchors that headings of a page make on GitHub."""
    text = FENCE.sub("", page.read_text())
    heads = re.findall(r"^#+\s+(.+)$", text, re.MULTILINE)
    plain = [re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads]
    return set(plain)


def broken_links(page: Path) -> list[str]:
    """Return one line for each link of a page that leads nowhere."""
    problems = []
    for groups in LINK.findall(FENCE.sub("", page.read_text())):
        link = groups[0] or groups[1]
        if re.match(r"[a-z]+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name) if name else page
        if not target.exists():
            problems.append(f"{page.relative_to(ROOT)}: {link}: no such file")
        elif anchor and target.suffix == ".md" and anchor not in anchors(target):
            problems.append(f"{page.relative_to(ROOT)}: {link}: no such heading")
    return problems


def main() -> int:
    """Print what is broken and return the exit code."""
    found = pages()
    problems = [problem for page in found for problem in broken_links(page)]
    print("\n".join(problems) or f"{len(found)} pages, all links lead somewhere")
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
