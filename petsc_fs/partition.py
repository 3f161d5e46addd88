"""Partition: which rank holds which cells of each field, in which order, and the numbering that follows from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from petsc_fs.errors import LayoutError, UsageError, together
from petsc_fs.fields import FIELD, in_order

if TYPE_CHECKING:
    from mpi4py import MPI

    from petsc_fs.scene import Scene

Cells = NDArray[np.int64]
Floats = NDArray[np.float64]

KINDS = ("auto", "rcb", "ptscotch", "contiguous")
"""Values of -petsc_fs_partition."""

ORDERINGS = ("auto", "natural", "morton")
"""Values of -petsc_fs_ordering."""

CELLS_IN_CACHE = 20_000
"""Cells of a rank from which on their order matters: below, the vectors of a solve stay in the caches."""

MORTON_BITS = 20
"""Per coordinate: three of them make up a number of 64 bits."""

SAME_PLACE = 1e-8
"""Points that differ by less than this, relative to the extent of the scene, are at one place."""


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

    def __repr__(self) -> str:
        sizes = ", ".join(f"{f} {self.sizes(f)[1]:,}" for f in self.fields)
        ranks = self.comm.size
        return f"<Layout, {self.dimension}D, on {ranks} rank{'s' if ranks > 1 else ''}: {sizes}>"

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


def chosen(prefix: str = "") -> tuple[str, str]:
    """Kind of partition and ordering that the options say. Local.

    Options:
        -petsc_fs_partition <auto> (auto, rcb, ptscotch, contiguous): which rank gets which cells:
            by bisection of their centres, by their graph, or in the order of the scene; auto is rcb where centres are
            known, else contiguous.
        -petsc_fs_mat_partitioning_*: of PETSc's MatPartitioning, where the kind is ptscotch.
        -petsc_fs_ordering <auto> (auto, natural, morton): order of the cells of a rank: that of the scene, or along a
            space-filling curve; auto is morton on ranks with many cells. Solutions come back in that of the scene.

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
    """Cut the cells of a scene into as many parts as there are ranks, and order those of each part.

    Collective on `comm`; rank 0 computes. Kinds:

    - rcb: recursive coordinate bisection of all cells of all fields as one cloud of points, weighted by their unknowns
      and cut between places only, so that all fields of one place are together: products with blocks of contact then
      need no communication, and S^1 and S^3 next to none;
    - ptscotch: the graph of couplings between all cells, by PETSc's MatPartitioning on rank 0
      (`-petsc_fs_mat_partitioning_type` takes another one);
    - contiguous: each field in the order of the scene, in chunks of equal length;
    - auto: rcb where all cell centres are known, else contiguous.

    Orderings: natural, that of the scene; morton, along a space-filling curve, so that neighbours stand near each other
    in memory (grid generators number cells almost at random); auto, morton where cell centres are known and a rank has
    more than `CELLS_IN_CACHE` cells. Contiguous chunks are left as they are.

    Args:
        scene: on each rank the whole scene, or the rows that it holds; or the whole scene on rank 0, None elsewhere.
        comm: communicator.
        kind: one of `KINDS`.
        ordering: one of `ORDERINGS`.
        prefix: of the options, `-PREFIXpetsc_fs_...`.

    Raises:
        UsageError: the scene or this PETSc lacks what kind or ordering needs.
    """
    dimension, sizes = comm.bcast((scene.dimension, scene.sizes) if scene is not None else None)
    cells = {f: sizes[f] // FIELD[f].block_size(dimension) for f in in_order(sizes)}
    many = sum(cells.values()) > CELLS_IN_CACHE * comm.size
    wants_order = ordering == "morton" or (ordering == "auto" and many)
    if kind == "contiguous" or (comm.size == 1 and not wants_order):
        if kind == "contiguous" and ordering == "morton":
            raise UsageError(f"-{prefix}petsc_fs_ordering morton: contiguous chunks keep the scene's order; use rcb")
        return Layout.contiguous(comm, dimension, sizes)
    centers = _centers(scene, comm, cells)
    edges = comm.gather(couplings(scene, cells)) if kind == "ptscotch" and comm.size > 1 else None
    owners: dict[str, Cells] | None = None
    keys: dict[str, Cells] = {}
    with together(comm):
        if comm.rank == 0 and scene is not None:
            if not centers and (kind == "rcb" or ordering == "morton"):
                option = f"partition {kind}" if kind == "rcb" else "ordering morton"
                raise UsageError(
                    f"-{prefix}petsc_fs_{option}: not all cell_centers of the scene are known; use "
                    f"-{prefix}petsc_fs_partition {'ptscotch' if kind == 'rcb' else kind}, -{prefix}petsc_fs_ordering "
                    "natural, or give them"
                )
            ends = np.cumsum([*cells.values()])[:-1]
            part: Cells | None = None
            if edges is not None:
                part = graph_parts(np.concatenate(edges), sum(cells.values()), comm.size, prefix)
            elif centers:
                weights = [np.full(n, float(FIELD[f].block_size(dimension))) for f, n in cells.items()]
                part = bisect(np.concatenate([*centers.values()]), np.concatenate(weights), comm.size)
            if centers and wants_order:
                order = np.split(morton(np.concatenate([*centers.values()])), ends)
                keys = dict(zip(cells, order, strict=True))
            if part is not None:
                owners = dict(zip(cells, np.split(part, ends), strict=True))
    owners, keys = comm.bcast((owners, keys))
    if owners is None:
        return Layout.contiguous(comm, dimension, sizes)
    return Layout.from_owners(comm, dimension, owners, keys)


def _centers(scene: Scene | None, comm: MPI.Intracomm, cells: Mapping[str, int]) -> dict[str, Floats]:
    """Centres of all cells on rank 0, from the rows that ranks hold; empty elsewhere, and where any are missing."""
    part = scene is not None and scene.rows is not None
    known = scene.cell_centers if scene is not None else {}
    pieces = comm.gather(known if part else None)
    if pieces is None:
        return {}
    if part:
        known = {f: np.concatenate([p[f] for p in pieces]) for f in cells if all(p and f in p for p in pieces)}
    return {f: known[f] for f in cells} if all(f in known and len(known[f]) == n for f, n in cells.items()) else {}


def bisect(points: Floats, weights: Floats, parts: int) -> Cells:
    """Recursive coordinate bisection: cut across the longest side, in proportion to the parts on either side.

    Berger, Bokhari, "A partitioning strategy for nonuniform problems on multiprocessors", IEEE Trans. Comput. C-36
    (1987). Points at one place stay together.

    Args:
        points: (n, 3).
        weights: (n,) not negative.
        parts: any number from 1.

    Returns:
        (n,) part of each point, from 0; parts differ in weight by at most that of a few places.
    """
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    grid = np.rint(points / (extent * SAME_PLACE)) if extent else np.zeros_like(points)
    places, inverse = np.unique(grid, axis=0, return_inverse=True)
    inverse = inverse.ravel()
    if len(places) < parts:  # whatever their places, no part is to be empty while there are cells
        places, inverse = grid, np.arange(len(points))
    weight = np.bincount(inverse, weights=weights, minlength=len(places))
    part = np.zeros(len(places), dtype=np.int64)
    todo: list[tuple[Cells, int, int]] = [(np.arange(len(places)), 0, parts)]
    while todo:
        members, first, count = todo.pop()
        if count == 1 or not members.size:
            part[members] = first
            continue
        axis = int(np.argmax(np.ptp(places[members], axis=0)))
        members = members[np.argsort(places[members, axis], kind="stable")]
        total = np.cumsum(weight[members])
        left = count // 2
        cut = int(np.searchsorted(total - weight[members] / 2, total[-1] * left / count))
        todo += [(members[:cut], first, left), (members[cut:], first + left, count - left)]
    return part[inverse]


def morton(points: Floats) -> Cells:
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


def couplings(scene: Scene | None, cells: Mapping[str, int]) -> Cells:
    """Pairs of cells that the rows held here couple, both ways; cell i of all and j as the number i n + j. Local."""
    pairs = [np.zeros(0, dtype=np.int64)]
    if scene is None:
        return pairs[0]
    first = dict(zip(cells, np.cumsum([0, *cells.values()])[:-1], strict=True))
    n = sum(cells.values())
    for (r, c), block in scene.blocks.items():
        start, stop = scene.row_range(r)
        rows = first[r] + np.repeat(np.arange(start, stop), np.diff(block.indptr)) // scene.block_size(r)
        columns = first[c] + block.indices.astype(np.int64) // scene.block_size(c)
        pairs.append(np.unique(np.concatenate([rows * n + columns, columns * n + rows])))
    return np.unique(np.concatenate(pairs))


def graph_parts(pairs: Cells, n: int, parts: int, prefix: str = "") -> Cells:
    """Parts of n cells by the graph of their couplings, see `couplings`. Local.

    Raises:
        UsageError: this PETSc has no such partitioner.
    """
    from petsc4py import PETSc

    edges = np.unique(pairs)
    rows, columns = np.divmod(edges[edges // n != edges % n], n)
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=n))])
    csr = (indptr.astype(PETSc.IntType), columns.astype(PETSc.IntType), np.ones(columns.size))
    graph = PETSc.Mat().createAIJ((n, n), csr=csr, comm=PETSc.COMM_SELF)
    partitioning = PETSc.MatPartitioning().create(PETSc.COMM_SELF)
    partitioning.setOptionsPrefix(f"{prefix}petsc_fs_")
    own = PETSc.Options(f"{prefix}petsc_fs_mat_partitioning_")
    found = PETSc.IS().createGeneral(np.zeros(0, dtype=PETSc.IntType), comm=PETSc.COMM_SELF)
    own["nparts"] = parts
    try:
        partitioning.setAdjacency(graph)
        partitioning.setType("ptscotch")
        partitioning.setFromOptions()
        partitioning.apply(found)
        return np.array(found.getIndices(), dtype=np.int64)
    except PETSc.Error as e:
        raise UsageError(
            f"-{prefix}petsc_fs_partition ptscotch: this PETSc has no such partitioner ({e}); use contiguous, or "
            f"-{prefix}petsc_fs_mat_partitioning_type with one that it has"
        ) from e
    finally:
        own.delValue("nparts")
        partitioning.destroy()
        graph.destroy()
