"""Fields on PETSc's own objects: a MatNest whose diagonal blocks are named, and what its parts carry.

A *field* is a row and column of a MatNest. Its name is that of its diagonal block (`PetscObjectSetName`,
`Mat.setName`), its block size that of the block, its index set what `MatNestGetISs` gives. Data travel as objects
composed on a block (`PetscObjectCompose`, `Mat.compose`):

- "fixed_stress_base", "fixed_stress_ratio" on the block of pressure, see `petsc_fs.pc.FixedStress`;
- "coordinates" on blocks of displacements: a Vec with the block size of the field, for rigid-body modes.

Sub-matrices of a MatNest hold its blocks by reference, so that names and data survive nested Schur complements. Nothing
here knows scenes; every function is collective unless it says that it is local.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs.errors import LayoutError, SceneError, UsageError, together

Blocks = dict[tuple[str, str], PETSc.Mat]
"""Matrices by (row field, column field); what is missing is zero."""

Pointer, Count = ctypes.c_void_p, ctypes.c_ssize_t
"""For `call`: an address, and PetscCount."""

_library = ctypes.PyDLL(PETSc.__file__)  # which keeps the interpreter locked: callbacks may be in Python


def call(function: str, *arguments: Any) -> None:
    """Call a function of PETSc that petsc4py lacks; petsc4py objects are handed over by their handle.

    Raises:
        PETSc.Error: it failed.
    """
    given = [ctypes.c_void_p(a.handle) if isinstance(a, PETSc.Object) else a for a in arguments]
    code = getattr(_library, function)(*given)
    if code:
        raise PETSc.Error(code)


def field_names(A: PETSc.Mat) -> tuple[str, ...]:
    """Names of the fields of a matrix: of the diagonal blocks of a MatNest, else of the matrix itself. Local."""
    if A.getType() != "nest":
        return (A.getName(),)
    rows, columns = A.getNestSize()
    return tuple(A.getNestSubMatrix(i, i).getName() for i in range(min(rows, columns)) if A.getNestSubMatrix(i, i))


def blocks_of(A: PETSc.Mat) -> Blocks:
    """The blocks of a square MatNest by the names of its fields, by reference. Local.

    Raises:
        LayoutError: a diagonal block is missing, or two have the same name.
    """
    names = field_names(A)
    if len(set(names)) != len(names) or A.getNestSize() != (len(names), len(names)):
        raise LayoutError(f"a MatNest needs one named block per field on its diagonal; found {', '.join(names)}")
    numbered = product(enumerate(names), enumerate(names))
    return {(r, c): B for (i, r), (j, c) in numbered if (B := A.getNestSubMatrix(i, j))}


def nest_of(names: Sequence[str], blocks: Blocks, comm: Any = None) -> PETSc.Mat:
    """A MatNest over fields, its blocks by reference."""
    return PETSc.Mat().createNest([[blocks.get((r, c)) for c in names] for r in names], comm=comm)


def split(A: PETSc.Mat, fields: Mapping[str, PETSc.IS]) -> PETSc.Mat:
    """The MatNest of one assembled matrix, by the rows of each field; blocks without an entry are left out.

    Collective. Blocks are copies (`MatCreateSubMatrix`). The vectors that belong to it list the rows of this rank field
    by field, in the order of `fields`.

    Args:
        A: square, rows and columns numbered alike.
        fields: for each field the global numbers of its rows that are to be on this rank; its block size is that of
            the field, and its name becomes that of the diagonal block.
    """
    blocks: Blocks = {}
    for (r, rows), (c, columns) in product(fields.items(), fields.items()):
        B = A.createSubMatrix(rows, columns)
        if r != c and not B.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"]:
            B.destroy()
            continue
        B.setBlockSizes(rows.getBlockSize(), columns.getBlockSize())
        blocks[r, c] = B
    for name in fields:
        blocks[name, name].setName(name)
    nest = nest_of(tuple(fields), blocks, A.comm)
    for B in blocks.values():
        B.destroy()  # the nest holds them
    return nest


def give_fields(ksp: PETSc.KSP) -> None:
    """Have the options of a KSP on a MatNest know its fields by name and number, at the outermost level.

    Collective. Below a `ContactTransform` or `FixedStress` that is so anyway. What this sets is the DM of the KSP; it
    is called before `KSPSetFromOptions`.
    """
    A = ksp.getOperators()[1]
    if A.getType() != "nest":
        return
    ksp.setDM(field_dm(A))
    if PETSc.Sys.getVersion() < (3, 25):
        ksp.setDMActive(False)
    else:
        ksp.setDMActive(PETSc.KSP.DMActive.ALL, False)


def field_dm(A: PETSc.Mat) -> PETSc.DMShell:
    """A DM that names the fields of a MatNest and groups them by number.

    PCFIELDSPLIT asks the DM of its KSP for fields (`-pc_fieldsplit_0_fields 0`, `-pc_fieldsplit_1_fields 1,2,3`) and
    hands the DM of each split on to it, so that this holds at every level. A split of one field takes the field's name
    as option prefix (`fieldsplit_contact_`), a split of several its number (`fieldsplit_1_`). (PETSc can do that for a
    MatNest without a DM since 3.22, but without names.)

    Collective. A diagonal block that is a MatNest is a field like any other, and splits into its own fields; one that
    has the attribute `COMPONENTS` (`PETSc.Object.setAttr`) splits into those.
    """
    whole = _Field.of(A)
    return _shell(whole.members, A.comm, interleaved=whole.interleaved)


COMPONENTS = "petsc_fs_components"
"""Name, and sizes on this rank and on all, of each scalar field that a matrix is made of: the unknowns of a cell next
to each other if the block size is their number, else one field after the other."""


class _Field:
    """A field as a DM knows it.

    Attributes:
        name: of the block.
        local: rows on this rank.
        total: rows on all ranks.
        block_size: of the block.
        members: the fields of a block that is a MatNest, or its components.
        interleaved: whether the members are components of a cell.
    """

    def __init__(self, name: str, sizes: tuple[int, int], block_size: int, members: list[_Field]) -> None:
        self.name, self.block_size, self.members = name, block_size, members
        self.local, self.total = sizes
        self.interleaved = False

    @classmethod
    def of(cls, block: PETSc.Mat) -> _Field:
        count = block.getNestSize()[0] if block.getType() == "nest" else 0
        members = [cls.of(block.getNestSubMatrix(i, i)) for i in range(count)]
        field = cls(block.getName(), block.getSizes()[0], block.getBlockSize(), members)
        if components := block.getAttr(COMPONENTS):
            field.members = [cls(name, sizes, 1, []) for name, sizes in components]
            field.interleaved = field.block_size == len(components)
        return field


def _shell(fields: list[_Field], comm: Any, *, interleaved: bool = False) -> PETSc.DMShell:
    local = [f.local for f in fields]
    dm = PETSc.DMShell().create(comm=comm)
    vector = PETSc.Vec().createMPI((sum(local), sum(f.total for f in fields)), comm=comm)
    dm.setGlobalVector(vector)
    offsets = vector.getOwnershipRange()[0] + np.concatenate([[0], np.cumsum(local)])

    def index_set(ids: Sequence[int]) -> PETSc.IS:
        sizes = {fields[i].block_size for i in ids}
        if interleaved:
            indices = np.sort([np.arange(offsets[0] + i, offsets[-1], len(fields)) for i in ids], axis=None)
            sizes = {len(ids)}
        else:
            indices = np.concatenate([np.arange(offsets[i], offsets[i + 1]) for i in ids])
        found = PETSc.IS().createGeneral(indices.astype(PETSc.IntType), comm=comm)
        found.setBlockSize(sizes.pop() if len(sizes) == 1 else 1)
        return found

    def sub_dm(ids: Sequence[int]) -> PETSc.DMShell:
        part = [fields[i] for i in ids]
        if len(part) == 1 and part[0].members:
            return _shell(part[0].members, comm, interleaved=part[0].interleaved)
        return _shell(part, comm, interleaved=interleaved)

    def decomposition(_: PETSc.DM) -> tuple[list[str], list[PETSc.IS], list[PETSc.DM]]:
        every = range(len(fields))
        return [f.name for f in fields], [index_set([i]) for i in every], [sub_dm([i]) for i in every]

    def create_sub_dm(_: PETSc.DM, ids: Sequence[int]) -> tuple[PETSc.IS, PETSc.DM]:
        numbers = [int(i) for i in ids]
        wrong = [i for i in numbers if not 0 <= i < len(fields)]
        if wrong:
            names = ", ".join(f"{i} {f.name}" for i, f in enumerate(fields))
            raise UsageError(f"-pc_fieldsplit_N_fields: no field {wrong[0]} at this level; fields are {names}")
        return index_set(numbers), sub_dm(numbers)

    dm.setCreateFieldDecomposition(decomposition)
    dm.setCreateSubDM(create_sub_dm)
    return dm


def levels(pc: PETSc.PC) -> Iterator[PETSc.PC]:
    """A PC and all PCs in it, each before those in it, in the order of elimination.

    Collective. Goes into PCFIELDSPLIT and into the Python PCs of this package, not into what is local to a rank, as
    the subdomains of PCASM are. What is in a PC is asked for only once the caller has had the PC itself: whoever walks
    may set it up first. A Python PC that is not set up has nothing in it; a PCFIELDSPLIT has to be.
    """
    yield pc
    if pc.getType() == "fieldsplit":
        for ksp in pc.getFieldSplitSubKSP():
            yield from levels(ksp.getPC())
    elif pc.getType() == "python":
        for inner in getattr(pc.getPythonContext(), "inners", ()):
            yield from levels(inner)


def one_matrix(A: PETSc.Mat, mat_type: str = "aij", out: PETSc.Mat | None = None) -> PETSc.Mat:
    """A MatNest as one assembled matrix, with the block size its fields share and the near-null space they have.

    Collective.

    Args:
        A: copied.
        mat_type: "aij", or "hypre" for the storage that PCHYPRE works on, of which it then needs no copy.
        out: an earlier result for a MatNest of the same patterns, to take the new values.
    """
    filled = _filled(A)
    one = filled.convert("aij", PETSc.Mat() if out is None else out)
    filled.destroy()
    if mat_type != "aij":
        aij, one = one, one.convert(mat_type, PETSc.Mat())
        aij.destroy()
    if out is None and len(set(A.getNestSize())) == 1:
        diagonal = [A.getNestSubMatrix(i, i) for i in range(A.getNestSize()[0])]
        sizes = {B.getBlockSize() for B in diagonal}
        if len(sizes) == 1:
            one.setBlockSizes(*(2 * [*sizes]))
        modes = rigid_body_modes(diagonal)
        if modes is not None:
            one.setNearNullSpace(modes)
    return one


def _filled(A: PETSc.Mat) -> PETSc.Mat:
    """A MatNest with empty matrices for the blocks that are missing: MatConvert needs at least one in each row."""
    rows, columns = A.getNestSize()
    grid = [[A.getNestSubMatrix(i, j) for j in range(columns)] for i in range(rows)]
    row_sizes = [next(B.getSizes()[0] for B in row if B) for row in grid]
    column_sizes = [next(row[j].getSizes()[1] for row in grid if row[j]) for j in range(columns)]
    for i, j in product(range(rows), range(columns)):
        if not grid[i][j]:
            grid[i][j] = empty((row_sizes[i], column_sizes[j]), A.comm)
    return PETSc.Mat().createNest(grid, comm=A.comm)


def empty(sizes: tuple[tuple[int, int], tuple[int, int]], comm: Any) -> PETSc.Mat:
    """An AIJ without entries."""
    zero = PETSc.Mat().createAIJ(sizes, nnz=0, comm=comm)
    zero.assemble()
    return zero


def rigid_body_modes(blocks: Sequence[PETSc.Mat]) -> PETSc.NullSpace | None:
    """Rigid-body modes of displacement fields together, where all of their blocks have "coordinates"; else None."""
    parts = [B.query("coordinates") for B in blocks]
    if not parts or not all(parts):
        return None
    local = np.concatenate([part.getArray() for part in parts])
    together = PETSc.Vec().createMPI((local.size, None), bsize=parts[0].getBlockSize(), comm=blocks[0].comm)
    together.setArray(local)
    return PETSc.NullSpace().createRigidBody(together)


def inverse_of_diagonal(A: PETSc.Mat, what: str, exclude: str = "") -> PETSc.Mat:
    """AIJ with the inverses of the diagonal blocks of a square matrix, each as large as its block size.

    Collective.

    Args:
        A: AIJ.
        what: its name, for errors.
        exclude: what to do about a singular block, for errors.

    Raises:
        SceneError: a block is singular to rounding; it is named by its number.
    """
    D, ((n, _), _) = A.getBlockSize(), A.getSizes()
    first = A.getOwnershipRange()[0]
    dense = diagonal_blocks(A, D)
    with together(A.comm.tompi4py()):
        values = np.linalg.svd(dense, compute_uv=False)
        bad = np.flatnonzero(~(values[:, -1] > ALMOST_SINGULAR * values[:, 0]))
        if bad.size:
            more = f", and at {bad.size - 1} more on this rank" if bad.size > 1 else ""
            error = SceneError(f"{what}: singular at cell {first // D + int(bad[0])}{more}{exclude}")
            error.cell = A.getName(), first // D + int(bad[0])
            raise error
    inverse = np.linalg.inv(dense)
    columns = first + (np.arange(n // D) * D)[:, None, None] + np.zeros((D, 1), dtype=np.int64) + np.arange(D)
    csr = ((np.arange(n + 1) * D).astype(PETSc.IntType), columns.ravel().astype(PETSc.IntType), inverse.ravel())
    return PETSc.Mat().createAIJ(A.getSizes(), bsize=D, csr=csr, comm=A.comm)


ALMOST_SINGULAR = 1e-14
"""Ratio of least to greatest singular value at which a small matrix counts as singular."""


def diagonal_blocks(A: PETSc.Mat, size: int) -> NDArray[np.float64]:
    """The blocks on the diagonal of the rows of this rank, dense: (rows / size, size, size). Local."""
    indptr, indices, data = A.getDiagonalBlock().getValuesCSR()
    rows = np.repeat(np.arange(indptr.size - 1), np.diff(indptr))
    inside = rows // size == indices // size
    dense = np.zeros(((indptr.size - 1) // size, size, size))
    dense[rows[inside] // size, rows[inside] % size, indices[inside] % size] = data[inside]
    return dense


def multiply(A: PETSc.Mat, x: NDArray[np.float64], *, transposed: bool = False) -> NDArray[np.float64]:
    """The product of a matrix, or its transpose, with the rows of a vector on this rank. Collective."""
    given, found = A.createVecs()[:: -1 if transposed else 1]
    given.setArray(x)
    (A.multTranspose if transposed else A.mult)(given, found)
    product = np.array(found.getArray())
    given.destroy()
    found.destroy()
    return product


def multiply_absolute(A: PETSc.Mat, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """|A| |x|, entry by entry. Collective."""
    M = magnitudes(A)
    product = multiply(M, np.abs(x))
    M.destroy()
    return product


def magnitudes(A: PETSc.Mat) -> PETSc.Mat:
    """A copy of an AIJ, or of a MatNest of such, with the magnitudes of all entries. Collective."""
    if A.getType() == "nest":
        rows, columns = (range(n) for n in A.getNestSize())
        grid = [[A.getNestSubMatrix(i, j) for j in columns] for i in rows]
        return PETSc.Mat().createNest([[magnitudes(B) if B else None for B in row] for row in grid], comm=A.comm)
    copy = A.duplicate(copy=True)
    parts = [copy]
    if copy.getType().startswith("mpi"):
        pointers = [ctypes.c_void_p(), ctypes.c_void_p()]
        call("MatMPIAIJGetSeqAIJ", copy, *map(ctypes.byref, pointers), None)
        parts = [borrowed(copy, pointer) for pointer in pointers]
    for part in parts:
        entries = int(part.getInfo(PETSc.Mat.InfoType.LOCAL)["nz_used"])
        address = ctypes.POINTER(ctypes.c_double)()
        call("MatSeqAIJGetArray", part, ctypes.byref(address))
        if entries:
            values = np.ctypeslib.as_array(address, shape=(entries,))
            np.abs(values, out=values)
        call("MatSeqAIJRestoreArray", part, ctypes.byref(address))
    return copy


def borrowed(owner: PETSc.Object, handle: ctypes.c_void_p) -> Any:
    """An object of PETSc that petsc4py has no call for, as petsc4py has it. Local.

    Args:
        owner: any object of the same communicator.
        handle: of the object.
    """
    call("PetscObjectCompose", owner, b"petsc_fs_borrowed", handle)
    found = owner.query("petsc_fs_borrowed")
    call("PetscObjectCompose", owner, b"petsc_fs_borrowed", None)
    return found
