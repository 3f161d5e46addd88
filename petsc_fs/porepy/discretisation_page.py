"""Picture and page of a study of discretisation error against run time."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from petsc_fs.files import complete
from petsc_fs.plot import pyplot
from petsc_fs.porepy.discretisation import CASES, DEFAULT_RTOL, MARGIN, Run, Study, needed_tolerance, orders

LOOKS = (
    ("#D55E00", "o", "-"),
    ("#E69F00", "s", (0, (5, 1.5))),
    ("#009E73", "^", (0, (1.2, 1.2))),
    ("#56B4E9", "D", (0, (6, 1.5, 1.2, 1.5))),
    ("#0072B2", "v", (0, (3, 1))),
    ("#CC79A7", "P", "-"),
    ("#000000", "X", (0, (5, 1.5))),
)
"""Colour (Okabe and Ito's palette, which the colour-blind can tell apart), marker and dashes of each tolerance."""

INTRODUCTION = """\
# Discretisation error against run time

<!-- Written by `petsc-fs discretisation`; do not edit. -->

How far must linear systems be solved? Not further than the discretisation is accurate. These problems have known
solutions ([petsc_fs/porepy/analytic.py](../petsc_fs/porepy/analytic.py)), so that the whole error of a run can be
measured: of grid, time steps and linear solver together. Errors are relative, in L2, at the end of the run.

{cases}

The relative tolerance of the linear solves (`-ksp_rtol`) is that of each solve, which begins with the state
of the step before. Seconds are processor time on one rank, of a run from meshing on and of its linear solves alone;
they are those of one run each, so look at iterations for small differences. Made with {versions}.

![Error against seconds and against cells](discretisation.png)
"""

DESCRIPTIONS = {
    "terzaghi": "a loaded column, drained at its top; a Cartesian grid of squares, implicit Euler in time",
    "mandel": "a slab between rigid plates, drained at its sides; triangles, implicit Euler in time",
    "sliding": "a closed inclined fracture that slides against friction in a compressed plane; triangles, one step of "
    "contact mechanics by Newton's method to a residual of 1e-8",
}


def draw(result: Study, target: Path) -> None:
    """Draw error against seconds and against cells, a row per case, a curve per tolerance.

    Raises:
        UsageError: matplotlib is missing, or the file cannot be written.
    """
    plt = pyplot()
    from matplotlib import ticker

    cases = result.cases
    tolerances = sorted({run.rtol for run in result.runs}, reverse=True)
    with plt.rc_context({"font.size": 9, "axes.grid": True, "grid.color": "#DDDDDD", "axes.axisbelow": True}):
        figure, axes = plt.subplots(
            len(cases), 2, figsize=(8.2, 2.9 * len(cases) + 0.5), squeeze=False, layout="constrained"
        )
        for row, name in zip(axes, cases, strict=True):
            case = CASES[name]
            error = case.errors[0]
            for rtol, (colour, marker, dashes) in zip(tolerances, _looks(len(tolerances)), strict=True):
                runs = result.of(name, rtol)
                style = {"color": colour, "marker": marker, "linestyle": dashes, "markersize": 5, "linewidth": 1.4}
                for axis, x in zip(row, ([r.seconds for r in runs], [r.cells for r in runs]), strict=True):
                    axis.loglog(x, [r.errors[error] for r in runs], label=f"rtol {rtol:g}", **style)
            _draw_order(row[1], result.tightest(name), error)
            row[0].set_title(case.title, loc="left", fontweight="bold")
            row[0].set_ylabel(f"relative error of {error}, L2 (-)")
            row[0].set_xlabel("processor time of the run (s)")
            row[1].set_xlabel("number of cells (-)")
            for axis in (a for panel in row for a in (panel.xaxis, panel.yaxis)):
                axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
                axis.set_minor_locator(ticker.NullLocator())
                axis.set_major_formatter(ticker.FormatStrFormatter("%g"))
        handles, labels = axes[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4), frameon=False)
        with complete(target) as temporary:
            figure.savefig(temporary, format="png", dpi=140, metadata={"Software": None})
        plt.close(figure)


def _looks(count: int) -> list[tuple[str, str, Any]]:
    return [LOOKS[i % len(LOOKS)] for i in range(count)]


def _draw_order(axis: Any, runs: Sequence[Run], error: str) -> None:
    """Write the observed orders beside the curve of the tightest tolerance."""
    for (a, b), order in zip(pairwise(runs), orders(runs, error), strict=True):
        x, y = (a.cells * b.cells) ** 0.5, (a.errors[error] * b.errors[error]) ** 0.5
        axis.annotate(f"order {order:.2f}", (x, y), xytext=(5, 4), textcoords="offset points", ha="left", va="bottom")


def page(result: Study) -> str:
    """The page, in Markdown."""
    described = "\n".join(f"- **{CASES[name].title}** (`{name}`): {DESCRIPTIONS[name]}." for name in result.cases)
    versions = ", ".join(f"{program} {version}" for program, version in result.versions.items())
    parts = [INTRODUCTION.format(cases=described, versions=versions), _recommendation(result)]
    for name in result.cases:
        parts += [f"\n## {CASES[name].title}\n", _convergence(result, name), "", _tolerances(result, name)]
    return "\n".join(parts) + "\n"


def _recommendation(result: Study) -> str:
    """Which tolerance is enough, and what it saves over the default."""
    lines = [
        "\n## The tolerance that is enough\n",
        f"Loosest tolerance measured at which no error differs by more than {100 * MARGIN:.0f} % from that with the "
        "tightest one, and Newton's method takes no more steps; and what it saves over "
        f"{DEFAULT_RTOL:g}, the tolerance of the shipped options files:\n",
        "| case | refinement | unknowns | enough | Krylov iterations saved | linear seconds saved | of the whole run |",
        "| --- | --: | --: | --: | --: | --: | --: |",
    ]
    enough: list[float] = []
    by_case = []
    for name in result.cases:
        before = len(enough)
        for refinement in sorted({run.refinement for run in result.of(name)}):
            runs = {r.rtol: r for r in result.of(name) if r.refinement == refinement}
            chosen = runs[needed_tolerance(list(runs.values()))]
            enough.append(chosen.rtol)
            base = runs.get(DEFAULT_RTOL)
            saved = ["", "", ""]
            if base is not None:
                pairs = (
                    (chosen.iterations, base.iterations),
                    (chosen.linear_seconds, base.linear_seconds),
                    (chosen.seconds, base.seconds),
                )
                saved = [f"{100 * (1 - new / old):.0f} %" for new, old in pairs]
            row = [name, f"{refinement:g}", f"{chosen.unknowns:,}", f"{chosen.rtol:g}", *saved]
            lines.append(f"| {' | '.join(row)} |")
        by_case.append(f"{name} {min(enough[before:]):g}")
    lines += [
        "",
        f"{min(enough):g} is enough for all of these ({', '.join(by_case)}). What algebra still errs by then is lost "
        "in the error of grid and time steps: the curves of tighter tolerances lie on top of each other. As grids get "
        "finer and their error smaller, the tolerance has to follow.",
    ]
    return "\n".join(lines)


def _convergence(result: Study, name: str) -> str:
    runs, errors = result.tightest(name), CASES[name].errors
    head = ["refinement", "cells", "unknowns", "solves", *(h for e in errors for h in (f"error of {e}", "order"))]
    lines = [
        f"With rtol {runs[-1].rtol:g}:\n",
        f"| {' | '.join(head)} |",
        "| " + " | ".join(["--:"] * len(head)) + " |",
    ]
    observed = {e: ["", *(f"{o:.2f}" for o in orders(runs, e))] for e in errors}
    for k, run in enumerate(runs):
        row = [f"{run.refinement:g}", f"{run.cells:,}", f"{run.unknowns:,}", str(run.solves)]
        row += [text for e in errors for text in (f"{run.errors[e]:.2e}", observed[e][k])]
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


def _tolerances(result: Study, name: str) -> str:
    finest = max(run.refinement for run in result.of(name))
    runs = [run for run in result.of(name) if run.refinement == finest]
    errors = CASES[name].errors
    head = ["rtol", "solves", "Krylov iterations", "linear s", "total s", *(f"error of {e}" for e in errors)]
    lines = [f"At refinement {finest:g}:\n", f"| {' | '.join(head)} |", "| " + " | ".join(["--:"] * len(head)) + " |"]
    for run in runs:
        row = [
            f"{run.rtol:g}",
            str(run.solves),
            f"{run.iterations:,}",
            f"{run.linear_seconds:.1f}",
            f"{run.seconds:.1f}",
        ]
        lines.append(f"| {' | '.join([*row, *(f'{run.errors[e]:.3e}' for e in errors)])} |")
    return "\n".join(lines)
