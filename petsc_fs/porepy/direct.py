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
    on until the backward error stalls, the norm of R (b - A x) over that of R (|A| |x| + |b|).

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
    magnitude = abs(A)
    r, c = np.ones(A.shape[0]), np.ones(A.shape[1])
    for _ in range(SWEEPS):
        scaled = diags(r) @ magnitude @ diags(c)
        rows, columns = (scaled.max(axis=axis).toarray().ravel() for axis in (1, 0))
        if not (rows.all() and columns.all()):
            raise SolveError("direct solve: the matrix has a row or column of zeros")
        r /= np.sqrt(rows)
        c /= np.sqrt(columns)
    try:
        factors = splu((diags(r) @ A @ diags(c)).tocsc())
    except RuntimeError as e:
        raise SolveError(f"direct solve: the matrix cannot be factorised ({e})") from e

    b = rhs.astype(np.longdouble)
    data, absolute = A.data.astype(np.longdouble), magnitude.data.astype(np.longdouble)
    starts = A.indptr[:-1]

    def norm(v: NDArray[np.longdouble]) -> float:
        return float(np.linalg.norm((r * v).astype(np.float64)))

    x = np.zeros(b.size, dtype=np.longdouble)
    residual, error = b, np.inf
    for _ in range(REFINEMENTS):
        candidate = x + c * factors.solve((r * residual).astype(np.float64))
        at = candidate[A.indices]
        next_residual = b - np.add.reduceat(data * at, starts)
        size = norm(np.add.reduceat(absolute * np.abs(at), starts) + np.abs(b))
        next_error = norm(next_residual) / (size or 1.0)
        if not next_error < 0.5 * error:
            break
        x, residual, error = candidate, next_residual, next_error
    return x.astype(np.float64)
