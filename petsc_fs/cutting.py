"""Cutting a sparse matrix into the blocks of a scene, again and again, where values change more than the pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from petsc_fs.scene import CSR, Columns, Integers, cut_rows, gather_rows
from petsc_fs.splice import Mask, Splice, changed_rows

_Places = tuple[Integers, Integers, Integers]
"""Of rows of a block: number of entries of each, their columns, and where they stand among those of the field."""


@dataclass
class _Rows:
    """How the rows of one field were cut last time.

    Attributes:
        indptr: first entry of each row.
        columns: of the entries, in the order of the whole matrix.
        target: where each column of the whole matrix belongs.
        patterns: `indptr` and `indices` of each block.
        places: for each block, where its entries stand among those of the rows.
    """

    indptr: Integers
    columns: Integers
    target: Columns
    patterns: list[tuple[Integers, Integers]]
    places: list[Integers]

    def are_comparable(self, indptr: Integers, target: Columns) -> bool:
        """Whether others are as many, and cut at the same columns."""
        same_target = all(np.array_equal(mine, other) for mine, other in zip(self.target, target, strict=True))
        return indptr.size == self.indptr.size and same_target

    def replace(self, indptr: Integers, columns: Integers, changed: Mask, blocks: Sequence[_Places]) -> None:
        """Take over rows that changed; what has the same pattern as before, keeps its arrays.

        Args:
            indptr: of all rows.
            columns: of all rows.
            changed: which rows did.
            blocks: into which these are cut.
        """
        moved = indptr[:-1] - self.indptr[:-1]
        self.indptr, self.columns = indptr, columns
        for k, (counts, new_indices, new_places) in enumerate(blocks):
            before, indices = self.patterns[k]
            splice = Splice(before, changed, counts)
            self.places[k] = splice.merge(self.places[k] + np.repeat(moved, np.diff(before)), new_places)
            same = np.array_equal(before, splice.indptr) and np.array_equal(splice.replaced(indices), new_indices)
            if not same:
                self.patterns[k] = splice.indptr, splice.merge(indices, new_indices)


class Cutter:
    """Cuts the rows of fields, and remembers for each field where its entries went.

    In a Newton run most rows have the same pattern from step to step: then a cut takes one comparison of column
    numbers and one copy of values. Rows that changed are cut anew. It costs memory: 12 bytes per entry.

    Attributes:
        hits: how often all rows of a field were cut from memory.
        valid: patterns of the blocks of the latest scene that was made with it, and passed; see `Scene.validate`.
    """

    def __init__(self) -> None:
        """Nothing is known yet."""
        self._known: dict[str, _Rows] = {}
        self.hits = 0
        self.valid: dict[tuple[str, str], tuple[Integers, Integers]] = {}

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
        indptr = np.concatenate([[0], np.cumsum(np.diff(matrix.indptr)[rows])])
        entries = _entries(matrix.indptr, rows)
        known = self._known_rows(name, indptr, matrix.indices[entries], target, parts)
        data = matrix.data[entries].astype(np.float64, copy=False)
        return [CSR(*pattern, data.take(at)) for pattern, at in zip(known.patterns, known.places, strict=True)]

    def _known_rows(self, name: str, indptr: Integers, columns: Integers, target: Columns, parts: int) -> _Rows:
        """What is known of a field, brought up to date."""
        known = self._known.get(name)
        if known is None or not known.are_comparable(indptr, target):
            blocks = _cut_places(indptr, columns, np.arange(indptr.size - 1), target, parts)
            patterns = [(np.concatenate([[0], np.cumsum(counts)]), indices) for counts, indices, _ in blocks]
            places = [places for _, _, places in blocks]
            # the columns are copied, or the whole matrix that they are a part of would stay in memory
            known = self._known[name] = _Rows(indptr, np.array(columns), target, patterns, places)
            return known
        changed = changed_rows(known.indptr, known.columns, indptr, columns)
        if changed.any():
            blocks = _cut_places(indptr, columns, np.flatnonzero(changed), target, parts)
            known.replace(indptr, np.array(columns), changed, blocks)
        else:
            self.hits += 1
        return known


def _cut_places(indptr: Integers, columns: Integers, rows: Integers, target: Columns, parts: int) -> list[_Places]:
    """Some rows in blocks that have the places of their entries for values."""
    places, counts = gather_rows(indptr, rows)
    numbered = CSR(np.concatenate([[0], np.cumsum(counts)]), columns[places], places.astype(np.float64))
    blocks = cut_rows(numbered, np.arange(rows.size), target, parts)
    # numpy takes by other integers at half the speed
    return [(np.diff(block.indptr), block.indices, block.data.astype(np.intp)) for block in blocks]


def _entries(indptr: Integers, rows: Integers) -> slice | Integers:
    """Places of all entries of some rows; a slice where the rows follow each other."""
    if rows.size and (np.diff(rows) == 1).all():
        return slice(int(indptr[rows[0]]), int(indptr[rows[-1] + 1]))
    return gather_rows(indptr, rows)[0]
