"""Errors that all ranks raise together, and what they leave in memory."""

import gc
import weakref

import pytest
from mpi4py import MPI

from petsc_fs.errors import SceneError, UsageError, portable, together

comm = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi


class Thing:
    """What a frame holds."""


def fail(error: BaseException | None) -> weakref.ref[Thing]:
    thing = Thing()
    with together(comm):
        if error is not None:
            raise error
    return weakref.ref(thing)


def test_nothing_happens_where_no_rank_fails():
    assert fail(None)() is None


@pytest.mark.parametrize("failing", ["first", "last", "all"])
def test_the_error_of_the_lowest_rank_is_raised_on_all(failing):
    mine = failing == "all" or comm.rank == (0 if failing == "first" else comm.size - 1)
    lowest = comm.size - 1 if failing == "last" else 0
    error = SceneError(f"rank {comm.rank}") if mine else None
    with pytest.raises(SceneError, match=f"rank {lowest}$") as raised:
        fail(error)
    assert raised.value.__cause__ is error


def test_other_errors_are_told_by_their_text():
    with pytest.raises(RuntimeError, match="ValueError: why"):
        fail(ValueError("why") if comm.rank == comm.size - 1 else None)
    for error in (UsageError("x"), MemoryError()):
        assert portable(error) is error


def test_an_interrupt_does_not_wait_for_the_others():
    if comm.rank == 0:
        with pytest.raises(KeyboardInterrupt), together(comm):
            raise KeyboardInterrupt


def test_an_error_keeps_no_frame_alive():
    """Frames hold PETSc's objects, which on ranks that fail must go at the same time as on the others."""
    things = []

    def failing() -> None:
        thing = Thing()
        things.append(weakref.ref(thing))
        with together(comm):
            raise SceneError("no")

    gc.collect()
    gc.disable()
    try:
        for catch in (SceneError, Exception):
            try:
                failing()
            except catch:
                pass
        assert [ref() for ref in things] == [None, None]
    finally:
        gc.enable()
