"""Cutting a sparse matrix into the blocks of a scene, again and again, where values change more than the pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from petsc_fs.scene import CSR, Columns, Integers, cut_rows, gather_rows


@dataclass
class _Rows:
    """How the rows of one field were cut last time.

    Attributes:
        lengths: entries of each row.
        columns: of these entries, in the order of the whole matrix.
        target: where each column of the whole matrix belongs.
        patterns: `indptr` and `indices` of each block.
        places: for each block, where its entries stand among those of the rows.
    """

    lengths: Integers
    columns: Integers
    target: Columns
    patterns: list[tuple[Integers, Integers]]
    places: list[Integers]

    def serve(self, lengths: Integers, columns: Integers, target: Columns) -> bool:
        """Whether other rows are cut in the same way."""
        pairs = ((self.lengths, lengths), (self.columns, columns), *zip(self.target, target, strict=True))
        return all(np.array_equal(mine, other) for mine, other in pairs)


class Cutter:
    """Cuts the rows of fields, and remembers for each field where its entries went.

    In a Newton run the rows of most fields have the same pattern from step to step: then a cut takes one comparison of
    column numbers and one copy of values. It costs memory: 8 bytes per entry.

    Attributes:
        hits: how often rows were cut from memory.
    """

    def __init__(self) -> None:
        """Nothing is known yet."""
        self._known: dict[str, _Rows] = {}
        self.hits = 0

    def cut(self, name: str, matrix: CSR, rows: Integers, target: Columns, parts: int) -> Sequence[CSR]:
        """The rows of one field, cut by the owners of their columns, as `petsc_fs.scene.cut_rows` does it.

        Blocks of equal patterns, from call to call, share `indptr` and `indices`.

        Args:
            name: of the field.
            matrix: the whole one.
            rows: of the field, in order.
            target: where each column belongs.
            parts: number of fields.
        """
        lengths = np.diff(matrix.indptr)[rows]
        entries = _entries(matrix.indptr, rows)
        columns = matrix.indices[entries]
        known = self._known.get(name)
        if known is not None and known.serve(lengths, columns, target):
            self.hits += 1
        else:
            known = self._known[name] = self._learn(lengths, columns, target, parts)
        data = matrix.data[entries].astype(np.float64, copy=False)
        return [CSR(*pattern, data[at]) for pattern, at in zip(known.patterns, known.places, strict=True)]

    @staticmethod
    def _learn(lengths: Integers, columns: Integers, target: Columns, parts: int) -> _Rows:
        """Cut the numbers of the entries instead of their values."""
        indptr = np.concatenate([[0], np.cumsum(lengths)])
        numbered = CSR(indptr, columns, np.arange(columns.size, dtype=np.float64))
        blocks = cut_rows(numbered, np.arange(lengths.size), target, parts)
        index = np.int32 if columns.size < 2**31 else np.int64
        return _Rows(
            lengths,
            np.array(columns),  # not a part of the whole matrix, which would stay in memory
            target,
            [(block.indptr, block.indices) for block in blocks],
            [block.data.astype(index) for block in blocks],
        )


def _entries(indptr: Integers, rows: Integers) -> slice | Integers:
    """Places of all entries of some rows; a slice where the rows follow each other."""
    if rows.size and (np.diff(rows) == 1).all():
        return slice(int(indptr[rows[0]]), int(indptr[rows[-1] + 1]))
    return gather_rows(indptr, rows)[0]
