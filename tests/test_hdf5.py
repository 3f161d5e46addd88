"""The scene format: what is written is read, files are whole or not there, and bad ones are told apart."""

import os
import shutil
import socket
import subprocess
import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from sample import CELLS, SCENES, assert_same, full_scene

from petsc_fs.errors import LayoutError, SceneError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.partition import Layout
from petsc_fs.scene import CSR, Scene

BUNDLED = sorted(p.name for p in SCENES.glob("*.h5"))


@pytest.fixture
def full(tmp_path) -> Path:
    """File of a scene that has everything."""
    return hdf5.write(full_scene(), tmp_path / "full.h5")


@pytest.fixture
def model1(tmp_path) -> Path:
    """Copy of a bundled scene."""
    return Path(shutil.copy(SCENES / "model1.h5", tmp_path))


@pytest.mark.parametrize("compression", ["gzip", "lzf", None])
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_scene_with_everything_comes_back(tmp_path, dimension, compression):
    scene = full_scene(dimension)
    assert_same(scene, hdf5.read(hdf5.write(scene, tmp_path / "s.h5", compression=compression)))


def test_a_scene_with_next_to_nothing_comes_back(tmp_path):
    scene = Scene(dimension=3, sizes={"mass": 2}, blocks={}, rhs={"mass": np.ones(2)})
    back = hdf5.read(hdf5.write(scene, tmp_path / "s.h5"))
    assert_same(scene, back)
    assert (back.material, back.contact_state, back.reference, back.metadata.model) == (None, None, {}, "")


def test_any_field_comes_back(tmp_path):
    cells = CELLS | {"intf_fourier": 3, "well_flow": 1, "energy": 6, "other_z_tracer": 6, "other_damage": 2}
    scene = full_scene(2, cells)
    assert scene.fields[-2:] == ("other_damage", "other_z_tracer")
    assert_same(scene, hdf5.read(hdf5.write(scene, tmp_path / "s.h5")))


def test_a_field_without_cells_comes_back(tmp_path):
    scene = full_scene(cells={"contact": 0, "intf_force": 0, "momentum": 3, "mass": 3})
    assert_same(scene, hdf5.read(hdf5.write(scene, tmp_path / "s.h5")))


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_scenes_survive_a_second_writing(tmp_path, name):
    scene = hdf5.read(SCENES / name)
    assert_same(scene, hdf5.read(hdf5.write(scene, tmp_path / name)))


def test_producers_name_the_programs(full):
    assert {"numpy", "petsc_fs", "h5py", "hdf5"} <= set(hdf5.read(full).metadata.producers)


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["model1.h5", "contact.h5"])
def test_each_rank_reads_its_rows(name):
    comm = MPI.COMM_WORLD
    whole = hdf5.read(SCENES / name)
    layout = Layout.contiguous(comm, *hdf5.read_sizes(SCENES / name))
    rows = {f: layout.rows(f) for f in layout.fields}
    seen = []
    part = hdf5.read(SCENES / name, lambda *header: seen.append(header) or rows)
    assert seen == [(whole.dimension, whole.sizes)]
    assert_same(part, whole.restrict(rows))
    held = comm.allreduce(sum(block.data.size for block in part.blocks.values()))
    assert held == sum(block.data.size for block in whole.blocks.values())


@pytest.mark.parametrize("rank", range(3))
def test_a_part_that_is_read_is_the_part_of_the_whole(full, rank):
    scene = full_scene()
    cuts = {f: scene.block_size(f) * np.array([0, 1, 1, scene.sizes[f] // scene.block_size(f)]) for f in scene.fields}
    rows = {f: (int(c[rank]), int(c[rank + 1])) for f, c in cuts.items()}
    assert_same(scene.restrict(rows), hdf5.read(full, lambda *_: rows))


def test_sizes_are_read_in_the_order_of_the_field_table(full):
    dimension, sizes = hdf5.read_sizes(full)
    assert (dimension, list(sizes.items())) == (2, list(full_scene().sizes.items()))


def test_everything_is_compressed_by_default(tmp_path):
    scene = hdf5.read(SCENES / "model1.h5")
    packed, plain = (hdf5.write(scene, tmp_path / f"{c}.h5", compression=c) for c in ("gzip", None))
    assert packed.stat().st_size < 0.85 * plain.stat().st_size
    with h5py.File(packed) as file:
        arrays = []
        file.visititems(lambda _, item: arrays.append(item) if isinstance(item, h5py.Dataset) else None)
        assert len(arrays) > 50
        assert all(item.compression == "gzip" for item in arrays if item.size)


def listing(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def failing(error: Exception, after: int):
    """A create_dataset that fails at some call."""
    calls, create = [], h5py.Group.create_dataset

    def create_dataset(*args, **kwargs):
        calls.append(1)
        if len(calls) > after:
            raise error
        return create(*args, **kwargs)

    return create_dataset


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("unable to flush")], ids=type)
@pytest.mark.parametrize("after", [0, 7])
def test_a_failed_writing_leaves_the_old_file(full, monkeypatch, error, after):
    before = listing(full.parent)
    monkeypatch.setattr(h5py.Group, "create_dataset", failing(error, after))
    with pytest.raises(UsageError, match=r"full\.h5: cannot be written: .*(No space|unable to flush)"):
        hdf5.write(full_scene(seed=1), full)
    assert listing(full.parent) == before


def test_an_interrupted_writing_leaves_the_old_file(full, monkeypatch):
    before = listing(full.parent)
    monkeypatch.setattr(h5py.Group, "create_dataset", failing(KeyboardInterrupt(), 3))
    with pytest.raises(KeyboardInterrupt):
        hdf5.write(full_scene(seed=1), full)
    assert listing(full.parent) == before


def test_an_invalid_scene_is_not_written(full):
    before = listing(full.parent)
    with pytest.raises(LayoutError, match="mass: rhs has shape"):
        hdf5.write(replace(full_scene(), rhs={**full_scene().rhs, "mass": np.ones(1)}), full)
    assert listing(full.parent) == before


def test_a_part_is_not_written(full):
    scene = full_scene()
    part = scene.restrict({f: (0, scene.block_size(f)) for f in scene.fields})
    with pytest.raises(SceneError, match="only a whole scene can be written"):
        hdf5.write(part, full)
    assert_same(scene, hdf5.read(full))


def test_a_written_file_is_replaced_and_has_usual_permissions(full):
    umask = os.umask(0o022)
    try:
        hdf5.write(full_scene(seed=1), full)
    finally:
        os.umask(umask)
    assert_same(full_scene(seed=1), hdf5.read(full))
    assert full.stat().st_mode & 0o777 == 0o644
    assert [p.name for p in full.parent.iterdir()] == ["full.h5"]


@pytest.mark.parametrize("target", ["missing/s.h5", "folder"])
def test_a_target_that_cannot_be_written_is_named(tmp_path, target):
    (tmp_path / "folder").mkdir()
    with pytest.raises(UsageError, match=f"{target}: cannot be written"):
        hdf5.write(full_scene(), tmp_path / target)
    assert [p.name for p in tmp_path.rglob("*")] == ["folder"]


def test_solution_has_one_dataset_per_field_with_units(tmp_path):
    scene = full_scene()
    path = hdf5.write_solution(scene.reference, tmp_path / "x.h5", scene)
    with h5py.File(path) as file:
        assert set(file) == set(scene.fields)
        for name, values in scene.reference.items():
            np.testing.assert_array_equal(file[name], values)
        assert (file["momentum"].attrs["unit"], file["mass"].attrs["unit"]) == ("m", "Pa")
        assert file.attrs["encoding-type"] == "petsc_fs solution"
        assert (file.attrs["model"], file.attrs["time_step_index"], file.attrs["newton_index"]) == ("random", 4, 2)
    with pytest.raises(SceneError, match=r"not a petsc_fs scene: its encoding-type is 'petsc_fs solution'"):
        hdf5.read(path)


def make_directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


def make_fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def make_socket(path: Path) -> None:
    path.unlink()
    with socket.socket(socket.AF_UNIX) as s:
        s.bind(os.path.relpath(path))


def make_foreign(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["x"] = np.ones(3)


def cut(keep):
    """Keep the first bytes, given as their number, or as a share of all."""

    def change(path: Path) -> None:
        whole = path.read_bytes()
        path.write_bytes(whole[: keep if isinstance(keep, int) else int(keep * len(whole))])

    return change


NOT_SCENES = {
    "missing": (Path.unlink, "no such file"),
    "directory": (make_directory, "is a directory, not a scene"),
    "fifo": (make_fifo, "is a device, FIFO or socket, not a scene"),
    "socket": (make_socket, "is a device, FIFO or socket, not a scene"),
    "device": (lambda p: p.unlink() or p.symlink_to("/dev/zero"), "is a device, FIFO or socket, not a scene"),
    "link_to_itself": (lambda p: p.unlink() or p.symlink_to(p), "cannot be read: Too many levels"),
    "empty": (lambda p: p.write_bytes(b""), "not an HDF5 file"),
    "text": (lambda p: p.write_text("fields: mass\n" * 100), "not an HDF5 file, so not a scene; make one with"),
    "foreign": (make_foreign, "an HDF5 file, but not a petsc_fs scene: it has no encoding-type"),
    "four_bytes": (cut(4), "not an HDF5 file"),
    "cut_at_1000_bytes": (cut(1000), "the file is truncated; copy or export it again"),
    "cut_at_tenth": (cut(0.1), "the file is truncated"),
    "cut_at_half": (cut(0.5), "the file is truncated"),
    "last_byte_missing": (cut(-1), "the file is truncated"),
}


@pytest.mark.parametrize(("change", "message"), NOT_SCENES.values(), ids=NOT_SCENES)
@pytest.mark.parametrize("read", [hdf5.read, hdf5.read_sizes])
def test_a_file_that_is_no_scene_says_what_it_is(model1, read, change, message):
    change(model1)
    with pytest.raises(SceneError) as error:
        read(model1)
    assert str(error.value).startswith(f"{model1}: {message}")
    assert "\n" not in str(error.value)


def delete(*names: str):
    def change(file: h5py.File) -> None:
        for name in names:
            del file[name]

    return change


def unset(name: str, group: str = "/"):
    def change(file: h5py.File) -> None:
        del file[group].attrs[name]

    return change


def put(name: str, value, group: str = "/"):
    def change(file: h5py.File) -> None:
        file[group].attrs[name] = value

    return change


def store(name: str, convert):
    """Replace a dataset by a function of it."""

    def change(file: h5py.File) -> None:
        values = convert(file[name][()])
        del file[name]
        file[name] = values

    return change


def rename(old: str, new: str):
    def change(file: h5py.File) -> None:
        file.move(old, new)

    return change


def shorter(values):
    return values[:-1]


def longer(values):
    return np.append(values, values[-1:], axis=0)


def as_text(values):
    return np.full(values.shape, "one", dtype=h5py.string_dtype())


MM = "blocks/mass/mass"
DAMAGE = {
    "older_version": (put("encoding-version", 0), "written in version 0 of the format, which is no longer read"),
    "newer_version": (put("encoding-version", 2), "written in version 2 of the format, .* update petsc_fs"),
    "version_in_words": (put("encoding-version", "one"), "encoding-version: expected a whole number, found 'one'"),
    "no_version": (unset("encoding-version"), "the scene is incomplete: .*'encoding-version'"),
    "other_type": (put("encoding-type", "anndata"), "not a petsc_fs scene: its encoding-type is 'anndata'"),
    "no_dimension": (unset("dimension"), "the scene is incomplete: .*'dimension'"),
    "dimension_zero": (put("dimension", 0), "dimension: expected 2 or 3, found 0"),
    "dimension_in_words": (put("dimension", "two"), "dimension: expected a whole number, found 'two'"),
    "no_model": (unset("model"), "the scene is incomplete: .*'model'"),
    "no_time": (unset("time"), "the scene is incomplete: .*'time'"),
    "no_fields": (delete("fields"), "the scene is incomplete: .*fields"),
    "no_blocks": (delete("blocks"), "the scene is incomplete: .*blocks"),
    "no_units": (delete("units"), "the scene is incomplete: .*units"),
    "no_group_of_a_field": (delete("fields/mass"), "the scene is incomplete: field 'mass' has no group"),
    "no_size": (unset("size", "fields/mass"), "the scene is incomplete: .*'size'"),
    "no_block_size": (unset("block_size", "fields/mass"), "the scene is incomplete: .*'block_size'"),
    "no_rhs": (delete("fields/mass/rhs"), "mass: rhs is missing"),
    "no_indptr": (delete(f"{MM}/indptr"), "the scene is incomplete: .*indptr"),
    "no_indices": (delete(f"{MM}/indices"), "the scene is incomplete: .*indices"),
    "no_data": (delete(f"{MM}/data"), "the scene is incomplete: .*data"),
    "no_encoding_of_a_block": (unset("encoding-type", MM), "the scene is incomplete: .*'encoding-type'"),
    "no_shape_of_a_block": (unset("shape", MM), "the scene is incomplete: .*'shape'"),
    "no_array_of_the_material": (delete("material/porosity"), "the scene is incomplete: .*'porosity'"),
    "no_number_of_the_material": (unset("biot_coefficient", "material"), "incomplete: .*'biot_coefficient'"),
    "no_time_step": (unset("time_step", "material"), "the scene is incomplete: .*'time_step'"),
    "short_rhs": (store("fields/mass/rhs", shorter), r"mass: rhs has shape \(5,\), expected \(6,\)"),
    "long_rhs": (store("fields/mass/rhs", longer), r"mass: rhs has shape \(7,\), expected"),
    "rhs_of_two_columns": (store("fields/mass/rhs", lambda v: np.stack([v, v], 1)), r"rhs has shape \(6, 2\)"),
    "rhs_is_a_number": (store("fields/mass/rhs", lambda v: 1.0), r"rhs has shape \(\), expected"),
    "short_reference": (store("fields/mass/reference", shorter), r"mass: reference has shape \(5,\), expected"),
    "long_centers": (
        store("fields/mass/cell_centers", longer),
        r"mass: cell_centers has shape \(7, 3\), expected \(6, 3\)",
    ),
    "long_states": (
        store("fields/contact/contact_state", longer),
        r"contact: contact_state has shape \(3,\), expected",
    ),
    "long_material": (store("material/porosity", longer), r"material: porosity has shape \(7,\), expected \(6,\)"),
    "short_indptr": (store(f"{MM}/indptr", shorter), r"block \(mass, mass\): indptr has 6 entries, expected 7"),
    "long_indptr": (store(f"{MM}/indptr", longer), r"block \(mass, mass\): indptr has 8 entries, expected 7"),
    "late_indptr": (store(f"{MM}/indptr", lambda p: np.append(1, p[1:])), "indptr starts at 1, expected 0"),
    "indptr_too_far": (store(f"{MM}/indptr", lambda p: np.append(p[:-1], 99)), "indptr runs to 99, but there are"),
    "indptr_not_far_enough": (
        store(f"{MM}/indptr", lambda p: np.append(p[:-1], p[-1] - 1)),
        r"block \(mass, mass\): indptr ends at \d+, but there are \d+ values",
    ),
    "indptr_decreases": (
        store(f"{MM}/indptr", lambda p: p[[0, 2, 1, 3, 4, 5, 6]]),
        "indptr must .* not decrease|columns of a row must increase",
    ),
    "short_indices": (store(f"{MM}/indices", shorter), r"block \(mass, mass\): \d+ indices but \d+ values"),
    "long_indices": (store(f"{MM}/indices", longer), r"block \(mass, mass\): \d+ indices but \d+ values"),
    "short_data": (store(f"{MM}/data", shorter), r"block \(mass, mass\): \d+ indices but \d+ values"),
    "fractional_indices": (store(f"{MM}/indices", lambda i: i + 0.5), "indptr and indices must be integers"),
    "fractional_indptr": (store(f"{MM}/indptr", lambda i: i + 0.5), "indptr and indices must be integers"),
    "text_in_data": (store(f"{MM}/data", as_text), "the scene is damaged"),
    "text_in_indices": (store(f"{MM}/indices", as_text), "indptr and indices: expected real numbers"),
    "text_in_rhs": (store("fields/mass/rhs", as_text), "the scene is damaged"),
    "text_in_states": (store("fields/contact/contact_state", as_text), "contact_state: expected real numbers"),
    "text_in_cell_dimension": (store("fields/mass/cell_dimension", as_text), "the scene is damaged"),
    "text_in_material": (store("material/porosity", as_text), "the scene is damaged"),
    "complex_data": (store(f"{MM}/data", lambda d: d + 1j), "the scene is damaged"),
    "nan_in_data": (store(f"{MM}/data", lambda d: d * np.nan), r"block \(mass, mass\): row \d+ has an entry .* finite"),
    "unknown_field": (rename("fields/mass", "fields/heat"), "field 'mass' has no group"),
    "additional_field": (lambda f: f.copy("fields/mass", "fields/heat"), "unknown field 'heat'; fields are contact"),
    "block_row_of_no_field": (rename("blocks/mass", "blocks/heat"), r"block \(heat, \w+\): .* no field 'heat'"),
    "block_column_of_no_field": (rename(MM, "blocks/mass/heat"), r"block \(mass, heat\): .* no field 'heat'"),
    "block_size": (put("block_size", 3, "fields/momentum"), "momentum: block_size is 3, expected 2 in 2D"),
    "block_size_zero": (put("block_size", 0, "fields/mass"), "mass: block_size is 0, expected 1"),
    "odd_size": (put("size", 9, "fields/momentum"), "momentum: 9 rows is not a multiple of block size 2"),
    "negative_size": (put("size", -2, "fields/momentum"), "momentum: -2 rows"),
    "huge_size": (put("size", 2**62, "fields/mass"), r"mass: rhs has shape \(6,\), expected \(46"),
    "block_shape": (put("shape", (6, 7), MM), r"block \(mass, mass\): shape is \(6, 7\), expected \(6, 6\)"),
    "compressed_columns": (put("encoding-type", "csc_matrix", MM), "encoding-type is 'csc_matrix', expected 'csr"),
    "group_for_dataset": (lambda f: f.move(f"{MM}/data", f"{MM}/x") or f.create_group(f"{MM}/data"), "is damaged"),
    "dataset_for_group": (
        lambda f: f.__delitem__("fields") or f.create_dataset("fields", data=[1.0]),
        "the scene is (damaged|incomplete)",
    ),
}


@pytest.mark.parametrize(("change", "message"), DAMAGE.values(), ids=DAMAGE)
def test_a_scene_with_one_thing_wrong_says_which(full, change, message):
    with h5py.File(full, "r+") as file:
        change(file)
    with pytest.raises(SceneError, match=message) as error:
        hdf5.read(full)
    assert str(error.value).startswith(f"{full}: ")
    assert "\n" not in str(error.value)


def rewritten(path: Path, convert) -> None:
    """The same file with each attribute passed through a function."""
    with h5py.File(path, "r+") as file:
        groups = [file]
        file.visititems(lambda _, item: groups.append(item))
        for group in groups:
            for name, value in list(group.attrs.items()):
                group.attrs[name] = convert(value)


def number_or_text(number, text):
    """A function of attributes: what to do with numbers, and with texts or arrays of them."""
    return lambda v: text(v) if isinstance(v, str) or np.asarray(v).dtype.kind == "O" else number(v)


LANGUAGES = {
    "fixed_length_text": number_or_text(np.asarray, lambda v: np.asarray(v, dtype="S")),
    "text_with_blanks": number_or_text(np.asarray, lambda v: np.char.ljust(np.asarray(v, dtype="S"), 30)),
    "array_of_one_text": number_or_text(np.asarray, lambda v: np.atleast_1d(np.asarray(v, dtype="S"))),
    "doubles": number_or_text(np.float64, lambda v: v),
    "arrays_of_one": number_or_text(np.atleast_1d, lambda v: v),
    "arrays_of_two_dimensions": number_or_text(lambda v: np.atleast_2d(np.float64(v)), lambda v: v),
    "big_endian": number_or_text(lambda v: np.asarray(v, dtype=">f8"), lambda v: v),
}


@pytest.mark.parametrize("convert", LANGUAGES.values(), ids=LANGUAGES)
def test_attributes_are_read_as_any_language_writes_them(full, convert):
    rewritten(full, convert)
    assert_same(full_scene(), hdf5.read(full))


@pytest.mark.parametrize("kind", ["u8", "u2", ">i4", "i1"])
def test_integers_of_any_type_become_signed_ones(full, kind):
    with h5py.File(full, "r+") as file:
        for name in [f"{MM}/indptr", f"{MM}/indices", "fields/contact/contact_state", "fields/mass/cell_dimension"]:
            store(name, lambda values: values.astype(kind))(file)
    scene = hdf5.read(full)
    assert_same(full_scene(), scene)
    scene.check_rows()
    assert scene.blocks["mass", "mass"].indices.dtype in (np.int8, np.int32, np.int64)


MATLAB = {
    "double_indices": lambda v: v.astype(float),
    "columns": lambda v: v[:, None] if v.ndim == 1 else v,
    "rows": lambda v: v[None] if v.ndim == 1 else v,
}


@pytest.mark.parametrize("convert", MATLAB.values(), ids=MATLAB)
def test_arrays_are_read_as_matlab_writes_them(full, convert):
    with h5py.File(full, "r+") as file:
        names = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        for name in names:
            store(name, convert)(file)
    assert_same(full_scene(), hdf5.read(full))
    rows = {f: (full_scene().block_size(f), n) for f, n in full_scene().sizes.items()}
    assert_same(full_scene().restrict(rows), hdf5.read(full, lambda *_: rows))


def test_a_text_that_is_nothing_is_empty(full):
    with h5py.File(full, "r+") as file:
        file.attrs["model"] = h5py.Empty("S1")
    assert hdf5.read(full).metadata.model == ""


@pytest.mark.parametrize("wrong", [1.5, np.nan, [1, 2], "one", h5py.Empty("i4"), np.zeros(0), 1j])
@pytest.mark.parametrize("name", ["dimension", "encoding-version", "newton_index"])
def test_an_attribute_that_is_no_whole_number_is_named(full, name, wrong):
    with h5py.File(full, "r+") as file:
        file.attrs[name] = wrong
    with pytest.raises(SceneError, match=f"{name}: expected a whole number, found"):
        hdf5.read(full)


def virtual(path: Path, values: np.ndarray) -> h5py.VirtualLayout:
    layout = h5py.VirtualLayout(shape=values.shape, dtype=values.dtype)
    layout[:] = h5py.VirtualSource(str(path), "x", shape=values.shape)
    return layout


def outside(file: h5py.File, name: str, values: np.ndarray) -> None:
    source = Path(file.filename).with_name("source.h5")
    with h5py.File(source, "w") as other:
        other["x"] = values
    file[name] = h5py.ExternalLink(source.name, "x")


ELSEWHERE = {
    "source_missing": (
        lambda f, name, v: f.create_virtual_dataset(name, virtual(Path("nowhere.h5"), v), fillvalue=0),
        "lies in other files; a scene is one file: h5repack",
    ),
    "external_storage": (
        lambda f, name, v: f.create_dataset(name, v.shape, v.dtype, external=[("/dev/zero", 0, v.nbytes)]),
        "lies in other files",
    ),
    "external_link": (outside, "lies in another file"),
    "no_chunk": (
        lambda f, name, v: f.create_dataset(name, v.shape, v.dtype, chunks=(2,)),
        "is not written in full, so that HDF5 would make it up",
    ),
    "one_chunk": (
        lambda f, name, v: f.create_dataset(name, v.shape, v.dtype, chunks=(2,), compression="gzip").write_direct(
            v, np.s_[:2], np.s_[:2]
        ),
        "is not written in full",
    ),
    "never_written": (lambda f, name, v: f.create_dataset(name, v.shape, v.dtype), "is not written in full"),
}


@pytest.mark.parametrize("name", ["fields/mass/rhs", "blocks/mass/mass/data", "material/porosity"])
@pytest.mark.parametrize(("make", "message"), ELSEWHERE.values(), ids=ELSEWHERE)
def test_numbers_that_are_not_in_the_file_are_not_made_up(full, make, message, name):
    with h5py.File(full, "r+") as file:
        values = file[name][()]
        del file[name]
        make(file, name, values)
    with pytest.raises(SceneError, match=rf"full\.h5: /{name} {message}"):
        hdf5.read(full)


def test_a_file_that_promises_more_than_it_holds_takes_no_memory(full):
    n = 10**10
    with h5py.File(full, "r+") as file:
        file["fields/mass"].attrs["size"] = n
        for name in file["fields/mass"]:
            shape = (n, *file[f"fields/mass/{name}"].shape[1:])
            del file[f"fields/mass/{name}"]
            file.create_dataset(f"fields/mass/{name}", shape, "f8", chunks=(2**16, 3)[: len(shape)], compression="gzip")
    tracemalloc.start()
    with pytest.raises(SceneError, match=r"/fields/mass/.* is not written in full"):
        hdf5.read(full)
    assert tracemalloc.get_traced_memory()[1] < 2**25
    tracemalloc.stop()


def test_more_than_any_compression_gives_is_refused(full, monkeypatch):
    monkeypatch.setattr(hdf5, "SMALL", 2**16)
    with h5py.File(full, "r+") as file:
        twice = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        twice.set_chunk((2**17,))
        twice.set_deflate(9)
        twice.set_deflate(9)
        file["fields/mass"].create_dataset("more", data=np.zeros(2**17), dcpl=twice)
    with pytest.raises(SceneError, match=r"/fields/mass/more says that it has 1048576 bytes, and \d+ are there"):
        hdf5.read(full)


def test_a_scene_larger_than_the_machine_is_refused(full, monkeypatch):
    monkeypatch.setattr(os, "sysconf", lambda name: 10)
    with pytest.raises(SceneError, match=r"full\.h5: takes 0 GiB, and this machine has 0 GiB"):
        hdf5.read(full)


def test_a_file_that_another_program_writes_is_locked(full):
    code = f"import h5py\nwith h5py.File({str(full)!r}, 'r+'): print('open', flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        with pytest.raises(SceneError, match=r"full\.h5: locked: another program has it open for writing"):
            hdf5.read(full)
        other.communicate(b"\n")
    assert_same(full_scene(), hdf5.read(full))


def test_a_file_whose_writer_died_says_how_to_clear_it(full):
    code = f"import h5py, os\nf = h5py.File({str(full)!r}, 'w', libver='latest'); f.flush(); os._exit(0)"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(SceneError, match=r"a program that wrote to it has not closed it; .*h5clear -s full\.h5"):
        hdf5.read(full)


def test_unknowns_numbered_by_component_are_found_in_a_file(model1):
    with h5py.File(model1, "r+") as file:
        group = file["blocks/momentum/momentum"]
        size = file["fields/momentum"].attrs["size"]
        block = CSR(*(group[name][()] for name in CSR._fields))
        order = np.arange(size).reshape(-1, 2).T.ravel()
        other = Scene.from_matrix(block, np.ones(size), {"mass": order}, dimension=2).blocks["mass", "mass"]
        for name, values in zip(CSR._fields, other, strict=True):
            group[name][...] = values
    with pytest.raises(LayoutError, match=r"model1\.h5: momentum: the unknowns are numbered component by component"):
        hdf5.read(model1)


@pytest.mark.parametrize("target", ["/dev/null", "fifo"])
def test_devices_are_no_files_to_write(tmp_path, target):
    os.mkfifo(tmp_path / "fifo")
    before = os.stat(tmp_path / target)
    with pytest.raises(UsageError, match="is a directory or device, not a file"):
        hdf5.write(full_scene(), tmp_path / target)
    assert os.stat(tmp_path / target).st_ino == before.st_ino


def test_a_link_that_is_written_stays_a_link(full):
    link = full.with_name("link.h5")
    link.symlink_to(full.name)
    hdf5.write(full_scene(seed=1), link)
    assert link.is_symlink()
    assert_same(full_scene(seed=1), hdf5.read(full))


@pytest.mark.parametrize("name", ["fields/momentum/rhs", "blocks/momentum/momentum/data"])
def test_a_flipped_bit_in_a_compressed_chunk_is_noticed(model1, name):
    with h5py.File(model1) as file:
        chunk = file[name].id.get_chunk_info(0)
    raw = bytearray(model1.read_bytes())
    raw[chunk.byte_offset + chunk.size // 2] ^= 4
    model1.write_bytes(raw)
    with pytest.raises(SceneError, match=r"model1\.h5: the scene is damaged \(.*\); copy or export it again"):
        hdf5.read(model1)
