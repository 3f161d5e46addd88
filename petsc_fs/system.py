"""System: a scene as PETSc objects, namely a MatNest with one block per pair of fields, a vector and a DM."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs.dm import Blocks, Problem, field_dm, field_nest, merge_mechanics, one_matrix
from petsc_fs.errors import LayoutError, SceneError, together
from petsc_fs.layout import Layout
from petsc_fs.scene import CSR, SLAB, Integers, Scene, increasing, slabs

FieldArrays = dict[str, NDArray[np.float64]]


class PatternChanged(LayoutError):
    """New values do not fit into the nonzero pattern of the old ones; build a new system."""


class System:
    """The linear system of one scene, distributed.

    Attributes:
        layout: distribution of the rows.
        blocks: matrices by (row field, column field), AIJ with the fields' block sizes.
        J: the Jacobian: a MatNest over `members`, or one AIJ.
        members: fields as J has them: name and the fields of the table it is made of.
        b: right-hand side, numbered as J: on each rank field by field.
        dm: names the members.
        problem: what the DM carries.
        row_scale: what the rows of each field have been multiplied by, see `scale_rows`.
    """

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        *,
        mat_type: str = "nest",
        near_null_space: bool = True,
        fixed_stress: bool = True,
        release: bool = False,
    ) -> None:
        """Build everything from the rows of this rank.

        Collective on `layout.comm`.

        Args:
            scene: whose row ranges are those of `layout` on this rank.
            layout: distribution of the rows.
            mat_type: "nest"; "merged" for a nest in which the fields of mechanics are copied into one
                matrix; "aij" for a copy of everything in one matrix, as direct solvers need it.
            near_null_space: whether displacement fields get their rigid-body modes.
            fixed_stress: whether the fixed-stress coefficients are computed.
            release: take each block out of the scene as soon as PETSc has it, so that little is held twice.

        Raises:
            LayoutError: scene and layout differ.
            SceneError: a block is too large for this PETSc.
        """
        self.layout = layout
        self.mat_type = mat_type
        fields = layout.fields
        with together(layout.comm):
            self._check(scene)
            self._fixed_stress = fixed_stress and "mass" in fields
            coefficients = scene.fixed_stress_coefficients() if self._fixed_stress else None
        pairs = list(product(fields, fields))
        entries = np.array([scene.blocks[rc].data.size if rc in scene.blocks else 0 for rc in pairs])
        entries = layout.comm.allreduce(entries)
        self.blocks: Blocks = {}
        for rc, n in zip(pairs, entries, strict=True):
            block = scene.blocks.pop(rc, None) if release else scene.blocks.get(rc)
            if n or rc[0] == rc[1]:
                self.blocks[rc] = self._create_block(*rc, block)
            del block  # before the next one is made
        self.members = merge_mechanics(fields) if mat_type == "merged" else [(f, (f,)) for f in fields]
        if mat_type == "aij" or len(self.members) == 1:
            self.J = one_matrix(fields, self.blocks, layout)
        else:
            self.J = field_nest(self.members, self.blocks, layout)
        self.b = self.J.createVecLeft()
        centers = scene.cell_centers if near_null_space else {}
        self.problem = Problem(layout, self.blocks, centers, coefficients, scene.contact_state)
        self.row_scale = dict.fromkeys(fields, 1.0)
        self._fingerprints: Sequence[_Fingerprint | None] = [None] * len(self.blocks)  # none before there is an update
        self.dm = field_dm(self.problem, self.members)
        self.set_rhs(scene.rhs)

    def update(self, scene: Scene, *, grow: bool = False) -> None:
        """Replace the values of matrix and right-hand side, keeping every PETSc object.

        Collective. The material data of the fixed-stress diagonal are replaced too. On several ranks blocks with the
        values of the last update are left alone.

        Args:
            scene: with the sizes of the first one.
            grow: whether blocks with an entry outside their nonzero pattern are made anew, and J with them, which is
                possible where it is a nest of single fields.

        Raises:
            PatternChanged: an entry is outside the nonzero pattern; the system is unusable then.
            LayoutError: scene and layout differ.
        """
        with together(self.layout.comm):
            self._check(scene)
            if self._fixed_stress:
                self.problem.fixed_stress = scene.fixed_stress_coefficients()
            for rc, block in scene.blocks.items():
                if block.data.size and rc not in self.blocks:
                    raise PatternChanged(f"block {rc} was empty")
        outgrown = self._set_blocks(scene)
        anew = self._make_anew(scene, outgrown, grow and self.mat_type == "nest" and self.J.getType() == "nest")
        self.problem.contact_state = scene.contact_state
        self.row_scale = dict.fromkeys(self.layout.fields, 1.0)
        for matrix in self.blocks.values():
            matrix.assemble()
        if anew:
            self.J.destroy()
            self.J = field_nest(self.members, self.blocks, self.layout)
        elif self.J.getType() == "nest":
            for k, (_, fields) in enumerate(self.members):
                if len(fields) > 1:
                    one_matrix(fields, self.blocks, self.layout, out=self.J.getNestSubMatrix(k, k))
            self.J.stateIncrease()
        else:
            one_matrix(self.layout.fields, self.blocks, self.layout, out=self.J)
        self.set_rhs(scene.rhs)

    def scale_rows(self, factors: Mapping[str, float]) -> None:
        """Multiply the equations of each field by a number, which changes no solution.

        Collective. Matrix, right-hand side and fixed-stress coefficients, all in place; `update` undoes it. The fields
        of mechanics must share a factor where they are one matrix. Powers of two cause no rounding.
        """
        for (r, _), block in self.blocks.items():
            block.scale(factors[r])
        if self.J.getType() == "nest":
            for k, (_, fields) in enumerate(self.members):
                if len(fields) > 1:
                    self.J.getNestSubMatrix(k, k).scale(factors[fields[0]])
            self.J.stateIncrease()
        elif len(self.layout.fields) > 1:
            rows = self.b.duplicate()
            rows.setArray(np.concatenate([np.full(self.layout.sizes(f)[0], factors[f]) for f in self.layout.fields]))
            self.J.diagonalScale(rows)
            rows.destroy()
        if self.problem.fixed_stress is not None:
            self.problem.fixed_stress = self.problem.fixed_stress * np.array([factors["mass"], 1.0])
        self.b.setArray(np.concatenate([factors[f] * v for f, v in self.by_field(self.b).items()]))
        self.row_scale = {f: factors[f] * scale for f, scale in self.row_scale.items()}

    def destroy(self) -> None:
        """Free PETSc's objects. Collective; after the KSP that uses them.

        The DM has to go by name: where PETSc 3.18 frees one that Python has let go of, all that the DM's Python
        context holds, the matrices among it, is never freed.
        """
        for thing in (self.dm, self.J, self.b, *self.blocks.values()):
            thing.destroy()

    def set_rhs(self, rhs: Mapping[str, NDArray[np.float64]]) -> None:
        """Set the right-hand side from the local rows of each field."""
        self.b.setArray(np.concatenate([self.row_scale[f] * rhs[f] for f in self.layout.fields]))

    @property
    def is_scaled(self) -> bool:
        """Whether the rows of any field are scaled."""
        return any(scale != 1.0 for scale in self.row_scale.values())

    def by_field(self, vector: PETSc.Vec) -> FieldArrays:
        """The local rows of each field of a vector, copied."""
        bounds = np.cumsum([self.layout.sizes(f)[0] for f in self.layout.fields])[:-1]
        return dict(zip(self.layout.fields, np.split(vector.getArray().copy(), bounds), strict=True))

    def field_norms(self, arrays: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
        """Euclidean norm of each field over all ranks. Collective."""
        squares = np.array([np.vdot(arrays[f], arrays[f]) for f in self.layout.fields])
        return dict(zip(self.layout.fields, np.sqrt(self.layout.comm.allreduce(squares)).tolist(), strict=True))

    def magnitudes(self, solution: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
        """Norm of |J| |x| + |b| per field: what the terms of its equations amount to before they cancel.

        Collective. Gathers the solution on every rank and copies one block at a time.
        """
        magnitude = {f: np.abs(v) for f, v in self.by_field(self.b).items()}
        whole = {f: np.abs(np.concatenate(self.layout.comm.allgather(v))) for f, v in solution.items()}
        for (r, c), block in self.blocks.items():
            indptr, indices, values = block.getValuesCSR()
            for first, last, start, stop in slabs(indptr, SLAB):
                sums = np.concatenate([[0.0], np.cumsum(np.abs(values[start:stop]) * whole[c][indices[start:stop]])])
                magnitude[r][first:last] += np.diff(sums[indptr[first : last + 1] - start])
        return self.field_norms(magnitude)

    def rounding_level(self, solution: Mapping[str, NDArray[np.float64]]) -> float:
        """Unit roundoff times the norm of |J| |x| + |b|: below this a residual says nothing. Collective."""
        return float(np.finfo(np.float64).eps * np.linalg.norm(list(self.magnitudes(solution).values())))

    def gather(self, arrays: Mapping[str, NDArray[np.float64]]) -> FieldArrays | None:
        """All rows of each field in the scene's numbering, on rank 0; None elsewhere. Collective."""
        parts = self.layout.comm.gather(dict(arrays))
        if parts is None:
            return None
        return {f: self.layout.to_scene(f, np.concatenate([part[f] for part in parts])) for f in self.layout.fields}

    def _set_blocks(self, scene: Scene) -> dict[tuple[str, str], PatternChanged]:
        """Give blocks the values of a scene; those that have no place for all of them. Collective."""
        # on one rank values are copied in less time than a digest of them takes
        equal = self._equal_blocks(scene) if self.layout.comm.size > 1 else set()
        outgrown = {}
        for rc, matrix in self.blocks.items():
            if rc in equal:
                if self.row_scale[rc[0]] != 1.0:
                    matrix.scale(1.0 / self.row_scale[rc[0]])
                continue
            try:
                _set_values(matrix, rc, scene.blocks.get(rc))
            except PatternChanged as e:
                outgrown[rc] = e.with_traceback(None)  # whose frames would keep PETSc's objects, on some ranks only
        return outgrown

    def _make_anew(self, scene: Scene, outgrown: Mapping[tuple[str, str], PatternChanged], possible: bool) -> bool:
        """Make blocks anew that have new entries on some rank; whether there are any. Collective.

        Raises:
            PatternChanged: there are some, and it is not possible.
        """
        with together(self.layout.comm):
            if outgrown and not possible:
                raise next(iter(outgrown.values()))
        anew = np.array([rc in outgrown for rc in self.blocks])
        self.layout.comm.Allreduce(MPI.IN_PLACE, anew, op=MPI.LOR)
        for rc, new in zip(self.blocks, anew, strict=True):
            if new:
                self.blocks[rc].destroy()
                self.blocks[rc] = self._create_block(*rc, scene.blocks.get(rc))
        return bool(anew.any())

    def _equal_blocks(self, scene: Scene) -> set[tuple[str, str]]:
        """Blocks that have the values of the last update on all ranks, as those of linear elasticity do. Collective."""
        latest = [_Fingerprint.of(scene.blocks.get(rc)) for rc in self.blocks]
        same = np.array([new.equals(old) for new, old in zip(latest, self._fingerprints, strict=True)])
        self.layout.comm.Allreduce(MPI.IN_PLACE, same, op=MPI.LAND)
        self._fingerprints = latest
        return {rc for rc, equal in zip(self.blocks, same, strict=True) if equal}

    def _check(self, scene: Scene) -> None:
        for name in self.layout.fields:
            if scene.sizes.get(name) != self.layout.sizes(name)[1] or scene.row_range(name) != self.layout.rows(name):
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
        used = np.zeros(self.layout.sizes("mass")[0] if "mass" in self.layout.fields else 0, dtype=bool)
        for (r, _), block in scene.blocks.items():
            if r == "mass":
                used |= np.diff(block.indptr) > 0
        if not used.all():  # hypre 2.26 may crash on such rows
            raise SceneError(
                f"mass: {np.count_nonzero(~used)} equations have no entry, so that the Jacobian is singular; the first "
                f"is that of cell {scene.row_name('mass', int(np.argmin(used)))}; export the scene again"
            )
        rows = self.layout.sizes("momentum")[0] if "momentum" in self.layout.fields else 0
        stiffness = scene.blocks.get(("momentum", "momentum"))
        filled = np.diff(stiffness.indptr) > 0 if stiffness is not None else np.zeros(rows, dtype=bool)
        if rows and not filled.all():  # hypre 2.26 crashes on such a row
            first = scene.row_range("momentum")[0] + int(np.argmin(filled))
            raise SceneError(
                f"momentum: {rows - np.count_nonzero(filled)} rows of the block (momentum, momentum) have no entry, "
                f"the first is {first}; export the scene again with its elastic stiffness"
            )

    def _create_block(self, r: str, c: str, block: CSR | None) -> PETSc.Mat:
        sizes = (self.layout.sizes(r), self.layout.sizes(c))
        if block is None:
            block = CSR(np.zeros(sizes[0][0] + 1, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))
        bsize = (self.layout.block_size(r), self.layout.block_size(c))
        if self.layout.comm.size == 1 and block.data.size and increasing(block):
            around = _around(block, sizes, self.layout.comm)
            around.setBlockSizes(*bsize)
            matrix = around.duplicate(copy=True)
            around.destroy()
            return matrix
        csr = (_petsc_int(block.indptr), _petsc_int(block.indices), block.data)
        return PETSc.Mat().createAIJ(sizes, bsize=bsize, csr=csr, comm=self.layout.comm)


@dataclass(frozen=True)
class _Fingerprint:
    """Tells whether a block is the same as an earlier one, without a copy of its values.

    Attributes:
        pattern: `indptr` and `indices`, by reference: blocks of one pattern usually share them.
        values: digest of the values.
    """

    pattern: tuple[Integers, ...]
    values: bytes

    @classmethod
    def of(cls, block: CSR | None) -> _Fingerprint:
        """Of a block, which is empty where it is None."""
        if block is None:
            return cls((), b"")
        values = hashlib.sha256(np.ascontiguousarray(block.data).data, usedforsecurity=False)
        return cls((block.indptr, block.indices), values.digest())

    def equals(self, other: _Fingerprint | None) -> bool:
        """Whether the blocks are the same."""
        if other is None or self.values != other.values or len(self.pattern) != len(other.pattern):
            return False
        pairs = zip(self.pattern, other.pattern, strict=True)
        return all(mine is theirs or np.array_equal(mine, theirs) for mine, theirs in pairs)


def _petsc_int(values: Integers) -> Integers:
    """Integers as PETSc has them, without a copy where they are that already."""
    return values.astype(PETSc.IntType, copy=False)


def _around(block: CSR, sizes: tuple[tuple[int, int], tuple[int, int]], comm: MPI.Intracomm) -> PETSc.Mat:
    """A matrix in the arrays of a block, on one rank: to copy it takes a seventh of inserting it row by row."""
    csr = (_petsc_int(block.indptr), _petsc_int(block.indices), block.data)
    return PETSc.Mat().createAIJWithArrays(sizes, csr, comm=comm)


def _has_pattern(matrix: PETSc.Mat, block: CSR) -> bool:
    """Whether a matrix on one rank has entries where a block has, and nowhere else."""
    indptr, indices = matrix.getRowIJ()
    return np.array_equal(indptr, block.indptr) and np.array_equal(indices, block.indices)


def _set_values(matrix: PETSc.Mat, rc: tuple[str, str], block: CSR | None) -> None:
    if block is not None and matrix.comm.size == 1 and _has_pattern(matrix, block):
        around = _around(block, matrix.getSizes(), matrix.comm)
        around.copy(matrix, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        around.destroy()
        return
    matrix.zeroEntries()
    if block is None or not block.data.size:
        return
    matrix.setOption(PETSc.Mat.Option.NEW_NONZERO_LOCATION_ERR, True)
    start = matrix.getOwnershipRange()[0]
    # setValuesCSR numbers rows from the first local one
    try:
        matrix.setValuesCSR(_petsc_int(block.indptr), _petsc_int(block.indices), block.data)
    except PETSc.Error as e:
        raise PatternChanged(f"block {rc}: an entry is new (first local row {start})") from e
