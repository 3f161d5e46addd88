"""What the benchmark measured as Markdown: a page of its own, or tables within a page, written anew.

A page says where its tables are, and of which measurements beside it:

    <!-- bench: bench.json bench_large.json -->
    what lies here is replaced
    <!-- end -->

and `growth` in place of `bench` for how iterations grow from the smallest to the largest 2D grid.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from petsc_fs.bench import Benchmark, Row
from petsc_fs.errors import UsageError
from petsc_fs.files import write_text
from petsc_fs.memory import in_units

COLUMNS = (
    "input", "unknowns", "ranks", "file", "iterations", "set-up s", "solve s", "set-up ratio", "solve ratio", "ratio",
    "memory", "complexity", "traffic", "of STREAM", "Python",
)  # fmt: skip
CLOCK = {"wall": "by the clock", "cpu": "of the processor, the busiest rank's"}
PART = re.compile(r"(<!-- (bench|growth): ([^>]+?) -->\n).*?(<!-- end -->)", re.DOTALL)


def page(found: Benchmark) -> str:
    """The measurements as a Markdown section."""
    head = [
        f"Seconds {CLOCK[found.settings.clock]}; medians of {found.settings.repeat} turns. Ratios are to",
        f"`{found.rows[0].file}` in the same turn; in brackets the least and the greatest. Memory is what the process",
        "grew by, over all ranks. Complexity: entries of all levels over those of the finest, of mechanics and of",
        "mass. Traffic: bytes per iteration, estimated; and what that makes of the bandwidth of STREAM's triad on as",
        "many ranks. Python: part of a first solve spent outside of compiled functions.",
        "",
    ]
    return "\n".join([*head, *table([found])])


def fill(text: str, folder: Path) -> str:
    """A page with its tables written anew.

    Args:
        text: of the page, with marks as in the head of this module.
        folder: with the measurements that the marks name.

    Raises:
        UsageError: the page has no marks, or measurements are missing.
    """
    if not PART.search(text):
        raise UsageError("the page has no table to fill: no <!-- bench: FILE.json --> with an <!-- end -->")

    def anew(part: re.Match[str]) -> str:
        found = [Benchmark.from_json(_text(folder / n, "scripts/bench --out writes it")) for n in part[3].split()]
        lines = table(found) if part[2] == "bench" else growth([row for one in found for row in one.rows])
        return "\n".join([part[1], *lines, part[4]])

    return PART.sub(anew, text)


def fill_page(path: Path) -> None:
    """Write the tables of a page anew, see `fill`.

    Raises:
        UsageError: as `fill`, or a file cannot be read or written.
    """
    write_text(path, fill(_text(path, "the page is written by hand, but for its tables"), path.parent))


def _text(path: Path, hint: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as e:
        raise UsageError(f"{path}: {e.strerror}; {hint}") from e


def table(measurements: Sequence[Benchmark]) -> list[str]:
    """A table of the rows of one or more measurements by the same clock, their means and the machine."""
    rows = [row for found in measurements for row in found.rows]
    bases = {found.rows[0].file for found in measurements}
    lines = [f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}", *map(_line, rows), ""]
    for (file, ranks), mean in geometric_means(rows).items():
        if file not in bases:
            worst = max((r for r in rows if (r.file, r.ranks) == (file, ranks) and r.ratio == r.ratio), key=_ratio)
            lines.append(
                f"- `{file}`, {_ranks(ranks)}: geometric mean {mean:.2f}, worst {worst.ratio:.2f} on {worst.input}"
            )
    streams = {row.ranks: row.stream for row in rows if np.isfinite(row.stream)}
    words = ", ".join(f"{in_units(speed)}/s on {_ranks(n)}" for n, speed in streams.items())
    about = ", ".join(f"{k} {v}" for k, v in measurements[-1].about.items())
    return [*lines, "", f"STREAM's triad: {words}. Seconds {CLOCK[measurements[0].settings.clock]}; {about}.", ""]


def _line(row: Row) -> str:
    name = row.input + (f" ({row.solves} steps)" if row.solves > 1 else "")
    cells = [name, f"{row.unknowns:,}", str(row.ranks), f"`{row.file}`"]
    if row.outcome:
        return f"| {' | '.join([*cells, row.outcome])} |{' |' * (len(COLUMNS) - 5)}"
    missed = "" if row.converged else " (misses its tolerance)"
    cells += [f"{row.iterations}{missed}", f"{row.setup:.3g}", f"{row.solve:.3g}"]
    cells += [f"{row.setup_ratio:.2f}", f"{row.solve_ratio:.2f}"]
    cells += [f"**{row.ratio:.2f}** ({row.lowest:.2f}–{row.highest:.2f})", in_units(row.peak)]
    cells += [", ".join("–" if np.isnan(c) else f"{c:.2f}" for c in (row.complexity, row.mass_complexity))]
    known = np.isfinite(row.traffic)
    cells += [in_units(row.traffic) if known else "", f"{row.bandwidth / row.stream:.0%}" if known else ""]
    return f"| {' | '.join([*cells, f'{row.python_share:.1%}'])} |"


def growth(rows: Sequence[Row]) -> list[str]:
    """How iterations grow from the smallest to the largest 2D grid of each model, as a table.

    A model's scenes are those whose names begin alike: model1, model1_g5_t2_n2, ...
    """
    lines = ["| model | ranks | file | unknowns | iterations | last to first |", f"|{'---|' * 6}"]
    grids: dict[tuple[str, int, str], dict[int, int]] = {}
    for row in rows:
        if row.dimension == 2 and row.converged and row.solves == 1:
            grids.setdefault((row.input.split("_")[0], row.ranks, row.file), {})[row.unknowns] = row.iterations
    for (model, ranks, file), found in sorted(grids.items()):
        if len(found) > 1:
            unknowns, iterations = zip(*sorted(found.items()), strict=True)
            cells = [model, str(ranks), f"`{file}`", ", ".join(f"{n:,}" for n in unknowns)]
            cells += [", ".join(map(str, iterations)), f"{iterations[-1] / iterations[0]:.2f}"]
            lines.append(f"| {' | '.join(cells)} |")
    return [*lines, ""]


def geometric_means(rows: Sequence[Row]) -> dict[tuple[str, int], float]:
    """Per file and number of ranks the geometric mean of its ratios."""
    found: dict[tuple[str, int], list[float]] = {}
    for row in rows:
        if np.isfinite(row.ratio):
            found.setdefault((row.file, row.ranks), []).append(row.ratio)
    return {key: float(np.exp(np.mean(np.log(ratios)))) for key, ratios in found.items()}


def _ratio(row: Row) -> float:
    return row.ratio


def _ranks(n: int) -> str:
    return f"{n} rank{'s' if n > 1 else ''}"
