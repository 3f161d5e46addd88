# mypy: disable-error-code="import-untyped"
"""A direct solver for the badly scaled Jacobians of mixed-dimensional models."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SolveError

Floats = NDArray[np.float64]

SWEEPS = 10
"""Of the equilibration; each takes the square root of what is left of the bad scaling."""

REFINEMENTS = 10
"""Steps of iterative refinement at most."""


def solve(matrix: Any, rhs: Floats) -> Floats:
    """Solve by sparse LU of the equilibrated matrix, refined with residuals in extended precision.

    Row and column scales R, C come from Ruiz's iteration, after which the largest entry of each row
    and column of R A C is about 1. On contact poromechanics this takes the condition number from
    about 1e17 to 1e11, where LU of A itself, or of R A, loses all but three digits. Refinement goes
    on until R (b - A x) no longer halves.

    Args:
        matrix: (n, n) scipy sparse matrix.
        rhs: (n,).

    Returns:
        (n,) solution, rounded to double precision.

    Raises:
        SolveError: the matrix is singular, or an entry is not finite.
    """
    from scipy.sparse import csr_matrix, diags
    from scipy.sparse.linalg import splu

    A = csr_matrix(matrix, copy=True)
    A.sum_duplicates()
    if not (np.isfinite(A.data).all() and np.isfinite(rhs).all()):
        raise SolveError("direct solve: the linear system has entries that are not finite (NaN or Inf)")
    r, c = np.ones(A.shape[0]), np.ones(A.shape[1])
    for _ in range(SWEEPS):
        scaled = diags(r) @ abs(A) @ diags(c)
        rows, columns = (scaled.max(axis=axis).toarray().ravel() for axis in (1, 0))
        if not (rows.all() and columns.all()):
            raise SolveError("direct solve: the matrix has a row or column of zeros")
        r /= np.sqrt(rows)
        c /= np.sqrt(columns)
    try:
        factors = splu((diags(r) @ A @ diags(c)).tocsc())
    except RuntimeError as e:
        raise SolveError(f"direct solve: the matrix cannot be factorised ({e})") from e
    data = A.data.astype(np.longdouble)
    x, residual, size = np.zeros(rhs.size, np.longdouble), rhs.astype(np.longdouble), np.inf
    for _ in range(REFINEMENTS):
        candidate = x + c * factors.solve((r * residual).astype(np.float64))
        left = rhs - np.add.reduceat(data * candidate[A.indices], A.indptr[:-1])
        if not np.linalg.norm((r * left).astype(np.float64)) < 0.5 * size:
            break
        x, residual, size = candidate, left, float(np.linalg.norm((r * left).astype(np.float64)))
    return x.astype(np.float64)
