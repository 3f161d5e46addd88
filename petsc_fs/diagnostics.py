"""Diagnostics of a preconditioner tree and of the blocks it divides by."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from petsc_fs.fields import FIELD
from petsc_fs.scene import CSR, diagonal_blocks

if TYPE_CHECKING:
    from petsc_fs.system import System

WEAK = 1e-10
"""Least singular value of a diagonal block over the largest entry of its rows, per the median of that over the field,
at which it counts as nearly singular."""
DIVIDED_BY = ("intf_force", "intf_flow")
"""Fields whose diagonal blocks the preconditioner divides by: D_22 and diag(J_44)."""


@dataclass(frozen=True)
class Weak:
    """The weakest diagonal block of a field.

    Attributes:
        field: its name.
        cell: number in the scene.
        ratio: its least singular value over the largest entry of its rows, relative to the field's median.
    """

    field: str
    cell: int
    ratio: float

    def __str__(self) -> str:
        """One line for people."""
        k = FIELD[self.field].index
        return (
            f"the diagonal block of J_{k}{k} ({self.field}) is nearly singular at cell {self.cell}: "
            f"{self.ratio:.1e} of what is usual"
        )


def weakest_entries(system: System) -> list[Weak]:
    """The weakest diagonal block of each field that is divided by, where it is nearly singular. Collective."""
    found = []
    layout = system.layout
    for name in DIVIDED_BY:
        if name not in layout.fields:
            continue
        bs = layout.block_size(name)
        dense = diagonal_blocks(CSR(*system.blocks[name, name].getDiagonalBlock().getValuesCSR()), bs)
        least = np.linalg.svd(dense, compute_uv=False)[:, -1] if len(dense) else np.zeros(0)
        rows = np.zeros(len(dense) * bs)
        for (r, _), block in system.blocks.items():
            if r == name:
                indptr, _, values = block.getValuesCSR()
                np.maximum.at(rows, np.repeat(np.arange(rows.size), np.diff(indptr)), np.abs(values))
        whole = rows.reshape(-1, bs).max(axis=1)
        ratios = np.divide(least, whole, out=np.zeros_like(least), where=whole > 0)
        everywhere = np.concatenate(layout.comm.allgather(ratios))
        usual = float(np.median(everywhere)) if everywhere.size else 0.0
        if usual and everywhere.min() <= WEAK * usual:
            cell = int(everywhere.argmin())
            found.append(Weak(name, layout.scene_cell(name, cell), float(everywhere[cell] / usual)))
    return found


def broken_level(pc: PETSc.PC, like: PETSc.Vec) -> str:
    """The innermost level of a set-up tree that turns ones into numbers that are not finite; "" if there is none.

    Collective.

    Args:
        pc: outermost preconditioner.
        like: vector of its size.
    """
    for part in reversed(list(_levels(pc))):
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
            return f"level -{part.getOptionsPrefix() or ''} ({part.getType()}) {what if not finite else 'broke down'}"
    return ""


def _levels(pc: PETSc.PC) -> Iterator[PETSc.PC]:
    """A PC and all PCs in it, outermost first."""
    yield pc
    if pc.getType() == PETSc.PC.Type.FIELDSPLIT:
        for ksp in pc.getFieldSplitSubKSP():
            yield from _levels(ksp.getPC())
    elif pc.getType() == PETSc.PC.Type.PYTHON:
        inner = getattr(pc.getPythonContext(), "inner", None)
        if inner is not None:
            yield from _levels(inner)
