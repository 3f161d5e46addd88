"""The file format `petsc_fs scene`, version 1, in HDF5.

    /                     encoding-type "petsc_fs scene", encoding-version 1, dimension, fields,
                          model, time_step_index, newton_index, time
    /units                size of each base unit in SI, as attributes
    /producers            version of each program that took part, as attributes
    /fields/NAME          size, block_size, unit; datasets rhs, reference, cell_centers, cell_volumes;
                          for mass also cell_dimension, for contact also contact_state
    /blocks/ROW/COLUMN    encoding-type "csr_matrix", shape; datasets indptr, indices, data
    /material             time_step; datasets, or attributes where one number holds everywhere

Rows and columns are numbered within their field, from 0; vector fields list all components of a
cell before the next cell. What is unknown is left out.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields as attributes
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from petsc_fs.errors import LayoutError, SceneError
from petsc_fs.fields import FIELD, FIELD_NAMES, in_order
from petsc_fs.io.files import complete
from petsc_fs.scene import CSR, Floats, Material, Metadata, Scene

ENCODING = "petsc_fs scene"
VERSION = 1
HEAP = b"GCOL"
HEAPS_WITHIN = 2**24
"""Bytes at the beginning of a file that are looked through for damaged heaps."""
PER_CELL = ("cell_centers", "cell_volumes", "cell_dimension", "contact_state")


def write(scene: Scene, path: str | os.PathLike[str], *, compression: str | None = "gzip") -> Path:
    """Write a whole scene; the file appears under its name only once it is complete.

    Args:
        scene: with all rows (not the part of one rank).
        path: of the file, replaced if it exists.
        compression: an h5py filter, or None.

    Raises:
        SceneError: the scene does not fit together.
        UsageError: the file cannot be written.
    """
    target = Path(path)
    scene.validate()
    if scene.cells or any(scene.row_range(f) != (0, n) for f, n in scene.sizes.items()):
        raise SceneError(f"{target}: only a whole scene can be written, this is the part of one rank")
    return _write_file(target, lambda file: write_group(file, scene, dataset_creator(compression)))


def dataset_creator(compression: str | None) -> Callable[[h5py.Group, str, Any], object]:
    """What stores an array under a name in a group, compressed if it has any entries."""
    options = {"compression": compression, "shuffle": True} if compression else {}

    def create(group: h5py.Group, name: str, array: Any) -> object:
        return group.create_dataset(name, data=array, **(options if array.size else {}))

    return create


def _write_file(target: Path, fill: Callable[[h5py.File], None]) -> Path:
    with complete(target) as temporary, h5py.File(temporary, "w") as file:
        fill(file)
    return target


def write_solution(solution: Mapping[str, Any], path: str | os.PathLike[str], scene: Scene) -> Path:
    """Write a solution, one dataset per field in the scene's numbering and units.

    Args:
        solution: all rows of each field.
        path: of the file, replaced if it exists.
        scene: that it solves; names where it comes from.

    Raises:
        UsageError: the file cannot be written.
    """

    def fill(file: h5py.File) -> None:
        file.attrs["encoding-type"] = "petsc_fs solution"
        file.attrs["encoding-version"] = VERSION
        file.attrs["model"] = scene.metadata.model
        file.attrs["time_step_index"] = scene.metadata.time_step_index
        file.attrs["newton_index"] = scene.metadata.newton_index
        for name, values in solution.items():
            file.create_dataset(name, data=values).attrs["unit"] = FIELD[name].unit

    return _write_file(Path(path), fill)


def write_group(file: h5py.Group, scene: Scene, create: Callable[[h5py.Group, str, Any], object]) -> None:
    """Write a whole scene into an empty file or group.

    Args:
        file: to write into.
        scene: with all rows, valid.
        create: given a group, a name and an array, stores it.
    """

    def put(group: h5py.Group, name: str, values: Any) -> None:
        array = np.asarray(values)
        if array.dtype.kind == "i" and name in ("indices", "indptr"):
            array = array.astype(np.int32 if (array.size == 0 or array.max() < 2**31) else np.int64)
        create(group, name, array)

    meta = scene.metadata
    file.attrs["encoding-type"] = ENCODING
    file.attrs["encoding-version"] = VERSION
    file.attrs["dimension"] = scene.dimension
    file.attrs["fields"] = list(scene.fields)
    for name in ("model", "time_step_index", "newton_index", "time"):
        file.attrs[name] = getattr(meta, name)
    file.create_group("units").attrs.update(meta.units)
    file.create_group("producers").attrs.update(meta.producers | versions())

    for name in scene.fields:
        group = file.create_group(f"fields/{name}")
        group.attrs["size"] = scene.sizes[name]
        group.attrs["block_size"] = scene.block_size(name)
        group.attrs["unit"] = FIELD[name].unit
        put(group, "rhs", scene.rhs[name])
        for what, values in _known_arrays(scene, name).items():
            put(group, what, values)
    file.create_group("blocks")
    for (r, c), block in scene.blocks.items():
        group = file.create_group(f"blocks/{r}/{c}")
        group.attrs["encoding-type"] = "csr_matrix"
        group.attrs["shape"] = (scene.sizes[r], scene.sizes[c])
        for what, values in zip(CSR._fields, block, strict=True):
            put(group, what, values)
    if scene.material is not None:
        group = file.create_group("material")
        group.attrs["time_step"] = scene.material.time_step
        for what, value in scene.material.cell_data().items():
            if np.ndim(value):
                put(group, what, value)
            else:
                group.attrs[what] = float(np.asarray(value))


def _known_arrays(scene: Scene, name: str) -> dict[str, Any]:
    """The optional arrays of a field that the scene has."""
    found: dict[str, Any] = {
        "reference": scene.reference.get(name),
        "cell_centers": scene.cell_centers.get(name),
        "cell_volumes": scene.cell_volumes.get(name),
        "cell_dimension": scene.cell_dimension if name == "mass" else None,
        "contact_state": scene.contact_state if name == "contact" else None,
    }
    return {k: v for k, v in found.items() if v is not None}


def versions() -> dict[str, str]:
    """Version of this package and of the file library."""
    try:
        own = version("petsc_fs")
    except PackageNotFoundError:
        own = "unknown"
    return {"petsc_fs": own, "h5py": h5py.version.version, "hdf5": h5py.version.hdf5_version}


def read_sizes(path: str | os.PathLike[str]) -> tuple[int, dict[str, int]]:
    """Dimension of a scene in a file, and size of each field, without reading any array.

    Raises:
        SceneError: the file is not a scene of this version.
    """
    with open_file(Path(path)) as file:
        return read_header(file)


def read(
    path: str | os.PathLike[str],
    rows: Callable[[int, dict[str, int]], Mapping[str, tuple[int, int]]] | None = None,
) -> Scene:
    """Read a scene, or the rows of one rank.

    Local: each rank calls it for itself and opens the file for reading only.

    Args:
        path: of the file.
        rows: given dimension and sizes, the half-open range of rows per field to read; all if None.

    Raises:
        SceneError: the file is missing, no HDF5, cut short, not a scene, or of another version.
        LayoutError: its parts do not fit together.
    """
    with open_file(Path(path)) as file:
        return read_group(file, rows)


def read_group(
    group: h5py.Group, rows: Callable[[int, dict[str, int]], Mapping[str, tuple[int, int]]] | None = None
) -> Scene:
    """Read a scene, or the rows of one rank, from an open file or a group of one; see `read`."""
    dimension, sizes = read_header(group)
    ranges = {f: (0, n) for f, n in sizes.items()} if rows is None else dict(rows(dimension, sizes))
    scene = _read(group, dimension, sizes, ranges)
    if rows is not None:
        scene.rows = ranges
    scene.validate()
    return scene


@contextmanager
def open_file(path: Path) -> Iterator[h5py.File]:
    """The file, with every way in which it can be unreadable told apart."""
    if not path.exists():
        raise SceneError(f"{path}: no such file")
    if path.is_dir():
        raise SceneError(f"{path}: is a directory, not a scene")
    try:
        _check_heaps(path)
        file = h5py.File(path, "r")
    except OSError as e:
        if isinstance(e, PermissionError):
            raise SceneError(f"{path}: no permission to read it") from e
        if "truncated" in str(e):
            raise SceneError(f"{path}: the file is truncated; copy or export it again") from e
        raise SceneError(f"{path}: not an HDF5 file, so not a scene; make one with petsc-fs export") from e
    with file, explained(path):
        yield file


def _check_heaps(path: Path) -> None:
    """Refuse a file with a damaged heap, where HDF5 keeps texts: its library may go round in it without end.

    A heap is "GCOL", a version, three zeros and its size in 8 bytes; then follow objects, each a number (2 bytes, 0 for
    the free space at the end), 6 bytes, its size (8 bytes) and as many bytes, up to a multiple of 8. Heaps are looked
    for at the beginning of a file, where those of a scene are.
    """
    with path.open("rb") as file:
        data = file.read(HEAPS_WITHIN)
    start = data.find(HEAP)
    while start >= 0:
        size = int.from_bytes(data[start + 8 : start + 16], "little")
        end, at = start + size, start + 16
        inside = start % 8 == 0 and data[start + 4 : start + 8] == b"\x01\0\0\0" and end <= len(data)
        while inside and at + 16 <= end:
            number, length = (int.from_bytes(data[at + a : at + b], "little") for a, b in ((0, 2), (8, 16)))
            step = 16 + -(-length // 8) * 8 if number else length
            if not 16 <= step <= end - at:
                raise SceneError(f"{path}: the scene is damaged (a heap of texts in it); copy or export it again")
            at += step
        start = data.find(HEAP, start + len(HEAP))


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """What goes wrong in reading, as an error that names the file."""
    try:
        yield
    except SceneError as e:
        raise type(e)(f"{path}: {e}") from e
    except KeyError as e:
        raise SceneError(f"{path}: the scene is incomplete: {e.args[0]}") from e
    except (OSError, RuntimeError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as e:
        raise SceneError(f"{path}: the scene is damaged ({e}); copy or export it again") from e


def read_header(file: h5py.File) -> tuple[int, dict[str, int]]:
    """Dimension of a scene, and size of each field.

    Raises:
        SceneError: the file is not a scene of this version.
        LayoutError: a size is impossible.
    """
    found, number = file.attrs.get("encoding-type"), file.attrs.get("encoding-version")
    if found == "petsc_fs sequence":
        raise SceneError("a sequence of scenes, and one is needed; petsc-fs convert --step K takes one out of it")
    if found != ENCODING:
        what = f"its encoding-type is {found!r}" if found is not None else "it has no encoding-type"
        raise SceneError(f"an HDF5 file, but not a petsc_fs scene: {what}, expected {ENCODING!r}")
    if not isinstance(number, int | np.integer):
        raise SceneError(f"encoding-version is {number!r}, expected the number {VERSION}")
    if number > VERSION:
        raise SceneError(f"written in version {number} of the format, this petsc_fs reads {VERSION}; update petsc_fs")
    if number < VERSION:
        raise SceneError(f"written in version {number} of the format, which is no longer read; export it again")
    dimension = int(file.attrs["dimension"])
    if dimension not in (2, 3):
        raise SceneError(f"dimension: expected 2 or 3, found {dimension}")
    for name in file.attrs["fields"]:
        if name not in file["fields"]:
            raise SceneError(f"the scene is incomplete: field {name!r} has no group")
    sizes: dict[str, int] = {}
    for name in file["fields"]:
        if name not in FIELD:
            raise LayoutError(f"unknown field {name!r}; fields are {', '.join(FIELD_NAMES)}")
        sizes[name] = int(file["fields"][name].attrs["size"])
        bs = int(file["fields"][name].attrs["block_size"])
        if bs != FIELD[name].block_size(dimension):
            raise LayoutError(
                f"{name}: block_size is {bs}, expected {FIELD[name].block_size(dimension)} in {dimension}D"
            )
        if sizes[name] < 0 or sizes[name] % bs:
            raise LayoutError(f"{name}: {sizes[name]} rows is not a multiple of block size {bs}")
    return dimension, {name: sizes[name] for name in in_order(sizes)}


def _read(file: h5py.File, dimension: int, sizes: dict[str, int], rows: Mapping[str, tuple[int, int]]) -> Scene:
    found: dict[str, dict[str, Any]] = {name: {} for name in ("rhs", "reference", *PER_CELL)}
    for name, size in sizes.items():
        group = file["fields"][name]
        bs = FIELD[name].block_size(dimension)
        for what, store in found.items():
            if what not in group:
                continue
            per_cell = what in PER_CELL
            expected = size // bs if per_cell else size
            if group[what].shape[:1] != (expected,):
                raise LayoutError(f"{name}: {what} has {len(group[what])} entries, expected {expected}")
            a, b = rows[name]
            values = group[what][a // bs : b // bs] if per_cell else group[what][a:b]
            store[name] = values if what in ("cell_dimension", "contact_state") else real_numbers(values)
    blocks: dict[tuple[str, str], CSR] = {}
    for r, row in file["blocks"].items():
        for c in row:
            what = f"block ({r}, {c})"
            if r not in sizes or c not in sizes:
                raise LayoutError(f"{what}: the scene has no field {r if r not in sizes else c!r}")
            blocks[r, c] = _read_block(row[c], what, (sizes[r], sizes[c]), *rows[r])
    return Scene(
        dimension=dimension,
        sizes=sizes,
        blocks=blocks,
        rhs=found["rhs"],
        reference=found["reference"],
        cell_centers=found["cell_centers"],
        cell_volumes=found["cell_volumes"],
        cell_dimension=found["cell_dimension"].get("mass"),
        contact_state=found["contact_state"].get("contact"),
        material=_read_material(file, sizes["mass"], rows["mass"]) if "material" in file and "mass" in sizes else None,
        metadata=read_metadata(file),
    )


def read_metadata(file: h5py.File) -> Metadata:
    """Where a scene comes from."""
    return Metadata(
        model=str(file.attrs["model"]),
        time_step_index=int(file.attrs["time_step_index"]),
        newton_index=int(file.attrs["newton_index"]),
        time=float(file.attrs["time"]),
        units={k: float(v) for k, v in file["units"].attrs.items()},
        producers={k: str(v) for k, v in file["producers"].attrs.items()},
    )


def _read_block(group: h5py.Group, what: str, shape: tuple[int, int], start: int, stop: int) -> CSR:
    check_block(group, what, shape)
    pointers, columns, values = (group[name] for name in CSR._fields)
    indptr = pointers[start : stop + 1].astype(np.int64)
    a, b = int(indptr[0]), int(indptr[-1])
    if start == 0 and a != 0:
        raise LayoutError(f"{what}: indptr starts at {a}, expected 0")
    if not 0 <= a <= b <= values.size:
        raise LayoutError(f"{what}: indptr runs to {b}, but there are {values.size} values")
    if stop == shape[0] and b != values.size:
        raise LayoutError(f"{what}: indptr ends at {b}, but there are {values.size} values")
    return CSR(indptr - a, columns[a:b], real_numbers(values[a:b]))


def check_block(group: h5py.Group, what: str, shape: tuple[int, int]) -> None:
    """The shapes and kinds of the datasets of a block."""
    encoding = group.attrs["encoding-type"]
    if encoding != "csr_matrix":
        raise LayoutError(f"{what}: encoding-type is {encoding!r}, expected 'csr_matrix'")
    if tuple(group.attrs["shape"]) != shape:
        raise LayoutError(f"{what}: shape is {tuple(group.attrs['shape'])}, expected {shape}")
    pointers, columns, values = (group[name] for name in CSR._fields)
    if pointers.dtype.kind not in "iu" or columns.dtype.kind not in "iu":
        raise LayoutError(f"{what}: indptr and indices must be integers")
    if pointers.shape != (shape[0] + 1,):
        raise LayoutError(f"{what}: indptr has {pointers.size} entries, expected {shape[0] + 1}")
    if columns.shape != values.shape:
        raise LayoutError(f"{what}: {columns.size} indices but {values.size} values")


def real_numbers(values: Any) -> Floats:
    """Numbers as they are computed with; a TypeError for text and complex numbers."""
    return np.asarray(values).astype(np.float64, casting="same_kind", copy=False)


def _read_material(file: h5py.File, size: int, rows: tuple[int, int]) -> Material:
    group = file["material"]
    names = [a.name for a in attributes(Material) if a.name != "time_step"]
    for name in group:
        if group[name].shape != (size,):
            raise LayoutError(f"material: {name} has shape {group[name].shape}, expected {(size,)}")
    values = {n: real_numbers(group[n][slice(*rows)]) if n in group else float(group.attrs[n]) for n in names}
    return Material(**values, time_step=float(group.attrs["time_step"]))
