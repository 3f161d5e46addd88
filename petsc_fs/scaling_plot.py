"""Picture of a strong-scaling study: seconds, iterations, memory and messages over ranks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from petsc_fs.errors import UsageError
from petsc_fs.plot import pyplot
from petsc_fs.scaling import Run, by_case, median

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, which people with colour blindness can tell apart."""

MARKERS = "osD^vP*"

Panel = tuple[str, str, bool]
PANELS: tuple[Panel, ...] = (
    ("setup_seconds", "set-up [s]", True),
    ("solve_seconds", "solve [s]", True),
    ("iterations", "iterations", False),
    ("bytes_per_unknown", "memory [bytes per unknown]", False),
    ("message_bytes", "sent in the solve [bytes]", False),
    ("reductions", "collectives in the solve", False),
)
"""Column of a `Run`, label with unit, and whether it falls with ranks ideally, which is then drawn."""


def plot(runs: Sequence[Run], target: Path) -> Path:
    """Draw medians of repetitions over ranks, one line per scene, options file and partition.

    What ideal scaling from the smallest number of ranks gives is dotted. On one rank every partition is the same.

    Args:
        runs: from `petsc_fs.scaling.measure`.
        target: of the picture; its suffix chooses the format.

    Raises:
        UsageError: matplotlib is missing or does not know the format, or no run worked.
    """
    lines = series(runs)
    if not lines:
        raise UsageError(f"{target}: no run worked, so there is nothing to draw")
    plt = pyplot()
    figure, grid = plt.subplots(2, 3, figsize=(11, 6.4), layout="constrained")
    for axes, panel in zip(grid.flat, PANELS, strict=True):
        for k, (label, at) in enumerate(lines.items()):
            _line(axes, panel, at, label, k)
        axes.set(xlabel="ranks", ylabel=panel[1], xscale="log")
        ticks = sorted({ranks for at in lines.values() for ranks in at})
        axes.set_xticks(ticks, [str(n) for n in ticks])
        axes.minorticks_off()
        axes.set_yscale("log") if panel[2] else axes.set_ylim(0, 1.1 * axes.get_ylim()[1])
        axes.grid(alpha=0.3)
    handles, labels = grid.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8)
    try:
        figure.savefig(target, dpi=150)
    except (OSError, ValueError) as e:
        raise UsageError(f"{target}: cannot be written: {e}") from e
    finally:
        plt.close(figure)
    return target


def _line(axes: Any, panel: Panel, at: dict[int, list[Run]], label: str, k: int) -> None:
    column, _, ideal = panel
    ranks = sorted(at)
    values = [median(at[n], column) for n in ranks]
    axes.plot(ranks, values, color=COLOURS[k % 7], marker=MARKERS[k % 7], label=label)
    if ideal:
        axes.plot(ranks, [values[0] * ranks[0] / n for n in ranks], ":", color=COLOURS[k % 7], lw=1)


def series(runs: Sequence[Run]) -> dict[str, dict[int, list[Run]]]:
    """Runs that worked by label of their line and ranks; those on one rank belong to the lines of all partitions."""
    worked = by_case(run for run in runs if run.outcome == "ok")
    lines: dict[str, dict[int, list[Run]]] = {}
    for scene, file, partition, ranks in worked:
        alone = ranks == 1
        if alone and any(key[:2] == (scene, file) and key[3] > 1 for key in worked):
            continue
        label = ", ".join(part for part in (Path(scene).stem, Path(file).stem, "" if alone else partition) if part)
        line = lines.setdefault(label, {})
        line[ranks] = worked[scene, file, partition, ranks]
        for (other, other_file, _, n), same in worked.items():
            if (other, other_file, n) == (scene, file, 1):
                line[1] = same
    return lines
