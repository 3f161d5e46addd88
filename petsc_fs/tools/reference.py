"""Reference solutions: as good as double precision can hold, and what that rests on.

Iterative refinement: x ← x + d, where d approximates J⁻¹ (b - J x). The residual is computed with twice the digits
of double precision (a pair of numbers for each, their products without error: Dekker, Numer. Math. 18, 1971), and
the solution is held so too, so that what limits its accuracy is 1e-32 times the condition number, not 1e-16 times.
Each step gains the digits that the solver for d has. Two solvers are at hand:

    direct     LU by MUMPS of R J C, with row and column scales of Ruiz's equilibration, on one rank
    iterative  the field-split Krylov solver for the scene, for scenes too large to factorise

As a program, `python -m petsc_fs.tools.reference SCENE TARGET.npz [--method direct|iterative|auto]` writes one.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import PetscFsError, SceneError, SolveError
from petsc_fs.io import hdf5
from petsc_fs.io.files import complete
from petsc_fs.options import inserted
from petsc_fs.scene import CSR, Scene
from petsc_fs.tools.accuracy import Ruler, backward_error

Floats = NDArray[np.float64]
Solve = Callable[[Floats], Floats]

METHODS = ("direct", "iterative", "auto")

LARGE = {2: 400_000, 3: 20_000}
"""Number of unknowns, by dimension, from which the iterative method is the default."""

SWEEPS = 10
"""Of the equilibration; each takes the square root of what is left of the bad scaling."""
STEPS = 40
"""Steps of refinement at most."""
ENOUGH = 1e-20
"""Relative size of a correction after which another one changes no digit of the solution in double precision."""
USELESS = 1e-13
"""Relative size of the last correction from which the solution is no reference."""
PREFIX = "reference_"
"""Of the solvers' options."""
WORKSPACE = {"mat_mumps_icntl_14": "200"}
"""Options of MUMPS without which it runs out of the memory that it has foreseen, where it has to pivot much."""
INNER_RTOL = 1e-8
"""Tolerance of the iterative method for each correction."""


@dataclass(frozen=True)
class Reference:
    """A solution and what is known of its accuracy.

    Attributes:
        solution: all rows of each field, rounded to double precision.
        method: what it was computed by, in words.
        refinements: corrections after the first solve.
        corrections: size of each correction relative to the solution, in the worst field; the last one
            bounds what is wrong with the solution before it is rounded.
        residual_by_field: |b - J x| of each field, of all fields' |b|, of the rounded solution.
        backward_error: of the rounded solution, see `petsc_fs.tools.accuracy.backward_error`.
        unrounded_backward_error: componentwise, with all digits that were computed.
        seconds: that it took.
        scene_digest: of the scene's file; "" if there is none.
    """

    solution: dict[str, Floats] = field(repr=False)
    method: str
    refinements: int
    corrections: tuple[float, ...]
    residual_by_field: dict[str, float]
    backward_error: dict[str, float]
    unrounded_backward_error: float
    seconds: float
    scene_digest: str = ""

    def about(self) -> dict[str, Any]:
        """Everything but the solution, for JSON."""
        return {k: v for k, v in asdict(self).items() if k != "solution"}


def solve(scene: Scene, method: str = "auto", scene_digest: str = "") -> Reference:
    """Compute a reference solution on this rank alone.

    Local. The solver's options have the prefix `reference_`.

    Args:
        scene: with all rows.
        method: one of `METHODS`; "auto" is "direct" up to the size `LARGE`, and "iterative" beyond, or where the
            factorisation fails.
        scene_digest: to be recorded.

    Raises:
        SolveError: corrections do not become small.
    """
    if method == "auto":
        large = sum(scene.sizes.values()) > LARGE[scene.dimension]
        try:
            return solve(scene, "iterative" if large else "direct", scene_digest)
        except SolveError:
            if large:
                raise
            return solve(scene, "iterative", scene_digest)
    started = time.perf_counter()
    b = np.concatenate([scene.rhs[f] for f in scene.fields])
    matrix = one_block(scene)
    exact = ExactResidual(matrix, b)
    with (_direct if method == "direct" else _iterative)(scene, matrix) as (correct, words):
        high, low, corrections = refine(exact, correct, [scene.sizes[f] for f in scene.fields])
    if not corrections[-1] <= USELESS:
        raise SolveError(
            f"no reference solution: after {len(corrections)} corrections by {words} the last one is still "
            f"{corrections[-1]:.1e} of the solution"
        )
    solution = by_field(scene, high)
    rounded = by_field(scene, exact(high, np.zeros_like(low))[0])
    size = float(np.linalg.norm(b)) or 1.0
    return Reference(
        solution=solution,
        method=f"{words}, refined with residuals in twice double precision",
        refinements=len(corrections) - 1,
        corrections=tuple(corrections),
        residual_by_field={f: float(np.linalg.norm(r)) / size for f, r in rounded.items()},
        backward_error=backward_error(scene, solution, rounded),
        unrounded_backward_error=backward_error(scene, solution, by_field(scene, exact(high, low)[0]))["componentwise"],
        seconds=time.perf_counter() - started,
        scene_digest=scene_digest,
    )


def one_block(scene: Scene) -> CSR:
    """The whole Jacobian in compressed rows, fields one after the other."""
    start = dict(zip(scene.fields, np.cumsum([0, *(scene.sizes[f] for f in scene.fields)]), strict=False))
    n = sum(scene.sizes.values())
    rows, columns, data = [], [], []
    for (r, c), block in scene.blocks.items():
        rows.append(start[r] + np.repeat(np.arange(scene.sizes[r]), np.diff(block.indptr)))
        columns.append(start[c] + block.indices)
        data.append(block.data)
    row = np.concatenate(rows)
    order = np.lexsort((np.concatenate(columns), row))
    indptr = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=n))])
    return CSR(indptr, np.concatenate(columns)[order], np.concatenate(data)[order])


def by_field(scene: Scene, vector: Floats) -> dict[str, Floats]:
    """Cut a vector numbered as `one_block` into fields."""
    bounds = np.cumsum([scene.sizes[f] for f in scene.fields])[:-1]
    return dict(zip(scene.fields, np.split(vector, bounds), strict=True))


def two_sum(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """The rounded sum and its rounding error, which together are the sum exactly (Knuth)."""
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


def two_product(a: Floats, b: Floats) -> tuple[Floats, Floats]:
    """The rounded product and its rounding error, which together are the product exactly (Dekker, Veltkamp)."""
    p = a * b
    a1, a2 = _halves(a)
    b1, b2 = _halves(b)
    return p, ((a1 * b1 - p) + a1 * b2 + a2 * b1) + a2 * b2


def _halves(a: Floats) -> tuple[Floats, Floats]:
    """A number as the sum of two with half the digits each."""
    c = 134217729.0 * a  # 2^27 + 1
    high = c - (c - a)
    return high, a - high


class ExactResidual:
    """b - A (x + y) with twice the digits of double precision, for x + y held in two vectors."""

    def __init__(self, matrix: CSR, b: Floats) -> None:
        """Sort the rows by length, so that their k-th entries can be dealt with at once."""
        counts = np.diff(matrix.indptr)
        self._matrix, self._b = matrix, b
        self._order = np.argsort(-counts, kind="stable")
        self._first = matrix.indptr[:-1][self._order]
        self._longer = np.searchsorted(-counts[self._order], -np.arange(int(counts.max(initial=0))), side="left")

    def __call__(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Residual and its rounding error, both (n,)."""
        high, low = self._b[self._order], np.zeros(self._b.size)
        for k, n in enumerate(self._longer):
            at = self._first[:n] + k
            column, a = self._matrix.indices[at], self._matrix.data[at]
            p, e = two_product(-a, x[column])
            s, t = two_sum(high[:n], p)
            high[:n], low[:n] = two_sum(s, t + (low[:n] + (e - a * y[column])))
        found = np.empty_like(high), np.empty_like(low)
        found[0][self._order], found[1][self._order] = high, low
        return found


def refine(residual: ExactResidual, correct: Solve, sizes: list[int]) -> tuple[Floats, Floats, list[float]]:
    """Correct a solution, from zero, until corrections are small or no longer become smaller.

    Args:
        residual: of the solution.
        correct: approximates J⁻¹ r.
        sizes: of the fields, in each of which a correction has to be small.

    Returns:
        Solution and its rounding error; relative size of each correction, in the worst field.

    Raises:
        SolveError: a correction is not finite.
    """
    n = sum(sizes)
    bounds = np.cumsum(sizes)[:-1]
    high, low = np.zeros(n), np.zeros(n)
    corrections: list[float] = []
    for _ in range(STEPS):
        step = correct(residual(high, low)[0])
        if not np.isfinite(step).all():
            raise SolveError("no reference solution: a correction is not finite")
        s, t = two_sum(high, step)
        s, t = two_sum(s, t + low)
        size = max(
            (
                float(np.linalg.norm(d) / (np.linalg.norm(v) or 1.0))
                for d, v in zip(np.split(step, bounds), np.split(s, bounds), strict=True)
            ),
            default=0.0,
        )
        if len(corrections) > 1 and size > 0.5 * corrections[-1]:
            break
        high, low = s, t
        corrections.append(size)
        if size < ENOUGH:
            break
    return high, low, corrections


def equilibrate(matrix: CSR) -> tuple[Floats, Floats]:
    """Scales r, c after which the largest entry of each row and column of diag(r) A diag(c) is about 1.

    D. Ruiz, A scaling algorithm to equilibrate both rows and columns norms in matrices, RAL-TR-2001-034.

    Raises:
        SolveError: a row or column is zero.
    """
    n = matrix.indptr.size - 1
    row = np.repeat(np.arange(n), np.diff(matrix.indptr))
    r, c = np.ones(n), np.ones(n)
    for _ in range(SWEEPS):
        scaled = np.abs(r[row] * matrix.data * c[matrix.indices])
        rows, columns = np.zeros(n), np.zeros(n)
        np.maximum.at(rows, row, scaled)
        np.maximum.at(columns, matrix.indices, scaled)
        if not (rows.all() and columns.all()):
            raise SolveError("no reference solution: the matrix has a row or column of zeros")
        r /= np.sqrt(rows)
        c /= np.sqrt(columns)
    return r, c


@contextmanager
def _direct(scene: Scene, matrix: CSR) -> Iterator[tuple[Solve, str]]:
    """LU of the equilibrated matrix: its solve, and what it is."""
    from petsc4py import PETSc

    n = matrix.indptr.size - 1
    r, c = equilibrate(matrix)
    row = np.repeat(np.arange(n), np.diff(matrix.indptr))
    package = next((p for p in ("mumps", "superlu") if PETSc.Sys.hasExternalPackage(p)), "petsc")
    integers = (matrix.indptr.astype(PETSc.IntType), matrix.indices.astype(PETSc.IntType))
    scaled = r[row] * matrix.data * c[matrix.indices]
    A = PETSc.Mat().createAIJ((n, n), csr=(*integers, scaled), comm=PETSc.COMM_SELF)
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setOptionsPrefix(PREFIX)
    pc.setType(PETSc.PC.Type.LU)
    pc.setFactorSolverType(package)
    pc.setOperators(A)
    x, y = A.createVecs()

    def correct(residual: Floats) -> Floats:
        y.setArray(r * residual)
        pc.apply(y, x)
        return np.asarray(c * x.getArray())

    try:
        with inserted(WORKSPACE if package == "mumps" else {}, PREFIX):
            pc.setFromOptions()
            pc.setUp()
        yield correct, f"LU ({package}) of the equilibrated matrix"
    except PETSc.Error as e:
        raise SolveError(f"no reference solution: {package} cannot factorise the matrix (error {e.ierr})") from e
    finally:
        for thing in (pc, A, x, y):
            thing.destroy()


@contextmanager
def _iterative(scene: Scene, matrix: CSR) -> Iterator[tuple[Solve, str]]:
    """The Krylov solver for the scene: its solve, and what it is."""
    from mpi4py import MPI

    from petsc_fs.options import Facts, choose
    from petsc_fs.solver import Solver

    tolerances = {"ksp_rtol": str(INNER_RTOL), "ksp_atol": "0", "petsc_fs_restarts": "0", "ksp_max_it": "500"}
    with inserted({**choose(Facts.of(scene, MPI.COMM_SELF)).values, **tolerances}, PREFIX):
        solver = Solver(scene, MPI.COMM_SELF, prefix=PREFIX)

        def correct(residual: Floats) -> Floats:
            size = float(np.linalg.norm(residual)) or 1.0
            solver.system.set_rhs(by_field(scene, residual / size))
            found = solver.solve().solution
            return size * np.concatenate([found[f] for f in scene.fields])

        try:
            yield correct, f"the field-split Krylov method to {INNER_RTOL:g}"
        finally:
            solver.destroy()


def digest(path: str | os.PathLike[str]) -> str:
    """What tells one scene file from another."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write(reference: Reference, path: str | os.PathLike[str]) -> None:
    """Write a reference as NumPy's .npz: an array for each field, and `about` in JSON."""
    arrays: Mapping[str, Any] = {**reference.solution, "about": json.dumps(reference.about())}
    with complete(Path(path)) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


def read(path: str | os.PathLike[str]) -> Reference:
    """Read what `write` wrote.

    Raises:
        SceneError: the file is not there or no reference.
    """
    try:
        with np.load(path) as arrays:
            about = json.loads(str(arrays["about"]))
            solution = {name: arrays[name] for name in arrays.files if name != "about"}
    except (OSError, ValueError, KeyError) as e:
        raise SceneError(f"{path}: not a reference solution ({e}); compute it anew") from e
    return Reference(solution=solution, **(about | {"corrections": tuple(about["corrections"])}))


def ruler(scene: Scene, reference: Reference) -> Ruler:
    """What measures solutions of the scene against its reference."""
    return Ruler(scene, reference.solution)


def main() -> int:
    """Run as a program."""
    parser = argparse.ArgumentParser(
        prog="python -m petsc_fs.tools.reference", description="compute a reference solution"
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("target", type=Path, metavar="TARGET.npz")
    parser.add_argument("--method", choices=METHODS, default="auto")
    args = parser.parse_args()
    import petsc4py

    petsc4py.init(["petsc-fs"])
    try:
        write(solve(hdf5.read(args.scene), args.method, digest(args.scene)), args.target)
    except PetscFsError as e:
        print(e, file=sys.stderr)
        return e.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
