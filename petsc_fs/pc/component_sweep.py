"""Displacements solved one component after the other, as block Gauss-Seidel does."""

from __future__ import annotations

import sys
from itertools import product

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petsc_fs.errors import LayoutError, SceneError
from petsc_fs.pc.base import BasePC, choice, told
from petsc_fs.pc.sparser import sparser

ORDERS = ("forward", "backward", "none")
"""Values of -component_order; the first is the default."""


class ComponentSweep(BasePC):
    """Block Gauss-Seidel over the components of displacements, with an inner PC for each of them.

    With A_km the couplings of component k of all cells with component m of all cells, and B_k the inner PC for A_kk,

        y_k = B_k (x_k - sum_m A_km y_m),    over m < k (forward), m > k (backward) or no m at all (none).

    The inner PCs see scalar matrices, whose rows have a D-th of the entries: of an isotropic elastic operator
    anisotropic Laplacians, which multigrid for scalar problems is made for, and which are spectrally equivalent to it
    by Korn's inequality ("separate displacement components"; Gustafsson, Lindskog, "On parallel solution of linear
    elasticity problems. Part I: theory", 1998). All of them together take a D-th of the memory and time of a multigrid
    for A. The sweep multiplies with the triangle of A that it needs, and neither that nor the diagonal blocks are
    stored twice.

    The operator is an AIJ with block size D, or a MatNest of such ones, which is not copied as a whole.

    Options, with the prefix of this PC:
        -component_order <forward> (forward, backward, none): from the first component to the last, the other
            way, or without couplings between them (block Jacobi).
        -component_drop <0>: entries of a component's matrix less than this share of the diagonal of their row are left
            out, see `petsc_fs.pc.sparser`; 0 keeps all.
        -component_*: of the inner PCs, the same for all components.
    """

    order = ORDERS[0]
    _couplings: dict[int, list[tuple[PETSc.Mat, PETSc.Vec]]]
    _vectors: tuple[PETSc.Vec, ...] = ()
    _whole: tuple[PETSc.Vec, ...] = ()

    def update(self, pc: PETSc.PC) -> None:
        """Take the components apart and set the inner PCs up. Collective.

        Raises:
            LayoutError: the operator has no block size.
            SceneError: multigrid would divide by zero.
            UsageError: an option has an impossible value.
        """
        blocks = _blocks(pc.getOperators()[1])
        D = blocks[0][0].getBlockSize()
        if D == 1:
            raise LayoutError("ComponentSweep: the operator has block size 1, so that it has no components")
        self.order = choice(pc, "component_order", ORDERS)
        prefix = (pc.getOptionsPrefix() or "") + "component_"
        if not self.inners:
            self.inners = tuple(PETSc.PC().create(pc.comm) for _ in range(D))
            for inner in self.inners:
                inner.setOptionsPrefix(prefix)
                inner.incrementTabLevel(1, parent=pc)
                inner.setFromOptions()
        drop = PETSc.Options(pc.getOptionsPrefix() or "").getReal("component_drop", 0)
        for k, inner in enumerate(self.inners):
            matrix = sparser(_component(blocks, D, k, k), drop)
            if inner.getType() == "hypre":
                _check_diagonal(matrix, prefix)
                aij, matrix = matrix, matrix.convert("hypre", PETSc.Mat())  # else PCHYPRE has a copy beside it
                aij.destroy()
            inner.setOperators(matrix, matrix)
            matrix.destroy()  # the PC holds it
            inner.setUp()
            inner.setUpOnBlocks()
        if not self._vectors:
            pairs = [inner.getOperators()[1].createVecs() for inner in self.inners]
            self._y, self._x = [right for right, _ in pairs], [left for _, left in pairs]
            self._vectors = (*self._x, *self._y)
        self._free_couplings()
        behind = {"forward": 1, "backward": -1, "none": 0}[self.order]
        self._couplings = {k: [] for k in range(D)}
        for k, m in product(range(D), range(D)):
            if (k - m) * behind > 0:
                coupling = _component(blocks, D, k, m)
                coupling.scale(-1.0)  # so that a product adds what is subtracted
                self._couplings[k].append((coupling, self._y[m]))

    @told
    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = one sweep over the components of x, from zero. Collective."""
        D = len(self.inners)
        if not x.getBlockSize() == y.getBlockSize() == D:
            self._apply_copied(pc, x, y)
            return
        for k in range(D)[:: -1 if self.order == "backward" else 1]:
            residual, update = self._x[k], self._y[k]
            x.strideGather(k, residual)
            for coupling, other in self._couplings[k]:
                coupling.multAdd(other, residual, residual)
            self.inners[k].apply(residual, update)
            update.strideScatter(k, y)

    def _apply_copied(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The same for vectors without the block size. Collective."""
        if not self._whole:
            size = x.getSizes()
            self._whole = tuple(PETSc.Vec().createMPI(size, bsize=len(self.inners), comm=x.comm) for _ in range(2))
        x.copy(self._whole[0])
        self.apply(pc, *self._whole)
        self._whole[1].copy(y)

    def describe(self) -> str:
        """Components and order in one line."""
        return f"{len(self.inners)} components, order {self.order}; of the first:"

    def release(self) -> None:
        """Free couplings and vectors. Collective; may be called twice."""
        self._free_couplings()
        for vector in (*self._vectors, *self._whole):
            vector.destroy()
        self._vectors = self._whole = ()

    def _free_couplings(self) -> None:
        for matrix, _ in (pair for pairs in getattr(self, "_couplings", {}).values() for pair in pairs):
            matrix.destroy()
        self._couplings = {}


def _check_diagonal(matrix: PETSc.Mat, prefix: str) -> None:
    """Refuse what hypre 2.26 crashes on: equations without an entry, or with zeros alone. Collective."""
    diagonal = matrix.getDiagonal()
    zeros = np.flatnonzero(diagonal.getArray() == 0)
    diagonal.destroy()
    comm = matrix.comm.tompi4py()
    number = comm.allreduce(zeros.size)
    if number:
        first = comm.allreduce(matrix.getOwnershipRange()[0] + int(zeros[0]) if zeros.size else sys.maxsize, MPI.MIN)
        raise SceneError(
            f"-{prefix}: {number} equations of displacements have a zero on the diagonal, the first at cell {first} of "
            "this level, which multigrid divides by; give the elastic stiffness, or use a direct solver: "
            "-options_file retry.opts"
        )


def _blocks(operator: PETSc.Mat) -> list[list[PETSc.Mat]]:
    """The blocks of a MatNest, or the one matrix that it is not."""
    if operator.getType() != "nest":
        return [[operator]]
    rows, columns = operator.getNestSize()
    return [[operator.getNestSubMatrix(i, j) for j in range(columns)] for i in range(rows)]


def _component(blocks: list[list[PETSc.Mat]], D: int, k: int, m: int) -> PETSc.Mat:
    """A_km as one AIJ. Collective."""
    parts = [[_entries(block, D, k, m) for block in row] for row in blocks]
    if len(parts) == len(parts[0]) == 1:
        return parts[0][0]
    nest = PETSc.Mat().createNest(parts, comm=blocks[0][0].comm)
    matrix = nest.convert("aij", PETSc.Mat())
    nest.destroy()
    for part in (part for row in parts for part in row):
        part.destroy()
    return matrix


def _entries(block: PETSc.Mat, D: int, k: int, m: int) -> PETSc.Mat:
    """The couplings of component k of the rows of an AIJ with component m of its columns. Collective."""
    sets = [
        PETSc.IS().createStride((stop - start) // D, start + component, D, comm=block.comm)
        for (start, stop), component in ((block.getOwnershipRange(), k), (block.getOwnershipRangeColumn(), m))
    ]
    entries = block.createSubMatrix(*sets)
    for index_set in sets:
        index_set.destroy()
    return entries
