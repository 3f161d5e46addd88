"""Diagnostics of a preconditioner tree and of the blocks it divides by."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs.dm import Blocks, Problem
from petsc_fs.errors import SceneError
from petsc_fs.fields import FIELD
from petsc_fs.layout import Layout
from petsc_fs.levels import levels
from petsc_fs.scene import CONTACT_STATES, CSR, Scene, diagonal_blocks

WEAK = 1e-10
"""Strength of a diagonal block, relative to the median of its field, at which it counts as nearly singular."""
DIVIDED_BY = ("intf_force", "intf_flow")
"""Fields whose diagonal blocks the preconditioner divides by: D_22 and diag(J_44)."""
REMEDY = 1e-2
"""-petsc_fs_regularize that helps against such blocks."""
SAME_PLACE = 1e-8
"""Distance of cell centres, over the largest coordinate, at which a cell of an interface is one of a fracture."""


@dataclass(frozen=True)
class Strengths:
    """The diagonal blocks of a field on this rank, and how far each of them is from a singular one.

    Attributes:
        dense: (cells, block size, block size).
        sizes: (cells,) largest entry of the rows of each block, outside of it too.
        ratios: (cells,) least singular value of each block over its size.
        everywhere: `ratios` of all ranks, in the order of the layout.
        usual: their median.
    """

    dense: NDArray[np.float64]
    sizes: NDArray[np.float64]
    ratios: NDArray[np.float64]
    everywhere: NDArray[np.float64]
    usual: float

    @classmethod
    def of(cls, layout: Layout, blocks: Blocks, name: str) -> Strengths:
        """Those of one field. Collective."""
        bs = layout.block_size(name)
        dense = diagonal_blocks(CSR(*blocks[name, name].getDiagonalBlock().getValuesCSR()), bs)
        rows = np.zeros(len(dense) * bs)
        for (r, _), block in blocks.items():
            if r == name:
                indptr, _, values = block.getValuesCSR()
                filled = np.flatnonzero(np.diff(indptr))
                if filled.size:
                    rows[filled] = np.maximum(rows[filled], np.maximum.reduceat(np.abs(values), indptr[filled]))
        sizes = rows.reshape(-1, bs).max(axis=1)
        least = np.linalg.svd(dense, compute_uv=False)[:, -1] if len(dense) else np.zeros(0)
        ratios = np.divide(least, sizes, out=np.zeros_like(least), where=sizes > 0)
        everywhere = np.concatenate(layout.comm.allgather(ratios))
        return cls(dense, sizes, ratios, everywhere, float(np.median(everywhere)) if everywhere.size else 0.0)


@dataclass(frozen=True)
class Weak:
    """The weakest diagonal block of a field.

    Attributes:
        field: its name.
        cell: number in the scene.
        ratio: its least singular value over the largest entry of its rows, relative to the field's median.
        state: contact state of the fracture cell at the same place; "" if unknown or there is none.
    """

    field: str
    cell: int
    ratio: float
    state: str = ""

    def __str__(self) -> str:
        """One line for people."""
        return (
            f"the diagonal block of {block_name(self.field)} is nearly singular at cell {self.cell}"
            + (f" ({self.state})" if self.state else "")
            + f": {self.ratio:.1e} of what is usual"
        )


def block_name(field: str) -> str:
    """The diagonal block that the preconditioner divides by, in the terms of the paper."""
    k = FIELD[field].index
    return f"J{'~' if field == 'contact' else ''}_{k}{k} ({field})"


def weakest_entries(layout: Layout, blocks: Blocks) -> list[Weak]:
    """The weakest diagonal block of each field that is divided by, where it is nearly singular. Collective.

    Args:
        layout: distribution of rows.
        blocks: matrices by pairs of fields.
    """
    return [weak for name in DIVIDED_BY if name in layout.fields for weak in _weakest(layout, blocks, name)]


def explain_weakness(problem: Problem, scene: Scene) -> list[str]:
    """What `weakest_entries` finds, and the weakest block of J~_11, each in a line with the contact state. Collective.

    Args:
        problem: with the blocks of the matrix.
        scene: the rows of this rank, with what is known of cells.
    """
    layout, blocks = problem.layout, problem.blocks
    found = weakest_entries(layout, blocks)
    transformed = transformed_contact_block(problem)
    if transformed is not None:
        found += _weakest(layout, {("contact", "contact"): transformed}, "contact")
        transformed.destroy()
    lines = []
    for weak in found:
        cell = int(layout.places(weak.field)[weak.cell])
        named = replace(weak, state=contact_state(layout, scene, weak.field, cell))
        lines.append(f"{named}; -petsc_fs_regularize {REMEDY:g} has the preconditioner do without it")
    return lines


def _weakest(layout: Layout, blocks: Blocks, name: str) -> Iterator[Weak]:
    strengths = Strengths.of(layout, blocks, name)
    ratios = strengths.everywhere
    if strengths.usual and ratios.min() <= WEAK * strengths.usual:
        cell = int(ratios.argmin())
        yield Weak(name, layout.scene_cell(name, cell), float(ratios[cell] / strengths.usual))


def transformed_contact_block(problem: Problem) -> PETSc.Mat | None:
    """J~_11 = J_11 - J_12 D_22^-1 J_21 as a new matrix; None if the scene has none, or D_22 is singular. Collective."""
    J = problem.blocks
    if not {("contact", "intf_force"), ("intf_force", "contact")} <= set(J):
        return None
    from petsc_fs.pc.contact_transform import add_product, block_diagonal_inverse  # only what a scene needs is loaded

    try:
        inverse = block_diagonal_inverse(J["intf_force", "intf_force"], "D_22, block of intf_force", problem)
    except SceneError:
        return None
    transform = inverse.matMult(J["intf_force", "contact"])
    transform.scale(-1.0)
    product = add_product(J["contact", "contact"], J["contact", "intf_force"], transform)
    for matrix in (inverse, transform):
        matrix.destroy()
    return product


def contact_state(layout: Layout, scene: Scene, name: str, cell: int) -> str:
    """Contact state of the fracture cell where a cell of a field is; "" if unknown or not at a fracture. Collective.

    Args:
        layout: distribution of cells.
        scene: the rows of this rank.
        name: of the field.
        cell: number in the layout.
    """
    bounds = layout.offsets[name][1:] // layout.block_size(name)
    owner = int(np.searchsorted(bounds, cell, side="right"))
    first = int(bounds[owner - 1]) if owner else 0
    own = scene.cell_centers.get(name)
    place = layout.comm.bcast(own[cell - first] if layout.comm.rank == owner and own is not None else None, root=owner)
    centers, states = scene.cell_centers.get("contact"), scene.contact_state
    found = -1
    if place is not None and centers is not None and states is not None and len(centers):
        near = np.abs(centers - place).max(axis=1) <= SAME_PLACE * np.abs(centers).max()
        found = int(np.asarray(states)[near.argmax()]) if near.any() else -1
    found = layout.comm.allreduce(found, MPI.MAX)
    return CONTACT_STATES[found] if found >= 0 else ""


def broken_level(pc: PETSc.PC) -> str:
    """The innermost level of a set-up tree that turns ones into numbers that are not finite; "" if there is none.

    Collective.
    """
    for part in reversed(list(levels(pc))):
        matrix = part.getOperators()[1]
        x, y = matrix.createVecs()
        x.set(1.0)
        y.set(0.0)
        try:
            part.apply(x, y)
            finite = bool(np.isfinite(y.norm()))
            what = "turns ones into numbers that are not finite"
        except PETSc.Error as e:
            finite, what = False, f"fails (error {e.ierr})"
        reason = part.getFailedReason() if hasattr(part, "getFailedReason") else 0
        for v in (x, y):
            v.destroy()
        if reason or not finite:
            kind, prefix = part.getType(), f"-{part.getOptionsPrefix() or ''}"
            hint = f"; if it is MUMPS, raise {prefix}mat_mumps_icntl_14" if kind in ("lu", "cholesky") else ""
            return f"level {prefix} ({kind}) {what if not finite else 'broke down'}{hint}"
    return ""
