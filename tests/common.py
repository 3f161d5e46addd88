"""What tests of the core share: bundled scenes, matrices as dense arrays, and what numpy says of a solve."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc
from sample import SCENES, csr, dense

from petsc_fs.errors import together
from petsc_fs.io import hdf5
from petsc_fs.partition import Layout, rows_of
from petsc_fs.result import Result
from petsc_fs.scene import CSR, Scene
from petsc_fs.solver import Solver
from petsc_fs.system import EPS, ROUNDING_UNITS, System

comm = MPI.COMM_WORLD
NAMES = tuple(path.stem for path in sorted(SCENES.glob("*.h5")))
FILE = {
    "biot": "poromechanics.opts",
    "undrained": "poromechanics.opts",
    "flow": "flow.opts",
    "contact": "contact_mechanics.opts",
    "cold2": "contact_thermoporomechanics.opts",
}
"""Options file of the published configuration; contact_poromechanics.opts for other scenes."""
__all__ = ["MPI", "SCENES", "Layout", "rows_of"]
Arrays = Mapping[str, np.ndarray]


# Scenes


def load(name: str) -> Scene:
    """A bundled scene."""
    return hdf5.read(SCENES / f"{name}.h5")


def file_for(name: str) -> str:
    """Options file for a bundled scene."""
    return FILE.get(name, "contact_poromechanics.opts")


def block_of(scene: Scene, r: str, c: str) -> np.ndarray:
    """A block of a whole scene, dense."""
    A = np.zeros((scene.sizes[r], scene.sizes[c]))
    if (r, c) in scene.blocks:
        indptr, indices, data = scene.blocks[r, c]
        A[np.repeat(np.arange(scene.sizes[r]), np.diff(indptr)), indices] = data
    return A


def with_block(scene: Scene, r: str, c: str, A: np.ndarray | CSR) -> Scene:
    """The scene with another block."""
    block = A if isinstance(A, CSR) else csr(A)
    return replace(scene, blocks=scene.blocks | {(r, c): block}, reference={})


def scaled(scene: Scene, matrix: float = 1.0, rhs: float = 1.0, rows: Mapping[str, float] | None = None) -> Scene:
    """The scene with its matrix, its right-hand side, and whole equations multiplied, as its material data are."""
    rows = rows or {}
    mass = matrix * rows.get("mass", 1.0)
    material = scene.material and replace(scene.material, fluid_density=scene.material.fluid_density * mass)
    blocks = {rc: b._replace(data=b.data * (matrix * rows.get(rc[0], 1.0))) for rc, b in scene.blocks.items()}
    values = {f: v * (rhs * rows.get(f, 1.0)) for f, v in scene.rhs.items()}
    return replace(scene, blocks=blocks, rhs=values, reference={}, material=material)


def fractured(scene: Scene, factor: float) -> Scene:
    """The scene with the fracture part of its matrix and its right-hand side changed."""
    blocks = {rc: b._replace(data=b.data * (factor if "contact" in rc else 1.0)) for rc, b in scene.blocks.items()}
    return replace(scene, blocks=blocks, rhs={f: factor * v for f, v in scene.rhs.items()}, reference={})


def noisy(scene: Scene, seed: int, share: float = 0.05) -> Scene:
    """The scene with each number changed by about this share, but for those of contact, which make it solvable."""
    rng = np.random.default_rng(seed)

    def near(values: np.ndarray) -> np.ndarray:
        return values * (1 + share * rng.standard_normal(values.size))

    blocks = {rc: b if rc[0] == "contact" else b._replace(data=near(b.data)) for rc, b in scene.blocks.items()}
    return replace(scene, blocks=blocks, rhs={f: near(v) for f, v in scene.rhs.items()}, reference={})


def thinned(scene: Scene, block: tuple[str, str], keep: np.ndarray | slice) -> Scene:
    """The scene with some entries of a block only."""
    b = scene.blocks[block]
    chosen = np.zeros(b.data.size, dtype=bool)
    chosen[keep] = True
    indptr = np.concatenate([[0], np.cumsum(chosen)])[b.indptr]
    return replace(scene, blocks=scene.blocks | {block: CSR(indptr, b.indices[chosen], b.data[chosen])})


def without_stiffness(scene: Scene, name: str, cell: int) -> Scene:
    """The scene with a diagonal block of one cell zero."""
    size = scene.block_size(name)
    A = block_of(scene, name, name)
    rows = slice(size * cell, size * (cell + 1))
    A[rows, rows] = 0.0
    return with_block(scene, name, name, A)


# Distribution


def system_of(scene: Scene, on: MPI.Intracomm = comm) -> System:
    """A whole scene as a system, each field cut evenly."""
    system = System(Layout.contiguous(on, scene.dimension, scene.sizes))
    system.take(scene)
    return system


def gathered(matrix: PETSc.Mat) -> np.ndarray:
    """A distributed matrix, dense, on every rank."""
    indptr, indices, values = matrix.getValuesCSR()
    part = np.zeros((indptr.size - 1, matrix.getSize()[1]))
    part[np.repeat(np.arange(indptr.size - 1), np.diff(indptr)), indices] = values
    return np.concatenate(matrix.comm.tompi4py().allgather(part))


def scaled_blocks(system: System, scene: Scene) -> dict[tuple[str, str], np.ndarray]:
    """Dense blocks of a whole scene with the row scales of its system."""
    return {(r, c): np.ldexp(block_of(scene, r, c), system.row_scale[r]) for r in scene.fields for c in scene.fields}


def local_order(layout: Layout, fields: Iterable[str]) -> np.ndarray:
    """For fields that stand side by side on each rank, where each row stands field after field."""
    parts, start = [], 0
    for f in fields:
        parts.append(start + np.arange(*layout.rows(f)))
        start += layout.sizes(f)[1]
    return np.concatenate(layout.comm.allgather(np.concatenate(parts)))


def unequal(scene: Scene) -> Layout:
    """All fracture cells on the last rank, nothing but rock on the others."""
    cells = {}
    for f in scene.fields:
        n = scene.sizes[f] // scene.block_size(f)
        last = np.where(np.arange(comm.size) == comm.size - 1, n, 0)
        rock = np.diff((n * np.arange(comm.size + 1)) // comm.size)
        cells[f] = rock if f in ("momentum", "mass") else last
    return Layout.from_cells(comm, scene.dimension, cells)


# Truth


def times(block: CSR, x: np.ndarray) -> np.ndarray:
    """The product of a block with a vector in extended precision."""
    terms, out = block.data * x[block.indices], np.zeros(block.indptr.size - 1, dtype=np.longdouble)
    full = np.flatnonzero(np.diff(block.indptr))
    if full.size:
        out[full] = np.add.reduceat(terms, block.indptr[full])
    return out


def confirm(scene: Scene, result: Result, solution: Arrays) -> None:
    """Assert that what a result says of a whole scene is so, computed in extended precision.

    Of a converged one the residual is within its tolerance, but for what rounding explains, and so is the backward
    error of every field; of any one, residuals are the true ones and no backward error is understated.
    """
    x = {f: np.asarray(v, dtype=np.longdouble) for f, v in solution.items()}
    r = {f: np.asarray(scene.rhs[f], dtype=np.longdouble) for f in x}
    size = {f: np.abs(v) for f, v in r.items()}
    b = np.linalg.norm(np.concatenate([*r.values()])) or np.longdouble(1.0)
    for (row, column), block in scene.blocks.items():
        if row in x and column in x:
            r[row] = r[row] - times(block, x[column])
            size[row] = size[row] + times(block._replace(data=np.abs(block.data)), np.abs(x[column]))
    residual, terms = ({f: np.linalg.norm(v) for f, v in part.items()} for part in (r, size))
    backward = {f: residual[f] / (terms[f] or 1.0) for f in x}
    relative, rounding = np.linalg.norm([*residual.values()]) / b, 8 * EPS * np.linalg.norm([*terms.values()]) / b
    said = result.true_relative_residual
    assert abs(said - relative) <= 1e-6 * relative + rounding, f"says {said:.3e}, numpy {relative:.3e}"
    for f in x:
        found, exact = result.residual_by_field[f], residual[f] / b
        assert abs(found - exact) <= 1e-6 * exact + 8 * EPS * terms[f] / b, f"{f}: says {found:.3e}, numpy {exact:.3e}"
        found, exact = result.backward_error_by_field[f], backward[f]
        assert found >= exact / 1.0001 - 8 * EPS, f"{f}: backward error is said to be {found:.3e}, but is {exact:.3e}"
    if result.converged:
        limit = result.tolerance * (1 + 1e-6) + ROUNDING_UNITS * EPS * np.linalg.norm([*terms.values()]) / b
        assert relative <= limit, f"{relative:.3e} of {limit:.3e}"
        worst, limit = max(backward.values()), max(result.field_tolerance * (1 + 1e-6), ROUNDING_UNITS * EPS)
        assert worst <= limit, f"{worst:.3e} of {limit:.3e}"


def verified(scene: Scene, solver: Solver, result: Result | None = None) -> Result:
    """A result, of a new solve if none is given, that numpy confirms for the whole scene. Collective."""
    found = solver.solve() if result is None else result
    whole = solver.system.gather(found.solution)
    with together(solver.layout.comm):
        if whole is not None:
            confirm(scene, found, whole)
    return found


def exact(scene: Scene) -> dict[str, np.ndarray]:
    """Solution by a dense factorisation."""
    A, b = dense(scene), np.concatenate([scene.rhs[f] for f in scene.fields])
    x, ends = np.linalg.solve(A, b), np.cumsum([scene.sizes[f] for f in scene.fields])[:-1]
    return dict(zip(scene.fields, np.split(x, ends), strict=True))
