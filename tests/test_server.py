"""Rank 0 has the scenes: the server against the solver it stands for, and how it ends."""

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from common import (
    NAMES,
    comm,
    confirm,
    file_for,
    fractured,
    load,
    noisy,
    thinned,
    verified,
    without_stiffness,
)
from petsc4py import PETSc
from programs import SECONDS_TO_END, Program

from petsc_fs import server
from petsc_fs.errors import SceneError, SolveError, UsageError
from petsc_fs.server import ServedSolver
from petsc_fs.solver import Solver


def on_rank_0(body) -> None:
    """Run something on rank 0 while the other ranks serve it."""
    client = server.start(comm)
    if client is None:
        return
    PETSc.Options().setValue("petsc_fs_least_rows", "1")  # however small, on all ranks
    try:
        body(client)
    finally:
        client.stop()
        PETSc.Options().delValue("petsc_fs_least_rows")


# Server and solver


@pytest.mark.mpi
@pytest.mark.parametrize("name", NAMES)
def test_served_solver_does_what_the_solver_does(database, name):
    """Several updates, and options that only rank 0 has."""
    database(file_for(name))
    first, second = load(name), fractured(load(name), 1.7)
    direct = Solver(first)
    expected = []
    steps = [(first, None), (second, 1e-3), (second, None), (first, None)]
    for scene, rtol in steps[: 2 if name == "model3" else 4]:
        if expected:
            direct.update(scene)
        result = verified(scene, direct, direct.solve(rtol))
        expected.append((scene, rtol, result, direct.system.gather(result.solution)))
    if comm.rank > 0:
        for option in PETSc.Options().getAll():
            PETSc.Options().delValue(option)

    def body(client):
        solver = ServedSolver(client, first)
        for k, (scene, rtol, result, solution) in enumerate(expected):
            if k:
                solver.update(scene)
            found = solver.solve(rtol)
            confirm(scene, found, found.solution)
            assert (found.converged, found.rtol) == (result.converged, result.rtol)
            assert found.iterations == result.iterations
            assert found.tolerance == pytest.approx(result.tolerance, rel=1e-6)
            assert set(found.error_by_field) == set(result.error_by_field)
            for f, values in solution.items():
                np.testing.assert_allclose(found.solution[f], values, rtol=0, atol=1e-7 * np.abs(values).max())
            assert solver.transfer_seconds > 0
        assert solver.rebuilds == 0
        assert client.comm.size == comm.size

    on_rank_0(body)


@pytest.mark.mpi
def test_patterns_may_change_and_only_other_sizes_take_a_new_solver(database):
    database("contact_poromechanics.opts")
    whole = load("model2")
    fewer, others = (thinned(whole, ("intf_flow", "mass"), slice(k, None, 2)) for k in (0, 1))

    def body(client):
        solver = ServedSolver(client, whole)
        layout = solver.layout
        for scene in (fewer, others, fewer, noisy(whole, 3), whole):
            solver.update(replace(scene, reference={}))
            result = solver.solve()
            confirm(scene, result, result.solution)
            assert solver.rebuilds == 0
            assert solver.layout is layout
        assert result.converged
        for f, values in whole.reference.items():
            assert np.linalg.norm(result.solution[f] - values) < 1e-6 * np.linalg.norm(values)
        solver.update(load("model1"))  # other grids
        assert solver.rebuilds == 1
        assert solver.solve().converged

    on_rank_0(body)


@pytest.mark.mpi
def test_small_systems_are_solved_on_fewer_ranks(database):
    """And larger ones at the same time on all, also where a system grows."""
    database("flow.opts")
    small = load("flow")  # of 1,248 unknowns

    def body(client):
        for least, ranks in ((3000, 1), (1248, 1), (624, min(2, comm.size)), (1, comm.size)):
            PETSc.Options().setValue("petsc_fs_least_rows", least)
            solver = ServedSolver(client, small)
            assert solver.layout.comm.size == ranks
            for _ in range(2):
                result = solver.solve()
                confirm(small, result, result.solution)
                solver.update(small)

    on_rank_0(body)


def _part_of(task):
    if task == "broken":
        raise ValueError("a task that cannot be done")
    return task, comm.rank


@pytest.mark.mpi
def test_work_is_shared():
    def body(client):
        tasks = [f"task {r}" for r in range(comm.size)]
        assert client.share(_part_of, tasks) == [(task, r) for r, task in enumerate(tasks)]
        with pytest.raises((ValueError, RuntimeError), match="a task that cannot be done"):
            client.share(_part_of, [*tasks[:-1], "broken"])
        assert client.share(_part_of, tasks)[-1] == (tasks[-1], comm.size - 1)

    on_rank_0(body)


@pytest.mark.mpi
def test_several_solvers_at_a_time_with_options_of_their_own(database):
    """Also options that change between solves, which all ranks follow."""
    database("contact_poromechanics.opts", flow_ksp_type="gmres", flow_pc_type="jacobi", flow_ksp_max_it="2")

    def body(client):
        one, other = ServedSolver(client, load("model1")), ServedSolver(client, load("flow"), prefix="flow_")
        assert one.solve().converged
        assert (other.solve().converged, other.solve().iterations) == (False, 2)
        PETSc.Options().setValue("flow_ksp_max_it", "3")
        third = ServedSolver(client, load("flow"), prefix="flow_")
        assert (third.solve().iterations, other.solve().iterations) == (3, 2)
        other.destroy()
        other.destroy()
        del third
        assert one.solve().converged
        assert len(client.rank._kept) == 1

    on_rank_0(body)
    PETSc.Options().delValue("flow_ksp_max_it")


@pytest.mark.mpi
def test_an_error_on_all_ranks_is_one_on_rank_0_and_the_server_goes_on(database):
    database("contact_poromechanics.opts")
    scene = load("model1")
    singular = without_stiffness(scene, "intf_force", 23)

    def body(client):
        solver = ServedSolver(client, singular)
        with pytest.raises(SceneError, match=r"D_22, block of intf_force: singular at cell 23"):
            solver.solve()
        with pytest.raises(SolveError, match="an earlier error left no system"):
            solver.solve()
        solver.update(scene)
        assert solver.solve().converged
        with pytest.raises(UsageError, match="petsc_fs_ordering random"):
            PETSc.Options().setValue("wrong_petsc_fs_ordering", "random")
            ServedSolver(client, scene, prefix="wrong_")
        PETSc.Options().delValue("wrong_petsc_fs_ordering")
        assert solver.solve().converged

    on_rank_0(body)


@pytest.mark.mpi
def test_stop_and_start_again():
    for _ in range(2):
        client = server.start(comm)
        assert (client is None) == (comm.rank > 0)
        if client is not None:
            assert server.start(comm) is client
            client.stop()
            client.stop()
            with pytest.raises(UsageError, match="server is stopped"):
                client.call("close")
    assert server._client is None


# Programs

SERVED = """
import sys, os, signal, time
import petsc4py; petsc4py.init(["program", "-petsc_fs_least_rows", "1"])
from mpi4py import MPI
from petsc_fs import options, server
from petsc_fs.io import hdf5
from petsc_fs.io.bundled import find_scene

sys.stdout.write(f"rank {MPI.COMM_WORLD.rank} pid {os.getpid()}" + os.linesep)
client = server.join()
options.insert(options.find_options_file("contact_poromechanics.opts"))
solver = server.ServedSolver(client, hdf5.read(find_scene("model1.h5")))
assert solver.solve().converged
print("solved")
"""


@pytest.mark.parametrize(
    ("ending", "code", "last"),
    [
        ("", 0, ""),
        ("raise RuntimeError('model broken')", 1, "RuntimeError: model broken"),
        ("sys.exit('that was all')", 1, "that was all"),
        ("os.kill(os.getpid(), signal.SIGINT); time.sleep(5)", 1, "KeyboardInterrupt"),
    ],
)
def test_every_end_of_rank_0_ends_all(tmp_path, ending, code, last):
    program = Program(tmp_path, f"{SERVED}\ntry:\n    pass\n    {ending}\nfinally:\n    print('finally')\n")
    program.wait_for("solved")
    started = time.monotonic()
    found, out, err = program.end(60)
    assert time.monotonic() - started < SECONDS_TO_END
    assert (out + err).count("finally") == 1  # on rank 0 only
    assert bool(found) == bool(code)
    assert err.count("Traceback") == ("raise" in ending or "SIGINT" in ending)
    assert last in err
    assert "PETSC ERROR" not in err


STUCK = """
from petsc_fs.solver import Solver
class Fails:
    def apply(self, pc, x, y):
        if MPI.COMM_WORLD.rank == {rank}:
            raise {error}
        x.copy(y)
"""


@pytest.mark.parametrize(("rank", "error"), [(1, "MemoryError('no room')"), (0, "RuntimeError('in the middle')")])
def test_a_rank_that_fails_in_the_middle_of_a_collective_call(tmp_path, rank, error):
    """The others wait for it in PETSc; it ends them after a while, with the only traceback."""
    (tmp_path / "failing.py").write_text("from mpi4py import MPI\n" + STUCK.format(rank=rank, error=error))
    text = SERVED.replace('"contact_poromechanics.opts"', '"custom.opts"')
    text = text.replace("client =", "server.SECONDS_TO_AGREE = 1.0\nclient =")
    (tmp_path / "custom.opts").write_text("-pc_type python\n-pc_python_type failing.Fails\n-ksp_type gmres\n")
    program = Program(tmp_path, text)
    program.wait_for("pid")
    _, out, err = program.end(60)
    assert program.process.returncode != 0
    assert "solved" not in out
    assert err.count("Traceback") == 1
    assert error.split("'")[1] in err


@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_rank_ends_all(tmp_path, victim):
    program = Program(tmp_path, SERVED + "\ntime.sleep(60)\n")
    lines = program.wait_for("solved")
    pids = {line.split()[1]: int(line.split()[3]) for line in lines if line.startswith("rank")}
    program.end_killed(pids[str(victim)])


def test_waiting_ranks_leave_the_cores_alone(tmp_path):
    program = Program(tmp_path, SERVED + "\nprint('now'); time.sleep(3); print('over'); sys.stdin.readline()\n")
    lines = program.wait_for("now")
    pid = next(int(line.split()[3]) for line in lines if line.startswith("rank 1"))

    def seconds() -> float:
        words = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    before = seconds()
    program.wait_for("over")
    assert seconds() - before < 0.15
    program.end(60)
