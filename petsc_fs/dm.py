"""DMShell with named fields, so that options files can group fields at every level.

PCFIELDSPLIT asks the DM of its KSP for fields (`-pc_fieldsplit_0_fields 0`,
`-pc_fieldsplit_1_fields 1,2,3`) and hands the DM of each split on to it. A split of one field takes
the field's name as option prefix (`fieldsplit_contact_`), a split of several its number
(`fieldsplit_1_`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs.errors import UsageError
from petsc_fs.fields import MECHANICS
from petsc_fs.layout import Layout
from petsc_fs.reuse import Reuse
from petsc_fs.scene import Integers

Members = Sequence[tuple[str, tuple[str, ...]]]
"""Fields as a DM lists them: name and the fields of the table it is made of, in the table's order."""


Blocks = dict[tuple[str, str], PETSc.Mat]
"""Matrices by (row field, column field); what is missing is zero."""


@dataclass
class Problem:
    """What a scene knows beyond its matrix; it travels with the DM to the level that needs it.

    Attributes:
        layout: distribution of the rows of each field.
        blocks: the matrix at this level, by reference.
        cell_centers: per field (cells on this rank, 3), where known.
        fixed_stress: (mass rows on this rank, 2): for damping exponent t the diagonal is
            first column * second column ** t; None without material data.
        contact_state: (fracture cells on this rank,) or None; used to explain errors.
        reuse: keeps what levels have built from one matrix to the next; None if nothing does.
    """

    layout: Layout
    blocks: Blocks
    cell_centers: dict[str, NDArray[np.float64]] = field(default_factory=dict)
    fixed_stress: NDArray[np.float64] | None = None
    contact_state: Integers | None = None
    reuse: Reuse | None = None


def field_dm(problem: Problem, members: Members) -> PETSc.DMShell:
    """A DM that splits its vector into named fields, in the order given.

    Collective. On each rank the vector lists all local rows of the first field, then of the second,
    and so on, which is how a MatNest numbers them.

    Args:
        problem: kept as the DM's application context, together with `members`, under
            `getAppCtx() == (problem, members)`.
        members: fields by name. One made of several fields splits further into those.
    """
    comm = problem.layout.comm
    dm = PETSc.DMShell().create(comm=comm)
    dm.setAppCtx((problem, tuple(members)))
    layout = problem.layout
    local = [sum(layout.sizes(f)[0] for f in fields) for _, fields in members]
    names = [f for _, fields in members for f in fields]
    dm.setGlobalVector(PETSc.Vec().createMPI((sum(local), sum(layout.sizes(f)[1] for f in names)), comm=comm))
    start = sum(layout.rows(f)[0] for f in names)  # all rows of the ranks before, which the layout knows
    offsets = start + np.concatenate([[0], np.cumsum(local)])

    def index_set(ids: Sequence[int]) -> PETSc.IS:
        indices = np.concatenate([np.arange(offsets[i], offsets[i + 1]) for i in ids])
        iset = PETSc.IS().createGeneral(indices.astype(PETSc.IntType), comm=comm)
        fields = [f for i in ids for f in members[i][1]]
        iset.setBlockSize(common_block_size(problem.layout, fields))
        space = near_null_space(problem, fields)
        if space is not None:
            iset.compose("nearnullspace", space)
        return iset

    def sub_dm(ids: Sequence[int]) -> PETSc.DMShell:
        part = [members[i] for i in ids]
        if len(part) == 1 and len(part[0][1]) > 1:
            part = [(f, (f,)) for f in part[0][1]]
        return field_dm(problem, part)

    def decomposition(_: PETSc.DM) -> tuple[list[str], list[PETSc.IS], list[PETSc.DM]]:
        every = range(len(members))
        return [name for name, _ in members], [index_set([i]) for i in every], [sub_dm([i]) for i in every]

    def create_sub_dm(_: PETSc.DM, ids: Sequence[int]) -> tuple[PETSc.IS, PETSc.DM]:
        numbers = [int(i) for i in ids]
        wrong = [i for i in numbers if not 0 <= i < len(members)]
        if wrong:
            names = ", ".join(f"{i} {name}" for i, (name, _) in enumerate(members))
            raise UsageError(f"-pc_fieldsplit_N_fields: no field {wrong[0]} at this level; fields are {names}")
        return index_set(numbers), sub_dm(numbers)

    dm.setCreateFieldDecomposition(decomposition)
    dm.setCreateSubDM(create_sub_dm)
    return dm


def merge_mechanics(names: Sequence[str]) -> Members:
    """Fields with those of mechanics as one member, in order."""
    merged: list[tuple[str, tuple[str, ...]]] = []
    mechanics = tuple(n for n in names if n in MECHANICS)
    for name in names:
        if name not in MECHANICS:
            merged.append((name, (name,)))
        elif name == mechanics[0]:
            merged.append(("mechanics", mechanics))
    return merged


def field_nest(
    members: Members, blocks: Blocks, layout: Layout, mat_type: str = "aij", *, assembled: bool = False
) -> PETSc.Mat:
    """One MatNest over fields, those made of several assembled into one matrix on the diagonal.

    Collective. Assembling copies; all other blocks are there by reference, in a MatNest of their own
    where a row or column has several fields. The assembled matrix keeps the block size that its fields
    share, which multigrid needs.

    A product with a MatNest asks all ranks several times where its parts are. `assembled` spares that in the blocks
    above the diagonal, which upper triangular factors multiply with, for copies of them.

    Args:
        members: fields by name, as in `field_dm`.
        blocks: matrices by pairs of fields of the table.
        layout: distribution of rows.
        mat_type: of assembled matrices, see `one_matrix`.
        assembled: whether blocks of several fields above the diagonal become one matrix, too.
    """

    def block(rows: tuple[str, ...], columns: tuple[str, ...]) -> PETSc.Mat | None:
        if len(rows) == len(columns) == 1:
            return blocks.get((rows[0], columns[0]))
        if not any((r, c) in blocks for r in rows for c in columns):
            return None
        if rows != columns:
            nest = _nest(rows, columns, blocks, layout)
            above = layout.fields.index(rows[0]) < layout.fields.index(columns[0])
            return _as_aij(nest) if assembled and above else nest
        return one_matrix(rows, blocks, layout, mat_type=mat_type)

    return PETSc.Mat().createNest([[block(r, c) for _, c in members] for _, r in members], comm=layout.comm)


def one_matrix(
    fields: Sequence[str], blocks: Blocks, layout: Layout, out: PETSc.Mat | None = None, mat_type: str = "aij"
) -> PETSc.Mat:
    """The square matrix of some fields as one matrix with the block size they share. Collective.

    Args:
        fields: of the rows and columns, in the order of the table.
        blocks: matrices by pairs of fields, copied.
        layout: distribution of rows.
        out: an earlier result of the same pattern, to take the new values.
        mat_type: "aij"; or "hypre" for the storage that PCHYPRE works on, of which it then needs no copy; or "nest"
            for a MatNest of the blocks by reference. One field alone is passed on by reference, as AIJ.
    """
    if len(fields) == 1:
        return blocks[fields[0], fields[0]]
    nest = _nest(fields, fields, blocks, layout)
    if mat_type == "nest":
        size = common_block_size(layout, fields)
        nest.setBlockSizes(size, size)
        return nest
    matrix = _as_aij(nest, out)
    if mat_type != "aij":
        aij, matrix = matrix, matrix.convert(mat_type, PETSc.Mat())
        aij.destroy()
    if out is None:
        size = common_block_size(layout, fields)
        matrix.setBlockSizes(size, size)
    return matrix


def _as_aij(nest: PETSc.Mat, out: PETSc.Mat | None = None) -> PETSc.Mat:
    """A MatNest, which ends here, as one AIJ. Collective."""
    matrix = nest.convert("aij", PETSc.Mat() if out is None else out)
    nest.destroy()
    return matrix


def _nest(rows: Sequence[str], columns: Sequence[str], blocks: Blocks, layout: Layout) -> PETSc.Mat:
    """A MatNest of blocks by reference, with empty matrices for those that are missing."""

    def block(r: str, c: str) -> PETSc.Mat:
        if (r, c) in blocks:
            return blocks[r, c]
        empty = PETSc.Mat().createAIJ((layout.sizes(r), layout.sizes(c)), nnz=0, comm=layout.comm)
        empty.assemble()
        return empty

    return PETSc.Mat().createNest([[block(r, c) for c in columns] for r in rows], comm=layout.comm)


def common_block_size(layout: Layout, fields: Sequence[str]) -> int:
    """Block size of a vector made of these fields: theirs if all agree, else 1."""
    sizes = {layout.block_size(f) for f in fields}
    return sizes.pop() if len(sizes) == 1 else 1


def near_null_space(problem: Problem, fields: Sequence[str]) -> PETSc.NullSpace | None:
    """Rigid-body modes of displacement fields with known cell centres, else None.

    Collective. 3 modes in 2D, 6 in 3D, made orthonormal, as `MatSetNearNullSpace` wants them.
    """
    if not all(f in MECHANICS and f in problem.cell_centers for f in fields):
        return None
    layout = problem.layout
    centers = np.concatenate([problem.cell_centers[f] for f in fields])
    vectors = []
    for mode in rigid_body_modes(centers, layout.dimension):
        vector = PETSc.Vec().createMPI((mode.size, None), bsize=layout.dimension, comm=layout.comm)
        vector.setArray(mode)
        vectors.append(vector)
    for i, vector in enumerate(vectors):
        for other in vectors[:i]:
            vector.axpy(-vector.dot(other), other)
        vector.normalize()
    return PETSc.NullSpace().create(vectors=vectors, comm=layout.comm)


def rigid_body_modes(centers: NDArray[np.float64], dimension: int) -> list[NDArray[np.float64]]:
    """Translations and rotations of points, as interleaved displacement vectors.

    Args:
        centers: (points, 3).
        dimension: D, number of components of each displacement.

    Returns:
        D (D + 1) / 2 arrays of length D * points.
    """
    modes = []
    for i in range(dimension):
        mode = np.zeros((len(centers), dimension))
        mode[:, i] = 1.0
        modes.append(mode.ravel())
    for i in range(dimension):
        for j in range(i + 1, dimension):
            mode = np.zeros((len(centers), dimension))
            mode[:, i] = -centers[:, j]
            mode[:, j] = centers[:, i]
            modes.append(mode.ravel())
    return modes
