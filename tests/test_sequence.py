"""Sequences: files that hold many steps, and their replay; the runs they come from are in test_run.py."""

import json
import os
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from sample import CELLS, SCENES, assert_same, full_scene

from petsc_fs import tree
from petsc_fs.cli import main as cli
from petsc_fs.cli.replay import Player
from petsc_fs.errors import SceneError, UsageError
from petsc_fs.io import hdf5, sequence
from petsc_fs.io.sequence import Writer
from petsc_fs.partition import Layout
from petsc_fs.scene import CSR, Metadata

BUNDLED = SCENES.parent / "sequences" / "model2_run.h5"


def some_scenes():
    """Three Newton steps: values change in one block, then its pattern does."""
    first = full_scene()
    rc = "mass", "mass"
    block = first.blocks[rc]
    other_values = CSR(block.indptr, block.indices, block.data + 1.0)
    keep = np.arange(1, block.data.size)
    shorter = CSR(np.maximum(block.indptr - 1, 0), block.indices[keep], block.data[keep])
    states = (first.contact_state + 1) % 3
    return [
        first,
        replace(first, blocks=first.blocks | {rc: other_values}, contact_state=states, metadata=step_of(1)),
        replace(first, blocks=first.blocks | {rc: shorter}, metadata=step_of(2)),
    ]


def step_of(newton_index):
    return Metadata(model="random", time_step_index=4, newton_index=newton_index, time=240.0, units={"kg": 1e10})


@pytest.fixture
def scenes():
    return some_scenes()


@pytest.fixture
def path(scenes, tmp_path):
    """A complete sequence."""
    return write(scenes, tmp_path / "some.h5")


def write(scenes, path):
    writer = Writer(path, model="random")
    for k, scene in enumerate(scenes):
        writer.append(scene, {"iterations": 10 + k})
    return writer.finish()


# Files


def test_every_step_is_a_scene(scenes, path):
    for k, scene in enumerate(scenes):
        assert_same(scene, sequence.read(path, k))
    assert_same(scenes[2], sequence.read(path, -1))


def test_a_step_copied_out_of_the_file_is_a_scene(scenes, path, tmp_path):
    with h5py.File(path) as source, h5py.File(tmp_path / "scene.h5", "w") as target:
        for name, value in source["steps/1"].attrs.items():
            target.attrs[name] = value
        for name in source["steps/1"]:
            source.copy(f"steps/1/{name}", target)
    assert_same(scenes[1], hdf5.read(tmp_path / "scene.h5"))


def test_contents(path):
    contents = sequence.read_contents(path)
    assert (contents.model, contents.complete) == ("random", True)
    assert [step.index for step in contents.steps] == [0, 1, 2]
    assert [step.newton_index for step in contents.steps] == [2, 1, 2]
    assert [step.run for step in contents.steps] == [{"iterations": 10}, {"iterations": 11}, {"iterations": 12}]
    first = full_scene()
    for step in contents.steps:
        assert (step.dimension, step.sizes) == (2, first.sizes)
        assert sum(step.contact_states.values()) == CELLS["contact"]
    entries = sum(block.data.size for block in first.blocks.values())
    assert [step.entries for step in contents.steps] == [entries, entries, entries - 1]


def test_what_does_not_change_is_stored_once(path):
    with h5py.File(path) as file:
        first, second, third = (file[f"steps/{k}"] for k in range(3))
        for name in ("blocks/momentum/mass/data", "fields/mass/cell_centers", "blocks/mass/mass/indices"):
            assert first[name] == second[name], name
        for name in ("blocks/mass/mass/data", "fields/contact/contact_state"):
            assert first[name] != second[name], name
        assert third["blocks/mass/mass/indices"] != first["blocks/mass/mass/indices"]
        assert third["fields/contact/contact_state"] == first["fields/contact/contact_state"]


def test_a_sequence_is_smaller_than_its_scenes(tmp_path):
    contents = sequence.read_contents(BUNDLED)
    alone = sum(
        hdf5.write(sequence.read(BUNDLED, step.index), tmp_path / "one.h5").stat().st_size for step in contents.steps
    )
    assert len(contents.steps) > 2
    assert BUNDLED.stat().st_size < 0.5 * alone
    assert BUNDLED.stat().st_size < 1e6


@pytest.mark.mpi
def test_each_rank_reads_its_rows(shared_tmp_path):
    comm = MPI.COMM_WORLD
    file = shared_tmp_path / "some.h5"
    if comm.rank == 0:
        write(some_scenes(), file)
    comm.barrier()
    for k, scene in enumerate(some_scenes()):
        layout = Layout.contiguous(comm, scene.dimension, scene.sizes)
        part = sequence.read(file, k, lambda *_, layout=layout: {f: layout.rows(f) for f in layout.fields})
        assert_same(scene.restrict({f: layout.rows(f) for f in layout.fields}), part)


def test_an_interrupted_run_leaves_its_steps(scenes, tmp_path):
    path = tmp_path / "some.h5"
    writer = Writer(path)
    for scene in scenes[:2]:
        writer.append(scene)
    kept = writer.abandon()
    assert [p.name for p in tmp_path.iterdir()] == ["some.partial.h5"]
    assert kept == tmp_path / "some.partial.h5"
    contents = sequence.read_contents(kept)
    assert (len(contents.steps), contents.complete) == (2, False)
    assert_same(scenes[1], sequence.read(kept, 1))


def test_a_run_without_steps_leaves_nothing(tmp_path):
    assert Writer(tmp_path / "a.h5").abandon() is None
    with pytest.raises(UsageError, match="the run has no Newton step"):
        Writer(tmp_path / "b.h5").finish()
    assert not list(tmp_path.iterdir())


def test_a_complete_sequence_replaces_an_older_one(scenes, path):
    writer = Writer(path)
    writer.append(scenes[2])
    assert len(sequence.read_contents(path).steps) == 3
    writer.finish()
    assert len(sequence.read_contents(path).steps) == 1
    assert [p.name for p in path.parent.iterdir()] == ["some.h5"]


def test_a_scene_that_does_not_fit_together_is_not_written(scenes, tmp_path):
    writer = Writer(tmp_path / "some.h5")
    writer.append(scenes[0])
    for name, values in (("rhs", scenes[0].rhs["mass"][1:]), ("rhs", scenes[0].rhs["mass"] * np.nan)):
        with pytest.raises(SceneError, match="mass: rhs has"):
            writer.append(replace(scenes[0], **{name: scenes[0].rhs | {"mass": values}}))
    whole = {f: (0, n) for f, n in scenes[0].sizes.items()}
    with pytest.raises(SceneError, match="part of one rank"):
        writer.append(scenes[0].restrict(whole))
    writer.append(scenes[1])
    assert len(sequence.read_contents(writer.finish()).steps) == 2


def test_files_that_cannot_be_written(tmp_path):
    (tmp_path / "folder.h5").mkdir()
    with pytest.raises(UsageError, match=r"folder\.h5: is a directory"):
        Writer(tmp_path / "folder.h5")
    with pytest.raises(UsageError, match=r"a\.h5: cannot be written"):
        Writer(tmp_path / "nowhere" / "a.h5")
    assert [p.name for p in tmp_path.iterdir()] == ["folder.h5"]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: f.attrs.__setitem__("encoding-version", 2), "version 2 of the format, this petsc_fs reads 1"),
        (lambda f: f["steps/1"].__delitem__("fields"), r"step 1 is incomplete: .*fields"),
        (lambda f: f["steps"].move("1", "7"), "the scene is incomplete"),
        (
            lambda f: f["steps/1/fields/mass/rhs"].__setitem__(0, np.nan),
            r"step 1: mass: rhs has an entry .* not finite",
        ),
    ],
    ids=["newer", "no_fields", "missing_step", "nan"],
)
def test_damaged_sequences(path, damage, message):
    with h5py.File(path, "r+") as file:
        damage(file)
    with pytest.raises(SceneError, match=message):
        sequence.read(path, 1)


def test_scenes_and_sequences_are_told_apart(path, tmp_path):
    assert sequence.is_sequence(path)
    assert not sequence.is_sequence(SCENES / "flow.h5")
    assert not sequence.is_sequence(tmp_path / "nowhere.h5")
    with pytest.raises(SceneError, match="a sequence of scenes, and one is needed; petsc-fs convert --step K"):
        hdf5.read(path)
    with pytest.raises(SceneError, match="not a petsc_fs sequence"):
        sequence.read(SCENES / "flow.h5", 0)
    with pytest.raises(SceneError, match="there is no step 3; steps are 0 to 2"):
        sequence.read(path, 3)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("0:2", [0, 1]), ("1:", [1, 2, 3]), (":1", [0]), (":", [0, 1, 2, 3]), ("2", [2]), ("-1", [3]), ("-2:", [2, 3])],
)
def test_choice_of_steps(text, expected):
    assert list(sequence.parse_steps(text, 4)) == expected


@pytest.mark.parametrize("text", ["", "a", "1:2:3", "4", "-5", "2:2", "1.5", "3:1"])
def test_choices_of_steps_that_are_none(text):
    with pytest.raises(UsageError, match=r"^steps: "):
        sequence.parse_steps(text, 4)


# Replay


@pytest.mark.mpi
def test_replay_needs_as_many_iterations_as_the_run(clean, monkeypatch):
    """The run was on one rank, by the published file; on more, the multigrid of hypre is another one."""
    monkeypatch.setattr(tree, "CANONICAL", "contact_poromechanics.opts")
    player = Player(BUNDLED, MPI.COMM_WORLD, smallest_tree=True)
    records = [player.play(step) for step in sequence.read_contents(BUNDLED).steps]
    assert all(record["converged"] for record in records)
    slack = 1 if MPI.COMM_WORLD.size == 1 else 5  # for other versions of PETSc and hypre
    for record in records:
        assert abs(record["iterations"] - record["iterations_in_run"]) <= slack
    player.solver.destroy()


@pytest.mark.mpi
def test_replay_keeps_its_solver_and_finds_the_solution_of_each_step(clean):
    from petsc_fs.solver import Solver

    comm = MPI.COMM_WORLD
    player = Player(BUNDLED, comm, smallest_tree=True)
    kept = set()
    for step in sequence.read_contents(BUNDLED).steps:
        player.play(step)
        kept.add(id(player.solver))
        found = player.solver.system.gather(player.result.solution)
        alone = Solver(sequence.read(BUNDLED, step.index), comm)
        expected = alone.system.gather(alone.solve().solution)
        alone.destroy()
        if comm.rank == 0:
            for field, values in expected.items():
                assert np.linalg.norm(found[field] - values) < 1e-5 * np.linalg.norm(values), (step.index, field)
    assert len(kept) == 1
    player.solver.destroy()


def test_steps_of_another_size_get_another_solver(clean, tmp_path):
    writer = Writer(tmp_path / "two.h5")
    for name in ("flow.h5", "contact.h5", "flow.h5"):
        writer.append(hdf5.read(SCENES / name))
    player = Player(writer.finish(), MPI.COMM_WORLD, smallest_tree=True)
    records = [player.play(step) for step in sequence.read_contents(player.path).steps]
    assert [record["unknowns"] for record in records] == [
        sum(hdf5.read_sizes(SCENES / name)[1].values()) for name in ("flow.h5", "contact.h5", "flow.h5")
    ]
    for record in records:
        assert max(record["error_by_field"].values()) < 1e-4
    player.solver.destroy()


def test_the_tolerance_of_an_inexact_run_is_replayed(clean, tmp_path):
    writer = Writer(tmp_path / "inexact.h5")
    scene = sequence.read(BUNDLED, 0)
    for run in ({}, {"forcing": 1e-2}, {"forcing": 1e-12}):
        writer.append(scene, run)
    player = Player(writer.finish(), MPI.COMM_WORLD, smallest_tree=True)
    exact, inexact, at_least = (player.play(step) for step in sequence.read_contents(player.path).steps)
    assert inexact["iterations"] < exact["iterations"] == at_least["iterations"]
    assert 1e-10 < inexact["true_relative_residual"] < 1e-2
    player.solver.destroy()


# The command line, in this process: what it does before it needs PETSc, or with PETSc's options as they are


def call(capsys, *arguments, code=0):
    """Output of `petsc-fs`."""
    assert cli.main([str(word) for word in arguments]) == code
    captured = capsys.readouterr()
    return captured.out if code == 0 else captured.err


def test_solve_replays_and_reports(clean, capsys, tmp_path):
    out = call(capsys, "solve", "model2_run.h5", "--report", tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())
    contents = sequence.read_contents(BUNDLED)
    assert report["converged"]
    assert [record["step"] for record in report["steps"]] == [step.index for step in contents.steps]
    assert report["totals"]["iterations"] == sum(record["iterations"] for record in report["steps"])
    assert (report["model"], report["complete"]) == ("model2", True)
    assert f"{len(contents.steps)} of {len(contents.steps)} steps: all converged" in out
    assert "in run" in out


def test_solve_of_one_step_saves_its_solution(clean, capsys, tmp_path):
    call(capsys, "solve", "model2_run.h5", "--steps", "1", "--save", tmp_path / "x.h5")
    with h5py.File(tmp_path / "x.h5") as file:
        assert {name: values.size for name, values in file.items()} == sequence.read_contents(BUNDLED).steps[1].sizes
        assert file.attrs["newton_index"] == 1


def test_inspect(capsys):
    out = call(capsys, "inspect", "model2_run.h5")
    assert "model2_run.h5: model2, 4 steps" in out
    assert "fields: contact 62" in out
    assert "time step 1, Newton step 2" in call(capsys, "inspect", "model2_run.h5", "--step", 2)


def test_inspect_says_that_a_sequence_is_incomplete(scenes, capsys, tmp_path):
    writer = Writer(tmp_path / "some.h5")
    writer.append(scenes[0])
    assert "incomplete: the run that wrote it was interrupted or failed" in call(capsys, "inspect", writer.abandon())


def test_convert_takes_a_step_out(capsys, tmp_path):
    call(capsys, "convert", "model2_run.h5", tmp_path / "step.h5", "--step", 3)
    assert_same(sequence.read(BUNDLED, 3), hdf5.read(tmp_path / "step.h5"))


@pytest.fixture
def empty_folder(tmp_path, monkeypatch):
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
    assert not os.listdir(empty_folder)


def test_the_bundled_sequence_is_found_by_name():
    assert cli.find_scene("model2_run.h5") == Path(BUNDLED)
