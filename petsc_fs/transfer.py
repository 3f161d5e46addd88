"""What goes where when a scene that rank 0 has is spread over all ranks.

A `Plan` says once which entry of rank 0's arrays goes to which place on which rank; a `Structure` is what a rank needs
to know once. After that the values of a scene are one array per rank.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.layout import Layout
from petsc_fs.scene import CSR, Floats, Integers, Material, Scene

Piece = tuple[str, Any]
"""Kind of an array whose values change, and which one: ("blocks", (row field, column field)), ("rhs", field),
("contact_state", None) or ("material", name)."""


@dataclass
class Structure:
    """What a rank knows of its part of a scene beside the values.

    Attributes:
        frame: the part without matrix, right-hand side, contact states and material.
        patterns: `indptr` and `indices` of each block, or of those that are new to the rank.
        pieces: arrays that make up the values, in their order, and their lengths.
    """

    frame: Scene
    patterns: dict[tuple[str, str], tuple[Integers, Integers]]
    pieces: list[tuple[Piece, int]]

    @property
    def size(self) -> int:
        """Number of values."""
        return sum(length for _, length in self.pieces)

    def grown(self, later: Structure) -> Structure:
        """What is known after blocks have got other patterns: `later` has those of these blocks only."""
        return replace(later, patterns=self.patterns | later.patterns)

    def part(self, values: Floats, changes: Mapping[str, Any]) -> Scene:
        """The part of the scene that has these values, by reference.

        Args:
            values: (size,).
            changes: from `changes_of` the whole scene.
        """
        blocks, rhs, material = {}, {}, dict(changes["material"])
        contact_state = None
        at = 0
        for (kind, key), length in self.pieces:
            piece = values[at : at + length]
            at += length
            if kind == "blocks":
                blocks[key] = CSR(*self.patterns[key], data=piece)
            elif kind == "rhs":
                rhs[key] = piece
            elif kind == "contact_state":
                contact_state = piece.astype(np.int8)
            else:
                material[key] = piece
        return replace(
            self.frame,
            blocks=blocks,
            rhs=rhs,
            contact_state=contact_state,
            material=Material(**material) if material else None,
            metadata=changes["metadata"],
        )


def changes_of(scene: Scene) -> dict[str, Any]:
    """What changes from scene to scene and is the same on all ranks."""
    numbers = {}
    if scene.material is not None:
        numbers = {name: v for name, v in scene.material.cell_data().items() if not np.ndim(v)}
        numbers["time_step"] = scene.material.time_step
    return {"material": numbers, "metadata": scene.metadata}


def same_frame(a: Scene, b: Scene) -> bool:
    """Whether two whole scenes differ in nothing but values and pattern."""

    def arrays(scene: Scene) -> dict[tuple[str, str], Any]:
        given: dict[tuple[str, str], Any] = {("centers", f): v for f, v in scene.cell_centers.items()}
        given |= {("volumes", f): v for f, v in scene.cell_volumes.items()}
        return given | {("dimension", ""): scene.cell_dimension}

    def kinds(scene: Scene) -> tuple[Any, ...]:
        material = {} if scene.material is None else {k: np.ndim(v) for k, v in scene.material.cell_data().items()}
        return scene.dimension, scene.sizes, scene.contact_state is None, material

    x, y = arrays(a), arrays(b)
    return kinds(a) == kinds(b) and x.keys() == y.keys() and all(np.array_equal(v, y[k]) for k, v in x.items())


@dataclass(frozen=True)
class _At:
    """Stands for the communicator in a layout seen from another rank."""

    rank: int
    size: int


class Plan:
    """Which entry of the arrays of a whole scene goes to which place on which rank. Local to rank 0.

    Attributes:
        counts: (ranks,) number of values of each rank.
    """

    def __init__(self, scene: Scene, layout: Layout) -> None:
        """Plan for all whole scenes with the pattern of this one.

        Args:
            scene: all rows.
            layout: distribution of the rows.
        """
        self.layout = layout
        self._structures: list[Structure] = []
        self._planned: dict[tuple[str, str], tuple[Integers, Integers]] = {}
        self._takes: list[dict[Piece, tuple[slice | Integers, int]]] = [{} for _ in range(layout.comm.size)]
        self._packed = np.empty(0)
        self.counts: Integers = np.zeros(layout.comm.size, dtype=np.int64)
        self.grow(scene)

    def grow(self, scene: Scene) -> None:
        """Plan for scenes of the same frame in which some blocks have other patterns.

        Args:
            scene: all rows; `indptr` and `indices` of blocks that have not changed are the very arrays of before.
        """
        patterns = {rc: (block.indptr, block.indices) for rc, block in scene.blocks.items()}
        new = {
            rc: pattern
            for rc, pattern in patterns.items()
            if rc not in self._planned or any(a is not b for a, b in zip(pattern, self._planned[rc], strict=True))
        }
        # Restricted like a scene, the numbers of its entries end up where the entries belong
        numbered = {rc: CSR(*pattern, np.arange(pattern[1].size, dtype=np.float64)) for rc, pattern in new.items()}
        bare = replace(scene, blocks=numbered, reference={}, contact_state=None, material=None)
        self._structures = []
        for rank, takes in enumerate(self._takes):
            seen: Any = _At(rank, self.layout.comm.size)
            view = replace(self.layout, comm=seen)
            part = bare.restrict(view)
            places: dict[Piece, Integers] = {("blocks", rc): b.data.astype(np.int64) for rc, b in part.blocks.items()}
            places |= {("rhs", f): view.own_rows(f) for f in part.sizes}
            if scene.contact_state is not None:
                places["contact_state", None] = view.own_cells("contact")
            if scene.material is not None:
                arrays = [name for name, value in scene.material.cell_data().items() if np.ndim(value)]
                places |= {("material", name): view.own_cells("mass") for name in arrays}
            takes |= {piece: (_selection(at), at.size) for piece, at in places.items()}
            self._structures.append(
                Structure(
                    replace(part, blocks={}, rhs={}),
                    {rc: (b.indptr, b.indices) for rc, b in part.blocks.items()},
                    [(piece, length) for piece, (_, length) in takes.items()],
                )
            )
        self._planned = patterns
        self.counts = np.array([sum(length for _, length in takes.values()) for takes in self._takes])

    def take_structures(self) -> list[Structure]:
        """What each rank has to know, to be sent once: it is forgotten here. Of blocks, only those that are new."""
        taken, self._structures = self._structures, []
        return taken

    def pack(self, scene: Scene) -> Floats:
        """All values of a scene, those of rank 0 first, in an array that the next call uses again."""
        total = int(self.counts.sum())
        self._packed = with_room(self._packed, total)
        end = 0
        for takes in self._takes:
            for (kind, key), (selection, length) in takes.items():
                values, room = _values(scene, kind, key), self._packed[end : end + length]
                if isinstance(selection, slice):
                    room[:] = values[selection]
                else:
                    np.take(values, selection, out=room, mode="clip")  # which clips nothing, but spares a copy of room
                end += length
        return self._packed[:total]

    def unpack(self, parts: Floats) -> dict[str, Floats]:
        """Per field all rows in the scene's numbering, from the local rows of all ranks, those of rank 0 first."""
        layout = self.layout
        pieces: dict[str, list[Floats]] = {f: [] for f in layout.fields}
        end = 0
        for rank in range(layout.comm.size):
            for f in layout.fields:
                length = int(layout.offsets[f][rank + 1] - layout.offsets[f][rank])
                pieces[f].append(parts[end : end + length])
                end += length
        return {f: layout.to_scene(f, np.concatenate(piece)) for f, piece in pieces.items()}


def with_room(array: Floats, size: int) -> Floats:
    """An array with room for so many numbers: the same one where it has it, else one that has some to spare.

    Patterns grow little by little, and to receive into memory that was never used takes several times as long.
    """
    return array if array.size >= size else np.empty(size + size // 16)


def _selection(places: Integers) -> slice | Integers:
    """A slice where the places follow each other, else the places."""
    if not places.size:
        return slice(0, 0)
    if (np.diff(places) == 1).all():
        return slice(int(places[0]), int(places[-1]) + 1)
    return places


def _values(scene: Scene, kind: str, key: Any) -> NDArray[Any]:
    """One of the arrays whose values change."""
    if kind == "blocks":
        return scene.blocks[key].data
    if kind == "rhs":
        return scene.rhs[key]
    values = scene.contact_state if kind == "contact_state" else getattr(scene.material, key)
    return np.asarray(values, dtype=np.float64)
