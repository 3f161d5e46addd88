"""Reading a scene in parallel: each rank reads a share of every dataset, and rows go to the ranks that own them."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from petsc_fs.errors import LayoutError, SceneError, together
from petsc_fs.fields import FIELD
from petsc_fs.io import hdf5
from petsc_fs.layout import Cells, Layout, rows_of
from petsc_fs.partition import Coupling, Places, graph_block, layout_of, needed, needs_places, parts_of, primary_field
from petsc_fs.redistribution import Redistribution, Transfer, run, shares
from petsc_fs.scene import CSR, Material, Scene, increasing, renumber

if TYPE_CHECKING:
    import h5py
    from mpi4py import MPI

Context = AbstractContextManager[Any]
Pair = tuple[str, str]
INTEGERS = ("cell_dimension", "contact_state")


def read_distributed(
    path: str | os.PathLike[str],
    comm: MPI.Intracomm,
    kind: str = "auto",
    ordering: str = "auto",
    *,
    layout: Layout | None = None,
    index_type: DTypeLike = np.int64,
    prefix: str = "",
    find: Callable[[h5py.File], AbstractContextManager[h5py.Group]] = nullcontext,
) -> tuple[Scene, Layout]:
    """Read a scene so that each rank gets its rows, by a partition made on the way.

    Collective. Each rank opens the file for itself, reads one contiguous share of every dataset, whole HDF5 chunks, in
    pieces of `petsc_fs.redistribution.PIECE` bytes, and sends the rows to their owners. Nothing is read or
    decompressed twice. No rank holds the matrix: beside its own rows each has a few pieces, the row pointers of all
    blocks (8 bytes a row and block), and its share of what the partition looks at: the blocks of fractures, the cell
    centres and, for partitioners of graphs, the pattern of one block. These come together on rank 0.

    Args:
        path: of the file, the same one for all ranks.
        comm: communicator.
        kind: of partition, see `petsc_fs.partition.parts_of`.
        ordering: of the cells of a rank, see there too.
        layout: that the rows shall have; no partition is made then.
        index_type: of the column numbers; PETSc's spares it a copy.
        prefix: of the options of graph partitioners.
        find: the group of the file that holds the scene, as a context; default the file itself.

    Returns:
        the part of this rank, and the layout that it is numbered by.

    Raises:
        SceneError, LayoutError: as `petsc_fs.io.hdf5.read`, the same on all ranks.
        UsageError: the partition is impossible.
    """
    stack, target = ExitStack(), Path(path)
    try:
        with together(comm):
            file = stack.enter_context(hdf5.open_file(target))

        @contextmanager
        def explained() -> Iterator[h5py.Group]:
            with hdf5.explained(target), find(file) as group:
                yield group

        with together(comm), explained() as group:
            reader = _Reader(group, comm, np.dtype(index_type), explained)
        reader.agree()
        reader.read_indptr()
        chosen = reader.layout(kind, ordering, prefix) if layout is None else layout
        part = reader.part(chosen)
        with together(comm), explained():
            for problem in reader.disordered:
                raise LayoutError(problem)
            part.validate()
    finally:
        stack.close()
    return part, chosen


class _Reader:
    """The steps of `read_distributed`."""

    def __init__(
        self, file: h5py.Group, comm: MPI.Intracomm, index_type: np.dtype[Any], explained: Callable[[], Context]
    ) -> None:
        """Check what can be checked without reading an array. Local.

        Args:
            file: the scene.
            comm: communicator.
            index_type: of column numbers.
            explained: context that names the file in errors.
        """
        self.comm, self.index_type, self._explained = comm, index_type, explained
        found = hdf5.parts(file)
        found.check_order()
        self.dimension, self.sizes, self.arrays, self.blocks = found.dimension, found.sizes, found.arrays, found.blocks
        self.cells = {f: n // FIELD[f].block_size(self.dimension) for f, n in self.sizes.items()}
        self.metadata = hdf5.read_metadata(file)
        if max(self.sizes.values(), default=0) > np.iinfo(index_type).max:
            raise SceneError(f"a field has more unknowns than {index_type} can number: use a PETSc with 64-bit indices")
        self.material = dict(found.material)
        self.time_step = self.material.pop("time_step", 0.0)
        self._shares: dict[str, tuple[int, NDArray[Any]]] = {}
        self.indptr: dict[Pair, Cells] = {}
        self.disordered: list[str] = []

    def agree(self) -> None:
        """Make sure that all ranks see the same file. Collective."""
        own = (self.dimension, self.sizes, {rc: len(g["data"]) for rc, g in self.blocks.items()}, list(self.arrays))
        first = self.comm.bcast(own)
        with together(self.comm), self._explained():
            if own != first:
                raise SceneError(f"rank {self.comm.rank} sees another scene there than rank 0")

    def layout(self, kind: str, ordering: str, prefix: str) -> Layout:
        """Where cells go. Collective."""
        places = Places(self.dimension, self.cells)
        if needs_places(self.cells, self.comm.size, kind, ordering):
            places = self._places(kind)
        parts = None
        with together(self.comm):
            if self.comm.rank == 0:
                parts = parts_of(places, self.comm.size, kind, ordering, prefix)
        return layout_of(parts, self.comm, self.dimension)

    def _places(self, kind: str) -> Places:
        """What the partition looks at, on rank 0; elsewhere without content. Collective."""
        known = {f: self.arrays[f, "cell_centers"] for f in self.sizes if (f, "cell_centers") in self.arrays}
        known = {f: dataset for f, dataset in known.items() if self.cells[f]}
        has_dimension = ("mass", "cell_dimension") in self.arrays and self.cells["mass"] > 0
        pairs = [rc for rc in self.blocks if needed(*rc)]
        wanted = [*known.values()]
        wanted += [self.blocks[rc][name] for rc in pairs for name in ("indices", "data")]
        wanted += [self.arrays["mass", "cell_dimension"]] if has_dimension else []
        found = self._gathered(wanted)
        dimension = found.pop() if has_dimension else None
        centers = {f: found.pop(0) for f in known}
        with together(self.comm), self._explained():
            couplings = {rc: self._coupling(rc, found.pop(0), found.pop(0)) for rc in pairs}
        graph = None
        by_graph = kind == "ptscotch" or (kind == "auto" and primary_field(self.cells) not in centers)
        if by_graph and self.comm.size > 1:
            name = graph_block(self.dimension, self.cells, dimension) if self.comm.rank == 0 else ""
            name = self.comm.bcast(name)
            if (name, name) in self.blocks:
                (indices,) = self._gathered([self.blocks[name, name]["indices"]])
                with together(self.comm), self._explained():
                    graph = self._rank_0(name, name, indices, np.zeros(indices.size))
        return Places(self.dimension, self.cells, centers, dimension, couplings, graph)

    def _coupling(self, rc: Pair, indices: NDArray[Any], data: NDArray[Any]) -> Coupling:
        """Of a gathered block; empty on other ranks than 0. Local."""
        return Coupling.of(self._rank_0(*rc, indices, data), *(self._block_size(f) for f in rc))

    def _rank_0(self, r: str, c: str, indices: NDArray[Any], data: NDArray[Any]) -> CSR:
        """A gathered block; empty on other ranks than 0. Local."""
        self._check_columns((r, c), indices)
        return CSR(self.indptr[r, c] if self.comm.rank == 0 else np.zeros(1, dtype=np.int64), indices, data)

    def _block_size(self, name: str) -> int:
        return FIELD[name].block_size(self.dimension)

    def part(self, layout: Layout) -> Scene:
        """The rows of this rank. Collective."""
        by_cell, by_row = {}, {}
        for f in self.sizes:
            owners, own, bs = layout.owners(f), layout.own_cells(f), self._block_size(f)
            by_cell[f] = Redistribution(self.comm, np.arange(owners.size + 1), owners, own)
            by_row[f] = Redistribution(
                self.comm, np.arange(owners.size * bs + 1), np.repeat(owners, bs), rows_of(own, bs)
            )
        found: dict[str, dict[str, Any]] = {what: {} for what in (*hdf5.PER_ROW, *hdf5.PER_CELL)}
        material: dict[str, Any] = {}
        transfers = []
        for (f, what), dataset in self.arrays.items():
            number = dataset.dtype if what in INTEGERS else np.dtype(np.float64)
            transfers.append(self._transfer(by_row[f] if what in hdf5.PER_ROW else by_cell[f], dataset, number))
            found[what][f] = transfers[-1].out
        for name, value in self.material.items():
            material[name] = value
            if not isinstance(value, float):
                transfers.append(self._transfer(by_cell["mass"], value, np.dtype(np.float64)))
                material[name] = transfers[-1].out
        blocks: dict[Pair, CSR] = {}
        run(self.comm, itertools.chain(transfers, self._block_transfers(layout, blocks)), self._explained)
        for (r, c), block in blocks.items():
            if not increasing(block):
                self.disordered.append(f"block ({r}, {c}): columns of a row must increase, without duplicates")
            if c in layout.cells:
                renumber(block, layout.places(c), self._block_size(c), out=block)
        return Scene(
            dimension=self.dimension,
            sizes=self.sizes,
            blocks=blocks,
            rhs=found["rhs"],
            reference=found["reference"],
            cell_centers=found["cell_centers"],
            cell_volumes=found["cell_volumes"],
            cell_dimension=found["cell_dimension"].get("mass"),
            contact_state=found["contact_state"].get("contact"),
            material=Material(**material, time_step=self.time_step) if material else None,
            metadata=self.metadata,
            rows={f: layout.rows(f) for f in self.sizes},
            cells={f: layout.own_cells(f) for f in self.sizes if f in layout.cells},
        )

    def _block_transfers(self, layout: Layout, blocks: dict[Pair, CSR]) -> Iterator[Transfer]:
        """The indices and entries of all blocks, whose arrays are put into `blocks`. Local."""
        for (r, c), group in self.blocks.items():
            owners = np.repeat(layout.owners(r), self._block_size(r))
            rows = Redistribution(self.comm, self.indptr.pop((r, c)), owners, layout.own_rows(r))
            check = partial(self._check_columns, (r, c))
            indices = self._transfer(rows, group["indices"], self.index_type, check)
            data = self._transfer(rows, group["data"], np.dtype(np.float64))
            blocks[r, c] = CSR(rows.indptr, indices.out, data.out)
            yield indices
            yield data

    def _check_columns(self, rc: Pair, columns: NDArray[Any]) -> None:
        if columns.size and not (0 <= columns.min() and columns.max() < self.sizes[rc[1]]):
            raise LayoutError(f"block ({rc[0]}, {rc[1]}): a column number is outside 0:{self.sizes[rc[1]]}")

    def read_indptr(self) -> None:
        """The row pointers of all blocks, on all ranks. Collective."""
        shared = self._own_shares([group["indptr"] for group in self.blocks.values()])
        everything = self.comm.allgather([values for _, values in shared])
        for (rc, group), parts in zip(self.blocks.items(), zip(*everything, strict=True), strict=True):
            what, values = f"block ({rc[0]}, {rc[1]})", group["data"].size
            indptr = self.indptr[rc] = np.concatenate(parts).astype(np.int64)
            with self._explained():  # the same on all ranks
                if indptr[0] != 0:
                    raise LayoutError(f"{what}: indptr starts at {indptr[0]}, expected 0")
                if (np.diff(indptr) < 0).any():
                    raise LayoutError(f"{what}: indptr must start at 0 and not decrease")
                if indptr.max() > values:
                    raise LayoutError(f"{what}: indptr runs to {indptr.max()}, but there are {values} values")
                if indptr[-1] != values:
                    raise LayoutError(f"{what}: indptr ends at {indptr[-1]}, but there are {values} values")

    def _gathered(self, datasets: Sequence[h5py.Dataset]) -> list[NDArray[Any]]:
        """Datasets on rank 0, elsewhere nothing of them; shares are kept for the redistribution. Collective."""
        own = self._own_shares(datasets)
        self._shares.update({dataset.name: share for dataset, share in zip(datasets, own, strict=True)})
        everything = self.comm.gather([values for _, values in own])
        if everything is None:
            return [values[:0] for _, values in own]
        return [np.concatenate(parts) for parts in zip(*everything, strict=True)]

    def _own_shares(self, datasets: Sequence[h5py.Dataset]) -> list[tuple[int, NDArray[Any]]]:
        """First entry of this rank's share of each dataset, and the share. Collective."""
        found = []
        with together(self.comm), self._explained():
            for dataset in datasets:
                a, b = shares(len(dataset), _chunk(dataset), self.comm.size)[self.comm.rank :][:2]
                found.append((int(a), dataset[a:b]))
        return found

    def _transfer(
        self,
        rows: Redistribution,
        dataset: h5py.Dataset,
        number: np.dtype[Any],
        check: Callable[[NDArray[Any]], None] | None = None,
    ) -> Transfer:
        """How a dataset gets to its owners. Local."""
        first, share = self._shares.pop(dataset.name, (0, None))

        def read(a: int, b: int) -> NDArray[Any]:
            values = dataset[a:b] if share is None else share[a - first : b - first]
            if check is not None:
                check(values)
            return np.asarray(values) if number.kind in "iu" else hdf5.real_numbers(values)

        out = np.empty((int(rows.indptr[-1]), *dataset.shape[1:]), dtype=number)
        return Transfer(rows, read, out, _chunk(dataset))


def _chunk(dataset: h5py.Dataset) -> int:
    """Number of rows of a dataset that lie in one chunk."""
    return dataset.chunks[0] if dataset.chunks else 1
