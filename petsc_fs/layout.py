"""Layout: which rank holds which cells of each field, and in which order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from petsc_fs.errors import LayoutError
from petsc_fs.fields import FIELD, in_order

if TYPE_CHECKING:
    from mpi4py import MPI

Cells = NDArray[np.int64]


@dataclass(frozen=True)
class Layout:
    """Contiguous rows of each field per rank, whole cells only, and the scene's numbers of these cells.

    The layout has a numbering of its own: first the cells of rank 0, then those of rank 1, and so on. `cells` says
    which cell of the scene each of them is. It is replicated: 8 bytes per cell and field on every rank, 3 MB at a
    million unknowns in 3D. Beyond some thousand ranks a distributed directory takes its place, in which rank k knows
    the owners of the k-th chunk of cells and answers for them (`AOCreateMemoryScalable` is PETSc's).

    Attributes:
        comm: communicator.
        dimension: of the rock matrix.
        offsets: per field (ranks + 1,) first row of each rank in the layout's numbering; the same on all ranks.
        cells: per field (cells,) number in the scene of each cell of the layout; the same on all ranks. For fields
            that are missing here, the layout's numbering is the scene's.
    """

    comm: MPI.Intracomm
    dimension: int
    offsets: Mapping[str, Cells]
    cells: Mapping[str, Cells] = field(default_factory=dict)

    @classmethod
    def contiguous(cls, comm: MPI.Intracomm, dimension: int, sizes: Mapping[str, int]) -> Layout:
        """Cells of each field, in the scene's order, cut into chunks of nearly equal length."""
        counts = {}
        for name in in_order(sizes):
            cells = sizes[name] // FIELD[name].block_size(dimension)
            bounds = (cells * np.arange(comm.size + 1)) // comm.size
            counts[name] = np.diff(bounds)
        return cls.from_cells(comm, dimension, counts)

    @classmethod
    def from_cells(cls, comm: MPI.Intracomm, dimension: int, cells: Mapping[str, ArrayLike]) -> Layout:
        """The scene's order, given the number of cells of each field on each rank, the same on all ranks.

        Raises:
            LayoutError: there is not one number per rank.
        """
        offsets = {}
        for name in in_order(cells):
            counts = np.asarray(cells[name], dtype=np.int64)
            if counts.shape != (comm.size,) or (counts < 0).any():
                raise LayoutError(f"{name}: expected one number of cells for each of {comm.size} ranks")
            offsets[name] = FIELD[name].block_size(dimension) * np.concatenate([[0], np.cumsum(counts)])
        return cls(comm, dimension, offsets)

    @classmethod
    def from_owners(
        cls,
        comm: MPI.Intracomm,
        dimension: int,
        owners: Mapping[str, ArrayLike],
        order: Mapping[str, ArrayLike] | None = None,
    ) -> Layout:
        """Given the rank of each cell, the same on all ranks; local, does not communicate.

        Args:
            comm: communicator.
            dimension: of the rock matrix.
            owners: per field (cells,) rank of each cell of the scene.
            order: per field (cells,) key by which the cells of a rank are sorted; equal keys, and fields without
                keys, keep the scene's order.

        Raises:
            LayoutError: a rank is outside the communicator, or keys and owners differ in number.
        """
        counts, cells = {}, {}
        for name in in_order(owners):
            rank = np.asarray(owners[name], dtype=np.int64)
            if rank.size and not (0 <= rank.min() and rank.max() < comm.size):
                raise LayoutError(f"{name}: owners must lie between 0 and {comm.size - 1}")
            keys = np.asarray(order[name]) if order is not None and name in order else np.zeros(rank.size)
            if keys.shape != rank.shape:
                raise LayoutError(f"{name}: {rank.size} owners, but {keys.size} keys of order")
            counts[name] = np.bincount(rank, minlength=comm.size)
            cells[name] = np.lexsort((keys, rank)).astype(np.int64)
        moved = {name: c for name, c in cells.items() if not np.array_equal(c, np.arange(c.size))}
        return cls(comm, dimension, cls.from_cells(comm, dimension, counts).offsets, moved)

    def only(self, fields: Iterable[str]) -> Layout:
        """The same layout for some of the fields."""
        names = in_order(fields)
        cells = {f: self.cells[f] for f in names if f in self.cells}
        return Layout(self.comm, self.dimension, {f: self.offsets[f] for f in names}, cells)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields, in the order of the table."""
        return tuple(self.offsets)

    def block_size(self, name: str) -> int:
        """Unknowns per cell of a field."""
        return FIELD[name].block_size(self.dimension)

    def rows(self, name: str) -> tuple[int, int]:
        """Half-open range of the rows of a field on this rank, in the layout's numbering."""
        offset = self.offsets[name]
        return int(offset[self.comm.rank]), int(offset[self.comm.rank + 1])

    def sizes(self, name: str) -> tuple[int, int]:
        """Number of rows of a field on this rank, and on all."""
        start, stop = self.rows(name)
        return stop - start, int(self.offsets[name][-1])

    def own_cells(self, name: str) -> Cells:
        """The scene's numbers of the cells of a field on this rank, in the order of the layout."""
        bs = self.block_size(name)
        start, stop = (n // bs for n in self.rows(name))
        return self.cells[name][start:stop] if name in self.cells else np.arange(start, stop)

    def own_rows(self, name: str) -> Cells:
        """The scene's numbers of the rows of a field on this rank, in the order of the layout."""
        return rows_of(self.own_cells(name), self.block_size(name))

    def places(self, name: str) -> Cells:
        """For each cell of the scene its number in the layout: the inverse of `cells`."""
        n = int(self.offsets[name][-1]) // self.block_size(name)
        if name not in self.cells:
            return np.arange(n)
        places = np.empty(n, dtype=np.int64)
        places[self.cells[name]] = np.arange(n)
        return places

    def owners(self, name: str) -> Cells:
        """For each cell of the scene the rank that holds it."""
        bounds = self.offsets[name][1:] // self.block_size(name)
        return np.searchsorted(bounds, self.places(name), side="right")

    def scene_cell(self, name: str, cell: int) -> int:
        """The scene's number of a cell of the layout."""
        return int(self.cells[name][cell]) if name in self.cells else cell

    def to_scene(self, name: str, values: NDArray[Any]) -> NDArray[Any]:
        """Values of all rows of a field, from the layout's order to the scene's."""
        if name not in self.cells:
            return values
        ordered = np.empty_like(values)
        ordered[rows_of(self.cells[name], self.block_size(name))] = values
        return ordered


def rows_of(cells: Cells, block_size: int) -> Cells:
    """Numbers of the rows of cells, all rows of a cell before the next cell."""
    return (cells[:, None] * block_size + np.arange(block_size)).ravel()
