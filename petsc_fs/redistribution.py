"""Redistribution: rows that ranks read in contiguous chunks go to the ranks that own them, piece by piece."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

import numpy as np
from mpi4py import MPI
from mpi4py.util.dtlib import from_numpy_dtype
from numpy.typing import NDArray

from petsc_fs.errors import together
from petsc_fs.layout import Cells

PIECE = 16 << 20
"""Bytes that a rank reads before it sends them on."""

Read = Callable[[int, int], NDArray[Any]]
"""Entries start:stop of an array in a file."""


class Redistribution:
    """Rows of varying length: all entries of an array lie row after row in a file, each row has an owner.

    The entries are shared out in contiguous chunks; each rank reads its share once and sends it on. Which entries go
    where follows from `indptr` on both sides, so only entries are sent.
    """

    def __init__(self, comm: MPI.Intracomm, indptr: Cells, owners: Cells, own: Cells) -> None:
        """Local, but all ranks must make it.

        Args:
            comm: communicator.
            indptr: (rows + 1,) first entry of each row in the file; the same on all ranks.
            owners: (rows,) rank that owns each row; the same on all ranks.
            own: the rows that this rank owns, in the order in which it wants them.
        """
        self.comm = comm
        self.entries = int(indptr[-1])
        self._indptr, self._owners = indptr, owners
        lengths = indptr[own + 1] - indptr[own]
        self.indptr = np.concatenate([[0], np.cumsum(lengths)])
        order = np.argsort(own, kind="stable")
        self._straight = comm.size == 1 and np.array_equal(own, np.arange(own.size))
        self._starts, self._stops, self._targets = indptr[own][order], indptr[own + 1][order], self.indptr[:-1][order]

    def exchange(self, piece: NDArray[Any], starts: Cells, stops: Cells, out: NDArray[Any]) -> None:
        """Send the entries of one piece to their owners, and receive this rank's. Collective.

        Args:
            piece: entries starts[rank]:stops[rank].
            starts: (ranks,) first entry that each rank has.
            stops: (ranks,) end of the entries that each rank has.
            out: (entries of the rows of this rank, ...) to be filled.
        """
        a, b = int(starts[self.comm.rank]), int(stops[self.comm.rank])
        if self._straight:
            out[a:b] = piece
            return
        width = int(np.prod(out.shape[1:]))
        sent, counts = self._sorted_by_owner(piece, a, b)
        places, received_counts = self._places(starts, stops)
        received = np.empty((places.size, *out.shape[1:]), dtype=out.dtype)
        kind = from_numpy_dtype(out.dtype)
        self.comm.Alltoallv([sent, counts * width, kind], [received, received_counts * width, kind])
        out[places] = received

    def _sorted_by_owner(self, piece: NDArray[Any], start: int, stop: int) -> tuple[NDArray[Any], Cells]:
        """Entries start:stop by rank, those of a rank in the order of the file; and how many each gets."""
        counts = np.zeros(self.comm.size, dtype=np.int64)
        if start == stop:
            return piece, counts
        a = int(np.searchsorted(self._indptr, start, side="right")) - 1
        b = int(np.searchsorted(self._indptr, stop, side="left"))
        ends = np.clip(self._indptr[a : b + 1], start, stop) - start
        owners, lengths = self._owners[a:b], np.diff(ends)
        counts += np.bincount(owners, weights=lengths, minlength=self.comm.size).astype(np.int64)
        if (np.diff(owners) >= 0).all():
            return piece, counts
        order = np.argsort(owners, kind="stable")
        return piece[ranges(ends[:-1][order], lengths[order])], counts

    def _places(self, starts: Cells, stops: Cells) -> tuple[Cells, Cells]:
        """Where the entries go that this rank receives, rank by rank; and how many come from each."""
        places, counts = [], np.zeros(self.comm.size, dtype=np.int64)
        for k, (start, stop) in enumerate(zip(starts, stops, strict=True)):
            a = int(np.searchsorted(self._stops, start, side="right"))
            b = int(np.searchsorted(self._starts, stop, side="left"))
            if start == stop or a >= b:
                continue
            first = np.maximum(self._starts[a:b], start)
            lengths = np.minimum(self._stops[a:b], stop) - first
            places.append(ranges(self._targets[a:b] + first - self._starts[a:b], lengths))
            counts[k] = lengths.sum()
        return np.concatenate([np.zeros(0, dtype=np.int64), *places]), counts


@dataclass(frozen=True)
class Transfer:
    """One array that is read and redistributed.

    Attributes:
        rows: its rows and their owners.
        read: the only access to the file; called on disjoint ranges of entries.
        out: (entries of the rows of this rank, ...) to be filled.
        chunk: number of entries that are stored, thus read, together.
    """

    rows: Redistribution
    read: Read
    out: NDArray[Any]
    chunk: int = 1

    def pieces(self, ranks: int) -> Iterator[tuple[Cells, Cells, int]]:
        """First entry of each rank, end of the entries of each rank, and bytes of the largest, piece by piece."""
        bounds = shares(self.rows.entries, self.chunk, ranks)
        entry = self.out.dtype.itemsize * int(np.prod(self.out.shape[1:]))
        step = max(1, PIECE // entry // self.chunk) * self.chunk
        for first in range(0, int(np.diff(bounds).max(initial=0)), step):
            starts = np.minimum(bounds[:-1] + first, bounds[1:])
            stops = np.minimum(starts + step, bounds[1:])
            yield starts, stops, entry * int((stops - starts).max())


def run(
    comm: MPI.Intracomm,
    transfers: Iterable[Transfer],
    explained: Callable[[], AbstractContextManager[Any]] = nullcontext,
) -> None:
    """Read this rank's share of each array and receive this rank's rows. Collective.

    As many pieces as fit into `PIECE` bytes are read before ranks agree that this went well, and send.

    Args:
        comm: communicator.
        transfers: the same arrays in the same order on all ranks.
        explained: context in which `read` runs.

    Raises:
        Exception: that of the lowest rank on which `read` raises, on all ranks.
    """
    batch: list[tuple[Transfer, Cells, Cells]] = []
    size = 0
    for transfer in transfers:
        for starts, stops, weight in transfer.pieces(comm.size):
            if batch and size + weight > PIECE:
                _run_batch(comm, batch, explained)
                batch, size = [], 0
            batch.append((transfer, starts, stops))
            size += weight
    _run_batch(comm, batch, explained)


def _run_batch(
    comm: MPI.Intracomm,
    batch: list[tuple[Transfer, Cells, Cells]],
    explained: Callable[[], AbstractContextManager[Any]],
) -> None:
    with together(comm), explained():
        pieces = [
            np.ascontiguousarray(t.read(int(starts[comm.rank]), int(stops[comm.rank])), dtype=t.out.dtype)
            for t, starts, stops in batch
        ]
    for piece, (transfer, starts, stops) in zip(pieces, batch, strict=True):
        transfer.rows.exchange(piece, starts, stops, transfer.out)


def shares(entries: int, chunk: int, ranks: int) -> Cells:
    """(ranks + 1,) bounds of nearly equal shares of some entries, at multiples of a chunk."""
    chunks = -(-entries // chunk)
    return np.minimum(entries, chunk * (chunks * np.arange(ranks + 1) // ranks))


def ranges(starts: Cells, lengths: Cells) -> Cells:
    """The numbers start, start + 1, ... of each range, one range after the other."""
    offset = np.cumsum(lengths) - lengths
    return np.asarray(np.repeat(starts - offset, lengths) + np.arange(int(lengths.sum())))
