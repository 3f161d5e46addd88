"""Errors a user can meet, each with the exit code of the command line, and how ranks fail together."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
    """A scene that cannot be read, or whose parts do not fit together."""

    exit_code = 3


class LayoutError(SceneError):
    """A field whose length, block size or index set does not fit the others."""


@contextmanager
def together(comm: MPI.Intracomm) -> Iterator[None]:
    """Run a block without communication so that an error on one rank is raised on all.

    Collective on `comm`. The block itself must not communicate. If any rank raises, every rank
    raises the error of the lowest such rank (its own error stays attached as the cause).
    """
    error: Exception | None = None
    try:
        yield
    except Exception as e:
        error = e
    first = next((e for e in comm.allgather(error and portable(error)) if e is not None), None)
    try:
        if first is not None:
            raise first from error
    finally:  # or error and frames hold each other, and with them PETSc's objects, beyond PetscFinalize on some ranks
        del first, error


def portable(error: BaseException) -> Exception:
    """An error that pickles: ours as they are, any other one by its text."""
    if isinstance(error, PetscFsError | MemoryError):
        return error
    return RuntimeError(f"{type(error).__name__}: {error}")
