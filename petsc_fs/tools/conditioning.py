"""How much the data of a scene can move its solution, field by field."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SolveError
from petsc_fs.options import inserted
from petsc_fs.scene import Scene
from petsc_fs.tools.accuracy import FieldArrays, residual, row_magnitudes, weights
from petsc_fs.tools.reference import PREFIX, WORKSPACE, equilibrate, one_block

Floats = NDArray[np.float64]

STEPS = 6
"""Of the power iteration; each costs two solves."""


def field_conditions(scene: Scene, solution: FieldArrays) -> dict[str, float]:
    """Condition number of each field: relative error of the field per unit of relative residual.

    With s_g the norm of |J| |x| + |b| in the rows of field g, S = diag(s_g), and the natural norms of
    `petsc_fs.tools.accuracy`, it is |J^-1 S|_(field f) / |x|_f in the spectral norm. A solution whose residual is at most
    eta s_g in every field has an error of at most sqrt(fields) eta times it; no scaling of equations by field and no
    units change it. Estimated from below, by power iteration with the factors of the equilibrated matrix.

    Local, on one rank.

    Args:
        scene: with all rows.
        solution: accurate.

    Returns:
        Per field; infinite where the field's solution is zero.

    Raises:
        SolveError: the matrix cannot be factorised.
    """
    from petsc4py import PETSc

    scene, solution = _of_size_one(scene, solution)
    matrix = one_block(scene)
    n = matrix.indptr.size - 1
    r, c = equilibrate(matrix)
    row = np.repeat(np.arange(n), np.diff(matrix.indptr))
    data = r[row] * matrix.data * c[matrix.indices]
    integers = (matrix.indptr.astype(PETSc.IntType), matrix.indices.astype(PETSc.IntType))
    A = PETSc.Mat().createAIJ((n, n), csr=(*integers, data), comm=PETSc.COMM_SELF)
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setOptionsPrefix(PREFIX)
    pc.setType(PETSc.PC.Type.LU)
    package = next((p for p in ("mumps", "superlu") if PETSc.Sys.hasExternalPackage(p)), "petsc")
    pc.setFactorSolverType(package)
    pc.setOperators(A)
    x, y = A.createVecs()
    scales = magnitudes(scene, solution)
    S = np.concatenate([np.full(scene.sizes[f], scales[f]) for f in scene.fields])
    natural = weights(scene)
    random = np.random.default_rng(0)
    found = {}
    try:
        with inserted(WORKSPACE if package == "mumps" else {}, PREFIX):
            pc.setFromOptions()
            pc.setUp()
        for name in scene.fields:
            W = np.concatenate([np.sqrt(natural[f]) * (f == name) for f in scene.fields])
            v, norm = random.standard_normal(n), 0.0
            for _ in range(STEPS):
                v /= np.linalg.norm(v) or 1.0
                y.setArray(r * S * v)
                pc.apply(y, x)
                forward = W * c * x.getArray()
                if not np.isfinite(forward).all():
                    raise SolveError("no condition number: the factors of the matrix are not finite")
                norm = float(np.linalg.norm(forward))
                y.setArray(c * W * forward)
                pc.applyTranspose(y, x)
                v = S * r * x.getArray()
            size = float(np.linalg.norm(W * np.concatenate([solution[f] for f in scene.fields])))
            found[name] = norm / size if size else float("inf")
    except PETSc.Error as e:
        raise SolveError(f"no condition number: the matrix cannot be factorised (error {e.ierr})") from e
    finally:
        for thing in (pc, A, x, y):
            thing.destroy()
    return found


def _of_size_one(scene: Scene, solution: FieldArrays) -> tuple[Scene, dict[str, Floats]]:
    """The same, with a right-hand side whose largest entry is about 1, so that no square over- or underflows."""
    largest = max((float(np.abs(b).max(initial=0.0)) for b in scene.rhs.values()), default=0.0)
    factor = 2.0 ** -np.frexp(largest)[1] if largest else 1.0
    rhs = {f: factor * b for f, b in scene.rhs.items()}
    return replace(scene, rhs=rhs, reference={}), {f: factor * x for f, x in solution.items()}


def magnitudes(scene: Scene, solution: FieldArrays) -> dict[str, float]:
    """Norm of |J| |x| + |b| per field."""
    return _norms(row_magnitudes(scene, solution))


def fieldwise_backward_error(
    scene: Scene, solution: FieldArrays, of: FieldArrays | None = None, magnitudes: FieldArrays | None = None
) -> float:
    """The largest over the fields of |b - J x| / s_g in its rows, with s_g as for `field_conditions`.

    What the condition numbers there bound errors by; it means something where the matrix is singular, too. No scaling
    of equations field by field and no units change it.

    Args:
        scene: with all rows.
        solution: all rows of each field.
        of: the residual, where it is known.
        magnitudes: see `petsc_fs.tools.accuracy.row_magnitudes`, where they are known.
    """
    sizes, norms = _norms(magnitudes or row_magnitudes(scene, solution)), _norms(of or residual(scene, solution))
    return max((norms[f] / s if s else float(norms[f] > 0) for f, s in sizes.items()), default=0.0)


def _norms(arrays: FieldArrays) -> dict[str, float]:
    return {f: float(np.linalg.norm(v)) for f, v in arrays.items()}
