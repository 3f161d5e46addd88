"""Pictures of scenes, runs and measurements: the one module that draws.

The suffix of a path chooses the format. Each raises a UsageError where matplotlib is missing or the picture cannot be
written.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs.errors import UsageError
from petsc_fs.fields import FIELD, FLUXES, POTENTIALS
from petsc_fs.scene import CONTACT_STATES, Floats, Integers, Scene, singular_diagonal_blocks


def pyplot() -> Any:
    """Matplotlib's pyplot, drawing into files.

    Raises:
        UsageError: it is missing.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError as e:
        raise UsageError(f"pictures need matplotlib ({e}); pip install 'petsc_fs[plot]'") from e
    return plt


def plot_blocks(scene: Scene, path: str | os.PathLike[str]) -> Path:
    """Draw the block structure of a whole Jacobian, and above it what each level eliminates, as the paper does.

    Above, one small grid per stage, with the paper's numbers of the fields; the legend says what shades and `S` mean.
    Below, the entries of the Jacobian itself.
    """
    plt = pyplot()
    from matplotlib.patches import Patch

    names, n, steps = scene.fields, len(scene.fields), stages(scene)
    numbers = [FIELD[name].index for name in names]
    figure = plt.figure(figsize=(max(1.2 * n + 1.8, 6.4), 1.2 * n + 4.0), layout="constrained")
    grid = figure.add_gridspec(2, len(steps), height_ratios=(1.4, max(n, 2)))
    for k, (title, shades) in enumerate(steps):
        small = figure.add_subplot(grid[0, k])
        _draw_shades(small, names, shades, 0.6)
        for (r, c), shade in shades.items():
            if shade == "singular":
                small.text(names.index(c) + 0.5, names.index(r) + 0.55, "S", ha="center", va="center")
        small.set_xticks(np.arange(n) + 0.5, numbers)
        small.set_yticks(np.arange(n) + 0.5, numbers)
        small.tick_params(length=0, pad=1)
        small.set_title(title, fontsize=11)
    axes = figure.add_subplot(grid[1, :])
    full = {rc: block for rc, block in scene.blocks.items() if block.data.size}
    _draw_shades(axes, names, dict.fromkeys(full, "original"), 0.8)
    for (r, c), block in full.items():
        i, j = names.index(r), names.index(c)
        rows = np.repeat(np.arange(scene.sizes[r]), np.diff(block.indptr))
        x = j + 0.04 + 0.92 * (block.indices + 0.5) / scene.sizes[c]
        y = i + 0.04 + 0.92 * (rows + 0.5) / scene.sizes[r]
        axes.plot(x, y, ",", color="#1f4e79", rasterized=True)
        box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
        label = f"$J_{{{FIELD[r].index}{FIELD[c].index}}}$"
        axes.text(j + 0.5, i + 0.5, label, ha="center", va="center", fontsize=13, bbox=box)
    labels = [f"{number} {name}" for number, name in zip(numbers, names, strict=True)]
    axes.set_xticks(np.arange(n) + 0.5, [f"{f}\n{scene.sizes[f]:,}" for f in names], fontsize=11)
    axes.set_yticks(np.arange(n) + 0.5, labels, fontsize=11)
    axes.tick_params(length=0)
    axes.xaxis.tick_top()
    axes.set_xlabel("rows are equations, columns unknowns, with their number above", fontsize=11)
    words = {"white": "empty", SHADES["original"]: "block of $J$", SHADES["changed"]: "block that the step changes"}
    handles = [Patch(facecolor=colour, edgecolor="#444444", label=text) for colour, text in words.items()]
    handles += [plt.Line2D([], [], ls="", marker=r"$\mathrm{S}$", markersize=9, color="black", label="singular block")]
    handles += [plt.Line2D([], [], ls="", marker=".", color="#1f4e79", label="entry of $J$")]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False, fontsize=11)
    figure.suptitle(f"{scene.metadata.model or 'scene'}: {sum(scene.sizes.values()):,} unknowns", fontsize=12)
    return _save(figure, Path(path))


SHADES = {"original": "#dfe5ec", "singular": "#dfe5ec", "changed": "#7f93a8"}


def _draw_shades(axes: Any, names: Sequence[str], shades: Mapping[tuple[str, str], str], width: float) -> None:
    """A grid of blocks, first row on top."""
    n = len(names)
    axes.set(xlim=(0, n), ylim=(n, 0), aspect="equal")
    for k in range(1, n):
        axes.axhline(k, color="#bbbbbb", lw=0.4, zorder=0)
        axes.axvline(k, color="#bbbbbb", lw=0.4, zorder=0)
    for (r, c), shade in shades.items():
        place = (names.index(c), names.index(r))
        axes.add_patch(pyplot().Rectangle(place, 1, 1, facecolor=SHADES[shade], edgecolor="#444444", lw=width))


def _save(figure: Any, target: Path) -> Path:
    """Write a picture, and forget it."""
    try:
        figure.savefig(target, dpi=120)
    except (OSError, ValueError) as e:
        target.unlink(missing_ok=True)
        raise UsageError(f"{target}: cannot be drawn: {e}") from e
    finally:
        pyplot().close(figure)
    return target


def stages(scene: Scene) -> list[tuple[str, dict[tuple[str, str], str]]]:
    """What is left after each level of the solver: title, and a shade for each block that is not empty."""
    original = {rc: "original" for rc, b in scene.blocks.items() if b.data.size}
    steps = []
    shades = dict(original)
    if "contact" in scene.sizes:
        singular = singular_diagonal_blocks(scene.blocks["contact", "contact"], scene.dimension)
        shades["contact", "contact"] = "singular" if singular else "original"
    steps.append(("$J$", shades))
    if {"contact", "intf_force"} <= set(scene.sizes):
        column = [r for r in scene.fields if (r, "intf_force") in original]
        transformed = original | {(r, "contact"): "changed" for r in column}
        steps.append(("$J Q_r$", transformed))
        original = {(r, c): v for (r, c), v in original.items() if "contact" not in (r, c)}
        original |= {(r, "intf_force"): "changed" for r in column if r != "contact"}
        steps.append(("$S^1$", original))
    if "mass" in scene.sizes and "momentum" in scene.sizes:
        original = {rc: v for rc, v in original.items() if not {"momentum", "intf_force"} & set(rc)}
        original |= {("mass", "mass"): "changed"}
        steps.append(("$S^2$", original))
    if any(f in scene.sizes for f in FLUXES):
        left = [f for f in POTENTIALS if f in scene.sizes]
        steps.append(("$S^3$", dict.fromkeys(product(left, left), "changed")))
    return steps


STATES = {
    "sticking": ("#0072B2", "-", "o"),
    "sliding": ("#E69F00", "--", "s"),
    "open": ("#009E73", ":", "^"),
}
"""Colour, line and marker of each of `CONTACT_STATES`; the colours are Okabe and Ito's, told apart by everyone."""

TIME_UNITS = {"weeks": 604800.0, "days": 86400.0, "h": 3600.0, "min": 60.0, "s": 1.0}
"""Units of time with their length in seconds, the longest first."""


def plot_contact_states(
    records: Sequence[Mapping[str, Any]],
    path: str | os.PathLike[str],
    *,
    title: str = "",
    cells: tuple[Floats, Integers] | None = None,
) -> Path:
    """Draw the number of sticking, sliding and open fracture cells over the Newton steps of a run, as the paper does.

    Shaded and white backgrounds tell the time steps apart; the axis above says when they end. Below, the iterations of
    each linear solve, and, if they are known, the fracture cells in their places.

    Args:
        records: one per Newton step, with `time_step`, `time` in s, `iterations`, and `contact_states`, name to number
            of cells.
        path: of the picture.
        title: above the picture.
        cells: centres (n, 3) of the fracture cells in m, and their states as in `Scene.contact_state`.

    Raises:
        UsageError: see above; or no record has contact states.
    """
    plt = pyplot()
    shown = [record for record in records if record["contact_states"]]
    if not shown:
        raise UsageError(f"{path}: no contact states to draw")
    heights = (3.0, 1.4) if cells is None else (3.0, 1.4, 3.4)
    figure = plt.figure(figsize=(6.4, 1.4 + sum(heights)), layout="constrained")
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    axes = figure.add_subplot(grid[0])
    below = figure.add_subplot(grid[1], sharex=axes)
    if cells is not None:
        _draw_cells(figure, grid[2], *cells)
    steps = np.arange(1, len(shown) + 1)
    for state, (color, line, marker) in STATES.items():
        counts = [record["contact_states"].get(state, 0) for record in shown]
        style = {"color": color, "marker": marker, "markersize": 4, "lw": 1.6, "clip_on": False}
        axes.plot(steps, counts, line, label=state, **style)
    below.plot(steps, [record["iterations"] for record in shown], ".-", color="black", lw=1)
    # A time step that is tried again with a shorter length counts as one more.
    attempts = [(record["time_step"], record["time"]) for record in shown]
    starts = [i for i, attempt in enumerate(attempts) if i == 0 or attempt != attempts[i - 1]]
    ends = [*starts[1:], len(shown)]
    for start, end in list(zip(starts, ends, strict=True))[::2]:
        for each in (axes, below):
            each.axvspan(start + 0.5, end + 0.5, color="#e4e4e4", lw=0, zorder=0)
    axes.set(xlim=(0.5, len(shown) + 0.5), ylim=(0, 1.05 * max(sum(r["contact_states"].values()) for r in shown)))
    below.set_ylim(bottom=0)
    axes.tick_params(labelbottom=False)
    for axis in (axes.xaxis, axes.yaxis, below.yaxis):
        axis.get_major_locator().set_params(integer=True)
    axes.set_ylabel("fracture cells")
    below.set(xlabel="Newton steps from the start", ylabel="iterations")
    times = [shown[start]["time"] for start in starts]
    unit = next(name for name, length in TIME_UNITS.items() if times[-1] >= length or length == 1.0)
    above = axes.secondary_xaxis("top")
    every = -(-len(starts) // 12)
    middles = [(start + end + 1) / 2 for start, end in zip(starts, ends, strict=True)]
    above.set_xticks(middles[::every], [f"{t / TIME_UNITS[unit]:.3g}" for t in times[::every]])
    above.tick_params(length=0)
    above.set_xlabel(f"end of the time step ({unit})" + (f" – {title}" if title else ""))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=len(STATES), frameon=False)
    return _save(figure, Path(path))


def _draw_cells(figure: Any, place: Any, centers: Floats, states: Integers) -> None:
    """Fracture cells in their places, by contact state; in 2D seen from above."""
    flat = np.ptp(centers[:, 2]) <= 1e-9 * np.ptp(centers)  # but for rounding
    axes = figure.add_subplot(place, projection=None if flat else "3d")
    for number, state in enumerate(CONTACT_STATES):
        color, _, marker = STATES[state]
        at = centers[states == number].T / 1000
        axes.scatter(*(at[:2] if flat else at), color=color, marker=marker, s=20)
    axes.set(aspect="equal", xlabel="x (km)", ylabel="y (km)")
    axes.set_title("at the last Newton step", fontsize=10)
    if not flat:
        axes.set_zlabel("z (km)")
        axes.locator_params(nbins=4)
        axes.set_box_aspect(axes.get_box_aspect(), zoom=0.95)  # room for it


COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's palette, which people with colour blindness can tell apart."""
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5)), (0, (3, 1)))
OUTCOME_COLOURS = {"right": "#0072B2", "refusal": "#F0E442", "wrong": "#D55E00", "hang": "#CC79A7", "crash": "#000000"}
MARKS = {"refusal": "", "wrong": " ×", "hang": " ∞", "crash": " !"}
"""What stands behind the number in a field of the matrix, for whom colours are not enough."""


def look(number: int) -> dict[str, Any]:
    """Colour, marker and dashes of a curve, which together tell 280 of them apart."""
    colour, marker, dashes = (c[number % len(c)] for c in (COLOURS, MARKERS, DASHES))
    return {"color": colour, "marker": marker, "linestyle": dashes, "markersize": 5, "linewidth": 1.5}


def plot_work_precision(
    curves: Mapping[str, Mapping[str, Sequence[tuple[float, float]]]],
    path: str | os.PathLike[str],
    title: str,
    seconds: str,
) -> Path:
    """Draw error against seconds, a panel each for what counts as seconds, one above the other.

    Args:
        curves: title of a panel to label to points, seconds and error.
        path: of the picture.
        title: above it.
        seconds: what they are, for the axes.
    """
    plt = pyplot()
    labels = list(dict.fromkeys(label for panel in curves.values() for label in panel))
    columns = max(1, min(len(labels), int(60 / max(map(len, labels), default=1))))
    size = (6.4, 3.6 * len(curves) + 0.25 * -(-len(labels) // columns))
    figure, panels = plt.subplots(len(curves), 1, figsize=size, sharex=True, squeeze=False, layout="constrained")
    for axes, (heading, panel) in zip(panels[:, 0], curves.items(), strict=True):
        for label, points in panel.items():
            x, y = zip(*points, strict=True)
            axes.plot(x, np.maximum(y, 1e-17), label=label, **look(labels.index(label)))
        axes.set(xscale="log", yscale="log", ylabel="forward error, all fields")
        axes.set_title(heading, loc="left", fontsize=11)
        axes.grid(color="#DDDDDD")
    panels[-1, 0].set_xlabel(f"seconds ({seconds})")
    _plain(panels[-1, 0].xaxis)
    figure.suptitle(title, fontsize=12)
    handles, names = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False)
    return _save(figure, Path(path))


def _plain(axis: Any) -> None:
    """Give a logarithmic axis plain numbers, 1, 2 and 5 of each decade where there are few."""
    from matplotlib.ticker import LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 1e3 * low else (1,)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def plot_matrix(
    cases: Sequence[Mapping[str, Any]], findings: Sequence[Mapping[str, Any]], outcomes: Sequence[str], path: Path
) -> Path:
    """Draw outcomes: a row for each options file, a column for each group of cases.

    A field has the colour of the worst outcome, and the number of cases that end so on some number of ranks.
    """
    plt = pyplot()
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    group_of = {case["name"]: case["group"] for case in cases}
    groups, files = list(dict.fromkeys(group_of.values())), list(dict.fromkeys(f["file"] for f in findings))
    fields: dict[tuple[int, int], dict[str, int]] = {}  # to the worst outcome of each case
    for f in findings:
        worst = fields.setdefault((files.index(f["file"]), groups.index(group_of[f["case"]])), {})
        worst[f["case"]] = max(worst.get(f["case"], 0), outcomes.index(f["outcome"]))
    grid = np.full((len(files), len(groups)), np.nan)
    figure, axes = plt.subplots(figsize=(6, 2.2 + 0.2 * len(files)), layout="constrained")
    for (i, j), worst in fields.items():
        grid[i, j] = number = max(worst.values())
        name, count = outcomes[number], list(worst.values()).count(number)
        text = f"{count}{MARKS[name]}" if name in MARKS else ""
        colour = "black" if name == "refusal" else "white"
        axes.text(j, i, text, ha="center", va="center_baseline", fontsize=9, color=colour)
    shades = ListedColormap([OUTCOME_COLOURS[name] for name in outcomes])
    axes.imshow(grid, cmap=shades, vmin=-0.5, vmax=len(outcomes) - 0.5, aspect="auto", interpolation="none")
    axes.set_yticks(range(len(files)), [file.removesuffix(".opts") for file in files], fontsize=9)
    sizes = [f"{group}, {list(group_of.values()).count(group)}" for group in groups]
    axes.set_xticks(range(len(groups)), sizes, rotation=35, ha="left", rotation_mode="anchor", fontsize=9)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.set_xlabel("what makes cases hard, and their number", fontsize=9)
    axes.xaxis.set_label_position("top")
    axes.set_xticks(np.arange(1, len(groups)) - 0.5, minor=True)
    axes.set_yticks(np.arange(1, len(files)) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1)
    ends = {"right": "all right", "refusal": "so many refused"}
    shown = [name for k, name in enumerate(outcomes) if name in ends or (grid == k).any()]
    handles = [Patch(facecolor=OUTCOME_COLOURS[n], label=ends.get(n, f"so many: {n}{MARKS.get(n)}")) for n in shown]
    handles.append(Patch(facecolor="white", edgecolor="grey", label="not for these fields"))
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize=9, frameon=False)
    return _save(figure, path)


def plot_front(
    groups: Mapping[str, Sequence[tuple[float, float]]], names: tuple[str, str], title: str, path: Path
) -> Path:
    """Draw trials of a sweep by two ratios to the base file.

    Args:
        groups: what they are called in the legend, to their ratios.
        names: what the ratios are of.
        title: above the picture.
        path: of it.
    """
    figure, axes = pyplot().subplots(figsize=(6.4, 5.2), layout="constrained")
    for k, (name, points) in enumerate(groups.items()):
        style = look(k) | {"linestyle": "none", "markersize": 4 + 3 * k, "alpha": 0.8}
        axes.plot(*np.reshape(points, (-1, 2)).T, label=f"{name} ({len(points)})", **style)
    both = zip(*(point for points in groups.values() for point in points), strict=True)
    for axis, name, values in zip("xy", names, both, strict=True):
        axes.set(**{f"{axis}label": f"{name} / {name} of the base file"})
        if max(values) > 10 * min(values):
            axes.set(**{f"{axis}scale": "log"})
            _plain(getattr(axes, f"{axis}axis"))
    axes.set_title(title, fontsize=11)
    axes.grid(color="#DDDDDD")
    axes.legend()
    return _save(figure, path)
