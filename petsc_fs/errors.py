"""Errors a user can meet, each with the exit code of the command line, and how ranks fail together."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpi4py import MPI


class PetscFsError(Exception):
    """Base of all errors this package raises on purpose; `exit_code` is what the command line returns."""

    exit_code = 1


class SolveError(PetscFsError):
    """A solve that ended without the answer: reason, iterations and residual are in the message."""

    exit_code = 1


class UsageError(PetscFsError):
    """A wrong call: an argument, an options file or a PETSc option that cannot be used."""

    exit_code = 2


class SceneError(PetscFsError):
    """A scene that cannot be read, or whose parts do not fit together.

    Attributes:
        cell: field and number of the cell that the message names, where that is not the scene's number yet.
    """

    exit_code = 3
    cell: tuple[str, int] | None = None


class LayoutError(SceneError):
    """A field whose length, block size or index set does not fit the others."""


class together:
    """Run a block without communication so that an error on one rank is raised on all.

    Collective on `comm`, as `with together(comm):`. The block itself must not communicate. If any rank raises, every
    rank raises the error of the lowest such rank (its own error stays attached as the cause). What is no `Exception`,
    an interrupt for example, passes without the others.

    A class and no generator: from Python 3.12 on, the frame of a generator and the error thrown into it hold each
    other, and with them the caller's PETSc objects, beyond PetscFinalize on some ranks.
    """

    def __init__(self, comm: MPI.Intracomm) -> None:
        self.comm = comm

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        if error is not None and not isinstance(error, Exception):
            return
        first = next((e for e in self.comm.allgather(error and portable(error)) if e is not None), None)
        try:
            if first is not None:
                raise first from error
        finally:  # or this frame and the errors hold each other
            del first, error, trace


def portable(error: BaseException) -> Exception:
    """An error that pickles: ours as they are, any other one by its text."""
    if isinstance(error, PetscFsError | MemoryError):
        return error
    return RuntimeError(f"{type(error).__name__}: {error}")
