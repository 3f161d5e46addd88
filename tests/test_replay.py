"""The way from a file to solutions: one solver for all steps of a sequence, and a scene as a sequence of one."""

import json

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from sample import SCENES, assert_same

from petsc_fs import options
from petsc_fs.cli import main as cli
from petsc_fs.cli import solve
from petsc_fs.cli.solve import Player
from petsc_fs.errors import SceneError
from petsc_fs.io import hdf5, sequence
from petsc_fs.io.sequence import Writer
from petsc_fs.result import finite
from petsc_fs.solver import Solver

BUNDLED = SCENES.parent / "sequences" / "model2_run.h5"
comm = MPI.COMM_WORLD


def steps_of(path):
    return solve._steps(path, None)[1]


@pytest.fixture
def play(clean):
    """Play all steps of a file by the smallest solver; the player and what the report has of each."""
    players = []

    def start(path, *, smallest=True):
        players.append(Player(path, comm, smallest=smallest))
        return players[-1], [players[-1].play(step) for step in steps_of(path)]

    yield start
    for player in players:
        player.close()


@pytest.mark.mpi
def test_replay_needs_as_many_iterations_as_the_run(play):
    """The run was on one rank, by the published file; on more, the multigrid of hypre is another one."""
    options.insert(options.find_options_file("contact_poromechanics.opts"))
    _, records = play(BUNDLED, smallest=False)
    assert all(record["converged"] for record in records)
    slack = 1 if comm.size == 1 else 5  # for other versions of PETSc and hypre
    for record in records:
        assert abs(record["iterations"] - record["iterations_in_run"]) <= slack


@pytest.mark.mpi
def test_replay_keeps_its_solver_and_finds_the_solution_of_each_step(play):
    player, _ = play(SCENES / "flow.h5")
    player.path, kept = BUNDLED, set()
    for step in steps_of(BUNDLED):
        player.play(step)
        kept.add(id(player.solver))
        found = player.solution()
        with options.inserted(player.choice.values):
            alone = Solver(sequence.read(BUNDLED, step.index), comm)
            expected = alone.system.gather(alone.solve().solution)
        alone.destroy()
        if comm.rank == 0:
            for field, values in expected.items():
                assert np.linalg.norm(found[field] - values) < 1e-5 * np.linalg.norm(values), (step.index, field)
    assert len(kept) == 1


@pytest.mark.mpi
def test_steps_of_another_size_get_another_solver(play, shared_tmp_path):
    names, path = ("flow.h5", "contact.h5", "flow.h5"), shared_tmp_path / "three.h5"
    if comm.rank == 0:
        writer = Writer(path)
        for name in names:
            writer.append(hdf5.read(SCENES / name))
        writer.finish()
    comm.barrier()
    _, records = play(path)
    sizes = [sum(hdf5.read_sizes(SCENES / name)[1].values()) for name in names]
    assert [record["unknowns"] for record in records] == sizes
    assert max(max(record["error_by_field"].values()) for record in records) < 1e-4


def test_the_tolerance_of_an_inexact_run_is_replayed(play, tmp_path):
    writer = Writer(tmp_path / "inexact.h5")
    for run in ({}, {"forcing": 1e-2}, {"forcing": 1e-12}):
        writer.append(sequence.read(BUNDLED, 0), run)
    _, (exact, inexact, at_least) = play(writer.finish())
    assert inexact["iterations"] < exact["iterations"] == at_least["iterations"]
    assert 1e-10 < inexact["true_relative_residual"] < 1e-2


def test_a_step_that_cannot_be_read_is_named(play, tmp_path):
    writer = Writer(tmp_path / "two.h5")
    for _ in range(2):
        writer.append(hdf5.read(SCENES / "flow.h5"))
    path = writer.finish()
    with h5py.File(path, "r+") as file:
        del file["steps/1/fields/mass/rhs"]
        file["steps/1/fields/mass/rhs"] = np.full(1126, np.nan)
    with pytest.raises(SceneError, match=r"step 1: mass: rhs has an entry .* not finite"):
        play(path)


def test_reports_are_strict_json():
    report = {"a": [1.0, np.inf, -np.inf], "b": {"c": float("nan"), "d": (2, "x")}, "e": True}
    assert json.loads(json.dumps(finite(report), allow_nan=False)) == {
        "a": [1.0, None, None],
        "b": {"c": None, "d": [2, "x"]},
        "e": True,
    }


# The command line, in this process: what it does before it needs PETSc, or with PETSc's options as they are


def call(capsys, *arguments, code=0):
    """Output of `petsc-fs`."""
    assert cli.main([str(word) for word in arguments]) == code
    captured = capsys.readouterr()
    return captured.out if code == 0 else captured.err


def test_solve_replays_and_reports(clean, capsys, tmp_path):
    out = call(capsys, "solve", "model2_run.h5", "--report", tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["converged"]
    assert [record["step"] for record in report["steps"]] == [0, 1, 2, 3]
    for total, value in report["totals"].items():
        assert value == pytest.approx(sum(record[total] for record in report["steps"]))
    assert (report["model"], report["complete"]) == ("model2", True)
    assert set(report["memory_bytes"]["peak"]) == {"read", "build", "set-up", "solve"}
    assert "4 of 4 steps: all converged" in out
    assert "in run" in out
    assert max(map(len, out.splitlines())) <= 80


def test_a_step_that_misses_its_tolerance_is_shown(clean, capsys, tmp_path):
    assert cli.main(["solve", "model2_run.h5", "--steps", ":2", "-ksp_max_it", "2", "--report", f"{tmp_path}/r"]) == 1
    out = capsys.readouterr().out
    assert "2 of 4 steps: 2 NOT CONVERGED (!)" in out
    assert "step 1: " in out
    assert [r["reason"] for r in json.loads((tmp_path / "r").read_text())["steps"]] == ["DIVERGED_MAX_IT"] * 2


def test_solve_of_one_step_saves_its_solution(clean, capsys, tmp_path):
    call(capsys, "solve", "model2_run.h5", "--steps", "1", "--save", tmp_path / "x.h5")
    with h5py.File(tmp_path / "x.h5") as file:
        assert {name: values.size for name, values in file.items()} == sequence.read_contents(BUNDLED).steps[1].sizes
        assert file.attrs["newton_index"] == 1


def test_inspect(capsys, tmp_path):
    out = call(capsys, "inspect", "model2_run.h5")
    assert "model2_run.h5: model2, 4 steps" in out
    assert "fields: contact 62" in out
    assert "time step 1, Newton step 2" in call(capsys, "inspect", "model2_run.h5", "--step", 2)
    writer = Writer(tmp_path / "some.h5")
    writer.append(hdf5.read(SCENES / "flow.h5"))
    assert "incomplete: the run that wrote it was interrupted or failed" in call(capsys, "inspect", writer.abandon())


def test_convert_takes_a_step_out(clean, capsys, tmp_path):
    call(capsys, "convert", "model2_run.h5", tmp_path / "step.h5", "--step", 3)
    assert_same(sequence.read(BUNDLED, 3), hdf5.read(tmp_path / "step.h5"))


@pytest.fixture
def empty_folder(clean, tmp_path, monkeypatch):
    """The working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["solve", "model2_run.h5", "--steps", "9"], 2, "steps: 9 names none of the steps 0 to 3"),
        (["solve", "model2_run.h5", "--steps", "x"], 2, "steps: cannot read 'x'"),
        (["solve", "flow.h5", "--steps", "0"], 2, "flow.h5 is no sequence"),
        (["solve", "model2_run.h5", "--save", "x.h5"], 2, "--save: writes the solution of one step"),
        (["solve", "model2_run.h5", "--report", "nowhere/r.json"], 2, "nowhere/r.json: the folder"),
        (["solve", "model2_run.h5", "-options_file", "flow.opts"], 2, "flow.opts is for scenes with the fields"),
        (["inspect", "model2_run.h5", "--step", "4"], 3, "there is no step 4; steps are 0 to 3"),
        (["inspect", "flow.h5", "--step", "0"], 2, "flow.h5 is no sequence"),
        (["inspect", "flow.h5", "--json", "x.json"], 2, "--json goes with --contraction"),
        (["inspect", "model2_run.h5", "--plot", "x.png"], 2, "choose it with --step K"),
        (["options", "model2_run.h5"], 3, "a sequence of scenes, and one is needed"),
        (["convert", "model2_run.h5", "x.h5"], 3, "a sequence of scenes, and one is needed"),
        (["convert", "model2_run.h5", "x", "--step", "0"], 2, "x: a step becomes a scene, whose name ends in .h5"),
        (["convert", "flow.h5", "x.h5", "--step", "0"], 3, "not a petsc_fs sequence"),
    ],
)
def test_errors_are_one_line_and_leave_no_file(capsys, empty_folder, arguments, code, message):
    error = call(capsys, *arguments, code=code)
    assert message in error
    assert error.startswith("petsc-fs: ")
    assert error.count("\n") == 1
    assert not list(empty_folder.iterdir())
