"""Union of the nonzero patterns of a sequence of scenes, so that PETSc's objects outlive small changes of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from petsc_fs.scene import CSR, Integers, Scene, gather_rows
from petsc_fs.splice import Mask, Splice, changed_rows


@dataclass
class _Block:
    """Pattern of one block: the union, and which of its entries the latest scene has.

    Attributes:
        indptr: of the union.
        indices: of the union.
        latest: `indptr` and `indices` of the latest scene.
        present: (entries of the union,) whether the latest scene has them; None if it has all.
    """

    indptr: Integers
    indices: Integers
    latest: tuple[Integers, Integers]
    present: Mask | None = None


class UnionPattern:
    """Gives every scene of a sequence the pattern of all scenes so far, with explicit zeros.

    Jacobians of a Newton run have a few entries that come and go, where a cell changes its contact state or
    an upwind direction turns. After a few steps the union changes no more.

    Attributes:
        grew: whether the latest scene had an entry that no scene before it had; true for the first.
    """

    def __init__(self) -> None:
        self.grew = False
        self._blocks: dict[tuple[str, str], _Block] = {}

    def fit(self, scene: Scene) -> Scene:
        """The scene with the union of the patterns so far.

        Local. Blocks whose pattern is the union already are passed on, not copied. Where a union has not grown,
        `indptr` and `indices` are those of the scene before.

        Args:
            scene: whole, or always the same rows of it; with the sizes of the scenes before.
        """
        self.grew = False
        blocks = {rc: self._fit(rc, block, scene.sizes[rc[1]]) for rc, block in scene.blocks.items() if block.data.size}
        for rc, known in self._blocks.items():
            if rc not in blocks:
                blocks[rc] = CSR(known.indptr, known.indices, np.zeros(known.indices.size))
        return replace(scene, blocks=blocks)

    def _fit(self, rc: tuple[str, str], block: CSR, columns: int) -> CSR:
        known = self._blocks.get(rc)
        if known is None:
            self.grew = True
            self._blocks[rc] = _Block(block.indptr, block.indices, (block.indptr, block.indices))
            return block
        changed = changed_rows(*known.latest, block.indptr, block.indices)
        if changed.any():
            self._take_rows(known, block, changed, columns)
        known.latest = block.indptr, block.indices
        if known.present is None:
            return CSR(known.indptr, known.indices, block.data)
        data = np.zeros(known.indices.size)
        data[known.present] = block.data
        return CSR(known.indptr, known.indices, data)

    def _take_rows(self, known: _Block, block: CSR, changed: Mask, columns: int) -> None:
        """Find which entries of the union are present in rows that changed, and add what is new in them to it."""
        rows = np.flatnonzero(changed)
        before, keys = _keys(known.indptr, known.indices, rows, columns), _keys(*block[:2], rows, columns)
        union = np.union1d(before, keys)
        present = np.isin(union, keys, assume_unique=True)
        splice = Splice(known.indptr, changed, np.bincount(union // columns, minlength=rows.size))
        if known.present is not None or not present.all():
            everything = np.ones(known.indices.size, dtype=np.bool_)
            known.present = splice.merge(everything if known.present is None else known.present, present)
            if known.present.all():
                known.present = None
        if union.size > before.size:
            self.grew = True
            known.indptr, known.indices = splice.indptr, splice.merge(known.indices, union % columns)


def _keys(indptr: Integers, indices: Integers, rows: Integers, columns: int) -> Integers:
    """One number per entry of some rows that increases by row and column."""
    places, counts = gather_rows(indptr, rows)
    return np.asarray(np.repeat(np.arange(rows.size), counts) * columns + indices[places])
