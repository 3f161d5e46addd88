"""Rank 0 has the scenes: the server against the solver it stands for, and how it ends."""

import os
import signal
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from programs import SECONDS_TO_END, Program
from sample import assert_same, dense, full_scene
from test_solver import database, load, scaled  # noqa: F401

from petsc_fs import server
from petsc_fs.errors import SceneError, SolveError, UsageError
from petsc_fs.partition import Layout
from petsc_fs.pattern import UnionPattern
from petsc_fs.scene import CSR, Scene
from petsc_fs.server import ServedSolver
from petsc_fs.solver import Solver
from petsc_fs.transfer import Plan, Structure, changes_of, same_frame

comm = MPI.COMM_WORLD
FILE = {"biot": "poromechanics.opts", "flow": "flow.opts", "contact": "contact_mechanics.opts"}


def on_rank_0(body) -> None:
    """Run something on rank 0 while the other ranks serve it."""
    client = server.start(comm)
    if client is None:
        return
    try:
        body(client)
    finally:
        client.stop()


def sparser(scene: Scene, block: tuple[str, str], keep: slice) -> Scene:
    """The scene with some entries of a block only."""
    b = scene.blocks[block]
    rows = np.repeat(np.arange(b.indptr.size - 1), np.diff(b.indptr))
    chosen = np.zeros(b.data.size, dtype=bool)
    chosen[keep] = True
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows[chosen], minlength=b.indptr.size - 1))])
    return replace(scene, blocks=scene.blocks | {block: CSR(indptr, b.indices[chosen], b.data[chosen])})


# Pattern


def test_union_pattern_changes_no_value_and_becomes_constant():
    whole = load("model1")
    union = UnionPattern()
    entries = ("mass", "mass"), ("contact", "contact")
    parts = [sparser(whole, rc, keep) for rc in entries for keep in (slice(0, None, 2), slice(1, None, 2))]
    grew, sizes = [], []
    for scene in [*parts, *parts]:
        fitted = union.fit(scene)
        fitted.validate()
        grew.append(union.grew)
        sizes.append(sum(b.data.size for b in fitted.blocks.values()))
        assert np.array_equal(dense(fitted), dense(scene))
    assert grew == [True, True] + [False] * 6
    assert sizes[1:] == [sum(b.data.size for b in whole.blocks.values())] * 7


def test_union_pattern_keeps_a_block_that_disappears():
    whole = load("model1")
    union = UnionPattern()
    union.fit(whole)
    blocks = {rc: b for rc, b in whole.blocks.items() if rc != ("contact", "intf_force")}
    fitted = union.fit(replace(whole, blocks=blocks))
    assert not union.grew
    assert not fitted.blocks["contact", "intf_force"].data.any()
    assert np.array_equal(fitted.blocks["contact", "intf_force"].indices, whole.blocks["contact", "intf_force"].indices)


def thinned(scene: Scene, rng: np.random.Generator, share: float) -> Scene:
    """The scene without some entries; some of its blocks have all, others may have none."""
    for rc, block in scene.blocks.items():
        gone = share * rng.integers(0, 3)
        scene = sparser(scene, rc, np.flatnonzero(rng.random(block.data.size) >= gone))
    return replace(scene, blocks={rc: block for rc, block in scene.blocks.items() if block.data.size})


@pytest.mark.parametrize("share", [0.01, 0.2, 0.5])
def test_union_pattern_of_random_changes_is_the_union(share):
    """Row by row against sets of places: the least pattern that has all, and it grows when a place is new."""
    rng, whole, union = np.random.default_rng(7), full_scene(), UnionPattern()
    seen: set[tuple[int, int]] = set()
    earlier: dict = {}
    for _ in range(12):
        scene = thinned(whole, rng, share)
        fitted = union.fit(scene)
        fitted.validate()
        assert np.array_equal(dense(fitted), dense(scene))
        places = set(zip(*np.nonzero(dense(scene)), strict=True))
        assert union.grew == bool(places - seen)
        seen |= places
        ones = {rc: CSR(b.indptr, b.indices, np.ones(b.data.size)) for rc, b in fitted.blocks.items()}
        assert set(zip(*np.nonzero(dense(replace(fitted, blocks=ones))), strict=True)) == seen
        if not union.grew:
            assert all(b.indices is earlier[rc].indices for rc, b in fitted.blocks.items())
        earlier = fitted.blocks


# Transfer


class Ranks:
    """A communicator as far as a layout needs it."""

    def __init__(self, rank: int, size: int) -> None:
        self.rank, self.size = rank, size


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("ranks", [1, 3])
@pytest.mark.parametrize("mixed", [False, True])
def test_what_arrives_is_the_part_of_the_scene(dimension, ranks, mixed):
    scene = full_scene(dimension)
    rng = np.random.default_rng(1)
    cells = {f: n // scene.block_size(f) for f, n in scene.sizes.items()}
    owners = {f: rng.integers(0, ranks, n) if mixed else np.sort(np.arange(n) % ranks) for f, n in cells.items()}
    layout = Layout.from_owners(Ranks(0, ranks), dimension, owners)
    plan = Plan(scene, layout)
    structures = plan.take_structures()
    later = replace(scaled(scene, 2.0), contact_state=scene.contact_state[::-1].copy())
    later.material = replace(scene.material, normal_jump=scene.material.normal_jump + 1, time_step=7.0)
    for now in (scene, later):
        starts = np.concatenate([[0], np.cumsum(plan.counts)])
        packed = plan.pack(now)
        for rank in range(ranks):
            expected = replace(now, reference={}).restrict(replace(layout, comm=Ranks(rank, ranks)))
            found = structures[rank].part(packed[starts[rank] : starts[rank + 1]], changes_of(now))
            assert_same(found, expected)
            assert {f: c.tolist() for f, c in found.cells.items()} == {f: c.tolist() for f, c in expected.cells.items()}
    values = {f: rng.standard_normal(n) for f, n in scene.sizes.items()}
    local = [values[f][replace(layout, comm=Ranks(rank, ranks)).own_rows(f)] for rank in range(ranks) for f in values]
    for f, back in plan.unpack(np.concatenate(local)).items():
        assert np.array_equal(back, values[f])


@pytest.mark.parametrize("ranks", [1, 3])
def test_what_arrives_after_patterns_have_grown_is_the_part_of_the_scene(ranks):
    """Random changes: ranks are told of new blocks only, and know what they would know of a plan made anew."""
    whole, rng, union = full_scene(), np.random.default_rng(3), UnionPattern()
    cells = {f: n // whole.block_size(f) for f, n in whole.sizes.items()}
    layout = Layout.from_owners(Ranks(0, ranks), 2, {f: rng.integers(0, ranks, n) for f, n in cells.items()})
    plan, known, told = None, [], []
    for _ in range(8):
        scene = union.fit(thinned(whole, rng, 0.05))
        if plan is None:
            plan = Plan(scene, layout)
            known = plan.take_structures()
        elif union.grew:
            plan.grow(scene)
            later = plan.take_structures()
            told.append(len(later[0].patterns))
            known = [structure.grown(new) for structure, new in zip(known, later, strict=True)]
        packed = plan.pack(scene)
        starts = np.concatenate([[0], np.cumsum(plan.counts)])
        assert packed.size == starts[-1]
        for rank, structure in enumerate(known):
            expected = replace(scene, reference={}).restrict(replace(layout, comm=Ranks(rank, ranks)))
            assert structure.size == plan.counts[rank]
            assert_same(structure.part(packed[starts[rank] : starts[rank + 1]], changes_of(scene)), expected)
    assert 0 < min(told) < len(whole.blocks)


def test_what_a_plan_depends_on():
    scene = full_scene()
    assert same_frame(scene, scaled(scene, 3.0))
    moved = replace(scene, cell_centers=scene.cell_centers | {"mass": scene.cell_centers["mass"] + 1})
    uniform = replace(scene, material=replace(scene.material, porosity=0.1))
    for other in (moved, uniform, replace(scene, contact_state=None), load("model1"), load("flow")):
        assert not same_frame(scene, other)


# Server and solver


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["model1", "model2", "model3", "biot", "flow", "contact"])
def test_served_solver_does_what_the_solver_does(database, name):  # noqa: F811
    """Several updates, and options that only rank 0 has."""
    database(FILE.get(name, "contact_poromechanics.opts"))
    first, second = load(name), scaled(load(name), 1.7)
    direct = Solver(first)
    expected = []
    steps = [(first, None), (second, 1e-3), (second, None), (first, None)]
    for scene, rtol in steps[: 2 if name == "model3" else 4]:
        if expected:
            direct.update(scene)
        result = direct.solve(rtol)
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
            assert found.converged == result.converged
            assert found.iterations == result.iterations
            assert found.rtol == result.rtol == (rtol or direct.rtol)
            assert found.tolerance == pytest.approx(result.tolerance, rel=1e-6)
            for f, values in solution.items():
                np.testing.assert_allclose(found.solution[f], values, rtol=0, atol=1e-7 * np.abs(values).max())
            assert solver.transfer_seconds > 0
        assert solver.rebuilds == 0
        assert client.comm.size == comm.size

    on_rank_0(body)


@pytest.mark.mpi
def test_looser_solves_are_judged_by_their_own_tolerance(database):  # noqa: F811
    database("contact_poromechanics.opts", petsc_fs_true_rtol="1e-9")
    solver = Solver(load("model2"))
    loose = solver.solve(1e-2)
    assert loose.converged
    assert loose.tolerance == pytest.approx(1e-1)
    assert solver.solve(1e-12).rtol == 1e-10  # never further than -ksp_rtol
    assert solver.solve().tolerance == pytest.approx(1e-9)


@pytest.mark.mpi
def test_a_pattern_that_grows_is_rebuilt_until_it_is_complete(database):  # noqa: F811
    database("contact_poromechanics.opts")
    whole = load("model2")
    fewer = sparser(whole, ("intf_flow", "mass"), slice(0, None, 2))
    others = sparser(whole, ("intf_flow", "mass"), slice(1, None, 2))

    def body(client):
        solver = ServedSolver(client, fewer)
        rebuilds = []
        for scene in (others, fewer, others, whole):
            solver.update(scene)
            rebuilds.append(solver.rebuilds)
        assert rebuilds == [1, 1, 1, 1]
        layout = solver.layout
        found = solver.solve()
        assert found.converged
        for f, values in whole.reference.items():
            assert np.linalg.norm(found.solution[f] - values) < 1e-6 * np.linalg.norm(values)
        moved = replace(whole, cell_centers={f: 2 * c for f, c in whole.cell_centers.items()})
        solver.update(moved)
        assert solver.rebuilds == 2
        assert solver.layout is not layout
        solver.update(load("model1"))  # other grids
        assert solver.rebuilds == 3
        assert solver.solve().converged

    on_rank_0(body)


@pytest.mark.mpi
def test_two_solvers_at_a_time_with_options_of_their_own(database):  # noqa: F811
    database("contact_poromechanics.opts", flow_ksp_type="preonly", flow_pc_type="lu", flow_petsc_fs_mat_type="aij")
    PETSc.Options().setValue("flow_pc_factor_mat_solver_type", "mumps")

    def body(client):
        one, other = ServedSolver(client, load("model1")), ServedSolver(client, load("flow"), prefix="flow_")
        assert [s.solve().iterations for s in (one, other)][1] == 1
        other.destroy()
        del other
        assert one.solve().converged
        assert len(client.rank._kept) == 1

    on_rank_0(body)
    PETSc.Options().delValue("flow_pc_factor_mat_solver_type")


@pytest.mark.mpi
def test_an_error_on_all_ranks_is_one_on_rank_0_and_the_server_goes_on(database):  # noqa: F811
    database("contact_poromechanics.opts")
    scene = load("model1")
    block = scene.blocks["intf_force", "intf_force"]
    data = block.data.copy()
    data[block.indptr[-3] :] = 0.0  # the rows of the last cell
    singular = replace(scene, blocks=scene.blocks | {("intf_force", "intf_force"): CSR(*block[:2], data)})

    def body(client):
        solver = ServedSolver(client, singular)
        with pytest.raises(SceneError, match=r"D_22, block of intf_force: singular at cell"):
            solver.solve()
        with pytest.raises((KeyError, SolveError, RuntimeError)):
            solver.solve()
        solver.update(scene)
        assert solver.solve().converged
        with pytest.raises(UsageError, match="petsc_fs_mat_type dense"):
            PETSc.Options().setValue("wrong_petsc_fs_mat_type", "dense")
            ServedSolver(client, scene, prefix="wrong_")
        PETSc.Options().delValue("wrong_petsc_fs_mat_type")
        assert solver.solve().converged

    on_rank_0(body)


@pytest.mark.mpi
def test_memory_that_runs_out_on_one_rank(database, monkeypatch):  # noqa: F811
    database("contact_poromechanics.opts")
    if comm.rank == comm.size - 1:

        def too_much(_):
            raise MemoryError("no room for the values")

        monkeypatch.setattr(Structure, "size", property(too_much))

    def body(client):
        with pytest.raises(MemoryError, match="no room"):
            ServedSolver(client, load("model1"))

    if comm.size > 1:  # rank 0 looks at the sizes itself
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
import petsc4py; petsc4py.init(["program"])
from mpi4py import MPI
from petsc_fs import options, server
from petsc_fs.io import hdf5
from petsc_fs.cli.main import find_scene

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
    assert out.count("finally") == 1  # on rank 0 only
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
    assert error.split("(")[0] in err


@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_rank_ends_all(tmp_path, victim):
    program = Program(tmp_path, SERVED + "\ntime.sleep(60)\n")
    lines = program.wait_for("solved")
    pids = {line.split()[1]: int(line.split()[3]) for line in lines if line.startswith("rank")}
    os.kill(pids[str(victim)], signal.SIGKILL)
    started = time.monotonic()
    code, _, err = program.end(60)
    assert time.monotonic() - started < SECONDS_TO_END
    assert code != 0
    assert "Traceback" not in err
    assert "PETSC ERROR" not in err


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
