"""Tables in Markdown and in HTML."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence


def markdown(headings: Sequence[str], rows: Iterable[Sequence[object]], *, numbers: bool = False) -> list[str]:
    """Lines of a table in Markdown; with `numbers`, all columns but the first are set to the right."""
    rule = ["---", *["--:" if numbers else "---"] * (len(headings) - 1)]
    cells = [[" ".join(str(c).split()).replace("|", "\\|") for c in row] for row in rows]
    return [f"| {' | '.join(row)} |" for row in (headings, rule, *cells)]


def hypertext(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in HTML; what it shows is escaped, and numbers stand to the right."""
    head = "".join(f"<th>{html.escape(h)}</th>" for h in headings)
    lines = []
    for row in rows:
        cells = [html.escape(str(cell)) for cell in row]
        lines.append("<tr>" + "".join(f"<td{' class=n' * is_number(c)}>{c}</td>" for c in cells) + "</tr>")
    body = "\n".join(lines)
    return f"<table><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table>"


def is_number(text: str) -> bool:
    """Whether a cell starts as a number does."""
    return text[:1].isdigit()
