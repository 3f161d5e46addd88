"""Nested fieldsplit preconditioners for contact poromechanics, the PETSc way.

Importing this package neither initialises PETSc nor imports a simulator; what it offers is imported when asked for:

- `Scene`: one linear system in fields, and `hdf5` and `sequence` to keep one or many in a file;
- `Solver`: solves scenes by PETSc options, which `options` finds;
- `petsc_fs.pc`: the Python PCs that options files name;
- `petsc_fs.porepy`: scenes from PorePy models.
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from petsc_fs import options
    from petsc_fs.io import hdf5, sequence
    from petsc_fs.scene import Scene
    from petsc_fs.solver import Solver

__all__ = ["Scene", "Solver", "__version__", "hdf5", "options", "sequence"]
__version__ = "0.2.0"


def __getattr__(name: str) -> Any:
    if name in ("Scene", "Solver"):
        try:
            return getattr(import_module(f"petsc_fs.{name.lower()}"), name)
        except ModuleNotFoundError as e:
            if e.name not in ("petsc4py", "mpi4py"):
                raise
            raise ImportError(missing(e)) from e
    if name in ("hdf5", "sequence"):
        return import_module(f"petsc_fs.io.{name}")
    if name == "options":
        return import_module("petsc_fs.options")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def missing(error: Exception) -> str:
    """What to do where petsc4py or mpi4py cannot be imported, in a line.

    They are no dependencies: they must be those of the machine's PETSc and MPI, and pip would compile PETSc.
    """
    there = sorted(Path("/usr/lib/petscdir").glob("petsc*/*-real/lib/python3/dist-packages"))  # outside Python's path
    debian = f"export PYTHONPATH={there[-1]}" if there else "apt-get install python3-petsc4py-real python3-mpi4py"
    return (
        f"{' '.join(str(error).split())}: petsc4py and mpi4py come with the PETSc and MPI of the machine: on Debian "
        f"{debian}; with conda, conda install -c conda-forge petsc4py mpi4py; else pip install 'petsc_fs[petsc]', "
        "which compiles PETSc"
    )
