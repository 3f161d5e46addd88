"""Reading a scene in parallel: each rank reads a share of every dataset."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from petsc_fs.errors import together
from petsc_fs.io import hdf5
from petsc_fs.partition import Layout, partition
from petsc_fs.scene import Scene

if TYPE_CHECKING:
    from mpi4py import MPI


def read_distributed(
    path: str | os.PathLike[str],
    comm: MPI.Intracomm,
    kind: str = "auto",
    ordering: str = "auto",
    *,
    layout: Layout | None = None,
    prefix: str = "",
    find: Callable[[Any], AbstractContextManager[Any]] = nullcontext,
) -> tuple[Scene, Layout]:
    """Read a scene so that each rank has an even share of its rows, and a partition of it.

    Collective. Each rank opens the file for itself and reads contiguous rows of every dataset. `petsc_fs.system.System`
    brings them to the ranks that the layout says.

    Args:
        path: of the file, the same one for all ranks.
        comm: communicator.
        kind: of partition, see `petsc_fs.partition.partition`.
        ordering: of the cells of a rank, see there too.
        layout: no partition is made, and this one returned.
        prefix: of the options of graph partitioners.
        find: the group of the file that holds the scene, as a context; default the file itself.

    Returns:
        the rows of this rank in the scene's numbering, and the layout.

    Raises:
        SceneError, LayoutError: as `petsc_fs.io.hdf5.read`, the same on all ranks.
        UsageError: the partition is impossible.
    """

    def share(dimension: int, sizes: dict[str, int]) -> dict[str, tuple[int, int]]:
        even = Layout.contiguous(comm, dimension, sizes)
        return {f: even.rows(f) for f in sizes}

    with together(comm):
        with hdf5.open_file(Path(path)) as file, find(file) as group:
            scene = hdf5.read_group(group, share if comm.size > 1 else None)
    return scene, layout or partition(scene, comm, kind, ordering, prefix)
