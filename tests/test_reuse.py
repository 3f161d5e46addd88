"""Reuse of multigrid hierarchies: what its triggers do, and that solutions do not depend on it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from test_solver import database  # noqa: F401

import petsc_fs
from petsc_fs.errors import UsageError
from petsc_fs.io import hdf5, sequence
from petsc_fs.reuse import Reuse, Triggers
from petsc_fs.scene import Scene
from petsc_fs.solver import Solver

pytestmark = pytest.mark.mpi
comm = MPI.COMM_WORLD
PACKAGE = Path(petsc_fs.__path__[0])
FAST = "contact_poromechanics_fast.opts"


class Built:
    """Stands for a hierarchy."""

    freed = 0

    def destroy(self) -> None:
        self.freed += 1


def reuse_with(**triggers: float) -> tuple[Reuse, Built]:
    """A Reuse after the first solve, in 10 iterations to 1e-10 with all of 10 cells per rank sticking."""
    reuse, built = Reuse("mechanics", Triggers(**triggers)), Built()
    reuse.take_matrix(np.zeros(10, dtype=np.int8), comm)
    assert reuse.kept("leaf") is None
    reuse.keep("leaf", built)
    reuse.note_solve(10, 1e-10)
    return reuse, built


def test_it_keeps_what_nothing_speaks_against():
    reuse, built = reuse_with()
    reuse.take_matrix(np.zeros(10, dtype=np.int8), comm)
    assert reuse.kept("leaf") is built
    assert not reuse.reason
    assert not built.freed


def test_changed_contact_states_end_it():
    states = np.zeros(10, dtype=np.int8)
    states[:2] = 2
    for changed, kept in ((0.2, True), (0.19, False)):
        reuse, built = reuse_with(changed=changed)
        reuse.take_matrix(states, comm)
        assert (reuse.kept("leaf") is built) == kept
        assert built.freed == (not kept)
    assert f"contact states of {2 * comm.size} of {10 * comm.size} fracture cells" in reuse.reason


def test_states_are_compared_with_those_of_the_build_not_the_last_ones():
    reuse, _ = reuse_with(changed=0.15)
    for number in (1, 2):
        states = np.zeros(10, dtype=np.int8)
        states[:number] = 1
        reuse.take_matrix(states, comm)
    assert not reuse.keeping


@pytest.mark.parametrize(("iterations", "residual", "kept"), [(12, 1e-10, True), (13, 1e-10, False), (7, 1e-5, False)])
def test_grown_iterations_per_digit_end_it(iterations, residual, kept):
    reuse, _ = reuse_with(growth=1.25)
    reuse.take_matrix(np.zeros(10, dtype=np.int8), comm)
    reuse.note_solve(iterations, residual)
    reuse.take_matrix(np.zeros(10, dtype=np.int8), comm)
    assert reuse.keeping == kept


def test_age_ends_it():
    reuse, _ = reuse_with(age=3)
    kept = []
    for _ in range(3):
        reuse.take_matrix(None, comm)
        kept.append(reuse.keeping)
    assert kept == [True, True, False]


def test_none_keeps_nothing_but_for_the_same_matrix():
    reuse, built = Reuse(), Built()
    reuse.keep("leaf", built)
    reuse.take_scaled(4.0)
    assert reuse.kept("leaf") is built
    assert reuse.scale == 0.25
    reuse.take_matrix(None, comm, row_scale=4.0)
    assert reuse.kept("leaf") is None
    assert built.freed == 1


@pytest.mark.parametrize("impossible", [{"changed": -0.1}, {"growth": 0.9}, {"age": -1}])
def test_impossible_triggers_are_refused(impossible):
    with pytest.raises(UsageError, match="must not be negative"):
        Triggers(**impossible)


def test_an_unknown_level_is_refused(database):  # noqa: F811
    database(None, petsc_fs_reuse="everything")
    with pytest.raises(UsageError, match="expected none or mechanics"):
        Reuse.from_options()


def load(step: int) -> Scene:
    return sequence.read(PACKAGE / "sequences" / "model2_run.h5", step)


def test_a_kept_hierarchy_changes_iterations_and_no_solution(database):  # noqa: F811
    database(FAST, petsc_fs_reuse="mechanics", petsc_fs_reuse_changed="1", petsc_fs_reuse_growth="9")
    steps = range(4)
    solver = Solver(load(0))
    results = []
    for step in steps:
        if step:
            solver.update(load(step))
        results.append(solver.solve())
    assert all(result.converged for result in results)
    assert solver.reuse.builds == 1
    for step, result in zip(steps, results, strict=True):
        fresh = Solver(load(step))
        expected = fresh.solve()
        assert expected.converged
        for f, values in result.solution.items():
            norm = np.sqrt(comm.allreduce(np.vdot(expected.solution[f], expected.solution[f])))
            error = np.sqrt(comm.allreduce(np.sum((values - expected.solution[f]) ** 2)))
            assert error <= 1e-3 * norm, f
        fresh.destroy()
    solver.destroy()


def test_the_same_scene_again_takes_the_same_iterations_without_a_build(database):  # noqa: F811
    database(FAST, petsc_fs_reuse="mechanics")
    scene = hdf5.read(PACKAGE / "scenes" / "model3.h5")
    solver = Solver(replace(scene, blocks=dict(scene.blocks)))
    first = solver.solve()
    solver.update(replace(scene, blocks=dict(scene.blocks)))
    second = solver.solve()
    assert solver.reuse.builds == 1
    assert abs(second.iterations - first.iterations) <= 1
    solver.destroy()


def test_without_reuse_every_matrix_has_its_own(database):  # noqa: F811
    database(FAST, petsc_fs_reuse="none")
    solver = Solver(load(0))
    solver.solve()
    solver.update(load(1))
    solver.solve()
    assert solver.reuse.builds == 2
    solver.destroy()


def test_only_solves_with_an_older_hierarchy_have_a_limit():
    reuse, _ = reuse_with()
    assert reuse.iteration_limit(1e-10) is None
    reuse.take_matrix(np.zeros(10, dtype=np.int8), comm)
    assert reuse.iteration_limit(1e-10) == 20
    assert reuse.iteration_limit(1e-5) == 10
    reuse.give_up()
    assert reuse.iteration_limit(1e-10) is None
    assert not reuse.keeping


def test_a_solve_that_a_kept_hierarchy_is_too_old_for_goes_on_with_the_latest(database):  # noqa: F811
    database(FAST, petsc_fs_reuse="mechanics", petsc_fs_reuse_changed="1", petsc_fs_reuse_growth="99")
    solver = Solver(load(0))
    solver.solve()
    solver.reuse._first_rate = 0.5  # as if the first solve had taken 5 iterations
    solver.update(load(1))
    result = solver.solve()
    assert result.converged
    assert solver.reuse.builds == 2
    assert "times the iterations" in solver.reuse.reason
    assert result.iterations > 10
    fresh = Solver(load(1))
    expected = fresh.solve()
    assert result.iterations <= 10 + expected.iterations
    fresh.destroy()
    solver.destroy()
