"""The page that says which options file to use when, from comparisons; see `petsc_fs.compare`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from petsc_fs import compare_plots
from petsc_fs.compare import (
    CLOCKS,
    SECONDS,
    Case,
    Comparison,
    Fastest,
    Point,
    Verdict,
    fastest,
    points,
    seconds_words,
    verdicts,
)
from petsc_fs.files import write_text
from petsc_fs.markdown import table

ACCURACIES = (1e-3, 1e-6, 1e-9)
"""Forward errors of the tables over scenes."""


READING = (
    "Down and to the left is better. A curve is one options file, a point of it one tolerance, the loosest above;\n"
    "bars are quartiles over rounds. Hollow points missed their tolerance. Direct solvers are large points without a\n"
    "line."
)
PICTURES = ("work_precision",)
"""Kinds of pictures that the page shows."""


def write_page(comparisons: Sequence[Comparison], target: Path) -> list[Path]:
    """Write the page in Markdown, and beside it the pictures that it shows.

    Args:
        comparisons: of different scenes.
        target: page; pictures are called like it, with the scene's name.

    Returns:
        Everything written.

    Raises:
        UsageError: matplotlib is missing, or a file cannot be written.
    """
    pictures: list[compare_plots.Picture] = []
    files = {entry.label: entry for found in comparisons for entry in found.entries}
    styles = compare_plots.looks(sorted(files.values(), key=lambda entry: entry.label))
    for found in comparisons:
        pictures += compare_plots.draw(found, target.parent, PICTURES, f"{target.stem}_", styles)
    for picture in pictures:
        picture.svg.unlink()
    lines = [
        "# Which options file to use when",
        "",
        "Written by `scripts/choosing` from what `petsc-fs compare` measured. *Error* is the forward error against a",
        "reference solution that is accurate to the last digit: each field's in its own natural norm, relative, and",
        "their root mean square. Seconds are medians.",
        "",
        *_in_short(comparisons),
        "",
        "## The fastest file for an accuracy",
        "",
        *_verdict_table([(found, v) for found in comparisons for v in verdicts(found)]),
        "",
        "≈: the quartiles of these files overlap with those of the fastest.",
        "",
        "## Direct or iterative",
        "",
        *_direct_table(comparisons),
        "",
        "## Which tolerance an accuracy takes",
        "",
        "`-ksp_rtol` bounds the residual, not the error. The loosest of the measured tolerances at and below which",
        "a file reaches an error on every number of ranks (–: at none of them):",
        "",
        *_tolerance_table(comparisons),
    ]
    lines += ["", "## Pictures", "", READING]
    for found in comparisons:
        for picture in pictures:
            if picture.scene in {case.label for case in found.cases}:
                lines += ["", f"### {picture.title}", "", f"![{picture.title}]({picture.png.name})"]
    lines += ["", "## How this was measured", ""]
    for found in comparisons:
        machine, versions = found.about["machine"], found.about["versions"]
        lines += [
            f"    {found.command}",
            "",
            f"{found.about['date']}, {machine['processor']}, PETSc {versions['petsc']}, seconds of "
            f"{CLOCKS[found.clock]}, load average {found.about['load']:.1f}"
            + ("" if found.about.get("complete", True) else "; interrupted, later rounds are missing")
            + ".",
            "",
        ]
        for case in found.cases:
            last = case.reference["corrections"][-1]
            lines.append(f"- {case.label}: reference by {case.reference['method']}; last correction {last:.0e}.")
        lines.append("")
    write_text(target, "\n".join(lines).rstrip() + "\n")
    return [target, *(picture.png for picture in pictures)]


def _in_short(comparisons: Sequence[Comparison]) -> list[str]:
    """What the tables amount to."""
    pairs = [(case, *pair) for found in comparisons for case, pair in _direct_and_other(found)]
    ratios = {_name(c): d.seconds / o.seconds for c, d, o in pairs if d is not None and o is not None}
    groups = {
        "takes less time than any other file": [n for n, r in ratios.items() if r < 1 / SIMILAR],
        "takes about as long as the best other file": [n for n, r in ratios.items() if 1 / SIMILAR <= r <= SIMILAR],
        "takes longer": [f"{n} ({r:.1f} times as long)" for n, r in ratios.items() if r > SIMILAR],
    }
    goal = f"- To an error of {ACCURACIES[1]:.0e}, a factorisation of the whole matrix"
    lines = [f"{goal} {verb} on {', '.join(names)}." for verb, names in groups.items() if names]
    met = [
        (p.error, p.rtol, p.file, p.scene)
        for found in comparisons
        for p in points(found.records, found.clock)
        if p.converged and p.rtol <= TRUSTED
    ]
    if met:
        error, rtol, file, scene = max(met)
        lines.append(
            f"- A small residual is no small error: of the solves that met a tolerance of {TRUSTED:.0e} or less, "
            f"the worst (`{file}` on {scene}, {rtol:.0e}) has an error of {error:.1e}. The last table says which "
            "tolerance is enough."
        )
    return lines


SIMILAR = 1.25
"""Ratio of seconds up to which two files are about as fast."""
TRUSTED = 1e-6
"""Tolerance of the residual that looks strict."""


def _name(case: Case) -> str:
    return f"{case.label} ({case.dimension}D, {case.unknowns:,})"


def _verdict_table(rows: Sequence[tuple[Comparison, Verdict]]) -> list[str]:
    """Which file is fastest where."""
    cells = []
    for found, verdict in rows:
        case = next(c for c in found.cases if c.label == verdict.scene)
        row = [_name(case), str(verdict.ranks), verdict.label]
        for winners in verdict.winners.values():
            ties = f" ≈ {', '.join(winners[0].ties)}" if winners and winners[0].ties else ""
            row.append(f"`{winners[0].file}` {seconds_words(winners)}{ties}" if winners else "none")
        cells.append(row)
    return table(["scene (unknowns)", "ranks", "error ≤", *SECONDS], cells)


def _direct_table(comparisons: Sequence[Comparison]) -> list[str]:
    """The best factorisation of the whole matrix against the best other file, on the fewest ranks."""
    rows = []
    for found in comparisons:
        for case, pair in _direct_and_other(found):
            cells = []
            for best in pair:
                if best is None:
                    cells.append("no result")
                else:
                    peak, _ = compare_plots.memory(found.records, case.label, best.file, min(found.ranks))
                    cells.append(f"`{best.file}` {best.seconds:.2g} s, {max(peak):.0f} MB")
            direct, other = pair
            ratio = f"{direct.seconds / other.seconds:.2g}" if direct is not None and other is not None else ""
            rows.append([_name(case), *cells, ratio])
    words = (
        f"Set-up and solve on the fewest ranks, to an error of {ACCURACIES[1]:.0e}; memory is the peak of the process."
    )
    headings = ["scene (unknowns)", "best direct solver", "best other file", "seconds, direct / other"]
    return [words, "", *table(headings, rows)]


def _direct_and_other(found: Comparison) -> list[tuple[Case, tuple[Fastest | None, Fastest | None]]]:
    """For each scene the fastest factorisation of the whole matrix, and the fastest other file."""
    everything = [p for p in points(found.records, found.clock) if p.ranks == min(found.ranks)]
    rows = []
    for case in sorted(found.cases, key=lambda c: c.unknowns):
        direct, other = (
            fastest(
                [p for p in everything if p.scene == case.label and p.direct == whole],
                ACCURACIES[1],
                SECONDS["set-up and solve"],
            )
            for whole in (True, False)
        )
        rows.append((case, (direct, other)))
    return rows


def _tolerance_table(comparisons: Sequence[Comparison]) -> list[str]:
    """The loosest tolerance at which each file reaches an accuracy."""
    rows = []
    for found in comparisons:
        everything = points(found.records, found.clock)
        for case in found.cases:
            for entry in found.entries:
                mine = [p for p in everything if (p.scene, p.file) == (case.label, entry.label)]
                if mine:
                    cells = [loosest(mine, accuracy) for accuracy in ACCURACIES]
                    rows.append([_name(case), f"`{entry.label}`", *cells])
    return table(["scene (unknowns)", "file", *(f"error ≤ {a:.0e}" for a in ACCURACIES)], rows)


def loosest(mine: Sequence[Point], accuracy: float) -> str:
    """The loosest tolerance at and below which all points are so accurate, on every number of ranks."""
    reached = "–"
    for rtol in sorted({p.rtol for p in mine}):
        if not all(p.ended and p.error <= accuracy for p in mine if p.rtol == rtol):
            break
        reached = f"{rtol:.0e}"
    return reached
