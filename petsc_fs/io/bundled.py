"""What each command asks for first: scenes by name, targets that may be written, and versions of what takes part."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable
from pathlib import Path

from petsc_fs.errors import SceneError, UsageError

HOME = Path(__file__).parent.parent


def bundled() -> dict[str, list[Path]]:
    """Files of the scenes and sequences that come with the package, by kind."""
    return {kind: sorted((HOME / kind).glob("*.h5")) for kind in ("scenes", "sequences")}


def find_scene(name: str) -> Path:
    """Path of a scene or sequence: as given, or else one that is bundled under this name.

    Raises:
        SceneError: there is neither, or what is there is a pipe or device.
    """
    path, there = Path(name), bundled()
    if path.exists():
        if not (path.is_file() or path.is_dir()):
            raise SceneError(f"{path}: a pipe or device, not a scene; copy it into a file first")
        return path
    for file in (*there["scenes"], *there["sequences"]):
        if path == Path(file.name):
            return file
    names = ", and ".join(f"bundled {kind} are {', '.join(f.name for f in files)}" for kind, files in there.items())
    raise SceneError(f"{path}: no such file; {names}")


def check_targets(*targets: Path | None, sources: Iterable[Path] = ()) -> None:
    """Complain about files that cannot be written, or that something would be lost by; nothing is written.

    Args:
        targets: files to write; None for those that are not asked for.
        sources: files that are read, and must stay.

    Raises:
        UsageError: a folder is missing or not to be written to, something else than a file is in the way, or it is a
            source, or two are the same.
    """
    taken = {source.resolve(): "is what is read, and would be lost" for source in sources}
    for target in targets:
        if target is None:
            continue
        folder = target.absolute().parent
        if not folder.is_dir():
            raise UsageError(f"{target}: the folder {folder} does not exist")
        if not os.access(folder, os.W_OK):
            raise UsageError(f"{target}: cannot be written: no permission to write into {folder}")
        of_the_system = folder.resolve() == Path("/dev") or folder.resolve().parts[1:2] == ("proc",)
        if of_the_system or (target.exists() and not target.is_file()):
            raise UsageError(
                f"{target}: cannot be written: it is a {'folder' if target.is_dir() else 'pipe or device'}"
            )
        if target.resolve() in taken:
            raise UsageError(f"{target}: cannot be written: it {taken[target.resolve()]}")
        taken[target.resolve()] = "is asked for twice"


def versions() -> dict[str, str]:
    """Version of everything that takes part in a solve."""
    import mpi4py
    import numpy as np
    from petsc4py import PETSc

    from petsc_fs.io import hdf5

    return {
        **hdf5.versions(),
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "mpi4py": mpi4py.__version__,
    }
