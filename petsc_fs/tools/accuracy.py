"""Accuracy: how far a solution is from a reference, and how well it satisfies the equations.

Each field has its own natural norm. With V the volumes of the cells that the unknowns live in,

    per cell or face of one dimension    |x|² = Σ V x² / Σ V          (the mean square)
    cells of several dimensions          the sum of the mean squares of each dimension (pressure in rock,
                                         fractures and intersections count alike, whatever the unit of length)
    integrated fluxes                    |v|² = Σ V (v/V)² = Σ v²/V   (the density of the flux)

and plain Euclidean norms where volumes are not known. Errors are relative to the norm of the reference. The error of
all fields together is the root mean square of those of the fields, so that each counts alike; fields whose reference
is zero, whose error is absolute, are left out of it.

Everything here works on whole scenes, on one rank.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import LayoutError
from petsc_fs.scene import CSR, Scene

Floats = NDArray[np.float64]
FieldArrays = Mapping[str, Floats]

FLUXES = ("intf_flow",)
"""Fields whose unknowns are integrals over their cell."""


def weights(scene: Scene) -> dict[str, Floats]:
    """Weight w of each unknown, such that the square of a field's norm is Σ w x².

    Args:
        scene: with all rows.

    Returns:
        Per field (size,).
    """
    return {f: _weights(scene, f) for f in scene.fields}


def _weights(scene: Scene, name: str) -> Floats:
    volumes = scene.cell_volumes.get(name)
    if volumes is None or not volumes.size or not (volumes > 0).all():
        return np.ones(scene.sizes[name])
    if name in FLUXES:
        per_cell = 1.0 / volumes
    else:
        dimension = scene.cell_dimension if name == "mass" else None
        groups = np.zeros(volumes.size, dtype=np.int64) if dimension is None else np.asarray(dimension)
        per_cell = volumes / np.bincount(groups, weights=volumes)[groups]
    return np.repeat(per_cell, scene.block_size(name))


@dataclass(frozen=True)
class Errors:
    """Forward errors of a solution.

    Attributes:
        total: root mean square of the relative errors of the fields.
        by_field: relative error per field; absolute where the reference is zero.
    """

    total: float
    by_field: dict[str, float]


class Ruler:
    """Measures solutions of one scene against a reference.

    Attributes:
        weights: see `weights`.
        scale: norm of the reference per field.
    """

    def __init__(self, scene: Scene, reference: FieldArrays) -> None:
        """Take the norms of the reference.

        Raises:
            LayoutError: the reference is not one for this scene.
        """
        for name, size in scene.sizes.items():
            if name not in reference or reference[name].shape != (size,):
                raise LayoutError(f"reference: {name} is not there with {size} entries; compute it anew for this scene")
        self.reference = reference
        self.weights = {f: w for f, w in weights(scene).items() if w.size}
        self.scale = {f: _norm(w, reference[f]) for f, w in self.weights.items()}

    def errors(self, solution: FieldArrays) -> Errors:
        """Forward errors of a solution, all rows of each field."""
        absolute = {f: _norm(w, solution[f] - self.reference[f]) for f, w in self.weights.items()}
        relative = {f: e / self.scale[f] for f, e in absolute.items() if self.scale[f]}
        total = float(np.sqrt(np.mean(np.square(list(relative.values()))))) if relative else 0.0
        return Errors(total, absolute | relative)


def _norm(weight: Floats, values: Floats) -> float:
    largest = _greatest(values)  # by which nothing over- or underflows when it is squared
    if not (largest > 0 and np.isfinite(largest)):
        return largest
    return largest * float(np.sqrt(np.sum(weight * (values / largest) ** 2)))


def multiply(block: CSR, x: Floats) -> Floats:
    """Product of a block with a vector, summed row by row."""
    rows = np.repeat(np.arange(block.indptr.size - 1), np.diff(block.indptr))
    found = np.bincount(rows, weights=block.data * x[block.indices], minlength=block.indptr.size - 1)
    return found.astype(np.float64)  # integers where there is no entry


def residual(scene: Scene, solution: FieldArrays) -> dict[str, Floats]:
    """The residual b - J x per field, in double precision."""
    found = {f: np.array(scene.rhs[f]) for f in scene.fields}
    for (r, c), block in scene.blocks.items():
        found[r] -= multiply(block, solution[c])
    return found


def row_magnitudes(scene: Scene, solution: FieldArrays) -> dict[str, Floats]:
    """|J| |x| + |b| per field, entry by entry: what the terms of each equation amount to before they cancel."""
    found = {f: np.abs(scene.rhs[f]) for f in scene.fields}
    for (r, c), block in scene.blocks.items():
        found[r] = found[r] + multiply(block._replace(data=np.abs(block.data)), np.abs(solution[c]))
    return found


def backward_error(
    scene: Scene, solution: FieldArrays, of: FieldArrays | None = None, magnitudes: FieldArrays | None = None
) -> dict[str, float]:
    """By how much the system must be changed for the solution to be exact, relative to the system.

    Normwise: |b - J x| / (|J| |x| + |b|) in the maximum norm (Rigal and Gaches, J. ACM 14, 1967). As fields differ in
    units this says little on any but the largest. Componentwise: max_i |b - J x|_i / (|J| |x| + |b|)_i (Oettli and
    Prager, Numer. Math. 6, 1964), which no scaling of equations or unknowns changes.

    Args:
        scene: with all rows.
        solution: all rows of each field.
        of: the residual, where it is known, maybe to better than double precision.
        magnitudes: see `row_magnitudes`, where they are known.

    Returns:
        "normwise" and "componentwise".
    """
    of, magnitudes = of or residual(scene, solution), magnitudes or row_magnitudes(scene, solution)
    rows = {f: np.zeros(n) for f, n in scene.sizes.items()}
    for (name, column), block in scene.blocks.items():
        rows[name] += multiply(block._replace(data=np.abs(block.data)), np.ones(scene.sizes[column]))
    r, b, scales, sums, x = (
        np.concatenate([values[f] for f in scene.fields]) for values in (of, scene.rhs, magnitudes, rows, solution)
    )
    ratio = np.divide(np.abs(r), scales, out=np.where(r == 0, 0.0, np.inf), where=scales > 0)
    norm = _greatest(sums) * _greatest(x) + _greatest(b)
    return {
        "normwise": _greatest(r) / norm if norm else 0.0,
        "componentwise": _greatest(ratio),
    }


def _greatest(values: Floats) -> float:
    return float(np.max(np.abs(values), initial=0.0))
