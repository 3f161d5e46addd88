"""What PETSc says when it fails or stops, in the terms of this package."""

from __future__ import annotations

import errno
import os
import re

import numpy as np
from mpi4py import MPI
from petsc4py import PETSc

from petsc_fs.errors import PetscFsError, SolveError, UsageError

REFUSALS = (62, 63, 86)
"""PETSc's codes for a wrong argument, one out of range and an unknown type: what bad options give."""


LAUNCHERS = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE")
"""Where the mpiexec of MPICH and its kin, and that of Open MPI, say how many ranks they have started."""


def check_build() -> None:
    """Refuse a PETSc, or a start, that this package cannot work with. Local, the same on all ranks.

    Raises:
        UsageError: PETSc's numbers are complex, or ranks do not see each other.
    """
    if np.issubdtype(PETSc.ScalarType, np.complexfloating):
        raise UsageError(
            "this PETSc is built for complex numbers, and petsc_fs needs one for real numbers (on Debian "
            "python3-petsc4py-real; elsewhere PETSC_DIR and PETSC_ARCH choose one)"
        )
    for name in LAUNCHERS:
        started = os.environ.get(name, "")
        if MPI.COMM_WORLD.size == 1 and started.isdecimal() and int(started) > 1:
            vendor, version = MPI.get_vendor()
            raise UsageError(
                f"mpiexec has started {started} ranks ({name}), each of which is alone: it is not the mpiexec of "
                f"mpi4py's MPI, {vendor} {'.'.join(map(str, version))}"
            )


def translate(error: Exception, what: str) -> PetscFsError | KeyboardInterrupt | BrokenPipeError:
    """The error of this package that stands for one of PETSc's; an interrupt and a closed output stand for themselves.

    An exception in a Python PC comes through PETSc as it is, or, in newer petsc4py, as the cause of its error.
    """
    if os.strerror(errno.EPIPE) in str(error):  # which newer PETSc notices itself
        return BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, PetscFsError | KeyboardInterrupt):
            return cause
        if isinstance(cause, ImportError) or (isinstance(cause, PETSc.Error) and cause.ierr in REFUSALS):
            return UsageError(f"PETSc refuses an option: {brief(cause)}")
        if not isinstance(cause, PETSc.Error):
            kind = "out of memory" if isinstance(cause, MemoryError) else type(cause).__name__
            return SolveError(f"{what}: {kind}: {' '.join(str(cause).split())}")
        cause = cause.__cause__ or cause.__context__
    return SolveError(f"{what}: {brief(error)}")


def brief(error: Exception) -> str:
    """One line of an error; of one of PETSc's, its code's text and the innermost message."""
    if not isinstance(error, PETSc.Error):
        return str(error)
    lines = [re.sub(r"^\[\d+\]\s*", "", line).strip() for line in str(error).splitlines()]
    messages = [line for line in lines if line and not re.match(r"\w+\(\) (line|at)", line)]
    text = "; ".join(messages) or f"error code {error.ierr}"
    if "hypre" in text and not PETSc.Sys.hasExternalPackage("hypre"):
        text += "; this PETSc has no hypre: take a file that ends in _gamg.opts, or none"
    return text


def reason_name(ksp: PETSc.KSP) -> str:
    """Name of the reason why a KSP stopped, for example CONVERGED_RTOL."""
    number = ksp.getConvergedReason()
    names = {v: k for k, v in vars(PETSc.KSP.ConvergedReason).items() if isinstance(v, int)}
    return str(names.get(number, number))
