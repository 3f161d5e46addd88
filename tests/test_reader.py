"""Reading in parallel: what is read is the file's, each rank its share, and ranks fail together."""

from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from common import NAMES, SCENES, Layout, comm, file_for, load, verified
from sample import assert_same, full_scene
from test_hdf5 import DAMAGE, NOT_SCENES

from petsc_fs.errors import SceneError
from petsc_fs.io import hdf5
from petsc_fs.io.reader import read_distributed
from petsc_fs.partition import partition
from petsc_fs.scene import Scene
from petsc_fs.solver import Solver

pytestmark = pytest.mark.mpi


def share_of(scene: Scene) -> Scene:
    """Even shares of the cells of each field, in order; on one rank the scene itself."""
    even = Layout.contiguous(comm, scene.dimension, scene.sizes)
    return scene.restrict({f: even.rows(f) for f in scene.sizes}) if comm.size > 1 else scene


def on_rank_0(target: Path, make: Callable[[Path], None]) -> Path:
    """Let rank 0 write a file that all read. Collective."""
    if comm.rank == 0:
        make(target)
    comm.barrier()
    return target


def damaged(folder: Path, name: str, change: Callable[[h5py.File], None]) -> Path:
    """A copy of a bundled scene with something changed. Collective."""

    def make(path: Path) -> None:
        path.write_bytes((SCENES / f"{name}.h5").read_bytes())
        with h5py.File(path, "r+") as file:
            change(file)

    return on_rank_0(folder / f"{name}.h5", make)


@contextmanager
def same_error(match: str = ""):
    """All ranks raise, and say the same in one line."""
    with pytest.raises(SceneError, match=match) as error:
        yield
    assert len(set(comm.allgather(str(error.value)))) == 1
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", NAMES)
def test_each_rank_reads_its_share_and_the_partition_is_that_of_the_whole(name):
    part, layout = read_distributed(SCENES / f"{name}.h5", comm, "rcb")
    whole = load(name)
    assert_same(share_of(whole), part)
    expected = partition(whole, comm, "rcb")
    for f in whole.fields:
        np.testing.assert_array_equal(layout.offsets[f], expected.offsets[f])
        np.testing.assert_array_equal(layout.places(f), expected.places(f))


@pytest.mark.parametrize("compression", [None, "gzip"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_scene_with_everything_and_few_cells(shared_tmp_path, dimension, compression):
    scene = full_scene(dimension)
    path = on_rank_0(shared_tmp_path / "full.h5", lambda p: hdf5.write(scene, p, compression=compression))
    for kind in ("auto", "contiguous"):
        part, layout = read_distributed(path, comm, kind)
        assert_same(share_of(scene), part)
        again, same = read_distributed(path, comm, layout=layout)
        assert same is layout
        assert_same(again, part)


@pytest.mark.parametrize("kind", ["auto", "rcb", "contiguous"])
@pytest.mark.parametrize("name", ["model1", "biot"])
def test_a_scene_read_in_parallel_is_solved_as_one_read_whole(database, name, kind):
    database(file_for(name))
    part, layout = read_distributed(SCENES / f"{name}.h5", comm, kind)
    solver = Solver(part, layout=layout, release=True)
    result = verified(load(name), solver)
    assert result.converged
    whole = Solver(load(name), layout=layout)
    assert abs(verified(load(name), whole).iterations - result.iterations) <= 1
    assert result.error_by_field.keys() == part.reference.keys()
    solver.update(read_distributed(SCENES / f"{name}.h5", comm, layout=layout)[0])
    assert verified(load(name), solver).converged


@pytest.mark.parametrize(("change", "message"), DAMAGE.values(), ids=DAMAGE)
def test_a_scene_with_one_thing_wrong_says_which(shared_tmp_path, change, message):
    def make(path: Path) -> None:
        hdf5.write(full_scene(), path)
        with h5py.File(path, "r+") as file:
            change(file)

    path = on_rank_0(shared_tmp_path / "full.h5", make)
    with same_error(message):
        read_distributed(path, comm)


@pytest.mark.parametrize(("change", "message"), NOT_SCENES.values(), ids=NOT_SCENES)
def test_a_file_that_is_no_scene_says_what_it_is(shared_tmp_path, change, message):
    def make(path: Path) -> None:
        path.write_bytes((SCENES / "model1.h5").read_bytes())
        change(path)

    path = on_rank_0(shared_tmp_path / "model1.h5", make)
    with same_error(message):
        read_distributed(path, comm)


@pytest.mark.parametrize("place", [0.0, 0.5, 0.99])
def test_a_flipped_bit_in_a_chunk_that_one_rank_reads(shared_tmp_path, place):
    def make(path: Path) -> None:
        path.write_bytes((SCENES / "model1.h5").read_bytes())
        with h5py.File(path) as file:
            chunks = file["blocks/momentum/momentum/data"].id
            chunk = chunks.get_chunk_info(int(place * chunks.get_num_chunks()))
        raw = bytearray(path.read_bytes())
        raw[chunk.byte_offset + chunk.size // 2] ^= 4
        path.write_bytes(raw)

    path = on_rank_0(shared_tmp_path / "model1.h5", make)
    with same_error("the scene is damaged"):
        read_distributed(path, comm)


def test_a_rank_without_the_file(shared_tmp_path):
    path = SCENES / "model1.h5" if comm.rank < comm.size - 1 else shared_tmp_path / "elsewhere.h5"
    with same_error("elsewhere.h5: no such file"):
        read_distributed(path, comm)


def test_the_row_with_a_nan_is_named_by_its_number_in_the_file(shared_tmp_path):
    def change(file: h5py.File) -> None:
        block = file["blocks/mass/momentum"]
        block["data"][block["indptr"][777]] = np.nan

    path = damaged(shared_tmp_path, "model2", change)
    with same_error(r"block \(mass, momentum\): row 777 has an entry that is not finite"):
        read_distributed(path, comm, "rcb")


def test_an_unknown_that_is_in_no_equation_is_named(shared_tmp_path):
    """Its equation has entries, so that no rank alone can tell."""

    def forget(file: h5py.File) -> None:
        for row in ("intf_flow", "mass"):
            block = file[f"blocks/{row}/mass"]
            block["data"][...] = np.where(block["indices"][()] == 5, 0.0, block["data"][()])

    path = damaged(shared_tmp_path, "flow", forget)
    with same_error(r"mass: the unknown of cell 5 has no entry or only zeros in the matrix"):
        scene, layout = read_distributed(path, comm)
        Solver(scene, layout=layout)
