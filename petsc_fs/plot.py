"""Pictures; the only module that imports matplotlib."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs.errors import UsageError
from petsc_fs.fields import FIELD
from petsc_fs.scene import Scene, singular_diagonal_blocks


def _pyplot() -> Any:
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError as e:
        raise UsageError(f"plots need matplotlib ({e}); pip install 'petsc_fs[plot]'") from e
    return plt


def plot_blocks(scene: Scene, path: str | os.PathLike[str]) -> Path:
    """Draw the block structure of the Jacobian, and above it what each level eliminates, as the paper does.

    Above, one small grid per stage: white blocks are empty, light ones those of the Jacobian, dark ones
    changed by the transformation or by a Schur complement, `S` a singular diagonal block. Below, the
    entries of the Jacobian itself.

    Args:
        scene: with all rows.
        path: of the picture; its suffix chooses the format.

    Raises:
        UsageError: matplotlib is missing or does not know the format.
    """
    plt = _pyplot()
    names = scene.fields
    n = len(names)
    steps = stages(scene)
    figure = plt.figure(figsize=(max(1.5 * n + 1.8, 2.0 * len(steps)), 1.5 * n + 3.4), layout="constrained")
    grid = figure.add_gridspec(2, len(steps), height_ratios=(1, 4))
    for k, (title, shades) in enumerate(steps):
        small = figure.add_subplot(grid[0, k])
        for (r, c), shade in shades.items():
            i, j = names.index(r), names.index(c)
            small.add_patch(plt.Rectangle((j, i), 1, 1, facecolor=SHADES[shade], edgecolor="#444444", lw=0.6))
            if shade == "singular":
                small.text(j + 0.5, i + 0.5, "S", ha="center", va="center", fontsize=8)
        _frame(small, n)
        small.set_xticks([])
        small.set_yticks([])
        small.set_title(title, fontsize=9)
    axes = figure.add_subplot(grid[1, :])
    for (r, c), block in scene.blocks.items():
        if not block.data.size:
            continue
        i, j = names.index(r), names.index(c)
        axes.add_patch(plt.Rectangle((j, i), 1, 1, facecolor=SHADES["original"], edgecolor="#444444", lw=0.8))
        rows = np.repeat(np.arange(scene.sizes[r]), np.diff(block.indptr))
        x = j + 0.04 + 0.92 * (block.indices + 0.5) / scene.sizes[c]
        y = i + 0.04 + 0.92 * (rows + 0.5) / scene.sizes[r]
        axes.plot(x, y, ",", color="#1f4e79", rasterized=True)
        box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
        label = f"$J_{{{FIELD[r].index}{FIELD[c].index}}}$"
        axes.text(j + 0.5, i + 0.5, label, ha="center", va="center", fontsize=11, bbox=box)
    _frame(axes, n)
    axes.set_xticks(np.arange(n) + 0.5, [f"{f}\n{scene.sizes[f]:,}" for f in names], fontsize=9)
    axes.set_yticks(np.arange(n) + 0.5, names, fontsize=9)
    axes.tick_params(length=0)
    axes.xaxis.tick_top()
    axes.set_xlabel("unknowns (columns)")
    axes.set_ylabel("equations (rows)")
    figure.suptitle(f"{scene.metadata.model or 'scene'}: {sum(scene.sizes.values()):,} unknowns", fontsize=11)
    target = Path(path)
    try:
        figure.savefig(target, dpi=120)
    except (OSError, ValueError) as e:
        raise UsageError(f"{target}: cannot be drawn: {e}") from e
    finally:
        plt.close(figure)
    return target


SHADES = {"original": "#dfe5ec", "singular": "#dfe5ec", "changed": "#7f93a8"}


def _frame(axes: Any, n: int) -> None:
    """Axes of an n by n grid of blocks, first row on top."""
    axes.set_xlim(0, n)
    axes.set_ylim(n, 0)
    axes.set_aspect("equal")
    for k in range(1, n):
        axes.axhline(k, color="#bbbbbb", lw=0.4, zorder=0)
        axes.axvline(k, color="#bbbbbb", lw=0.4, zorder=0)


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
    if "intf_flow" in scene.sizes:
        steps.append(("$S^3$", {("mass", "mass"): "changed"}))
    return steps
