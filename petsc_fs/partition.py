"""Partition: which rank gets which cells, so that all fields of one place are together.

Only the cells of the rock are cut into parts, by their centres or by their graph. Every other cell goes where its
*anchor* is, a rock cell that the matrix couples it to: momentum and mass of a rock cell are together, and so are
contact, both walls, interface fluxes and pressure of one fracture cell, beside a rock cell that touches them. Products
with blocks of contact then need no communication, and S^1 and S^3 next to none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SceneError, UsageError, together
from petsc_fs.fields import FIELD, in_order
from petsc_fs.layout import Layout
from petsc_fs.scene import CSR, Floats, Integers, Scene

if TYPE_CHECKING:
    from mpi4py import MPI

Mask = NDArray[np.bool_]

KINDS = ("auto", "rcb", "ptscotch", "contiguous")
"""Values of -petsc_fs_partition."""

ORDERINGS = ("auto", "natural", "morton")
"""Values of -petsc_fs_ordering."""

CELLS_IN_CACHE = 10_000
"""Rock cells of a rank from which on their order matters: below, the vectors of a solve stay in the caches."""

MORTON_BITS = 20
"""Per coordinate: three of them make up a number of 64 bits."""

SAME_PLACE = 1e-9
"""Coordinates that differ by less than this, relative to the extent of the scene, count as equal."""

COUPLED = ("contact", "intf_force", "intf_flow")
"""Fields on fractures: what their rows couple to says where they are."""


@dataclass(frozen=True)
class Coupling:
    """How strongly cells of two fields act on each other: pairs of cells and the sum of |entries|."""

    rows: Integers
    columns: Integers
    strength: Floats

    @classmethod
    def of(cls, block: CSR, row_size: int, column_size: int, first_row: int = 0) -> Coupling:
        """From a block, with the block sizes of its rows and columns; rows are numbered from `first_row` on."""
        rows = (first_row + np.repeat(np.arange(block.indptr.size - 1), np.diff(block.indptr))) // row_size
        return cls.added(rows, block.indices.astype(np.int64) // column_size, np.abs(block.data))

    @classmethod
    def added(cls, rows: Integers, columns: Integers, strength: Floats) -> Coupling:
        """From pairs in any order, those that occur more than once added up."""
        order = np.lexsort((columns, rows))
        rows, columns, strength = rows[order], columns[order], strength[order]
        new = np.ones(rows.size, dtype=bool)
        new[1:] = (np.diff(rows) != 0) | (np.diff(columns) != 0)
        starts = np.flatnonzero(new)
        return cls(rows[starts], columns[starts], np.add.reduceat(strength, starts) if starts.size else strength)

    def transposed(self) -> Coupling:
        """Rows and columns exchanged."""
        return Coupling(self.columns, self.rows, self.strength)

    def strongest(self, cells: int, allowed: Mask) -> Integers:
        """For each of so many row cells the column cell among those allowed (a mask) that acts most, or -1."""
        keep = allowed[self.columns]
        rows, columns = self.rows[keep], self.columns[keep]
        order = np.lexsort((-columns, self.strength[keep], rows))  # of equals, the lowest number comes last
        partner = np.full(cells, -1, dtype=np.int64)
        partner[rows[order]] = columns[order]
        return partner


@dataclass(frozen=True)
class Places:
    """What a partition is made from, for all cells of a scene, in the scene's numbering.

    Attributes:
        dimension: of the rock matrix.
        cells: number of cells per field.
        centers: per field (cells, 3), where known.
        cell_dimension: (mass cells,) or None.
        couplings: by (row field, column field), for the blocks of `needed`.
        graph: for partitioners of graphs, the pattern of the block `graph_block`, by rows; else None.
    """

    dimension: int
    cells: Mapping[str, int]
    centers: Mapping[str, Floats] = field(default_factory=dict)
    cell_dimension: Integers | None = None
    couplings: Mapping[tuple[str, str], Coupling] = field(default_factory=dict)
    graph: CSR | None = None

    @classmethod
    def of(cls, scene: Scene) -> Places:
        """From a whole scene."""
        cells = {f: n // scene.block_size(f) for f, n in scene.sizes.items()}
        rock = graph_block(scene.dimension, cells, scene.cell_dimension)
        return cls(
            scene.dimension,
            cells,
            scene.cell_centers,
            scene.cell_dimension,
            {
                (r, c): Coupling.of(block, scene.block_size(r), scene.block_size(c))
                for (r, c), block in scene.blocks.items()
                if needed(r, c)
            },
            scene.blocks.get((rock, rock)),
        )


@dataclass(frozen=True)
class Parts:
    """A partition: plain arrays, the same for any communicator with that many ranks.

    Attributes:
        owners: per field (cells,) rank of each cell of the scene.
        order: per field (cells,) key that sorts the cells of a rank.
    """

    owners: Mapping[str, Integers]
    order: Mapping[str, Integers]


def needed(row: str, column: str) -> bool:
    """Whether a partition looks at the entries of a block: those of fractures, which are small."""
    return (row in COUPLED or (row == "mass" and column in COUPLED)) and row != column


def primary_field(cells: Mapping[str, int]) -> str:
    """The field whose cells are cut into parts: momentum, or else mass, or else the largest."""
    for name in ("momentum", "mass"):
        if cells.get(name):
            return name
    return max(in_order(cells), key=lambda f: cells[f])


def is_ordered(cells: Mapping[str, int], ranks: int, ordering: str) -> bool:
    """Whether cells leave the order of the scene, where their centres are known."""
    many = cells[primary_field(cells)] > CELLS_IN_CACHE * ranks
    return ordering == "morton" or (ordering == "auto" and many)


def needs_places(cells: Mapping[str, int], ranks: int, kind: str, ordering: str) -> bool:
    """Whether a partition looks at more than the numbers of cells."""
    return kind != "contiguous" and (ranks > 1 or is_ordered(cells, ranks, ordering))


def graph_block(dimension: int, cells: Mapping[str, int], cell_dimension: Integers | None) -> str:
    """The field whose diagonal block is the graph of the rock: mass rather than momentum, as it is smaller."""
    primary = primary_field(cells)
    rock = _rock(dimension, cells, cell_dimension)
    return "mass" if rock is not None and (primary == "mass" or np.count_nonzero(rock) == cells[primary]) else primary


def chosen(prefix: str = "") -> tuple[str, str]:
    """Kind of partition and ordering that the options say.

    Options:
        -petsc_fs_partition auto|rcb|ptscotch|contiguous: which rank gets which cells, see `parts_of`.
        -petsc_fs_ordering auto|natural|morton: order of the cells of a rank, see `parts_of`.

    Raises:
        UsageError: a value is none of `KINDS` or `ORDERINGS`.
    """
    from petsc4py import PETSc

    values = []
    for name, choices in (("petsc_fs_partition", KINDS), ("petsc_fs_ordering", ORDERINGS)):
        value = str(PETSc.Options(prefix).getString(name, "auto"))
        if value not in choices:
            raise UsageError(f"-{prefix}{name} {value}: expected {' or '.join(choices)}")
        values.append(value)
    return values[0], values[1]


def partition(
    scene: Scene | None, comm: MPI.Intracomm, kind: str = "auto", ordering: str = "auto", prefix: str = ""
) -> Layout:
    """The layout of a scene. Collective on `comm`; rank 0 computes, the others receive.

    Args:
        scene: the whole scene; only rank 0 looks at it, so others may have None.
        comm: communicator.
        kind: one of `KINDS`.
        ordering: one of `ORDERINGS`.
        prefix: of the options of the graph partitioner, `-mat_partitioning_...` after it and `petsc_fs_`.

    Raises:
        UsageError: the scene or this PETSc lacks what the kind needs.
    """
    parts: Parts | None = None
    with together(comm):
        if comm.rank == 0:
            if scene is None:
                raise SceneError("partition: rank 0 has no scene")
            places = Places(scene.dimension, {f: n // scene.block_size(f) for f, n in scene.sizes.items()})
            if needs_places(places.cells, comm.size, kind, ordering):
                places = Places.of(scene)
            parts = parts_of(places, comm.size, kind, ordering, prefix)
            dimension = scene.dimension
    return layout_of(parts, comm, dimension if comm.rank == 0 else 0)


def layout_of(parts: Parts | None, comm: MPI.Intracomm, dimension: int) -> Layout:
    """The layout of what rank 0 has computed, on all ranks. Collective; other ranks may give None and 0."""
    owners, order, dimension = comm.bcast((parts.owners, parts.order, dimension) if parts is not None else None)
    return Layout.from_owners(comm, dimension, owners, order)


def parts_of(places: Places, ranks: int, kind: str = "auto", ordering: str = "auto", prefix: str = "") -> Parts:
    """Cut the cells of a scene into as many parts as there are ranks, and order those of each part. Local.

    Kinds:

    - rcb: recursive coordinate bisection of the rock cells, weighted by the unknowns they anchor;
    - ptscotch: their graph, all vertices alike, by PETSc's MatPartitioning (`-petsc_fs_mat_partitioning_type` takes
      another one); PTScotch draws random numbers, so that a second partition may differ;
    - contiguous: each field in the order of the scene, in chunks of equal length, nothing together;
    - auto: rcb where cell centres are known, else ptscotch where PETSc has it, else contiguous.

    Orderings:

    - natural: that of the scene;
    - morton: along a space-filling curve, see `morton`, so that neighbours stand near each other in memory. Grid
      generators number them almost at random, and then each entry of a matrix with few in a row, as in multigrid for
      single components, may wait for memory. With bisection and reverse Cuthill-McKee gains are the same;
    - auto: morton where cell centres are known and a rank has more than `CELLS_IN_CACHE` rock cells, else natural.

    Contiguous chunks are left as they are.

    Raises:
        UsageError: the scene or this PETSc lacks what kind or ordering needs.
    """
    primary = primary_field(places.cells)
    centers = places.centers.get(primary)
    if kind == "auto" and ranks > 1:
        if centers is not None:
            kind = "rcb"
        else:
            kind = "ptscotch" if has_partitioner("ptscotch") else "contiguous"
    if ordering == "morton" and centers is None:
        raise UsageError(f"-{prefix}petsc_fs_ordering morton: no cell_centers of {primary} in the scene; use natural")
    if ordering == "morton" and kind == "contiguous":
        raise UsageError(
            f"-{prefix}petsc_fs_ordering morton: -{prefix}petsc_fs_partition contiguous keeps the scene's; use rcb"
        )
    ordered = centers is not None and is_ordered(places.cells, ranks, ordering)
    if kind == "contiguous" or (ranks == 1 and not ordered):
        chunks = {f: np.arange(1, ranks + 1) * n // ranks for f, n in places.cells.items()}
        owners = {f: np.searchsorted(c, np.arange(places.cells[f]), side="right") for f, c in chunks.items()}
        return Parts(owners, {f: np.arange(n) for f, n in places.cells.items()})
    anchor = anchors(places)
    weights = np.zeros(places.cells[primary])
    for f, a in anchor.items():
        weights += np.bincount(a, minlength=weights.size) * FIELD[f].block_size(places.dimension)
    members = np.flatnonzero(anchor[primary] == np.arange(weights.size))
    part = np.zeros(weights.size, dtype=np.int64)
    if ranks > 1 and kind == "rcb":
        if centers is None:
            raise UsageError(
                f"-{prefix}petsc_fs_partition rcb: no cell_centers of {primary} in the scene; use ptscotch"
            )
        part[members] = bisect(centers[members], weights[members], ranks)
    elif ranks > 1:
        name, cells, part_of = _graph_parts(places, ranks, prefix)
        part[anchor[name][cells]] = part_of
    order = morton(places.centers[primary]) if ordered else np.arange(weights.size)
    return Parts({f: part[a] for f, a in anchor.items()}, {f: order[a] for f, a in anchor.items()})


def morton(points: Floats) -> Integers:
    """Places along the curve of Morton, "A computer oriented geodetic data base" (IBM, 1966), which fills space.

    Args:
        points: (n, 3).

    Returns:
        (n,) the bits of the three coordinates by turns, the highest first; points nearer to each other than 1e-6 of
        their extent may share a number.
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    extent = float(np.ptp(points, axis=0).max()) or 1.0
    steps = ((points - points.min(axis=0)) / extent * (2**MORTON_BITS - 1)).astype(np.int64)
    key = np.zeros(len(points), dtype=np.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            key |= ((steps[:, axis] >> bit) & 1) << (3 * bit + axis)
    return key


def bisect(points: Floats, weights: Floats, parts: int) -> Integers:
    """Recursive coordinate bisection: cut across the longest side, in proportion to the parts on either side.

    Berger, Bokhari, "A partitioning strategy for nonuniform problems on multiprocessors", IEEE Trans. Comput. C-36
    (1987). Points of equal coordinate are cut in their order.

    Args:
        points: (n, 3).
        weights: (n,) not negative.
        parts: any number from 1.

    Returns:
        (n,) part of each point, from 0; parts differ in weight by at most that of a few points.
    """
    part = np.zeros(len(points), dtype=np.int64)
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    grid = np.rint(points / (extent * SAME_PLACE)) if extent else np.zeros_like(points)
    todo = [(np.arange(len(points)), 0, parts)]
    while todo:
        members, first, count = todo.pop()
        if count == 1 or not members.size:
            part[members] = first
            continue
        axis = int(np.argmax(np.ptp(points[members], axis=0)))
        members = members[np.argsort(grid[members, axis], kind="stable")]
        total = np.cumsum(weights[members])
        left = count // 2
        cut = int(np.searchsorted(total - weights[members] / 2, total[-1] * left / count))
        todo += [(members[:cut], first, left), (members[cut:], first + left, count - left)]
    return part


def anchors(places: Places) -> Mapping[str, Integers]:
    """For each cell of each field the cell of the primary field that it goes with. Local."""
    return _Anchors(places).anchor


class _Anchors:
    """Cells find their anchors one field after the other, each through those that have one already."""

    def __init__(self, places: Places) -> None:
        self.places = places
        self.primary = primary_field(places.cells)
        self.anchor = {f: np.full(places.cells[f], -1, dtype=np.int64) for f in in_order(places.cells)}
        n = places.cells[self.primary]
        rock = _rock(places.dimension, places.cells, places.cell_dimension)
        fracture = None if rock is None else ~rock
        if places.cell_dimension is not None:
            fracture = places.cell_dimension == places.dimension - 1
        self.fracture = fracture
        if self.primary == "mass" and rock is not None:
            self.anchor["mass"][rock] = np.flatnonzero(rock)
        else:
            self.anchor[self.primary][:] = np.arange(n)
            if rock is not None:
                self._rock_pressure(np.flatnonzero(rock))
        self._walls()
        self._fractures()
        self._rest()

    def _rock_pressure(self, rock: Integers) -> None:
        """Pressure cells of the rock are the displacement cells, in the same order or at the same place."""
        mass, momentum = self.places.centers.get("mass"), self.places.centers.get("momentum")
        n = self.places.cells["momentum"] if self.primary == "momentum" else -1
        if mass is None or momentum is None:
            if rock.size == n:
                self.anchor["mass"][rock] = np.arange(n)
        elif self.primary == "momentum":
            self.anchor["mass"][rock] = match(mass[rock], momentum)

    def _walls(self) -> None:
        """Contact and the two walls of a fracture cell have one anchor."""
        to_rock = "momentum" if self.primary == "momentum" else "mass"
        self._attach("intf_force", to_rock)
        self._gather("contact", "intf_force")
        self._attach("contact", "intf_force")
        self._follow("intf_force", "contact")

    def _fractures(self) -> None:
        """So have pressure and fluxes of a fracture cell."""
        fracture = self.fracture
        if fracture is not None and "mass" in self.anchor:
            self._gather("mass", "intf_force", fracture)
            if "contact" not in self.anchor:
                self._follow("intf_force", "mass", fracture)
            if "intf_flow" in self.anchor:
                self._attach("intf_flow", "mass", ~fracture)
                self._gather("mass", "intf_flow", fracture)
                self._follow("intf_flow", "mass", fracture)
        self._attach("intf_flow", "mass")

    def _rest(self) -> None:
        """Whoever has no anchor yet: through any coupling, at the same place, or in proportion."""
        changed = True
        while changed:
            changed = False
            for r in self.anchor:
                for c in self.anchor:
                    changed |= r != c and self._attach(r, c)
        for f, anchor in self.anchor.items():
            free = np.flatnonzero(anchor < 0)
            if not free.size:
                continue
            own, others = self.places.centers.get(f), self.places.centers.get(self.primary)
            if own is not None and others is not None:
                at = match(own[free], others)
                anchor[free[at >= 0]] = self.anchor[self.primary][at[at >= 0]]
                free = np.flatnonzero(anchor < 0)
            roots = np.unique(self.anchor[self.primary][self.anchor[self.primary] >= 0])
            anchor[free] = roots[free * roots.size // anchor.size]

    def _coupling(self, r: str, c: str) -> Coupling | None:
        """Of either block."""
        if r not in self.anchor or c not in self.anchor:
            return None
        if (r, c) in self.places.couplings:
            return self.places.couplings[r, c]
        other = self.places.couplings.get((c, r))
        return other.transposed() if other is not None else None

    def _attach(self, r: str, c: str, allowed: Mask | None = None) -> bool:
        """Cells of r without anchor take that of the cell of c that acts most on them; whether any did."""
        coupling = self._coupling(r, c)
        if coupling is None:
            return False
        known = self.anchor[c] >= 0 if allowed is None else (self.anchor[c] >= 0) & allowed
        partner = coupling.strongest(self.anchor[r].size, known)
        take = (self.anchor[r] < 0) & (partner >= 0)
        self.anchor[r][take] = self.anchor[c][partner[take]]
        return bool(take.any())

    def _gather(self, c: str, r: str, only: Mask | None = None) -> None:
        """Cells of c without anchor take that of the first cell of r that has them for its partner."""
        coupling = self._coupling(r, c)
        if coupling is None:
            return
        allowed = np.ones(self.anchor[c].size, dtype=bool) if only is None else only
        partner = coupling.strongest(self.anchor[r].size, allowed)
        rows = np.flatnonzero((partner >= 0) & (self.anchor[r] >= 0))[::-1]
        first = np.full(self.anchor[c].size, -1, dtype=np.int64)
        first[partner[rows]] = self.anchor[r][rows]
        take = (self.anchor[c] < 0) & (first >= 0)
        self.anchor[c][take] = first[take]

    def _follow(self, r: str, c: str, only: Mask | None = None) -> None:
        """Cells of r take the anchor of their partner in c, whatever they had."""
        coupling = self._coupling(r, c)
        if coupling is None:
            return
        known = self.anchor[c] >= 0 if only is None else (self.anchor[c] >= 0) & only
        partner = coupling.strongest(self.anchor[r].size, known)
        self.anchor[r][partner >= 0] = self.anchor[c][partner[partner >= 0]]


def match(points: Floats, others: Floats) -> Integers:
    """For each point the number of the one at the same place among others, or -1."""
    if not len(points) or not len(others):
        return np.full(len(points), -1, dtype=np.int64)
    if points.shape == others.shape:
        extent = float(np.ptp(others, axis=0).max())
        if (np.abs(points - others) <= SAME_PLACE * extent).all():
            return np.arange(len(points))
    every = np.concatenate([others, points])
    extent = float(np.ptp(every, axis=0).max()) or 1.0
    _, place = np.unique(np.rint(every / (extent * SAME_PLACE * 10)), axis=0, return_inverse=True)
    place = place.ravel()
    at = np.full(place.max() + 1, -1, dtype=np.int64)
    at[place[: len(others)]] = np.arange(len(others))
    return np.asarray(at[place[len(others) :]])


def _rock(dimension: int, cells: Mapping[str, int], cell_dimension: Integers | None) -> Mask | None:
    """Which mass cells are rock; where it is not known, as many as momentum has, first. None without mass."""
    n = cells.get("mass", 0)
    if not n:
        return None
    if cell_dimension is not None and (cell_dimension == dimension).any():
        return np.asarray(cell_dimension == dimension)
    return np.asarray(np.arange(n) < (cells.get("momentum") or n))


def has_partitioner(kind: str) -> bool:
    """Whether this PETSc has a graph partitioner."""
    from petsc4py import PETSc

    partitioning = PETSc.MatPartitioning().create(PETSc.COMM_SELF)
    try:
        partitioning.setType(kind)
    except PETSc.Error:
        return False
    finally:
        partitioning.destroy()
    return True


def _graph_parts(places: Places, ranks: int, prefix: str) -> tuple[str, Integers, Integers]:
    """By PETSc's MatPartitioning on this rank alone: a field, its cells in the rock, and their parts."""
    from petsc4py import PETSc

    name = graph_block(places.dimension, places.cells, places.cell_dimension)
    if places.graph is None:
        raise UsageError(f"-{prefix}petsc_fs_partition ptscotch: the scene has no block ({name}, {name}); use rcb")
    rock = _rock(places.dimension, places.cells, places.cell_dimension)
    members = np.flatnonzero(rock) if name == "mass" and rock is not None else np.arange(places.cells[name])
    size = FIELD[name].block_size(places.dimension)
    coupling = Coupling.of(places.graph, size, size)
    number = np.full(places.cells[name], -1, dtype=np.int64)
    number[members] = np.arange(members.size)
    rows, columns = number[coupling.rows], number[coupling.columns]
    keep = (rows >= 0) & (columns >= 0) & (rows != columns)
    both = Coupling.added(
        np.concatenate([rows[keep], columns[keep]]),
        np.concatenate([columns[keep], rows[keep]]),
        np.zeros(2 * np.count_nonzero(keep)),
    )
    indptr = np.concatenate([[0], np.cumsum(np.bincount(both.rows, minlength=members.size))])
    csr = (indptr.astype(PETSc.IntType), both.columns.astype(PETSc.IntType), np.ones(both.columns.size))
    graph = PETSc.Mat().createAIJ((members.size, members.size), csr=csr, comm=PETSc.COMM_SELF)
    partitioning = PETSc.MatPartitioning().create(PETSc.COMM_SELF)
    partitioning.setOptionsPrefix(f"{prefix}petsc_fs_")
    own = PETSc.Options(f"{prefix}petsc_fs_mat_partitioning_")
    owners = PETSc.IS().createGeneral(np.zeros(0, dtype=PETSc.IntType), comm=PETSc.COMM_SELF)
    own["nparts"] = ranks
    try:
        partitioning.setAdjacency(graph)
        partitioning.setType("ptscotch")
        partitioning.setFromOptions()
        partitioning.apply(owners)
        return name, members, np.array(owners.getIndices(), dtype=np.int64)
    except PETSc.Error as e:
        raise UsageError(
            f"-{prefix}petsc_fs_partition ptscotch: this PETSc has no such partitioner ({e}); use rcb, contiguous, or "
            f"-{prefix}petsc_fs_mat_partitioning_type with one that it has"
        ) from e
    finally:
        own.delValue("nparts")
        partitioning.destroy()
        graph.destroy()
