"""Pictures; the only module that imports matplotlib."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs.errors import UsageError
from petsc_fs.fields import FIELD
from petsc_fs.scene import CSR, Scene


def _pyplot() -> Any:
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError as e:
        raise UsageError(f"plots need matplotlib ({e}); pip install 'petsc_fs[plot]'") from e
    return plt


def plot_blocks(scene: Scene, path: str | os.PathLike[str]) -> Path:
    """Draw which blocks of the Jacobian are empty, invertible or singular, as in the paper's figure.

    Each cell of the grid is one block, shaded where it has entries; within it, the pattern of the
    entries. `S` marks a diagonal block that is singular (contact where a fracture sticks).

    Args:
        scene: with all rows.
        path: of the picture; its suffix chooses the format.

    Raises:
        UsageError: matplotlib is missing or does not know the format.
    """
    plt = _pyplot()
    names = scene.fields
    n = len(names)
    figure, axes = plt.subplots(figsize=(1.5 * n + 1.8, 1.5 * n + 1.0), layout="constrained")
    for i, r in enumerate(names):
        for j, c in enumerate(names):
            block = scene.blocks.get((r, c))
            filled = block is not None and block.data.size > 0
            axes.add_patch(
                plt.Rectangle((j, i), 1, 1, facecolor="#dfe5ec" if filled else "white", edgecolor="#444444", lw=0.8)
            )
            if block is None or not filled:
                continue
            rows = np.repeat(np.arange(scene.sizes[r]), np.diff(block.indptr))
            x = j + 0.04 + 0.92 * (block.indices + 0.5) / scene.sizes[c]
            y = i + 0.04 + 0.92 * (rows + 0.5) / scene.sizes[r]
            axes.plot(x, y, ",", color="#1f4e79", rasterized=True)
            index = f"{FIELD[r].index}{FIELD[c].index}"
            label = f"$J_{{{index}}}$" + (
                " S" if r == c == "contact" and singular_blocks(block, scene.dimension) else ""
            )
            box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
            axes.text(j + 0.5, i + 0.5, label, ha="center", va="center", fontsize=11, bbox=box)
    axes.set_xlim(0, n)
    axes.set_ylim(n, 0)
    axes.set_aspect("equal")
    axes.set_xticks(np.arange(n) + 0.5, [f"{f}\n{scene.sizes[f]:,}" for f in names], fontsize=9)
    axes.set_yticks(np.arange(n) + 0.5, names, fontsize=9)
    axes.tick_params(length=0, top=False)
    axes.xaxis.tick_top()
    axes.set_xlabel("unknowns (columns)")
    axes.set_ylabel("equations (rows)")
    title = scene.metadata.model or "scene"
    axes.set_title(f"{title}: {sum(scene.sizes.values()):,} unknowns; S: singular diagonal block", fontsize=10)
    target = Path(path)
    try:
        figure.savefig(target, dpi=150)
    except (OSError, ValueError) as e:
        raise UsageError(f"{target}: cannot be drawn: {e}") from e
    finally:
        plt.close(figure)
    return target


def singular_blocks(block: CSR, size: int) -> int:
    """Number of singular diagonal blocks of this size in a square block."""
    rows = np.repeat(np.arange(block.indptr.size - 1), np.diff(block.indptr))
    inside = rows // size == block.indices // size
    dense = np.zeros(((block.indptr.size - 1) // size, size, size))
    dense[rows[inside] // size, rows[inside] % size, block.indices[inside] % size] = block.data[inside]
    values = np.linalg.svd(dense, compute_uv=False)
    return int(np.count_nonzero(~(values[:, -1] > 1e-14 * values[:, 0])))
