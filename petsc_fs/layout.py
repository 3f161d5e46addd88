"""Layout: which rank holds which rows of each field."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from petsc_fs.errors import LayoutError
from petsc_fs.fields import FIELD, in_order

if TYPE_CHECKING:
    from mpi4py import MPI


@dataclass(frozen=True)
class Layout:
    """Contiguous rows of each field per rank, whole cells only.

    Attributes:
        comm: communicator.
        dimension: of the rock matrix.
        offsets: per field (ranks + 1,) first global row of each rank; the same on all ranks.
    """

    comm: MPI.Intracomm
    dimension: int
    offsets: Mapping[str, NDArray[np.int64]]

    @classmethod
    def contiguous(cls, comm: MPI.Intracomm, dimension: int, sizes: Mapping[str, int]) -> Layout:
        """Cells of each field cut into chunks of nearly equal length."""
        counts = {}
        for name in in_order(sizes):
            cells = sizes[name] // FIELD[name].block_size(dimension)
            bounds = (cells * np.arange(comm.size + 1)) // comm.size
            counts[name] = np.diff(bounds)
        return cls.from_cells(comm, dimension, counts)

    @classmethod
    def from_cells(cls, comm: MPI.Intracomm, dimension: int, cells: Mapping[str, ArrayLike]) -> Layout:
        """Given the number of cells of each field on each rank, the same on all ranks.

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

    def only(self, fields: Iterable[str]) -> Layout:
        """The same layout for some of the fields."""
        return Layout(self.comm, self.dimension, {f: self.offsets[f] for f in in_order(fields)})

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields, in the order of the table."""
        return tuple(self.offsets)

    def block_size(self, name: str) -> int:
        """Unknowns per cell of a field."""
        return FIELD[name].block_size(self.dimension)

    def rows(self, name: str) -> tuple[int, int]:
        """Half-open global range of the rows of a field on this rank."""
        offset = self.offsets[name]
        return int(offset[self.comm.rank]), int(offset[self.comm.rank + 1])

    def sizes(self, name: str) -> tuple[int, int]:
        """Number of rows of a field on this rank, and on all."""
        start, stop = self.rows(name)
        return stop - start, int(self.offsets[name][-1])
