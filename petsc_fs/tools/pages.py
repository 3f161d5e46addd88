"""Tables in Markdown and in HTML, and pages that hold them."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence


def markdown(headings: Sequence[str], rows: Iterable[Sequence[object]], *, numbers: bool = False) -> list[str]:
    """Lines of a table in Markdown; with `numbers`, all columns but the first are set to the right."""
    rule = ["---", *["--:" if numbers else "---"] * (len(headings) - 1)]
    cells = [[" ".join(str(c).split()).replace("|", "\\|") for c in row] for row in rows]
    return [f"| {' | '.join(row)} |" for row in (headings, rule, *cells)]


STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 68rem; margin: 2rem auto;
  padding: 0 1rem; overflow-wrap: break-word; }
h2 { border-bottom: 2px solid #0072B2; } caption { text-align: left; color: #444; }
table { border-collapse: collapse; margin: .6rem 0 1rem; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { text-align: left; padding: .25rem .7rem; border-bottom: 1px solid #ddd; vertical-align: top; }
td.n { text-align: right; white-space: nowrap; } img { max-width: 100%; } .wide, pre { overflow-x: auto; }
th button { font: inherit; background: none; border: 0; padding: 0; text-align: left; cursor: pointer;
  text-decoration: underline dotted; }
th[aria-sort=ascending] button::after { content: " ▲"; } th[aria-sort=descending] button::after { content: " ▼"; }
pre { background: #f5f5f5; padding: .7rem; font-size: .82rem; } :focus-visible { outline: 3px solid #0072B2; }
"""

SORT = """
for (const th of document.querySelectorAll("thead th")) {
  const button = document.createElement("button");
  button.append(...th.childNodes);
  th.append(button);
  button.onclick = () => {
    const body = th.closest("table").tBodies[0], sign = th.getAttribute("aria-sort") === "ascending" ? -1 : 1;
    const key = row => { const text = row.cells[th.cellIndex].textContent, n = parseFloat(text.replaceAll(",", ""));
      return isNaN(n) ? text : n; };
    for (const other of th.parentNode.cells) other.removeAttribute("aria-sort");
    th.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
    body.append(...[...body.rows].sort((a, b) => { const x = key(a), y = key(b);
      return sign * (typeof x === "number" && typeof y === "number" ? x - y : String(x).localeCompare(String(y))); }));
  };
}
"""
"""Headings become buttons that sort by their column; without JavaScript they are what they were."""


def whole(title: str, body: Iterable[str]) -> str:
    """A page in HTML that needs no other file and no network; the title is escaped, the lines of the body are not."""
    title = html.escape(title)
    return "\n".join(
        [
            f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<style>{STYLE}</style></head><body><main><h1>{title}</h1>",
            *body,
            f"</main><script>{SORT}</script></body></html>\n",
        ]
    )


def hypertext(caption: str, headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in HTML; what it shows is escaped, and numbers stand to the right. Wide ones scroll, also by keyboard."""
    head = "".join(f'<th scope="col">{html.escape(h)}</th>' for h in headings)
    lines = []
    for first, *row in rows:
        cells = [html.escape(str(cell)) for cell in row]
        lines.append(f'<tr><th scope="row">{html.escape(str(first))}</th>')
        lines.append("".join(f"<td{' class=n' * is_number(c)}>{c}</td>" for c in cells) + "</tr>")
    body, caption = "\n".join(lines), html.escape(caption)
    return (
        f'<div class="wide" role="region" tabindex="0" aria-label="{caption}"><table><caption>{caption}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>"
    )


def is_number(text: str) -> bool:
    """Whether a cell starts as a number does."""
    return text[:1].isdigit()
