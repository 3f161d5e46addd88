"""Reference solutions, errors against them, and by how much errors may exceed residuals.

A reference is correct to the last digits of double precision wherever the matrix has a condition number below 1e14 or
so: a solution x + y, held in two vectors, is corrected by solves with residuals b - J (x + y) that are rounded once,
until corrections are far below rounding (N. J. Higham, Accuracy and Stability of Numerical Algorithms, 2002, chapter
12). Two solves are at hand:

    direct     LU by MUMPS of R J C, with row and column scales of Ruiz's equilibration, on one rank
    iterative  the default Krylov solver for the scene, for scenes too large to factorise

Each field has its own natural norm. With V the volumes of the cells that the unknowns live in,

    per cell or face of one dimension    |x|² = Σ V x² / Σ V          (the mean square)
    cells of several dimensions          the sum of the mean squares of each dimension (pressure in rock,
                                         fractures and intersections count alike, whatever the unit of length)
    integrated fluxes                    |v|² = Σ V (v/V)² = Σ v²/V   (the density of the flux)

and plain Euclidean norms where volumes are not known. Errors are relative to the norm of the reference.

Everything here works on whole scenes, on one rank. As a program, `python -m petsc_fs.tools.reference SCENE TARGET.npz
[METHOD]` writes a reference.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import LayoutError, PetscFsError, SceneError, SolveError
from petsc_fs.fields import FLUXES, POTENTIALS
from petsc_fs.io import hdf5
from petsc_fs.io.files import complete
from petsc_fs.options import inserted
from petsc_fs.scene import CSR, Scene

Floats = NDArray[np.float64]
FieldArrays = Mapping[str, Floats]
Solve = Callable[[Floats], Floats]

LARGE = {2: 400_000, 3: 40_000}
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
POWER_STEPS = 6
"""Of the power iteration for condition numbers; each costs two solves."""


@dataclass(frozen=True)
class Reference:
    """A solution and what is known of its accuracy."""

    solution: dict[str, Floats]  # all rows of each field, rounded to double precision
    method: str  # what it was computed by, in words
    corrections: tuple[
        float, ...
    ]  # size of each, relative to the solution, in the worst field; the last one is a bound
    backward_error: dict[str, float]  # of the rounded solution, see `backward_error`
    scene_digest: str = ""  # of the scene's file; "" if there is none

    def about(self) -> dict[str, Any]:
        """Everything but the solution, for JSON."""
        return {k: v for k, v in vars(self).items() if k != "solution"}


def solve(scene: Scene, method: str = "auto", scene_digest: str = "") -> Reference:
    """Compute a reference solution of a whole scene on this rank alone. Local.

    The method is "direct", "iterative" or "auto": direct up to the size `LARGE`, and iterative beyond, or where the
    factorisation fails. The solver's options have the prefix `reference_`; the digest is recorded.

    Raises:
        SolveError: corrections do not become small.
    """
    if method == "auto":
        if sum(scene.sizes.values()) <= LARGE[scene.dimension]:
            with suppress(SolveError):
                return solve(scene, "direct", scene_digest)
        return solve(scene, "iterative", scene_digest)
    matrix, b = one_block(scene), together(scene, scene.rhs)
    with factors(matrix) if method == "direct" else _krylov(scene) as (correct, _):
        x, corrections = refine(matrix, b, correct, [scene.sizes[f] for f in scene.fields])
    words = "LU of the equilibrated matrix"
    if method == "iterative":
        words = f"the field-split Krylov method to {INNER_RTOL:g}"
    if not corrections[-1] <= USELESS:
        size = f"correction {len(corrections)} by {words} is still {corrections[-1]:.1e} of the solution"
        raise SolveError(f"no reference solution: {size}")
    solution = by_field(scene, x)
    exact = by_field(scene, residual(matrix, b, x, np.zeros_like(x)))
    return Reference(solution, words, tuple(corrections), backward_error(scene, solution, exact), scene_digest)


def one_block(scene: Scene, fields: Sequence[str] = ()) -> CSR:
    """The whole Jacobian in compressed rows, or that of some fields, one field after the other."""
    names = fields or scene.fields
    start = dict(zip(names, np.cumsum([0, *(scene.sizes[f] for f in names)]), strict=False))
    blocks = {(r, c): block for (r, c), block in scene.blocks.items() if {r, c} <= set(names)}
    row = np.concatenate([start[r] + rows_of(block) for (r, _), block in blocks.items()])
    column = np.concatenate([start[c] + block.indices for (_, c), block in blocks.items()])
    order = np.lexsort((column, row))
    indptr = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=sum(scene.sizes[f] for f in names)))])
    return CSR(indptr, column[order], np.concatenate([b.data for b in blocks.values()])[order])


def rows_of(block: CSR) -> NDArray[np.int64]:
    """Row number of each entry."""
    return np.repeat(np.arange(block.indptr.size - 1), np.diff(block.indptr))


def together(scene: Scene, values: FieldArrays) -> Floats:
    """All fields as one vector, numbered as `one_block`."""
    return np.concatenate([values[f] for f in scene.fields])


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
    (a1, a2), (b1, b2) = _halves(a), _halves(b)
    return p, ((a1 * b1 - p) + a1 * b2 + a2 * b1) + a2 * b2


def _halves(a: Floats) -> tuple[Floats, Floats]:
    """A number as the sum of two with half the digits each."""
    c = 134217729.0 * a  # 2^27 + 1
    high = c - (c - a)
    return high, a - high


def residual(matrix: CSR, b: Floats, x: Floats, y: Floats) -> Floats:
    """The residual b - A (x + y), each entry rounded once: products are exact, and sums are those of `math.fsum`."""
    p, e = two_product(-matrix.data, x[matrix.indices])
    e -= matrix.data * y[matrix.indices]
    lists: list[Any] = [v.tolist() for v in (matrix.indptr, p, e, b)]
    ends, terms, small, right = lists
    try:
        found = [math.fsum([v, *terms[i:j], *small[i:j]]) for v, i, j in zip(right, ends[:-1], ends[1:], strict=True)]
    except (OverflowError, ValueError) as error:
        raise SolveError("no reference solution: the residual is not finite") from error
    return np.array(found)


def refine(matrix: CSR, b: Floats, correct: Solve, sizes: list[int]) -> tuple[Floats, list[float]]:
    """Correct a solution, from zero, until corrections are small or no longer become smaller.

    `correct` approximates A⁻¹ r; corrections have to be small in each field, of these sizes. Returns the solution,
    rounded, and the relative size of each correction, in the worst field.

    Raises:
        SolveError: a correction or residual is not finite.
    """
    high: Floats = np.zeros(b.size)
    low: Floats = np.zeros(b.size)
    bounds = np.cumsum(sizes)[:-1]
    corrections: list[float] = []
    for _ in range(STEPS):
        step = correct(residual(matrix, b, high, low))
        if not np.isfinite(step).all():
            raise SolveError("no reference solution: a correction is not finite")
        s, t = two_sum(high, step)
        s, t = two_sum(s, t + low)
        parts = zip(np.split(step, bounds), np.split(s, bounds), strict=True)
        size = max((float(np.linalg.norm(d) / (np.linalg.norm(v) or 1.0)) for d, v in parts), default=0.0)
        if len(corrections) > 1 and size > 0.5 * corrections[-1]:
            break
        high, low = s, t
        corrections.append(size)
        if size < ENOUGH:
            break
    return high, corrections


def equilibrate(matrix: CSR) -> tuple[Floats, Floats]:
    """Scales r, c after which the largest entry of each row and column of diag(r) A diag(c) is about 1.

    D. Ruiz, A scaling algorithm to equilibrate both rows and columns norms in matrices, RAL-TR-2001-034.

    Raises:
        SolveError: a row or column is zero.
    """
    n, row = matrix.indptr.size - 1, rows_of(matrix)
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
def factors(matrix: CSR) -> Iterator[tuple[Solve, Solve]]:
    """LU of the equilibrated matrix: A⁻¹ and A⁻ᵀ, as functions; a SolveError where it cannot be factorised."""
    from petsc4py import PETSc

    n = matrix.indptr.size - 1
    r, c = equilibrate(matrix)
    integers = (matrix.indptr.astype(PETSc.IntType), matrix.indices.astype(PETSc.IntType))
    scaled = r[rows_of(matrix)] * matrix.data * c[matrix.indices]
    A = PETSc.Mat().createAIJ((n, n), csr=(*integers, scaled), comm=PETSc.COMM_SELF)
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setOptionsPrefix(PREFIX)
    pc.setType(PETSc.PC.Type.LU)
    package = next((p for p in ("mumps", "superlu") if PETSc.Sys.hasExternalPackage(p)), "petsc")
    pc.setFactorSolverType(package)
    pc.setOperators(A)
    x, y = A.createVecs()

    def applied(apply: Callable[[Any, Any], None], left: Floats, right: Floats, v: Floats) -> Floats:
        y.setArray(right * v)
        apply(y, x)
        return np.asarray(left * x.getArray())

    try:
        with inserted(WORKSPACE if package == "mumps" else {}, PREFIX):
            pc.setFromOptions()
            pc.setUp()
        yield partial(applied, pc.apply, c, r), partial(applied, pc.applyTranspose, r, c)
    except PETSc.Error as e:
        raise SolveError(f"{package} cannot factorise the matrix (error {e.ierr})") from e
    finally:
        for thing in (pc, A, x, y):
            thing.destroy()


@contextmanager
def _krylov(scene: Scene) -> Iterator[tuple[Solve, None]]:
    """The default Krylov solver for the scene, as a function; in the place of `factors`."""
    from mpi4py import MPI

    from petsc_fs.solver import Solver

    tolerances = {"ksp_rtol": str(INNER_RTOL), "ksp_atol": "0", "ksp_max_it": "500"}
    with inserted(tolerances, PREFIX):
        solver = Solver(scene, MPI.COMM_SELF, prefix=PREFIX)

        def correct(r: Floats) -> Floats:
            size = float(np.linalg.norm(r)) or 1.0
            return size * together(scene, solver.solve(rhs=by_field(scene, np.divide(r, size))).solution)

        try:
            yield correct, None
        finally:
            solver.destroy()


# --- errors


def weights(scene: Scene) -> dict[str, Floats]:
    """Weight w of each unknown, (size,) per field, such that the square of a field's norm is Σ w x²."""
    found: dict[str, Floats] = {}
    for name, size in scene.sizes.items():
        volumes = scene.cell_volumes.get(name)
        if volumes is None or not volumes.size or not (volumes > 0).all():
            found[name] = np.ones(size)
            continue
        dimension = scene.cell_dimension if name in POTENTIALS else None
        groups = np.zeros(volumes.size, dtype=np.int64) if dimension is None else np.asarray(dimension)
        # fluxes are integrals over their cell
        per_cell = 1.0 / volumes if name in FLUXES else volumes / np.bincount(groups, weights=volumes)[groups]
        found[name] = np.repeat(per_cell, scene.block_size(name))
    return found


def forward_error(scene: Scene, reference: FieldArrays, solution: FieldArrays) -> tuple[float, dict[str, float]]:
    """Forward errors of a solution, all rows of each field.

    Returns:
        Root mean square of the relative errors of the fields, so that each counts alike; relative error per
        field. Where the reference is zero, the error of a field is absolute, and left out of the first.

    Raises:
        LayoutError: the reference is not one for this scene.
    """
    for name, size in scene.sizes.items():
        if name not in reference or reference[name].shape != (size,):
            raise LayoutError(f"reference: {name} is not there with {size} entries; compute it anew for this scene")
    known = {f: w for f, w in weights(scene).items() if w.size}
    absolute = {f: _norm(w, solution[f] - reference[f]) for f, w in known.items()}
    scale = {f: _norm(w, reference[f]) for f, w in known.items()}
    relative = {f: e / scale[f] for f, e in absolute.items() if scale[f]}
    total = float(np.sqrt(np.mean(np.square(list(relative.values()))))) if relative else 0.0
    return total, absolute | relative


def _norm(weight: Floats, values: Floats) -> float:
    largest = _greatest(values)  # by which nothing over- or underflows when it is squared
    if not 0 < largest < np.inf:
        return largest
    return largest * float(np.sqrt(np.sum(weight * (values / largest) ** 2)))


def _greatest(values: Floats) -> float:
    return float(np.max(np.abs(values), initial=0.0))


def _greatest_of(values: FieldArrays) -> float:
    return max(map(_greatest, values.values()), default=0.0)


def multiply(block: CSR, x: Floats) -> Floats:
    """Product of a block with a vector, summed row by row."""
    found = np.bincount(rows_of(block), weights=block.data * x[block.indices], minlength=block.indptr.size - 1)
    return found.astype(np.float64)  # integers where there is no entry


def magnitudes(scene: Scene, solution: FieldArrays) -> dict[str, Floats]:
    """|J| |x| + |b| per field, entry by entry: what the terms of each equation amount to before they cancel."""
    found = {f: np.abs(scene.rhs[f]) for f in scene.fields}
    for (r, c), block in scene.blocks.items():
        found[r] = found[r] + multiply(block._replace(data=np.abs(block.data)), np.abs(solution[c]))
    return found


def backward_error(scene: Scene, solution: FieldArrays, of: FieldArrays | None = None) -> dict[str, float]:
    """By how much the system must be changed for the solution to be exact, relative to the system.

    With s = |J| |x| + |b|,

        normwise        |b - J x| / (|J| |x| + |b|) in the maximum norm (Rigal and Gaches, J. ACM 14, 1967); as fields
                        differ in units this says little on any but the largest
        componentwise   max_i |b - J x|_i / s_i (Oettli and Prager, Numer. Math. 6, 1964), which no scaling of equations
                        or unknowns changes
        fieldwise       the largest over the fields of |b - J x| / |s| in its rows, which no scaling of whole fields and
                        no units change; what `field_conditions` bound errors by

    All rows of a scene and of its solution; `of` is the residual, where it is known to better than double precision.
    """
    if of is None:
        known = {f: np.array(scene.rhs[f]) for f in scene.fields}
        for (r, c), block in scene.blocks.items():
            known[r] -= multiply(block, solution[c])
        of = known
    scales = magnitudes(scene, solution)
    ones = {f: np.ones(n) for f, n in scene.sizes.items()}
    sums = magnitudes(replace(scene, rhs={f: 0 * v for f, v in ones.items()}), ones)
    norm = _greatest_of(sums) * _greatest_of(solution) + _greatest_of(scene.rhs)
    componentwise = fieldwise = 0.0
    for f, rest in of.items():
        share = np.where(rest == 0, 0.0, np.inf)
        np.divide(np.abs(rest), scales[f], out=share, where=scales[f] > 0)
        componentwise = max(componentwise, _greatest(share))
        size, scale = float(np.linalg.norm(rest)), float(np.linalg.norm(scales[f]))
        fieldwise = max(fieldwise, size / scale if scale else float(size > 0))
    normwise = _greatest_of(of) / norm if norm else 0.0
    return {"normwise": normwise, "componentwise": componentwise, "fieldwise": fieldwise}


def field_conditions(scene: Scene, solution: FieldArrays) -> dict[str, float]:
    """Condition number of each field: relative error of the field per unit of relative residual.

    With s_g the norm of |J| |x| + |b| in the rows of field g, S = diag(s_g), and natural norms, it is
    |J⁻¹ S|_(field f) / |x|_f in the spectral norm. A solution whose residual is at most eta s_g in every field has an
    error of at most sqrt(fields) eta times it; no scaling of equations by field and no units change it. Estimated from
    below, by power iteration with the factors of the equilibrated matrix.

    Local, for a whole scene and its accurate solution; infinite where a field's solution is zero.

    Raises:
        SolveError: the matrix cannot be factorised.
    """
    largest = _greatest_of(scene.rhs)
    factor = 2.0 ** -np.frexp(largest)[1] if largest else 1.0  # so that no square over- or underflows
    scene = replace(scene, rhs={f: factor * b for f, b in scene.rhs.items()}, reference={})
    solution = {f: factor * x for f, x in solution.items()}
    sizes = {f: np.linalg.norm(v) for f, v in magnitudes(scene, solution).items()}
    S = np.repeat([sizes[f] for f in scene.fields], [scene.sizes[f] for f in scene.fields])
    natural, random, found = weights(scene), np.random.default_rng(0), {}
    with factors(one_block(scene)) as (inverse, transposed):
        for name in scene.fields:
            W = together(scene, {f: np.sqrt(w) * float(f == name) for f, w in natural.items()})
            v, norm = random.standard_normal(S.size), 0.0
            for _ in range(POWER_STEPS):
                forward = W * inverse(S * v / (np.linalg.norm(v) or 1.0))
                if not np.isfinite(forward).all():
                    raise SolveError("no condition number: the factors of the matrix are not finite")
                norm = float(np.linalg.norm(forward))
                v = S * transposed(W * forward)
            size = float(np.linalg.norm(W * together(scene, solution)))
            found[name] = norm / size if size else float("inf")
    return found


# --- files


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
    """Read what `write` wrote; a SceneError where it is not there or no reference."""
    try:
        with np.load(path) as arrays:
            about = json.loads(str(arrays["about"]))
            solution = {name: arrays[name] for name in arrays.files if name != "about"}
        return Reference(solution, **(about | {"corrections": tuple(about["corrections"])}))
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise SceneError(f"{path}: not a reference solution ({e}); compute it anew") from e


def made(scene: str | os.PathLike[str], target: Path) -> Reference:
    """The reference of a scene's file: in `target`, if it is one of this scene, or else computed in another process.

    A factorisation that crashes is followed by the iterative method.

    Raises:
        SolveError: there is none.
    """
    import subprocess

    from petsc_fs.tools.measure import environment

    if target.exists() and (found := read(target)).scene_digest == digest(scene):
        return found
    target.parent.mkdir(parents=True, exist_ok=True)
    said = ""
    for method in ("auto", "iterative"):
        command = [sys.executable, "-m", "petsc_fs.tools.reference", os.fspath(scene), str(target), method]
        done = subprocess.run(command, capture_output=True, text=True, env=environment(), check=False)
        if done.returncode == 0:
            return read(target)
        said = " ".join(done.stderr.split()[-60:]) or f"exit code {done.returncode}"
    raise SolveError(f"{Path(scene).name}: {said}")


def main() -> int:
    """Run as a program."""
    import petsc4py

    petsc4py.init(["petsc-fs"])
    scene, target, method = sys.argv[1], sys.argv[2], (*sys.argv[3:], "auto")[0]
    try:
        write(solve(hdf5.read(Path(scene)), method, digest(scene)), target)
    except PetscFsError as e:
        print(e, file=sys.stderr)
        return e.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
