"""How much the data of a scene can move its solution, field by field."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from petsc_fs.accuracy import multiply, weights
from petsc_fs.errors import SolveError
from petsc_fs.reference import equilibrate, one_block
from petsc_fs.scene import Scene

Floats = NDArray[np.float64]

STEPS = 6
"""Of the power iteration; each costs two solves."""


def field_conditions(scene: Scene, solution: Mapping[str, Floats]) -> dict[str, float]:
    """Condition number of each field: relative error of the field per unit of relative residual.

    With s_g the norm of |J| |x| + |b| in the rows of field g, S = diag(s_g), and the natural norms of
    `petsc_fs.accuracy`, it is |J^-1 S|_(field f) / |x|_f in the spectral norm. A solution whose residual is at most
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

    matrix = one_block(scene)
    n = matrix.indptr.size - 1
    r, c = equilibrate(matrix)
    row = np.repeat(np.arange(n), np.diff(matrix.indptr))
    data = r[row] * matrix.data * c[matrix.indices]
    integers = (matrix.indptr.astype(PETSc.IntType), matrix.indices.astype(PETSc.IntType))
    A = PETSc.Mat().createAIJ((n, n), csr=(*integers, data), comm=PETSc.COMM_SELF)
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setOptionsPrefix("reference_")
    pc.setType(PETSc.PC.Type.LU)
    pc.setFactorSolverType(next((p for p in ("mumps", "superlu") if PETSc.Sys.hasExternalPackage(p)), "petsc"))
    pc.setOperators(A)
    x, y = A.createVecs()
    scales = magnitudes(scene, solution)
    S = np.concatenate([np.full(scene.sizes[f], scales[f]) for f in scene.fields])
    natural = weights(scene)
    random = np.random.default_rng(0)
    found = {}
    try:
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


def magnitudes(scene: Scene, solution: Mapping[str, Floats]) -> dict[str, float]:
    """Norm of |J| |x| + |b| per field."""
    size = {f: np.abs(scene.rhs[f]) for f in scene.fields}
    for (r, c), block in scene.blocks.items():
        size[r] = size[r] + multiply(block._replace(data=np.abs(block.data)), np.abs(solution[c]))
    return {f: float(np.linalg.norm(v)) for f, v in size.items()}
