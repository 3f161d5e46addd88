"""Pytest on one rank or on several: `pytest` and `scripts/mpiexec -n 2 python -m pytest`.

On several ranks every rank runs the tests marked `mpi`, and no others. Rank 0 alone reports. A test that
fails on any rank fails on all of them, with the traceback of each rank that failed, so that all exit
non-zero. A rank that failed waits `GRACE` seconds for the others, which may be waiting for it in a collective
call; no test takes longer than `LIMIT` seconds.
"""

import faulthandler
import os
import time
from pathlib import Path

import hypothesis
import petsc4py
import pytest
from _pytest.runner import runtestprotocol
from mpi4py import MPI

petsc4py.init([])
pytest.register_assert_rewrite("common")

GRACE = 30
LIMIT = 300

world = MPI.COMM_WORLD.Dup()  # apart from what the tests send
parallel = world.size > 1
stderr = os.dup(2)  # replaced by the terminal once pytest has let go of it
uncollected: list[str] = []  # what went wrong on this rank in collecting tests

# Ranks must draw the same examples, and a CI run the same ones each time.
hypothesis.settings.register_profile(
    "petsc_fs", deadline=None, derandomize=parallel or "CI" in os.environ, database=None
)
hypothesis.settings.load_profile("petsc_fs")


@pytest.fixture
def shared_tmp_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Temporary directory, the same one on all ranks. Collective."""
    return world.bcast(tmp_path_factory.mktemp("shared") if world.rank == 0 else None)


@pytest.hookimpl(trylast=True)  # after the terminal reporter has come into being
def pytest_configure(config: pytest.Config) -> None:
    os.dup2(2, stderr)
    if world.rank > 0:
        config.get_terminal_writer()._file = open(os.devnull, "w")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if parallel:
        serial = [item for item in items if not item.get_closest_marker("mpi")]
        items[:] = [item for item in items if item.get_closest_marker("mpi")]
        config.hook.pytest_deselected(items=serial)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    if report.failed:
        uncollected.append(report.longreprtext)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Let no rank start tests that another does not have. Collective."""
    collected = world.allgather(([item.nodeid for item in session.items], "\n".join(uncollected)))
    if any(nodeids != collected[0][0] for nodeids, _ in collected):
        errors = [f"--- rank {rank}\n{text}" for rank, (_, text) in enumerate(collected) if text]
        pytest.exit("\n".join(["the ranks collected different tests", *errors]), returncode=2)


def pytest_internalerror(excrepr: object) -> None:
    if parallel:
        abort(str(excrepr))


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run one test on all ranks and report the worst that happened."""
    if not parallel:
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    faulthandler.dump_traceback_later(LIMIT, exit=True, file=stderr)
    reports = runtestprotocol(item, log=False, nextitem=nextitem)
    failures = "\n".join(f"{r.longreprtext}\n{r.capstdout}{r.capstderr}" for r in reports if r.failed)
    wait_for_others(failures)
    faulthandler.cancel_dump_traceback_later()
    gathered = world.allgather(failures)
    elsewhere = [(f"rank {rank}", text) for rank, text in enumerate(gathered) if text and rank != world.rank]
    if elsewhere:
        worst = max(reports, key=lambda report: (report.failed, report.when == "call"))
        if not worst.failed:
            worst.outcome = "failed"
            worst.longrepr = f"failed on {', '.join(rank for rank, _ in elsewhere)}"
        worst.sections += elsewhere
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def wait_for_others(failures: str) -> None:
    """Wait until all ranks have run the test; give up after `GRACE` seconds if it failed here. Collective."""
    deadline = time.monotonic() + GRACE
    arrived = world.Ibarrier()
    while not arrived.Test():
        if failures and time.monotonic() > deadline:
            abort(f"{failures}\nThe other ranks did not finish this test.")
        time.sleep(0.001)


def abort(text: str) -> None:
    """End all ranks, with a last word from this one."""
    os.write(stderr, f"\n--- rank {world.rank}\n{text}\n".encode())
    MPI.COMM_WORLD.Abort(1)


@pytest.fixture
def clean():
    """PETSc's options database, as it was before once the test is over."""
    from petsc4py import PETSc

    database = PETSc.Options()
    before = database.getAll()
    yield database
    for name in database.getAll():
        if name not in before:
            database.delValue(name)


@pytest.fixture
def database(clean):
    """Puts options, and those of a file besides, into the database; all of them are gone after the test."""
    from petsc_fs import options

    def insert(file: str | None = None, **more: str) -> None:
        for name, value in more.items():
            clean.setValue(name, value)
        if file is not None:
            options.insert(options.find_options_file(file))

    return insert
