"""Iterations of the bundled scenes by the default solver, as a row of docs/builds.md; on any number of ranks.

Exits with 1 where a scene does not converge.
"""

import platform
import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI  # first, for wheels in which it is what finds libmpi
from petsc4py import PETSc

import petsc_fs

SCENES = sorted((Path(petsc_fs.__path__[0]) / "scenes").glob("*.h5"))


def main() -> int:
    """Collective."""
    results = [petsc_fs.Solver(petsc_fs.hdf5.read(path)).solve() for path in SCENES]
    scalar, integer = np.dtype(PETSc.ScalarType), np.dtype(PETSc.IntType)
    hypre = "" if PETSc.Sys.hasExternalPackage("hypre") else ", no hypre"
    vendor, version = MPI.get_vendor()
    build = [
        f"{'.'.join(map(str, PETSc.Sys.getVersion()))} ({scalar}, {integer}{hypre})",
        f"{vendor} {'.'.join(map(str, version))}, Python {platform.python_version()}, numpy {np.__version__}",
        MPI.COMM_WORLD.size,
    ]
    if MPI.COMM_WORLD.rank == 0:
        print("|", " | ".join(map(str, [*build, *(r.iterations for r in results)])), "|", flush=True)
    return 0 if all(r.converged for r in results) else 1


if __name__ == "__main__":
    sys.exit(main())
