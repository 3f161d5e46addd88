"""Nested fieldsplit preconditioners for contact poromechanics, the PETSc way.

Importing this package neither initialises PETSc nor imports a simulator; what it offers is imported when asked for:

- `Scene`: one linear system in fields, and `hdf5` and `sequence` to keep one or many in a file;
- `Solver`: solves scenes by PETSc options, which `options` finds;
- `petsc_fs.pc`: the Python PCs that options files name;
- `petsc_fs.porepy`: scenes from PorePy models.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from petsc_fs import options
    from petsc_fs.io import hdf5, sequence
    from petsc_fs.scene import Scene
    from petsc_fs.solver import Solver

__all__ = ["Scene", "Solver", "__version__", "hdf5", "options", "sequence"]
__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name in ("Scene", "Solver"):
        return getattr(import_module(f"petsc_fs.{name.lower()}"), name)
    if name in ("hdf5", "sequence"):
        return import_module(f"petsc_fs.io.{name}")
    if name == "options":
        return import_module("petsc_fs.options")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
