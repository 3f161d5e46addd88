"""Pictures of a comparison: work-precision diagrams, convergence histories, time by phase and memory.

Files are told apart by colour (Okabe and Ito's palette, which the colour-blind can tell apart), marker and dashes
together, so that they still are in print without colour. A file looks the same in all pictures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs.errors import UsageError
from petsc_fs.tools.compare import CLOCKS, Case, Comparison, Entry, Point, Spread, points
from petsc_fs.tools.measure import Record
from petsc_fs.tools.plots import pyplot

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)), (0, (3, 1)))
PHASES = (("read", "#BBBBBB", ""), ("set-up", "#56B4E9", "//"), ("solve", "#0072B2", ""))
KINDS = ("work_precision", "history", "cost")
DPI = 130
SETTINGS = {
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "petsc_fs",
    "legend.frameon": False,
}


@dataclass(frozen=True)
class Picture:
    """A picture that was drawn.

    Attributes:
        kind: "work_precision", "history" or "cost".
        scene: label of the scene.
        png: path.
        svg: path.
        title: what it shows.
        caption: how to read it.
    """

    kind: str
    scene: str
    png: Path
    svg: Path
    title: str
    caption: str


@dataclass(frozen=True)
class Look:
    """Colour, marker and dashes of a file."""

    colour: str
    marker: str
    dashes: Any


def looks(entries: Sequence[Entry]) -> dict[str, Look]:
    """What each file looks like in all pictures, by label."""
    return {
        entry.label: Look(COLOURS[k % len(COLOURS)], MARKERS[k % len(MARKERS)], DASHES[k % len(DASHES)])
        for k, entry in enumerate(entries)
    }


def draw(
    found: Comparison,
    out: Path,
    kinds: Sequence[str] = KINDS,
    prefix: str = "",
    styles: Mapping[str, Look] | None = None,
) -> list[Picture]:
    """Draw pictures into a folder, each as PNG and SVG.

    Args:
        found: what was measured.
        out: folder.
        kinds: of `KINDS`, those to draw.
        prefix: of the files' names.
        styles: what files look like, by label; default `looks` of those compared.

    Raises:
        UsageError: matplotlib is missing, or a picture cannot be written.
    """
    plt = pyplot()
    everything = points(found.records, found.clock)
    draws = dict(zip(KINDS, (_work_precision, _history, _cost), strict=True))
    pictures = []
    with plt.rc_context(SETTINGS):
        for case in found.cases:
            mine = [p for p in everything if p.scene == case.label]
            if not mine:
                continue
            for kind in kinds:
                picture = draws[kind](
                    found, case, mine, styles or looks(found.entries), out / f"{prefix}{kind}_{case.label}"
                )
                if picture is not None:
                    pictures.append(picture)
    return pictures


def _save(figure: Any, path: Path) -> tuple[Path, Path]:
    paths = path.parent / f"{path.name}.png", path.parent / f"{path.name}.svg"
    try:
        for target in paths:
            figure.savefig(target, dpi=DPI, metadata={"Date": None} if target.suffix == ".svg" else None)
    except OSError as e:
        raise UsageError(f"{target}: cannot be drawn: {e}") from e
    finally:
        pyplot().close(figure)
    return paths


def _legend(figure: Any, handles: dict[str, Any], width: float) -> None:
    """One legend below all panels, in as many columns as fit."""
    longest = max(map(len, handles))
    columns = max(1, min(len(handles), int(width / (0.75 + 0.072 * longest))))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=columns, handlelength=3.2)


def _work_precision(
    found: Comparison, case: Case, mine: Sequence[Point], styles: Mapping[str, Look], path: Path
) -> Picture:
    """Error against seconds, set-up included and excluded, a row for each number of ranks."""
    plt = pyplot()
    width = 9.2
    figure, grid = plt.subplots(
        len(found.ranks),
        2,
        figsize=(width, 3.4 * len(found.ranks) + 0.7),
        squeeze=False,
        sharey=True,
        layout="constrained",
    )
    handles: dict[str, Any] = {}
    for row, ranks in zip(grid, found.ranks, strict=True):
        for axes, (title, what) in zip(row, (("set-up and solve", "total"), ("solve alone", "solve")), strict=True):
            axes.set(xscale="log", yscale="log", xlabel=f"seconds ({CLOCKS[found.clock]})")
            axes.set_title(f"{title}, {rank_words(ranks)}", loc="left")
            for label, look in styles.items():
                curve = sorted((p for p in mine if p.file == label and p.ranks == ranks), key=lambda p: -p.rtol)
                if curve:
                    handles[label] = _curve(axes, curve, what, look)
            _limit(axes, [getattr(p, what) for p in mine if p.ranks == ranks])
            _pad(axes)
        row[0].set_ylabel("forward error, all fields (1)")
    _legend(figure, handles, width)
    png, svg = _save(figure, path)
    return Picture(
        "work_precision",
        case.label,
        png,
        svg,
        f"Error against seconds: {case.label}",
        "Down and to the left is better. A curve is one options file, a point of it one tolerance, from "
        f"{found.rtols[0]:.0e} above to {found.rtols[-1]:.0e} below; bars are quartiles over {found.repeat} rounds. "
        "Hollow points missed their tolerance in some round. Direct solvers are large points without a line.",
    )


def _curve(axes: Any, curve: Sequence[Point], what: str, look: Look) -> Any:
    """One file's points, with quartiles; what stands for it in the legend."""
    direct = all(p.direct for p in curve)
    if direct:  # tolerances that are met by the same iterate are one point
        curve = list({p.error: p for p in curve}.values())
    spreads: list[Spread] = [getattr(p, what) for p in curve]
    x = np.array([s.median for s in spreads])
    y = np.array([max(p.error, 1e-17) for p in curve])
    bars = np.abs([[s.median - s.low for s in spreads], [s.high - s.median for s in spreads]])
    axes.errorbar(x, y, xerr=bars, fmt="none", ecolor=look.colour, elinewidth=0.8, alpha=0.5, capsize=1.5)
    line = axes.plot(
        x,
        y,
        color=look.colour,
        marker=look.marker,
        linestyle="none" if direct else look.dashes,
        markersize=9 if direct else 5,
        markeredgecolor="white" if direct else look.colour,
        markeredgewidth=0.6,
        linewidth=1.5,
        zorder=3,
    )[0]
    missed = [k for k, p in enumerate(curve) if not p.converged]
    axes.plot(
        x[missed],
        y[missed],
        linestyle="none",
        marker=look.marker,
        markersize=line.get_markersize(),
        markerfacecolor="white",
        markeredgecolor=look.colour,
        zorder=4,
    )
    return line


def _limit(axes: Any, spreads: Sequence[Spread]) -> None:
    """Limits of the axis of seconds, which matplotlib takes too wide where there are bars."""
    if spreads:
        low, high = min(s.low for s in spreads), max(s.high for s in spreads)
        room = max((high / low) ** 0.07, 1.1)
        axes.set_xlim(low / room, high * room)


def _pad(axes: Any, between: Sequence[float] = (1, 2, 5)) -> None:
    """Room around the points, and ticks between powers of ten too where few of these are in sight."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axes.margins(0.08)
    low, high = axes.get_xlim()
    if np.log10(high / low) < 2:
        axes.xaxis.set_major_locator(LogLocator(subs=between))
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_minor_formatter(NullFormatter())


def _history(
    found: Comparison, case: Case, mine: Sequence[Point], styles: Mapping[str, Look], path: Path
) -> Picture | None:
    """Error and residual over time, of all fields and of each, on the least number of ranks."""
    plt = pyplot()
    records = [r for r in found.records if r["scene"] == case.label and r["history"]]
    if not records:
        return None
    ranks = min(r["ranks"] for r in records)
    panels = ["all fields", *case.sizes]
    columns = min(len(panels), HISTORY_COLUMNS)
    rows = -(-len(panels) // columns)
    width = 3.0 * columns + 0.4
    figure, grid = plt.subplots(
        2 * rows, columns, figsize=(width, 4.4 * rows + 0.8), squeeze=False, sharex=True, layout="constrained"
    )
    halves = {"forward_error": grid[:rows].ravel(), "residual": grid[rows:].ravel()}
    handles: dict[str, Any] = {}
    for what, half in halves.items():
        for axes, name in zip(half, panels, strict=False):
            axes.sharey(half[0])
            axes.set(xscale="log", yscale="log")
            axes.set_title(name, loc="left")
            for record in records:
                history, look = record["history"], styles[record["file"]]
                values = history.get(what) if name == "all fields" else history.get(HISTORIES[what], {}).get(name)
                if record["ranks"] == ranks and values is not None and len(values) > 1:
                    seconds = history["seconds" if found.clock == "wall" else "cpu_seconds"]
                    handles[record["file"]] = _trace(axes, seconds, values, look)
            _pad(axes, (1, 3))
            axes.tick_params(labelbottom=True)
        for axes in half[len(panels) :]:
            axes.remove()
    for row in range(rows):
        grid[row, 0].set_ylabel("forward error (1)")
        grid[rows + row, 0].set_ylabel("true residual / |b| (1)")
    for axes in figure.axes:
        axes.set_xlabel("seconds in solve" if found.clock == "wall" else "processor seconds in solve")
    _legend(figure, handles, width)
    png, svg = _save(figure, path)
    return Picture(
        "history",
        case.label,
        png,
        svg,
        f"Convergence by field: {case.label}, {rank_words(ranks)}",
        "Each field's error in its own norm, relative to the reference, and its part of the true residual, over the "
        f"seconds since the solve began, for the tolerance {min(r['rtol'] for r in records):.0e}, from the first "
        "iteration on. Where a residual falls and an error does not, the tolerance on the residual promises too much.",
    )


MOST_ITERATIONS = 150
"""Of a history that are drawn, ever sparser."""
HISTORY_COLUMNS = 3
HISTORIES = {"forward_error": "error_by_field", "residual": "residual_by_field"}


def _trace(axes: Any, seconds: Sequence[float], values: Sequence[float], look: Look) -> Any:
    """One line of a history, from the first iteration on, of long ones a part; zeros are left out."""
    shown = np.unique(np.geomspace(1, len(values) - 1, MOST_ITERATIONS).round().astype(int))
    x, y = np.array(seconds)[shown], np.array(values)[shown]
    return axes.plot(
        x,
        np.where(y > 0, y, np.nan),
        color=look.colour,
        linestyle=look.dashes,
        linewidth=1.2,
        marker=look.marker,
        markersize=3,
        markevery=max(1, x.size // 12),
    )[0]


def _cost(found: Comparison, case: Case, mine: Sequence[Point], styles: Mapping[str, Look], path: Path) -> Picture:
    """Time by phase and memory of each file and number of ranks, for a tolerance in the middle."""
    plt = pyplot()
    rtols = sorted({p.rtol for p in mine}, reverse=True)
    rtol = rtols[len(rtols) // 2]
    bars = [
        (entry.label, ranks, point)
        for entry in found.entries
        for ranks in found.ranks
        for point in mine
        if (point.file, point.ranks, point.rtol) == (entry.label, ranks, rtol)
    ]
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(9.2, 0.34 * max(len(bars), 2) + 1.4), sharey=True, layout="constrained", width_ratios=(3, 2)
    )
    at = np.arange(len(bars))
    start = np.zeros(len(bars))
    for name, colour, hatch in PHASES:
        widths = np.array([getattr(point, name.replace("-", "")).median for *_, point in bars])
        left.barh(at, widths, 0.7, left=start, color=colour, hatch=hatch, edgecolor="white", linewidth=0.4, label=name)
        start = start + widths
    low, high = (np.array([getattr(point.total, q) for *_, point in bars]) for q in ("low", "high"))
    read = np.array([point.read.median for *_, point in bars])
    middle = np.array([point.total.median for *_, point in bars])
    spread = np.abs([middle - low, high - middle])
    left.errorbar(read + middle, at, xerr=spread, fmt="none", ecolor="black", elinewidth=0.9, capsize=2)
    for y, end in zip(at, read + high, strict=True):
        left.annotate(
            f"{start[y]:.3g} s", (max(end, start[y]), y), (4, 0), textcoords="offset points", va="center", fontsize=8
        )
    left.set_xlim(0, 1.15 * max((read + high).max(initial=0.0), start.max(initial=0.0)) or 1.0)
    left.set_yticks(at, [f"{label}, {rank_words(ranks)}" for label, ranks, _ in bars])
    left.set_ylim(len(bars) - 0.5, -0.5)
    left.set_xlabel(f"seconds ({CLOCKS[found.clock]}), tolerance {rtol:.0e}")
    left.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    left.grid(axis="y", visible=False)

    for y, (label, ranks, _) in zip(at, bars, strict=True):
        peak, base = memory(found.records, case.label, label, ranks)
        right.barh(y, max(base), 0.7, color="#BBBBBB", edgecolor="white", linewidth=0.4, label="scene and libraries")
        right.barh(
            y,
            max(peak) - max(base),
            0.7,
            left=max(base),
            color="#009E73",
            hatch="//",
            edgecolor="white",
            linewidth=0.4,
            label="solver",
        )
        right.annotate(
            f"{max(peak):.0f} MB", (max(peak), y), (4, 0), textcoords="offset points", va="center", fontsize=8
        )
    right.margins(x=0.22)
    right.set_xlim(left=0)
    right.set_xlabel("peak memory of the largest rank (MB)")
    handles, labels = right.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    right.legend(unique.values(), unique.keys(), loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    right.grid(axis="y", visible=False)
    png, svg = _save(figure, path)
    return Picture(
        "cost",
        case.label,
        png,
        svg,
        f"Time by phase, and memory: {case.label}",
        f"Medians over {found.repeat} rounds, with the quartiles of set-up and solve. Memory is the peak of the "
        "process, libraries and scene included, on the rank that has most.",
    )


def memory(records: Sequence[Record], scene: str, file: str, ranks: int) -> tuple[list[float], list[float]]:
    """Peak and base of each rank in MB, medians over rounds."""
    runs = [r for r in records if (r["scene"], r["file"], r["ranks"]) == (scene, file, ranks) and r["peak_rss"]]
    peak, base = ((np.median([r[what] for r in runs], axis=0) / 1e6).tolist() for what in ("peak_rss", "base_rss"))
    return peak, base


def rank_words(ranks: int) -> str:
    """For example "2 ranks"."""
    return f"{ranks} rank{'s' if ranks > 1 else ''}"
