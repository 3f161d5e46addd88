"""Union of the nonzero patterns of a sequence of scenes, so that PETSc's objects outlive small changes of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from petsc_fs.scene import CSR, Integers, Scene


@dataclass
class _Block:
    """Pattern of one block: the union, and where the entries of the latest scene stand in it.

    Attributes:
        indptr: of the union.
        indices: of the union.
        latest: pattern of the latest scene.
        places: of its entries among those of the union; None if it is the union.
    """

    indptr: Integers
    indices: Integers
    latest: CSR
    places: Integers | None = None


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

        Local. Blocks whose pattern is the union already are passed on, not copied.

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
            self._blocks[rc] = _Block(block.indptr, block.indices, block)
            return block
        if not _same_pattern(block, known.latest):
            self._compare(known, block, columns)
        if known.places is None:
            return CSR(known.indptr, known.indices, block.data)
        data = np.zeros(known.indices.size)
        data[known.places] = block.data
        return CSR(known.indptr, known.indices, data)

    def _compare(self, known: _Block, block: CSR, columns: int) -> None:
        """Find the places of another pattern, and add what is new in it to the union."""
        known.latest = block
        union, keys = _keys(known.indptr, known.indices, columns), _keys(block.indptr, block.indices, columns)
        places = np.searchsorted(union, keys)
        if not np.array_equal(union[np.minimum(places, union.size - 1)], keys):
            self.grew = True
            union = np.union1d(union, keys)
            counts = np.bincount(union // columns, minlength=block.indptr.size - 1)
            known.indptr = np.concatenate([[0], np.cumsum(counts)])
            known.indices = union % columns
            places = np.searchsorted(union, keys)
        known.places = None if places.size == union.size else places


def _keys(indptr: Integers, indices: Integers, columns: int) -> Integers:
    """One number per entry that increases by row and column."""
    rows = np.repeat(np.arange(indptr.size - 1), np.diff(indptr))
    return np.asarray(rows * columns + indices)


def _same_pattern(a: CSR, b: CSR) -> bool:
    return np.array_equal(a.indptr, b.indptr) and np.array_equal(a.indices, b.indices)
