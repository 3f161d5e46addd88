"""Reading in parallel: the same as reading whole and cutting, every entry once, and ranks that fail together."""

from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from sample import SCENES, assert_same, full_scene
from test_hdf5 import DAMAGE, NOT_SCENES

from petsc_fs import redistribution
from petsc_fs.errors import SceneError
from petsc_fs.io import hdf5
from petsc_fs.io.reader import read_distributed
from petsc_fs.partition import has_partitioner, partition
from petsc_fs.redistribution import Redistribution, Transfer, run, shares

comm = MPI.COMM_WORLD
pytestmark = pytest.mark.mpi
NAMES = [path.name for path in sorted(SCENES.glob("*.h5"))]


def on_rank_0(target: Path, make) -> Path:
    """Let rank 0 write a file that all read. Collective."""
    if comm.rank == 0:
        make(target)
    comm.barrier()
    return target


@pytest.mark.parametrize("name", NAMES)
def test_reading_in_parallel_is_reading_whole_and_cutting(name):
    part, layout = read_distributed(SCENES / name, comm, "rcb", index_type=np.int32)
    whole = hdf5.read(SCENES / name)
    expected = partition(whole, comm, "rcb")
    for f in whole.fields:
        np.testing.assert_array_equal(layout.offsets[f], expected.offsets[f])
        np.testing.assert_array_equal(layout.places(f), expected.places(f))
    assert_same(part, whole.restrict(layout))
    assert {block.indices.dtype for block in part.blocks.values()} == {np.dtype(np.int32)}


@pytest.mark.parametrize("kind", [*(["ptscotch"] if has_partitioner("ptscotch") else []), "contiguous"])
def test_other_partitions_and_a_given_layout(kind):
    part, layout = read_distributed(SCENES / "model1.h5", comm, kind)
    assert_same(part, hdf5.read(SCENES / "model1.h5").restrict(layout))
    again, same = read_distributed(SCENES / "model1.h5", comm, layout=layout)
    assert same is layout
    assert_same(again, part)


@pytest.mark.parametrize("compression", [None, "gzip"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_scene_with_everything_and_few_cells(shared_tmp_path, dimension, compression):
    scene = full_scene(dimension)
    path = on_rank_0(shared_tmp_path / "full.h5", lambda p: hdf5.write(scene, p, compression=compression))
    for kind in ("auto", "contiguous"):
        part, layout = read_distributed(path, comm, kind)
        assert_same(scene.restrict(layout), part)


def test_every_entry_is_read_once_in_pieces(monkeypatch):
    read: dict[str, list[tuple[int, int]]] = {}
    original = h5py.Dataset.__getitem__

    def note(dataset, key):
        a, b, _ = key.indices(len(dataset))
        read.setdefault(dataset.name, []).append((a, b))
        return original(dataset, key)

    monkeypatch.setattr(h5py.Dataset, "__getitem__", note)
    monkeypatch.setattr(redistribution, "PIECE", 1 << 14)
    part, layout = read_distributed(SCENES / "model1.h5", comm, "rcb")
    monkeypatch.undo()
    assert_same(part, hdf5.read(SCENES / "model1.h5").restrict(layout))
    with h5py.File(SCENES / "model1.h5") as file:
        for name in sorted({name for names in comm.allgather(list(read)) for name in names}):
            dataset = file[name]
            ranges = sorted(r for pieces in comm.allgather(read.get(name, [])) for r in pieces if r[0] < r[1])
            assert [r[0] for r in ranges] == [0, *(r[1] for r in ranges[:-1])], name
            assert ranges[-1][1] == len(dataset)
            assert all(a % dataset.chunks[0] == 0 for a, _ in ranges)
        names = []
        file.visititems(lambda name, item: names.append(f"/{name}") if isinstance(item, h5py.Dataset) else None)
        assert set(names) == {name for part in comm.allgather(list(read)) for name in part}
    largest = [b - a for name, pieces in read.items() if name.endswith("momentum/momentum/data") for a, b in pieces]
    assert comm.allreduce(len(largest)) > 2 * comm.size


def test_shares_end_at_chunks():
    np.testing.assert_array_equal(shares(10, 4, 2), [0, 4, 10])
    np.testing.assert_array_equal(shares(10, 1, 4), [0, 2, 5, 7, 10])
    np.testing.assert_array_equal(shares(0, 3, 2), [0, 0, 0])


@pytest.mark.parametrize("piece", [8, 64, 1 << 20])
def test_rows_of_any_length_find_their_owners(monkeypatch, piece):
    monkeypatch.setattr(redistribution, "PIECE", piece)
    rng = np.random.default_rng(piece)
    lengths = rng.integers(0, 9, 40)
    indptr = np.concatenate([[0], np.cumsum(lengths)])
    values = rng.random(indptr[-1])
    owners = rng.integers(0, comm.size, 40)
    own = rng.permutation(np.flatnonzero(owners == comm.rank))
    rows = Redistribution(comm, indptr, owners, own)
    out = np.empty(rows.indptr[-1])
    run(comm, [Transfer(rows, lambda a, b: values[a:b], out, chunk=3)])
    np.testing.assert_array_equal(out, np.concatenate([np.zeros(0), *(values[indptr[r] : indptr[r + 1]] for r in own)]))


@contextmanager
def same_error(match: str = ""):
    """All ranks raise, and say the same in one line."""
    with pytest.raises(SceneError, match=match) as error:
        yield
    assert len(set(comm.allgather(str(error.value)))) == 1
    assert "\n" not in str(error.value)


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


@pytest.mark.skipif(comm.size == 1, reason="one rank sees one file")
def test_ranks_that_see_different_files():
    with same_error(f"rank {comm.size - 1} sees another scene there than rank 0"):
        read_distributed(SCENES / ("model2.h5" if comm.rank == comm.size - 1 else "model1.h5"), comm)


def test_the_row_with_a_nan_is_named_by_its_number_in_the_file(shared_tmp_path):
    def make(path: Path) -> None:
        path.write_bytes((SCENES / "model2.h5").read_bytes())
        with h5py.File(path, "r+") as file:
            block = file["blocks/mass/momentum"]
            block["data"][block["indptr"][777]] = np.nan

    path = on_rank_0(shared_tmp_path / "model2.h5", make)
    with same_error(r"block \(mass, momentum\): row 777 has an entry that is not finite"):
        read_distributed(path, comm, "rcb")


def test_more_unknowns_than_the_index_type_can_number():
    with same_error("a field has more unknowns than int8 can number: use a PETSc with 64-bit indices"):
        read_distributed(SCENES / "model1.h5", comm, index_type=np.int8)
