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
    if os.path.exists(path):  # False where a folder may not be looked into, or the name is too long
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
    taken = {source.resolve(): "it is what is read, and would be lost" for source in sources}
    for target in targets:
        if target is None:
            continue
        folder = target.absolute().parent
        if not os.path.isdir(folder):
            raise UsageError(f"{target}: the folder {folder} does not exist")
        why = taken.get(target.resolve(), "")
        if not os.access(folder, os.W_OK):
            why = f"there is no permission to write into {folder}"
        elif os.path.isdir(target):
            why = "it is a folder"
        elif (os.path.exists(target) and not os.path.isfile(target)) or _of_the_system(folder):
            why = "it is a pipe or device"
        elif len(os.fsencode(target.name)) > os.pathconf(folder, "PC_NAME_MAX"):
            why = "it has too long a name"
        if why:
            raise UsageError(f"{target}: cannot be written: {why}")
        taken[target.resolve()] = "it is asked for twice"


def _of_the_system(folder: Path) -> bool:
    """Whether what is in a folder are devices or open files, under the names of files."""
    return folder.resolve() == Path("/dev") or folder.resolve().parts[1:2] == ("proc",)


def versions() -> dict[str, str]:
    """Version of everything that takes part in a solve; whether PETSc has hypre."""
    import mpi4py
    import numpy as np
    import petsc4py
    from mpi4py import MPI
    from petsc4py import PETSc

    from petsc_fs.io import hdf5

    return {
        **hdf5.versions(),
        "petsc": ".".join(map(str, PETSc.Sys.getVersion())),
        "petsc4py": petsc4py.__version__,
        "hypre": "yes" if PETSc.Sys.hasExternalPackage("hypre") else "no",
        "mpi": " ".join(MPI.Get_library_version().strip("\0").split(",")[0].splitlines()[0].split()),
        "mpi4py": mpi4py.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
    }
