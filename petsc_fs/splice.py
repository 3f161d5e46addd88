"""Rows of a sparse pattern that are not what they were, and new ones in their place.

From one Newton step to the next most rows of a Jacobian keep their pattern; the few others are where a cell changes
its contact state or an upwind direction turns. So entries are compared and copied by runs of rows, not one by one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.scene import Integers

Mask = NDArray[np.bool_]


def changed_rows(indptr: Integers, indices: Integers, later_indptr: Integers, later_indices: Integers) -> Mask:
    """Which rows of a pattern differ from those of a later one, (rows,).

    Args:
        indptr: (rows + 1,) first entry of each row.
        indices: columns, in any order, which matters.
        later_indptr: of as many rows.
        later_indices: of the later pattern.
    """
    if later_indptr is indptr and later_indices is indices:
        return np.zeros(indptr.size - 1, dtype=np.bool_)
    counts = np.diff(indptr)
    changed: Mask = counts != np.diff(later_indptr)
    same_length = np.flatnonzero(~changed)
    if same_length.size < changed.size:
        runs = _edges(~changed)
        indices, later_indices = _join(indices, indptr[runs]), _join(later_indices, later_indptr[runs])
    differing = np.flatnonzero(indices != later_indices)
    changed[same_length[np.searchsorted(np.cumsum(counts[same_length]), differing, side="right")]] = True
    return changed


class Splice:
    """Replaces some rows of a sparse matrix, in any array with one element per entry.

    Attributes:
        indptr: (rows + 1,) afterwards.
    """

    def __init__(self, indptr: Integers, changed: Mask, counts: Integers) -> None:
        """Prepare the replacement.

        Args:
            indptr: (rows + 1,) as it is.
            changed: (rows,) which rows are replaced.
            counts: (rows replaced,) number of their new entries.
        """
        after = np.diff(indptr)
        after[changed] = counts
        self.indptr = np.concatenate([[0], np.cumsum(after)])
        edges = _edges(changed)
        rows_before = np.concatenate([[0], np.cumsum(changed)])[edges]
        self._replaced = indptr[edges]
        self._new = np.concatenate([[0], np.cumsum(counts)])[rows_before]

    def replaced(self, old: NDArray[Any]) -> NDArray[Any]:
        """The elements of the rows that are replaced."""
        return _join(old, self._replaced)

    def merge(self, old: NDArray[Any], new: NDArray[Any]) -> NDArray[Any]:
        """The whole array afterwards, of the old one's type.

        Args:
            old: (entries,) of all rows.
            new: (new entries,) of the rows replaced, in their order.
        """
        pieces, end = [], 0
        for (start, stop), (first, last) in zip(_pairs(self._replaced), _pairs(self._new), strict=True):
            pieces += [old[end:start], new[first:last]]
            end = stop
        return np.concatenate([*pieces, old[end:]], dtype=old.dtype, casting="same_kind")


def _edges(mask: Mask) -> Integers:
    """Where each run of true elements begins and ends, in turn: (2 runs,)."""
    return np.flatnonzero(np.diff(mask, prepend=False, append=False))


def _join(array: NDArray[Any], edges: Integers) -> NDArray[Any]:
    """Pieces of an array in a row, each from one edge to the next but not from there on: (2 pieces,) edges."""
    return np.concatenate([array[:0], *(array[start:stop] for start, stop in _pairs(edges))])


def _pairs(edges: Integers) -> list[list[int]]:
    """First and last edge of each piece."""
    pairs: list[list[int]] = edges.reshape(-1, 2).tolist()
    return pairs
