"""System: a scene as PETSc objects, namely a MatNest with a named block per field, and a right-hand side."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs import nest
from petsc_fs.errors import LayoutError, SceneError, together
from petsc_fs.fields import MECHANICS
from petsc_fs.nest import Blocks
from petsc_fs.partition import Layout
from petsc_fs.scene import CSR, Scene, csr_rows

Floats = NDArray[np.float64]
FieldArrays = dict[str, Floats]
Pair = tuple[str, str]

TIED = 1.0
"""Difference of exponents up to which the fields of mechanics share one."""
ROUNDS = 50
"""Rounds of equilibration between fields, of which there are few, at most."""
BALANCED = 1e-3
"""Largest exponent at which it ends."""

EPS = 2.0**-52
ROUNDING_UNITS = 100
"""A residual of so many units of rounding of the terms of its equations cannot be told from zero."""
SMALL = 1e-5
"""Relative residual of the equilibrated system from which rounding is no excuse."""


@dataclass(frozen=True)
class Check:
    """How well a vector satisfies the user's system, field by field; all numbers have a power of two in common.

    Attributes:
        residual: |b_f - A_f x|.
        terms: | |A_f| |x| + |b_f| |, or a lower bound of it.
        rhs: |b_f|.
        balanced: |b - A x| / |b| with the rows of the equilibrated system.
    """

    residual: Mapping[str, float]
    terms: Mapping[str, float]
    rhs: Mapping[str, float]
    balanced: float

    @property
    def relative(self) -> float:
        """|b - A x| / |b|; the absolute residual where b is zero."""
        return norm(self.residual) / (norm(self.rhs) or 1.0)

    @property
    def backward(self) -> dict[str, float]:
        """|b_f - A_f x| / | |A_f| |x| + |b_f| | per field: by how much its equations must be changed to hold."""
        return {f: r / (self.terms[f] or 1.0) for f, r in self.residual.items()}

    @property
    def rounding(self) -> float:
        """What rounding may leave of the residual, relative to |b|; 0 where that is not small, whatever the units."""
        if self.balanced > SMALL:
            return 0.0
        return ROUNDING_UNITS * EPS * norm(self.terms) / (norm(self.rhs) or 1.0)

    def excess(self, tolerance: float, field_tolerance: float) -> float:
        """By what factor the tolerances are missed; at most 1 where they are met, or rounding forbids it."""
        overall = self.relative / max(tolerance, self.rounding)
        return max(overall, *(e / max(field_tolerance, ROUNDING_UNITS * EPS) for e in self.backward.values()))


def norm(parts: Mapping[str, float]) -> float:
    """Norm of a vector, from those of its fields."""
    return math.hypot(*parts.values())


class System:
    """The linear system of one scene after another, distributed.

    The rows of each field are multiplied by a power of two, which rounds nothing, so that no field hides behind the
    units of another; `residual` and `solution` undo it. The right-hand side is brought to a size of one likewise.

    Attributes:
        layout: distribution of the rows.
        blocks: matrices by (row field, column field), AIJ with the fields' block sizes.
        J: the Jacobian, a MatNest of them; a new one after each `take`.
        b: right-hand side, numbered as J: on each rank field by field.
        row_scale: per field the exponent of two that its rows are multiplied by.
        rhs_scale: the exponent that the right-hand side, and with it the solution, is multiplied by besides.
        block_norms: largest row sum of |entries| of each block, as it was given.
        renewals: how often blocks were made anew because their pattern had changed.
    """

    def __init__(self, layout: Layout, *, root_only: bool = False, near_null_space: bool = True) -> None:
        """Nothing is there yet; see `take`. Local.

        Args:
            layout: distribution of the rows, without empty fields.
            root_only: whether scenes are on rank 0 alone; otherwise each rank gives its share of their rows.
            near_null_space: whether displacement fields get their rigid-body modes.
        """
        self.layout = layout
        self.root_only = root_only
        self.blocks: Blocks = {}
        self.J: Any = None
        self.b: Any = None
        self.renewals = 0
        self.row_scale = dict.fromkeys(layout.fields, 0)
        self.rhs_scale = 0
        self.block_norms: dict[Pair, float] = {}
        self._near_null_space = near_null_space
        self._patterns: dict[Pair, CSR] = {}
        ends = np.cumsum([layout.sizes(f)[0] for f in layout.fields]).tolist()
        self._parts = {f: slice(end - layout.sizes(f)[0], end) for f, end in zip(layout.fields, ends, strict=True)}
        given = Layout.contiguous(layout.comm, layout.dimension, {f: layout.sizes(f)[1] for f in layout.fields})
        self._shares = {f: given.rows(f) for f in layout.fields}
        self._rows = {f: _Rows(layout, f, None if root_only else given.sizes(f)[0]) for f in layout.fields}
        self._moved = any(
            f in layout.cells or not np.array_equal(layout.offsets[f], given.offsets[f]) for f in layout.fields
        )

    # From scenes

    def take(self, scene: Scene | None, *, release: bool = False) -> None:
        """Take matrix, right-hand side and cell data of a scene. Collective.

        Args:
            scene: of the fields and sizes of the layout: all rows, or this rank's share of them in the scene's
                numbering (even shares of cells, in order), or with `root_only` all rows on rank 0, None elsewhere.
            release: take each block out of the scene as soon as PETSc has it, so that little is held twice.

        Raises:
            LayoutError: scene and layout differ.
            SceneError: an equation is empty, or a block too large for this PETSc.
        """
        with together(self.layout.comm):
            if scene is not None:
                self._check(scene)
        old = self.J
        if self.root_only:
            self._spread(scene)
        else:
            assert scene is not None
            self._take_rows(scene, release)
        for name in self.layout.fields:
            self.blocks[name, name].setName(name)
        if scene is not None and scene.rows is not None:
            self._check_unknowns()
        self._compose(scene)
        self._equilibrate()
        self.J = nest.nest_of(self.layout.fields, self.blocks, self.layout.comm)
        if old is not None:
            old.destroy()
        if self.b is None:
            self.b = self.J.createVecLeft()
        self.set_rhs(scene.rhs if scene is not None else None)

    def set_rhs(self, rhs: Mapping[str, Floats] | None) -> None:
        """Take a right-hand side, given as in `take`. Collective."""
        local = [np.ldexp(self.to_layout(f, rhs[f] if rhs else None), self.row_scale[f]) for f in self.layout.fields]
        largest = self.layout.comm.allreduce(max(float(np.abs(v).max(initial=0.0)) for v in local), MPI.MAX)
        self.rhs_scale = -math.frexp(largest)[1] if largest else 0
        self.b.setArray(np.ldexp(np.concatenate(local), self.rhs_scale))

    def _check(self, scene: Scene) -> None:
        for name in self.layout.fields:
            expected = (0, scene.sizes.get(name, -1)) if scene.rows is None else self._shares[name]
            if scene.sizes.get(name) != self.layout.sizes(name)[1] or scene.row_range(name) != expected:
                raise LayoutError(f"{name}: the rows of the scene are not those of the layout")
        if set(scene.sizes) != set(self.layout.fields):
            raise LayoutError(f"the scene has fields {scene.fields}, the layout {self.layout.fields}")
        limit = np.iinfo(PETSc.IntType).max
        for (r, c), block in scene.blocks.items():
            if block.data.size > limit:
                raise SceneError(
                    f"block ({r}, {c}): {block.data.size} entries on a rank; "
                    "use more ranks, or a PETSc with 64-bit indices"
                )
        scene.check_rows()

    def _check_unknowns(self) -> None:
        """Check that each unknown is in an equation; a whole scene checks that itself. Collective.

        Sums over columns, with another weight for each row so that what is not zero does not cancel, are zero where it
        is not.
        """
        for name in self.layout.fields:
            total: Floats = np.zeros(self.layout.sizes(name)[0])
            for (_, column), block in self.blocks.items():
                if column == name:
                    weights = 1.0 + np.modf(np.arange(*block.getOwnershipRange()) * 0.6180339887498949)[0]
                    total = total + nest.multiply(block, weights, transposed=True)
            with together(self.layout.comm):
                if (empty := np.flatnonzero(total == 0)).size:
                    cell = self.layout.own_cells(name)[empty[0] // self.layout.block_size(name)]
                    raise SceneError(
                        f"{name}: the unknown of cell {cell} has no entry or only zeros in the matrix, which is "
                        "singular so; leave the cell out, or give it a row with 1 on the diagonal"
                    )

    def _bsize(self, r: str, c: str) -> tuple[int, int]:
        return self.layout.block_size(r), self.layout.block_size(c)

    def _take_rows(self, scene: Scene, release: bool) -> None:
        """Blocks from this rank's share of the rows: contiguous rows first, then those of the layout."""
        pairs = list(product(self.layout.fields, self.layout.fields))
        entries = np.array([scene.blocks[rc].data.size if rc in scene.blocks else 0 for rc in pairs])
        entries = self.layout.comm.allreduce(entries)
        for rc, n in zip(pairs, entries, strict=True):
            if rc in self.blocks:
                self.blocks.pop(rc).destroy()
            if not n and rc[0] != rc[1]:
                continue
            block = scene.blocks.pop(rc, None) if release else scene.blocks.get(rc)
            if block is None:
                block = CSR(np.zeros(scene.sizes[rc[0]] + 1, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))
                block = csr_rows(block, 0, self._shares[rc[0]][1] - self._shares[rc[0]][0])
            elif scene.rows is None:
                block = csr_rows(block, *self._shares[rc[0]])
            given = [block]
            del block
            self.blocks[rc] = self._from_rows(*rc, given, keep=not release)

    def _from_rows(self, r: str, c: str, given: list[CSR], *, keep: bool) -> PETSc.Mat:
        """A block from this rank's share of its rows, which is taken out of `given`."""
        comm, block = self.layout.comm, given.pop()
        sizes = tuple((self._shares[f][1] - self._shares[f][0], self.layout.sizes(f)[1]) for f in (r, c))
        csr = (*(part.astype(PETSc.IntType, copy=False) for part in block[:2]), block.data)
        if comm.size == 1:
            matrix = PETSc.Mat().createAIJWithArrays(sizes, csr, comm=comm)  # in these very arrays
        else:
            matrix = PETSc.Mat().createAIJ(sizes, csr=csr, comm=comm)
        del block, csr
        if self._moved or (keep and comm.size == 1):
            shared = matrix
            if self._moved:
                matrix = shared.createSubMatrix(self._rows[r].numbers, self._rows[c].numbers)
                for kept in (b"SubMatrix", b"ISAllGather"):  # copies for another call of the same kind
                    nest.call("PetscObjectCompose", matrix, kept, None)
            else:
                matrix = shared.duplicate(copy=True)
            shared.destroy()
        matrix.setBlockSizes(*self._bsize(r, c))
        return matrix

    def _spread(self, scene: Scene | None) -> None:
        """Blocks from rank 0's scene: what changes is the values, of a few small blocks the pattern too."""
        todo: list[tuple[Pair, bool]] = []
        if scene is not None:
            for rc in product(self.layout.fields, self.layout.fields):
                block, known = scene.blocks.get(rc), self._patterns.get(rc)
                if block is None and rc[0] == rc[1]:
                    block = CSR(np.zeros(scene.sizes[rc[0]] + 1, dtype=np.int64), np.zeros(0, np.int64), np.zeros(0))
                if block is None or (not block.data.size and rc[0] != rc[1]):
                    continue
                same = known is not None and _equal(known.indptr, block.indptr) and _equal(known.indices, block.indices)
                self._patterns[rc] = block
                todo.append((rc, not same))
        todo = self.layout.comm.bcast(todo)
        for rc in sorted(set(self.blocks) - {rc for rc, _ in todo}):
            self.blocks.pop(rc).destroy()
            self._patterns.pop(rc, None)
        for rc, changed in todo:
            if changed:
                if rc in self.blocks:
                    self.blocks.pop(rc).destroy()
                    self.renewals += 1
                self.blocks[rc] = self._preallocated(*rc, scene)
            values = self._patterns[rc].data if scene is not None else np.zeros(0)
            values = np.ascontiguousarray(values, dtype=np.float64)
            nest.call("MatSetValuesCOO", self.blocks[rc], values.ctypes.data_as(nest.Pointer), 1)
        for rc, block in self._patterns.items():
            self._patterns[rc] = block._replace(data=np.zeros(0))

    def _preallocated(self, r: str, c: str, scene: Scene | None) -> PETSc.Mat:
        """A matrix with the pattern of a block that rank 0 has."""
        rows = columns = np.zeros(0, dtype=PETSc.IntType)
        if scene is not None:
            block = self._patterns[r, c]
            row_of = np.repeat(np.arange(block.indptr.size - 1), np.diff(block.indptr))
            rows, columns = self._numbers(r)[row_of], self._numbers(c)[block.indices]
        matrix = PETSc.Mat().create(self.layout.comm)
        matrix.setSizes((self.layout.sizes(r), self.layout.sizes(c)))
        matrix.setType("aij")
        matrix.setBlockSizes(*self._bsize(r, c))
        pointers = [part.ctypes.data_as(nest.Pointer) for part in (rows, columns)]
        nest.call("MatSetPreallocationCOO", matrix, nest.Count(rows.size), *pointers)
        return matrix

    def _numbers(self, name: str) -> NDArray[Any]:
        """For each row of the scene its number in the layout."""
        bs = self.layout.block_size(name)
        places: NDArray[Any] = (self.layout.places(name)[:, None] * bs + np.arange(bs)).ravel()
        return places.astype(PETSc.IntType)

    def _compose(self, scene: Scene | None) -> None:
        """Give the blocks what travels with them."""
        comm, fields = self.layout.comm, self.layout.fields
        coefficients, centers = None, {}
        with together(comm):
            if scene is not None:
                coefficients = scene.fixed_stress_coefficients() if "mass" in fields else None
                centers = {f: v for f, v in scene.cell_centers.items() if f in MECHANICS}
        known = comm.bcast((coefficients is not None, sorted(centers)))
        if known[0]:
            for k, name in enumerate(("fixed_stress_base", "fixed_stress_ratio")):
                values = None if coefficients is None else self._share("mass", scene, coefficients[:, k])
                self.blocks["mass", "mass"].compose(name, self._vector("mass", values))
        for f in known[1]:
            values = None
            if scene is not None:
                values = self._share(f, scene, centers[f][:, : self.layout.dimension].ravel())
            self.blocks[f, f].compose("coordinates", self._vector(f, values))
            if self._near_null_space and (modes := nest.rigid_body_modes([self.blocks[f, f]])) is not None:
                self.blocks[f, f].setNearNullSpace(modes)

    def _vector(self, name: str, values: Floats | None) -> PETSc.Vec:
        vector = self.blocks[name, name].createVecLeft()
        vector.setArray(self._rows[name].to_layout(values))
        return vector

    def _share(self, name: str, scene: Scene | None, values: Floats) -> Floats:
        """This rank's share of the rows of a field, of values for the rows that the scene has."""
        if scene is None or scene.rows is not None or self.root_only:
            return values
        return values[slice(*self._shares[name])]

    def to_layout(self, name: str, values: Floats | None) -> Floats:
        """This rank's rows of a field, from values given as in `take`. Collective."""
        if values is not None and not self.root_only and values.size == self.layout.sizes(name)[1]:
            values = values[slice(*self._shares[name])]
        return self._rows[name].to_layout(values)

    # Scales

    def _equilibrate(self) -> None:
        """Multiply the rows of each field by a power of two, so that blocks are alike in size whatever the units."""
        self.block_norms = {rc: block.norm(PETSc.NormType.INFINITY) for rc, block in self.blocks.items()}
        exponents = row_exponents(self.block_norms)
        for (r, _), block in self.blocks.items():
            if exponents[r]:
                block.scale(2.0 ** exponents[r])
        if exponents.get("mass") and (base := self.blocks["mass", "mass"].query("fixed_stress_base")) is not None:
            base.scale(2.0 ** exponents["mass"])
        self.row_scale = exponents

    # Vectors

    def by_field(self, vector: PETSc.Vec) -> FieldArrays:
        """The local rows of each field of a vector, copied. Local."""
        values = vector.getArray()
        return {f: values[part].copy() for f, part in self._parts.items()}

    def check(self, x: PETSc.Vec | None, r: PETSc.Vec, *, exactly: bool = False) -> Check:
        """How well x satisfies the system as it was given; sets r to the residual of the present one. Collective.

        Products of blocks with fields, and diagonals, bound |A| |x| from below, at the cost of one product with J.

        Args:
            x: a vector like b; None is zero.
            r: another one, overwritten with b - J x.
            exactly: whether |A| |x| is computed as it is, for a copy of one block at a time.
        """
        rhs = self.by_field(self.b)
        residual, terms = {f: v.copy() for f, v in rhs.items()}, {f: np.abs(v) for f, v in rhs.items()}
        values = {} if x is None else self.by_field(x)
        with np.errstate(invalid="ignore", over="ignore"):
            for (row, column), block in self.blocks.items() if values else ():
                product = nest.multiply(block, values[column])
                residual[row] -= product
                if exactly:
                    size = nest.multiply_absolute(block, values[column])
                elif row == column:
                    diagonal = block.getDiagonal()
                    size = np.maximum(np.abs(product), np.abs(diagonal.getArray() * values[row]))
                    diagonal.destroy()
                else:
                    size = np.abs(product)
                terms[row] += size
            r.setArray(np.concatenate([*residual.values()]))
            residuals, sizes, rights = self.norms(
                *({f: np.ldexp(v, -self.row_scale[f]) for f, v in part.items()} for part in (residual, terms, rhs))
            )
        return Check(residuals, sizes, rights, r.norm() / (self.b.norm() or 1.0))

    def imbalance(self, x: PETSc.Vec, r: PETSc.Vec) -> dict[str, float]:
        """By how much the sum of the equations of each field, in which fluxes between cells cancel, misses. Collective.

        With w one for the first component of each cell, 1/2 for the second and 1/3 for the third, what is returned is
        |w^T r_f| / (|w^T A_f| |x| + |w^T b_f|), the backward error of w^T A_f x = w^T b_f.
        """
        values, left, rhs = self.by_field(x), self.by_field(r), self.by_field(self.b)
        sums = np.zeros((len(self.layout.fields), 3))
        for k, f in enumerate(self.layout.fields):
            weights = np.tile(1.0 / np.arange(1, self.layout.block_size(f) + 1), self.layout.own_cells(f).size)
            sums[k] = weights @ left[f], 0.0, weights @ rhs[f]
            for (row, column), block in self.blocks.items():
                if row == f:
                    sums[k, 1] += np.abs(nest.multiply(block, weights, transposed=True)) @ np.abs(values[column])
        missing, terms, rights = np.abs(self.layout.comm.allreduce(sums)).T
        found = missing / np.where(terms + rights > 0, terms + rights, 1.0)
        return dict(zip(self.layout.fields, found.tolist(), strict=True))

    def least_sizes(self, check: Check, tolerance: float) -> dict[str, float]:
        """Per field the size below which it changes no equation by more than a tolerance of its terms. Local."""
        limits = {
            f: [check.terms[r] / n for (r, c), n in self.block_norms.items() if c == f and n] for f in check.terms
        }
        return {f: tolerance * min(found, default=0.0) for f, found in limits.items()}

    def norms(self, *vectors: Mapping[str, Floats]) -> list[dict[str, float]]:
        """Euclidean norms of each field of vectors over all ranks, also where squares overflow or vanish.

        Collective.
        """
        comm, fields = self.layout.comm, self.layout.fields
        parts = [vector[f] for vector in vectors for f in fields]
        exponents = np.zeros(len(parts), dtype=int)
        with np.errstate(over="ignore", under="ignore"):
            squares = comm.allreduce(np.array([np.vdot(v, v) for v in parts]))
            if not all(1e-280 < s < 1e280 for s in squares):
                largest = np.array([np.abs(v).max(initial=0.0) for v in parts])
                comm.Allreduce(MPI.IN_PLACE, largest, op=MPI.MAX)
                exponents = np.frexp(largest)[1]
                parts = [np.ldexp(v, -e) for v, e in zip(parts, exponents, strict=True)]
                squares = comm.allreduce(np.array([np.vdot(v, v) for v in parts]))
        found = np.ldexp(np.sqrt(squares), exponents).reshape(len(vectors), -1).tolist()
        return [dict(zip(fields, row, strict=True)) for row in found]

    def gather(self, arrays: Mapping[str, Floats]) -> FieldArrays | None:
        """All rows of each field in the scene's numbering, on rank 0; None elsewhere. Collective."""
        whole = {f: self._rows[f].to_scene(arrays[f]) for f in self.layout.fields}
        return whole if self.layout.comm.rank == 0 else None

    def destroy(self) -> None:
        """Free PETSc's objects. Collective; after the KSP that uses them."""
        for thing in (self.J, self.b, *self.blocks.values(), *self._rows.values()):
            if thing is not None:
                thing.destroy()
        self.J = self.b = None
        self.blocks = {}


class _Rows:
    """Moves vectors of a field between the scene's numbering and the layout's.

    Attributes:
        numbers: the scene's numbers of the rows of this rank.
    """

    def __init__(self, layout: Layout, name: str, share: int | None) -> None:
        """Of a vector in the scene's numbering each rank has `share` rows; None: all of them are on rank 0."""
        comm = layout.comm
        local, total = layout.sizes(name)
        if share is None:
            share = 0 if comm.rank else total
        # without a block size, which MatCreateSubMatrix could not give to columns of which a rank needs some components
        self.numbers = PETSc.IS().createGeneral(layout.own_rows(name).astype(PETSc.IntType), comm=comm)
        self._given = PETSc.Vec().createMPI((share, total), comm=comm)
        self._root = PETSc.Vec().createMPI((0 if comm.rank else total, total), comm=comm)
        self._own = PETSc.Vec().createMPI((local, total), comm=comm)
        here = PETSc.IS().createStride(local, self._own.getOwnershipRange()[0], 1, comm=comm)
        self._forth = PETSc.Scatter().create(self._given, self.numbers, self._own, here)
        self._back = PETSc.Scatter().create(self._own, here, self._root, self.numbers)
        here.destroy()

    def to_layout(self, values: Floats | None) -> Floats:
        """From the rows given on this rank (None: there are none). Collective."""
        self._given.setArray(np.zeros(0) if values is None else values)
        self._forth.scatter(self._given, self._own)
        return np.array(self._own.getArray())

    def to_scene(self, values: Floats) -> Floats:
        """All rows on rank 0, none elsewhere. Collective."""
        self._own.setArray(values)
        self._back.scatter(self._own, self._root)
        return np.array(self._root.getArray())

    def destroy(self) -> None:
        """Free PETSc's objects. Collective."""
        for thing in (self.numbers, self._given, self._root, self._own, self._forth, self._back):
            thing.destroy()


def row_exponents(sizes: Mapping[Pair, float]) -> dict[str, int]:
    """Exponents of two for the rows of each field, from the norms of blocks.

    Rows and columns of the matrix of norms are scaled in turns until the largest entry of each is one (Ruiz, "A scaling
    algorithm to equilibrate both rows and columns norms in matrices", RAL-TR-2001-034, 2001); the rows' factors are
    what counts. Fields of mechanics, which multigrid treats together, have one in common unless they are far apart, and
    that of momentum is zero, so that the largest block stays as it is.
    """
    logs = {rc: math.log2(n) for rc, n in sizes.items() if n > 0 and math.isfinite(n)}
    names = {f for rc in sizes for f in rc}
    row, column = dict.fromkeys(names, 0.0), dict.fromkeys(names, 0.0)
    for _ in range(ROUNDS):
        rows, columns = _largest(logs, row, column)
        row = {f: row[f] - rows.get(f, 0.0) / 2 for f in row}
        column = {f: column[f] - columns.get(f, 0.0) / 2 for f in column}
        if max(map(abs, (*rows.values(), *columns.values())), default=0.0) < BALANCED:
            break
    mechanics = [f for f in MECHANICS if f in names]
    if len(mechanics) > 1 and np.ptp([row[f] for f in mechanics]) <= TIED:
        row |= dict.fromkeys(mechanics, float(np.mean([row[f] for f in mechanics])))
    zero = row[mechanics[-1] if mechanics else min(row)]
    return {f: round(r - zero) for f, r in row.items()}


def _largest(
    logs: Mapping[Pair, float], row: Mapping[str, float], column: Mapping[str, float]
) -> tuple[dict[str, float], dict[str, float]]:
    rows: dict[str, float] = {}
    columns: dict[str, float] = {}
    for (r, c), n in logs.items():
        scaled = n + row[r] + column[c]
        rows[r], columns[c] = max(rows.get(r, -math.inf), scaled), max(columns.get(c, -math.inf), scaled)
    return rows, columns


def _equal(a: NDArray[Any], b: NDArray[Any]) -> bool:
    return a is b or np.array_equal(a, b)
