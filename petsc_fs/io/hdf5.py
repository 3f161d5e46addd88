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
cell before the next cell. What is unknown is left out. A scene lies in one file, and all of it is written: no
external links or storage, no virtual datasets, no chunks left to the fill value.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields as attributes
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np

from petsc_fs import __version__
from petsc_fs.csr import whole_numbers
from petsc_fs.errors import LayoutError, SceneError
from petsc_fs.fields import FIELD, FIELD_NAMES, field_of, in_order
from petsc_fs.io.files import check_regular, complete
from petsc_fs.scene import CSR, Integers, Material, Metadata, Scene, check_order

ENCODING = "petsc_fs scene"
VERSION = 1
T = TypeVar("T", str, int, float)
LOCKS = "; wait for it (or HDF5_USE_FILE_LOCKING=FALSE where the file system has no locks)"
HEAP = b"GCOL"
HEAPS_WITHIN = 2**24
"""Bytes at the beginning of a file that are looked through for damaged heaps."""
DEFLATE, SMALL = 1032, 2**26
"""Bytes that one byte of a deflated file can become at most, and bytes below which nobody minds."""
PER_ROW = ("rhs", "reference")
PER_CELL = ("cell_centers", "cell_volumes", "cell_dimension", "contact_state")
INTEGERS = ("cell_dimension", "contact_state")


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
    if any(scene.row_range(f) != (0, n) for f, n in scene.sizes.items()):
        raise SceneError(f"{target}: only a whole scene can be written, this is the part of one rank")
    with complete(target) as temporary, h5py.File(temporary, "w") as file:
        write_group(file, scene, dataset_creator(compression))
    return target


def dataset_creator(compression: str | None) -> Callable[[h5py.Group, str, Any], object]:
    """What stores an array under a name in a group, compressed if it has any entries."""
    options = {"compression": compression, "shuffle": True} if compression else {}

    def create(group: h5py.Group, name: str, array: Any) -> object:
        return group.create_dataset(name, data=array, **(options if array.size else {}))

    return create


def write_solution(solution: Mapping[str, Any], path: str | os.PathLike[str], scene: Scene) -> Path:
    """Write a solution, one dataset per field in the scene's numbering and units; see `write`.

    Args:
        solution: all rows of each field.
        path: of the file, replaced if it exists.
        scene: that it solves; names where it comes from.

    Raises:
        UsageError: the file cannot be written.
    """
    target = Path(path)
    with complete(target) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["encoding-type"] = "petsc_fs solution"
        file.attrs["encoding-version"] = VERSION
        for name in ("model", "time_step_index", "newton_index"):
            file.attrs[name] = getattr(scene.metadata, name)
        for name, values in solution.items():
            file.create_dataset(name, data=values).attrs["unit"] = FIELD[name].unit
    return target


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
        for what in (*PER_ROW, *PER_CELL):
            values = getattr(scene, what)
            if isinstance(values, dict):
                values = values.get(name)
            elif name != {"cell_dimension": "mass", "contact_state": "contact"}[what]:
                continue
            if values is not None:
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


def versions() -> dict[str, str]:
    """Version of this package and of the file library."""
    return {"petsc_fs": __version__, "h5py": h5py.version.version, "hdf5": h5py.version.hdf5_version}


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
        SceneError: the file is missing, locked, no HDF5, cut short, not a scene, of another version, or promises more
            than it holds.
        LayoutError: its parts do not fit together.
    """
    with open_file(Path(path)) as file:
        return read_group(file, rows)


def read_group(
    group: h5py.Group, rows: Callable[[int, dict[str, int]], Mapping[str, tuple[int, int]]] | None = None
) -> Scene:
    """Read a scene, or the rows of one rank, from an open file or a group of one; see `read`."""
    dimension, sizes = read_header(group)
    promised = sum(check_storage(group[name]) for name in ("fields", "blocks", "material") if name in group)
    memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if rows is None and promised > memory:
        raise SceneError(f"takes {promised / 2**30:.0f} GiB, and this machine has {memory / 2**30:.0f} GiB")
    fields = field_groups(group)
    for f, size in sizes.items():  # before anything is made of the sizes
        if "rhs" not in fields[f]:
            raise LayoutError(f"{f}: rhs is missing")
        if (rhs := fields[f]["rhs"]).size != size:
            raise LayoutError(f"{f}: rhs has shape {rhs.shape}, expected {(size,)}")
    chosen = {f: (0, n) for f, n in sizes.items()} if rows is None else rows(dimension, sizes)
    ranges = {f: (int(a), int(b)) for f, (a, b) in chosen.items()}
    arrays: dict[str, dict[str, Any]] = {what: {} for what in (*PER_ROW, *PER_CELL)}
    for f, size in sizes.items():
        datasets, bs = fields[f], FIELD[f].block_size(dimension)
        for what, found in arrays.items():
            unit = bs if what in PER_CELL else 1
            if what in datasets:
                shape = (size // unit, 3) if what == "cell_centers" else (size // unit,)
                part = slice(*(n // unit for n in ranges[f]))
                found[f] = _read_array(datasets[what], f"{f}: {what}", shape, part, what not in INTEGERS)
    blocks: dict[tuple[str, str], CSR] = {}
    for row_name, row in group["blocks"].items():
        for column_name, block in row.items():
            r, c = field_of(row_name), field_of(column_name)
            if r not in sizes or c not in sizes:
                raise LayoutError(f"block ({r}, {c}): the scene has no field {r if r not in sizes else c!r}")
            read_rows = partial(_read_block, block, f"block ({r}, {c})", (sizes[r], sizes[c]))
            if r == c and rows is not None:  # a whole scene is asked for it when it is there
                check_order(r, dimension, sizes[r], read_rows)
            blocks[r, c] = read_rows(*ranges[r])
    scene = Scene(
        dimension=dimension,
        sizes=sizes,
        blocks=blocks,
        cell_dimension=arrays.pop("cell_dimension").get("mass"),
        contact_state=arrays.pop("contact_state").get("contact"),
        **arrays,
        material=_read_material(group["material"], sizes["mass"], slice(*ranges["mass"]))
        if "material" in group and "mass" in sizes
        else None,
        metadata=read_metadata(group),
        rows=None if rows is None else ranges,
    )
    scene.validate()
    return scene


@contextmanager
def open_file(path: Path) -> Iterator[h5py.File]:
    """The file, with every way in which it can be unreadable told apart."""
    check_regular(path, "scene")
    try:
        _check_heaps(path)
        file = h5py.File(path, "r")
    except OSError as e:
        if isinstance(e, PermissionError):
            raise SceneError(f"{path}: no permission to read it") from e
        for sign, meaning in (
            ("truncated", "the file is truncated; copy or export it again"),
            ("to lock file", f"locked: another program has it open for writing{LOCKS}"),
            ("h5clear", f"a program that wrote to it has not closed it; if none does any more, h5clear -s {path.name}"),
        ):
            if sign in str(e):
                raise SceneError(f"{path}: {meaning}") from e
        raise SceneError(f"{path}: not an HDF5 file, so not a scene; make one with petsc-fs export or convert") from e
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


def attribute(group: h5py.Group, name: str, kind: type[T]) -> T:
    """A text or number as any language writes it: of fixed or variable length, of any type, alone or an array of one.

    Raises:
        KeyError: there is none.
        SceneError: it is something else.
    """
    found = group.attrs[name]
    value = np.asarray("" if isinstance(found, h5py.Empty) else found).ravel()
    if value.size == 1:
        item = value[0].decode(errors="replace") if isinstance(value[0], bytes) else value.tolist()[0]
        if kind is str and isinstance(item, str):
            return kind(item.rstrip("\0 ").encode(errors="replace").decode())
        if kind is not str and isinstance(item, int | float) and (kind is float or float(item).is_integer()):
            return kind(item)
    words = {str: "a text", int: "a whole number", float: "a number"}[kind]
    raise SceneError(f"{name}: expected {words}, found {value.tolist() if value.size != 1 else item!r}")


def check_encoding(file: h5py.Group, encoding: str) -> None:
    """Refuse what is not in a format, or in another version of it."""
    found = attribute(file, "encoding-type", str) if "encoding-type" in file.attrs else None
    if found == "petsc_fs sequence" != encoding:
        raise SceneError("a sequence of scenes, and one is needed; petsc-fs convert --step K takes one out of it")
    if found != encoding:
        what = f"its encoding-type is {found!r}" if found is not None else "it has no encoding-type"
        raise SceneError(f"an HDF5 file, but not a {encoding}: {what}, expected {encoding!r}")
    number = attribute(file, "encoding-version", int)
    if number != VERSION:
        what = f"this petsc_fs reads {VERSION}; update petsc_fs" if number > VERSION else "which is no longer read"
        raise SceneError(f"written in version {number} of the format, {what}")


def read_header(file: h5py.Group) -> tuple[int, dict[str, int]]:
    """Dimension of a scene, and size of each field.

    Raises:
        SceneError: the file is not a scene of this version.
        LayoutError: a size is impossible.
    """
    check_encoding(file, ENCODING)
    dimension = attribute(file, "dimension", int)
    if dimension not in (2, 3):
        raise SceneError(f"dimension: expected 2 or 3, found {dimension}")
    for name in np.ravel(file.attrs["fields"]):
        word = name.decode(errors="replace") if isinstance(name, bytes) else str(name)
        if word.rstrip("\0 ") not in file["fields"]:
            raise SceneError(f"the scene is incomplete: field {word!r} has no group")
    sizes: dict[str, int] = {}
    for name, group in field_groups(file).items():
        if name not in FIELD:
            raise LayoutError(f"unknown field {name!r}; fields are {', '.join(FIELD_NAMES)}; see --fields")
        sizes[name], bs = attribute(group, "size", int), attribute(group, "block_size", int)
        if bs != FIELD[name].block_size(dimension):
            raise LayoutError(
                f"{name}: block_size is {bs}, expected {FIELD[name].block_size(dimension)} in {dimension}D"
            )
        if sizes[name] < 0 or sizes[name] % bs:
            raise LayoutError(f"{name}: {sizes[name]} rows is not a multiple of block size {bs}")
    return dimension, {name: sizes[name] for name in in_order(sizes)}


def field_groups(file: h5py.Group) -> dict[str, h5py.Group]:
    """Group of each field of a scene.

    Raises:
        LayoutError: two names in the file stand for one.
    """
    groups = {field_of(name): group for name, group in file["fields"].items()}
    if len(groups) != len(file["fields"]):
        raise LayoutError(f"two of {', '.join(file['fields'])} are the same field by what --fields says")
    return groups


def check_storage(group: h5py.Group, depth: int = 3) -> int:
    """Refuse datasets that promise more than the file holds, before anything is allocated for them.

    HDF5 fills in what is not there without a word: chunks that were never written, virtual datasets whose sources are
    missing.

    Returns:
        Size of all datasets, in bytes.

    Raises:
        SceneError: a dataset lies in another file, is not written in full, or says that it is larger than it can be.
    """
    total = 0
    for name in group:
        if isinstance(group.get(name, getlink=True), h5py.ExternalLink):
            raise SceneError(f"{group.name}/{name} lies in another file; a scene is one file: copy it into it")
        item = group[name]
        if isinstance(item, h5py.Group) and depth:
            total += check_storage(item, depth - 1)
        if not isinstance(item, h5py.Dataset) or not item.shape or 0 in item.shape:
            continue
        made, size, stored = item.id.get_create_plist(), item.id.get_type().get_size(), item.id.get_storage_size()
        if made.get_layout() == h5py.h5d.VIRTUAL or made.get_external_count():
            raise SceneError(f"{item.name} lies in other files; a scene is one file: h5repack -l CONTI writes one")
        promised = needed = math.prod(item.shape) * size
        there = stored
        if made.get_layout() == h5py.h5d.CHUNKED:
            chunk = made.get_chunk()
            needed, there = (
                math.prod(-(-n // c) for n, c in zip(item.shape, chunk, strict=True)),
                item.id.get_num_chunks(),
            )
            promised = needed * math.prod(chunk) * size
        if there < needed:
            raise SceneError(f"{item.name} is not written in full, so that HDF5 would make it up; export it again")
        if stored > item.file.id.get_filesize() or promised > max(SMALL, DEFLATE * stored):
            raise SceneError(f"{item.name} says that it has {promised} bytes, and {stored} are there; export it again")
        total += promised
    return total


def _read_array(dataset: h5py.Dataset, what: str, shape: tuple[int, ...], part: slice, real: bool = True) -> Any:
    """Part of a dataset of a shape, as double if `real`; also of a column or a row."""
    if dataset.dtype.kind not in "biuf":
        raise SceneError(f"the scene is damaged ({what}: expected real numbers)")
    if dataset.shape == shape:
        values = dataset[part]
    elif dataset.shape == (*shape, 1):
        values = dataset[part, 0]
    elif dataset.shape == (1, *shape):
        values = dataset[0, part]
    else:
        raise LayoutError(f"{what} has shape {dataset.shape}, expected {shape}")
    return values.astype(np.float64, copy=False) if real else values


def read_metadata(file: h5py.Group) -> Metadata:
    """Where a scene comes from."""
    units, producers = file["units"], file["producers"]
    return Metadata(
        model=attribute(file, "model", str),
        time_step_index=attribute(file, "time_step_index", int),
        newton_index=attribute(file, "newton_index", int),
        time=attribute(file, "time", float),
        units={name: attribute(units, name, float) for name in units.attrs},
        producers={name: attribute(producers, name, str) for name in producers.attrs},
    )


def _read_block(group: h5py.Group, what: str, shape: tuple[int, int], start: int, stop: int) -> CSR:
    """Rows start:stop of a block of a shape."""
    encoding, found = attribute(group, "encoding-type", str), tuple(map(int, np.ravel(group.attrs["shape"])))
    if encoding != "csr_matrix":
        raise LayoutError(f"{what}: encoding-type is {encoding!r}, expected 'csr_matrix'")
    if found != shape:
        raise LayoutError(f"{what}: shape is {found}, expected {shape}")
    pointers, columns, values = (group[name] for name in CSR._fields)
    size = int(values.size)
    if pointers.size != shape[0] + 1:
        raise LayoutError(f"{what}: indptr has {pointers.size} entries, expected {shape[0] + 1}")
    if columns.size != size:
        raise LayoutError(f"{what}: {columns.size} indices but {size} values")

    def integers(dataset: h5py.Dataset, a: int, b: int) -> Integers:
        found = _read_array(dataset, f"{what}: indptr and indices", (int(dataset.size),), slice(a, b), real=False)
        return whole_numbers(found, f"{what}: indptr and indices")

    indptr = integers(pointers, start, stop + 1).astype(np.int64)
    a, b = int(indptr[0]), int(indptr[-1])
    if start == 0 and a != 0:
        raise LayoutError(f"{what}: indptr starts at {a}, expected 0")
    if (np.diff(indptr) < 0).any():
        raise LayoutError(f"{what}: indptr must start at 0 and not decrease")
    if not 0 <= a <= b <= size:
        raise LayoutError(f"{what}: indptr runs to {b}, but there are {size} values")
    if stop == shape[0] and b != size:
        raise LayoutError(f"{what}: indptr ends at {b}, but there are {size} values")
    return CSR(indptr - a, integers(columns, a, b), _read_array(values, f"{what}: data", (size,), slice(a, b)))


def _read_material(group: h5py.Group, size: int, part: slice) -> Material:
    values: dict[str, Any] = {
        name: _read_array(group[name], f"material: {name}", (size,), part)
        if name in group
        else attribute(group, name, float)
        for name in (a.name for a in attributes(Material))
    }
    return Material(**values)
