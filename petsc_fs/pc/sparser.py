"""Matrices without their small entries, for multigrid, whose coarse levels follow from the finest one."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

PAYS = 0.5
"""Share of all entries that has to go: a sparser copy costs as much as a few cycles of multigrid."""


def sparser(A: PETSc.Mat, share: float) -> PETSc.Mat:
    """A without entries that are small beside the diagonal of their row, or A itself where those are few; A is freed.

    What is left out is added to the diagonal, so that sums over rows, which say what happens to slowly varying
    functions, stay as they are. It is never as much as the diagonal, whose sign stays.

    Collective. What is left out of a row depends on the row alone.

    Args:
        A: square AIJ.
        share: of the magnitude of the diagonal; entries below it go. In rows of more entries than 1 / share it is one
            by their number.
    """
    if not share:
        return A
    indptr, indices, data = A.getValuesCSR()
    counts = np.diff(indptr)
    diagonal = A.getDiagonal()
    least = np.abs(diagonal.getArray()) * np.minimum(share, 1.0 / np.maximum(counts, 1))
    kept = np.flatnonzero(np.abs(data) >= np.repeat(least, counts))
    diagonal.destroy()
    remaining, entries = A.comm.tompi4py().allreduce(np.array([kept.size, data.size]))
    if remaining > (1.0 - PAYS) * entries:
        return A
    csr = np.searchsorted(kept, indptr).astype(indices.dtype), indices[kept], data[kept]
    B = PETSc.Mat().createAIJ(A.getSizes(), csr=csr, comm=A.comm)
    B.setOption(PETSc.Mat.Option.NEW_NONZERO_ALLOCATION_ERR, False)  # the diagonal may be missing from the pattern
    lost, sums = A.getRowSum(), B.getRowSum()
    lost.axpy(-1.0, sums)
    lost.setArray(np.where(np.diff(csr[0]) < counts, lost.getArray(), 0.0))  # without rounding where nothing is
    B.setDiagonal(lost, addv=PETSc.InsertMode.ADD_VALUES)
    for thing in (lost, sums, A):
        thing.destroy()
    return B
