"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(
    headings: Sequence[str], rows: Iterable[Sequence[object]], *, numbers: bool = False, compact: bool = False
) -> list[str]:
    """Lines of a table.

    Args:
        headings: of the columns.
        rows: cells, as text or what `str` makes text of.
        numbers: whether all columns but the first hold numbers, which are set to the right.
        compact: whether the rule below the headings goes without spaces.
    """
    rule = ["---", *["--:" if numbers else "---"] * (len(headings) - 1)]
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in (headings, rule, *rows)]
    if compact:
        lines[1] = lines[1].replace(" ", "")
    return lines
