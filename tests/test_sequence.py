"""Sequences: files that hold many steps; their replay is in test_replay.py, the runs they come from in test_run.py."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from sample import CELLS, SCENES, assert_same, full_scene

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
