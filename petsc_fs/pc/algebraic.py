"""The fixed-stress diagonal from the matrix alone, by sums over rows of a sparse Schur complement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs.nest import magnitudes

SHARE = 0.7
"""Of an upper bound. Fixed stress needs more than half of what mechanics adds; in 2D the bound is close to that, in 3D
some way above it. Iterations in undrained rock hardly change between 0.5 and 1 (2D 22 to 20, 3D 25 to 27)."""


def stabilisation(A: PETSc.Mat, B: PETSc.Mat, C: PETSc.Mat) -> NDArray[np.float64]:
    """What mechanics adds to the diagonal of the mass balance once it is eliminated, as sums of magnitudes.

    With S = |C| |diag A|^-1 |B|, magnitudes entry by entry, the value of cell k is `SHARE` of the lesser of

        sum_m S_km   and   sum_m S_km w_m / w_k,   1 / w_m = sum_i |B_im| |A_ii|^-1/2.

    Sums over rows bound the eigenvalues of a matrix: those of D^-1 C (diag A)^-1 B are at most 1 for either sum as D,
    as l1-Jacobi smoothers are made (Baker, Falgout, Kolev, Yang, "Multigrid smoothers for ultraparallel computing",
    2011). The first sum varies less where cells are distorted. The second follows the units of each pressure, so that
    no cell takes on those of its neighbours; it is 0 for cells whose pressure does not act on mechanics, as those
    of intersections. S is never formed: five products of a factor and a vector do.

    Local solves with A, the fully algebraic stabilisation that the paper cites (Franceschini, Gazzola, Ferronato,
    2022), miss what a pressure that varies slowly meets: a fifth of the analytic values in 2D, less in 3D.

    Collective. The result is the same on any number of ranks, to rounding.

    Args:
        A: (u, u) mechanics, of any type that knows its diagonal. Zeros on the diagonal are left out.
        B: (u, m) what pressures do to mechanics, AIJ or a MatNest of such.
        C: (m, u) what mechanics does to the mass balance, AIJ or a MatNest of such.

    Returns:
        (rows of C on this rank,), not negative; its sign is that of the diagonal of the mass balance.
    """
    B, C = magnitudes(B), magnitudes(C)
    weights, inverse = B.createVecs()
    A.getDiagonal(inverse)
    inverse.abs()
    inverse.reciprocal()  # zeros stay
    moved = inverse.copy()
    moved.sqrtabs()
    norms = weights.duplicate()
    B.multTranspose(moved, norms)

    def sums(w: PETSc.Vec) -> PETSc.Vec:
        """S w."""
        B.mult(w, moved)
        moved.pointwiseMult(moved, inverse)
        return C * moved

    weights.set(1.0)
    plain = sums(weights)
    norms.copy(weights)
    weights.reciprocal()
    weighted = sums(weights)
    result: NDArray[np.float64] = SHARE * np.minimum(plain.getArray(), weighted.getArray() * norms.getArray())
    for temporary in (B, C, weights, inverse, moved, norms, plain, weighted):
        temporary.destroy()
    return result
