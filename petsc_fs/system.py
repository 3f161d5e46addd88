"""System: a scene as PETSc objects, namely a MatNest with one block per pair of fields, a vector and a DM."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from petsc_fs.dm import Blocks, Problem, field_dm, field_nest, merge_mechanics, one_matrix
from petsc_fs.errors import LayoutError, SceneError, together
from petsc_fs.fixed_stress import analytic_coefficients
from petsc_fs.layout import Layout
from petsc_fs.scene import CSR, SLAB, Integers, Scene, slabs

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
            coefficients = analytic_coefficients(scene) if self._fixed_stress else None
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
        self.dm = field_dm(self.problem, self.members)
        self.set_rhs(scene.rhs)

    def update(self, scene: Scene) -> None:
        """Replace the values of matrix and right-hand side, keeping every PETSc object.

        Collective. The material data of the fixed-stress diagonal are replaced too.

        Raises:
            PatternChanged: an entry is outside the nonzero pattern; the system is unusable then.
            LayoutError: scene and layout differ.
        """
        with together(self.layout.comm):
            self._check(scene)
            if self._fixed_stress:
                self.problem.fixed_stress = analytic_coefficients(scene)
            for rc, block in scene.blocks.items():
                if block.data.size and rc not in self.blocks:
                    raise PatternChanged(f"block {rc} was empty")
            for rc, matrix in self.blocks.items():
                _set_values(matrix, rc, scene.blocks.get(rc))
        self.problem.contact_state = scene.contact_state
        for matrix in self.blocks.values():
            matrix.assemble()
        if self.J.getType() == "nest":
            for k, (_, fields) in enumerate(self.members):
                if len(fields) > 1:
                    one_matrix(fields, self.blocks, self.layout, out=self.J.getNestSubMatrix(k, k))
            self.J.stateIncrease()
        else:
            one_matrix(self.layout.fields, self.blocks, self.layout, out=self.J)
        self.set_rhs(scene.rhs)

    def set_rhs(self, rhs: Mapping[str, NDArray[np.float64]]) -> None:
        """Set the right-hand side from the local rows of each field."""
        self.b.setArray(np.concatenate([rhs[f] for f in self.layout.fields]))

    def by_field(self, vector: PETSc.Vec) -> FieldArrays:
        """The local rows of each field of a vector, copied."""
        bounds = np.cumsum([self.layout.sizes(f)[0] for f in self.layout.fields])[:-1]
        return dict(zip(self.layout.fields, np.split(vector.getArray().copy(), bounds), strict=True))

    def field_norms(self, arrays: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
        """Euclidean norm of each field over all ranks. Collective."""
        squares = np.array([np.vdot(arrays[f], arrays[f]) for f in self.layout.fields])
        return dict(zip(self.layout.fields, np.sqrt(self.layout.comm.allreduce(squares)).tolist(), strict=True))

    def rounding_level(self, solution: Mapping[str, NDArray[np.float64]]) -> float:
        """Unit roundoff times the norm of |J| |x| + |b|: below this a residual says nothing.

        Collective. Gathers the solution on every rank and copies one block at a time.
        """
        magnitude = {f: np.abs(v) for f, v in self.by_field(self.b).items()}
        whole = {f: np.abs(np.concatenate(self.layout.comm.allgather(v))) for f, v in solution.items()}
        for (r, c), block in self.blocks.items():
            indptr, indices, values = block.getValuesCSR()
            for first, last, start, stop in slabs(indptr, SLAB):
                sums = np.concatenate([[0.0], np.cumsum(np.abs(values[start:stop]) * whole[c][indices[start:stop]])])
                magnitude[r][first:last] += np.diff(sums[indptr[first : last + 1] - start])
        norms = self.field_norms(magnitude)
        return float(np.finfo(np.float64).eps * np.linalg.norm(list(norms.values())))

    def gather(self, arrays: Mapping[str, NDArray[np.float64]]) -> FieldArrays | None:
        """All rows of each field in the scene's numbering, on rank 0; None elsewhere. Collective."""
        parts = self.layout.comm.gather(dict(arrays))
        if parts is None:
            return None
        return {f: self.layout.to_scene(f, np.concatenate([part[f] for part in parts])) for f in self.layout.fields}

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

    def _create_block(self, r: str, c: str, block: CSR | None) -> PETSc.Mat:
        sizes = (self.layout.sizes(r), self.layout.sizes(c))
        if block is None:
            block = CSR(np.zeros(sizes[0][0] + 1, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))
        bsize = (self.layout.block_size(r), self.layout.block_size(c))
        csr = (_petsc_int(block.indptr), _petsc_int(block.indices), block.data)
        return PETSc.Mat().createAIJ(sizes, bsize=bsize, csr=csr, comm=self.layout.comm)


def _petsc_int(values: Integers) -> Integers:
    """Integers as PETSc has them, without a copy where they are that already."""
    return values.astype(PETSc.IntType, copy=False)


def _set_values(matrix: PETSc.Mat, rc: tuple[str, str], block: CSR | None) -> None:
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
