"""Displacements solved one component after the other, as block Gauss-Seidel does."""

from __future__ import annotations

import sys
from itertools import product
from typing import Any

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petsc_fs.errors import LayoutError, SceneError
from petsc_fs.pc.wrapper import choice
from petsc_fs.reuse import Reuse

ORDERS = ("forward", "backward", "none")
"""Values of -component_order; the first is the default."""


class ComponentSweep:
    """Block Gauss-Seidel over the components of displacements, with an inner PC for each of them.

    With A_km the couplings of component k of all cells with component m of all cells, and B_k the inner PC for A_kk,

        y_k = B_k (x_k - sum_m A_km y_m),    over m < k (forward), m > k (backward) or no m at all (none).

    The inner PCs see scalar matrices, whose rows have a D-th of the entries: of an isotropic elastic operator
    anisotropic Laplacians, which multigrid for scalar problems is made for, and which are spectrally equivalent to it
    by Korn's inequality ("separate displacement components"; Gustafsson, Lindskog, "On parallel solution of linear
    elasticity problems. Part I: theory", 1998). All of them together take a D-th of the memory and time of a multigrid
    for A. The sweep multiplies with the triangle of A that it needs, and neither that nor the diagonal blocks are
    stored twice.

    The operator is an AIJ with block size D, or a MatNest of such ones, which is not copied as a whole. Where the
    problem that the DM carries has a `petsc_fs.reuse.Reuse`, that decides whether a sweep built earlier is kept.

    Options, with the prefix of this PC:
        -component_order forward|backward|none: see above.
        -component_pc_type, ...: the inner PCs, the same for all components.
    """

    sweep: Sweep | None = None
    reuse: Reuse | None = None

    @property
    def inners(self) -> tuple[PETSc.PC, ...]:
        """The inner PCs, by component."""
        return self.sweep.inners if self.sweep is not None else ()

    def setUp(self, pc: PETSc.PC) -> None:
        """Take the components apart and set the inner PCs up, or take those that were kept. Collective.

        Raises:
            LayoutError: the operator has no block size.
            UsageError: an option has an impossible value.
        """
        self._release()
        dm = pc.getDM()
        carried = dm.getAppCtx() if dm and dm.getType() == "shell" else None
        self.reuse = carried[0].reuse if carried is not None else None
        order = choice(pc, "component_order", ORDERS)
        name = pc.getOptionsPrefix() or ""
        kept = self.reuse.kept(name) if self.reuse is not None else None
        if isinstance(kept, Sweep):
            self.sweep = kept
            return
        self.sweep = Sweep(pc, order)
        if self.reuse is not None:
            self.reuse.keep(name, self.sweep)

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = one sweep over the components of x, from zero. Collective."""
        assert self.sweep is not None
        self.sweep.apply(x, y)
        if self.reuse is not None and self.reuse.scale != 1.0:
            y.scale(self.reuse.scale)

    def view(self, pc: PETSc.PC, viewer: PETSc.Viewer) -> None:
        """Print the order and the first inner PC. Collective."""
        if viewer.getType() != PETSc.Viewer.Type.ASCII or self.sweep is None:
            return
        viewer.printfASCII(f"ComponentSweep: {len(self.inners)} components, order {self.sweep.order}; of the first:\n")
        self.inners[0].view(viewer)

    def destroy(self, pc: PETSc.PC) -> None:
        """Free the inner PCs, unless they are kept. Collective; may be called twice."""
        self._release()

    def _release(self) -> None:
        if self.sweep is not None and self.reuse is None:
            self.sweep.destroy()
        self.sweep = None


class Sweep:
    """The components of one matrix and their PCs.

    Attributes:
        order: one of `ORDERS`.
        inners: PCs, by component.
    """

    def __init__(self, pc: PETSc.PC, order: str) -> None:
        """Take the Pmat of a `ComponentSweep` apart and set the inner PCs up. Collective."""
        _, operator = pc.getOperators()
        blocks = _blocks(operator)
        D = blocks[0][0].getBlockSize()
        if D == 1:
            raise LayoutError("ComponentSweep: the operator has block size 1, so that it has no components")
        self.order = order
        prefix = (pc.getOptionsPrefix() or "") + "component_"
        self.inners: tuple[PETSc.PC, ...] = ()
        for k in range(D):
            inner = PETSc.PC().create(pc.comm)
            inner.setOptionsPrefix(prefix)
            inner.incrementTabLevel(1, parent=pc)
            inner.setFromOptions()
            matrix = _component(blocks, D, k, k)
            if inner.getType() == "hypre":
                _check_diagonal(matrix, prefix)
                aij, matrix = matrix, matrix.convert("hypre", PETSc.Mat())  # else PCHYPRE has a copy beside it
                aij.destroy()
            inner.setOperators(matrix, matrix)
            inner.setUp()
            inner.setUpOnBlocks()
            self.inners += (inner,)
        behind = {"forward": 1, "backward": -1, "none": 0}[order]
        pairs_of_vectors = [inner.getOperators()[1].createVecs() for inner in self.inners]
        self._y = [right for right, _ in pairs_of_vectors]
        self._x = [left for _, left in pairs_of_vectors]
        self._couplings: dict[int, list[tuple[PETSc.Mat, PETSc.Vec]]] = {k: [] for k in range(D)}
        for k, m in product(range(D), range(D)):
            if (k - m) * behind > 0:
                coupling = _component(blocks, D, k, m)
                coupling.scale(-1.0)  # so that a product adds what is subtracted
                self._couplings[k].append((coupling, self._y[m]))
        self._whole: tuple[PETSc.Vec, ...] = ()

    def apply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Y = one sweep over the components of x, from zero. Collective."""
        D = len(self.inners)
        if not x.getBlockSize() == y.getBlockSize() == D:
            self._apply_copied(x, y)
            return
        for k in range(D)[:: -1 if self.order == "backward" else 1]:
            residual, update = self._x[k], self._y[k]
            x.strideGather(k, residual)
            for coupling, other in self._couplings[k]:
                coupling.multAdd(other, residual, residual)
            self.inners[k].apply(residual, update)
            update.strideScatter(k, y)

    def _apply_copied(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The same for vectors without the block size. Collective."""
        if not self._whole:
            size = x.getSizes()
            self._whole = tuple(PETSc.Vec().createMPI(size, bsize=len(self.inners), comm=x.comm) for _ in range(2))
        x.copy(self._whole[0])
        self.apply(*self._whole)
        self._whole[1].copy(y)

    def destroy(self) -> None:
        """Free everything. Collective; may be called twice."""
        for inner in self.inners:
            inner.destroy()
        for matrix, _ in (pair for pairs in self._couplings.values() for pair in pairs):
            matrix.destroy()
        for vector in (*self._x, *self._y, *self._whole):
            vector.destroy()
        self.inners, self._couplings, self._x, self._y, self._whole = (), {}, [], [], ()


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
            "this level, which multigrid divides by; export the scene again with its elastic stiffness, or use a "
            "direct solver: -options_file retry.opts"
        )


def _blocks(operator: PETSc.Mat) -> list[list[Any]]:
    """The blocks of a MatNest, or the one matrix that it is not."""
    if operator.getType() != "nest":
        return [[operator]]
    rows, columns = operator.getNestSize()
    return [[operator.getNestSubMatrix(i, j) for j in range(columns)] for i in range(rows)]


def _component(blocks: list[list[Any]], D: int, k: int, m: int) -> PETSc.Mat:
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
