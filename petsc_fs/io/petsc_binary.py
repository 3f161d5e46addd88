"""Scenes in PETSc's own binary format, for C and Fortran programs (MatLoad, VecLoad, ISLoad).

FOLDER/matrix.petsc          the Jacobian, one AIJ, fields one after the other
FOLDER/rhs.petsc             right-hand side
FOLDER/reference.petsc       reference solution, if known
FOLDER/fields/NAME.petsc     index set: rows and columns of the field in the matrix
FOLDER/fields/NAME.WHAT.petsc  vector over these rows that PCs look for, composed as WHAT on the block of the field:
                             fixed_stress_base and fixed_stress_ratio of mass, coordinates of displacements
FOLDER/scene.h5              what this format has no place for: cell data, material, units

A file is integers and numbers, big-endian: a matrix 1211216, rows, columns, entries (-1 if dense), the number of
entries of each row, columns, values; a vector 1211214, length, values; an index set 1211218, length, numbers. How wide
they are depends on how PETSc was built, and is not said: the first integer and the size of the file give it away.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petsc_fs.errors import SceneError, UsageError
from petsc_fs.fields import FIELD_NAMES, MECHANICS, field_of, in_order
from petsc_fs.io import hdf5
from petsc_fs.io.files import check_regular, complete
from petsc_fs.scene import CSR, Integers, Scene

MATRIX, RHS, REFERENCE, FIELDS, REST = "matrix.petsc", "rhs.petsc", "reference.petsc", "fields", "scene.h5"
KINDS = {"matrix": 1211216, "vector": 1211214, "index set": 1211218}
INTEGERS = (">i4", ">i8", "<i4", "<i8")
NUMBERS = {8: "f8", 4: "f4", 16: "c16"}
CUT = "cut short, or damaged: its length does not fit what it announces"


def from_scene(source: Path, folder: Path) -> list[Path]:
    """Write a scene in PETSc's format, with integers as wide as those of the PETSc that is installed.

    Args:
        source: scene in HDF5.
        folder: to write; made if missing.

    Returns:
        The files written.

    Raises:
        SceneError: the scene cannot be read.
        UsageError: the folder cannot be written.
    """
    from petsc4py import PETSc

    integer = np.dtype(PETSc.IntType).newbyteorder(">")
    scene = hdf5.read(source)
    try:
        (folder / FIELDS).mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise UsageError(f"{folder}: cannot be made: {e.strerror}") from e
    for stale in [folder / REFERENCE, *(f for name in FIELD_NAMES for f in (folder / FIELDS).glob(f"{name}.*petsc"))]:
        stale.unlink(missing_ok=True)
    written = []

    def store(name: str, kind: str, *content: Any) -> None:
        with complete(folder / name) as temporary, temporary.open("wb") as file:
            for part in ([KINDS[kind]], *content):
                array = np.asarray(part)
                array.astype(integer if array.dtype.kind in "iu" else ">f8").tofile(file)
        Path(f"{folder / name}.info").unlink(missing_ok=True)
        written.append(folder / name)

    counts, columns, values = _whole(scene)
    store(MATRIX, "matrix", [counts.size, counts.size, values.size], counts, columns, values)
    store(RHS, "vector", [counts.size], *(scene.rhs[f] for f in scene.fields))
    if set(scene.reference) == set(scene.fields):
        store(REFERENCE, "vector", [counts.size], *(scene.reference[f] for f in scene.fields))
    start = 0
    for name, size in ((f, scene.sizes[f]) for f in scene.fields):
        store(f"{FIELDS}/{name}.petsc", "index set", [size], np.arange(start, start + size))
        start += size
        for what, values in companions(scene, name).items():
            store(f"{FIELDS}/{name}.{what}.petsc", "vector", [size], values)
    written.append(hdf5.write(replace(scene, blocks={}, reference={}), folder / REST))
    return written


def companions(scene: Scene, name: str) -> dict[str, NDArray[np.float64]]:
    """Vectors over the rows of a field that PCs look for, by the names they are composed under; see `petsc_fs.nest`."""
    if name == "mass" and (coefficients := scene.fixed_stress_coefficients()) is not None:
        return {"fixed_stress_base": coefficients[:, 0], "fixed_stress_ratio": coefficients[:, 1]}
    if name in MECHANICS and name in scene.cell_centers:
        return {"coordinates": scene.cell_centers[name][:, : scene.dimension].ravel()}
    return {}


def _whole(scene: Scene) -> tuple[Integers, Integers, NDArray[np.float64]]:
    """Number of entries of each row of the whole matrix, their columns and values."""
    start = dict(zip(scene.fields, np.cumsum([0, *(scene.sizes[f] for f in scene.fields)]).tolist(), strict=False))
    rows, columns = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    values: list[NDArray[np.float64]] = [np.empty(0)]
    for (r, c), block in scene.blocks.items():
        rows.append(start[r] + np.repeat(np.arange(scene.sizes[r]), np.diff(block.indptr)))
        columns.append(start[c] + block.indices.astype(np.int64))
        values.append(block.data)
    row, column, value = (np.concatenate(parts) for parts in (rows, columns, values))
    order = np.lexsort((column, row))
    return np.bincount(row, minlength=sum(scene.sizes.values())), column[order], value[order]


def to_scene(folder: Path, target: Path, *, dimension: int | None = None) -> list[Path]:
    """Write a scene from a folder in PETSc's format; index sets may be in any order and interleaved.

    Args:
        folder: as `from_scene` writes it; reference.petsc and scene.h5 may be missing.
        target: scene in HDF5.
        dimension: of the rock matrix; needed where there is no scene.h5 that says it.

    Raises:
        SceneError: a file is missing or not PETSc's, or the parts do not fit together.
        UsageError: the dimension is not known, or the target cannot be written.
    """
    files = {field_of(file.stem): file for file in sorted((folder / FIELDS).glob("*.petsc"))}
    if not (present := in_order(files)):
        raise SceneError(f"{folder}: no {FIELDS}/NAME.petsc there; fields are {', '.join(FIELD_NAMES)}")
    matrix, n, columns = File(folder / MATRIX, "matrix").matrix()
    rhs = File(folder / RHS, "vector").vector()
    rows = {name: File(files[name], "index set").index_set() for name in present}
    if n != columns or n != rhs.size:
        raise SceneError(f"{folder}: the matrix is {n} x {columns}, the right-hand side has {rhs.size} rows")
    known: dict[str, Any] = {}
    if (folder / REST).exists():
        rest = hdf5.read(folder / REST)
        if dimension not in (None, rest.dimension):
            raise UsageError(f"{folder / REST} has dimension {rest.dimension}, not {dimension}")
        dimension = rest.dimension
        for what in ("cell_centers", "cell_volumes", "cell_dimension", "contact_state", "material", "metadata"):
            known[what] = getattr(rest, what)
    if dimension is None:
        raise UsageError(f"{folder}: no {REST} there to tell the dimension; say --dimension 2 or 3")
    scene = Scene.from_matrix(matrix, rhs, rows, dimension=dimension, **known)
    if (folder / REFERENCE).exists():
        solution = File(folder / REFERENCE, "vector").vector()
        if solution.size != n:
            raise SceneError(f"{folder / REFERENCE}: has {solution.size} rows, the matrix has {n}")
        scene.reference = {name: solution[rows[name]] for name in present}
    return [hdf5.write(scene, target)]


def is_petsc(head: bytes) -> bool:
    """Whether a file that begins so has a matrix, vector or index set in PETSc's format."""
    return any(head.startswith(np.array(number, kind).tobytes()) for number in KINDS.values() for kind in INTEGERS)


class File:
    """A file with one object; what it announces is compared with its size before anything is made of it."""

    def __init__(self, path: Path, kind: str) -> None:
        check_regular(path, "file in PETSc's binary format")
        self.path, self.raw, self.at = path, path.read_bytes(), 0
        for integer in map(np.dtype, INTEGERS):
            if self.raw.startswith(np.array(KINDS[kind], integer).tobytes()):
                self.integer, self.at = integer, integer.itemsize
                return
        raise SceneError(f"{path}: not a file in PETSc's binary format, or of another kind than its name says")

    def integers(self, count: int) -> Integers:
        """The next integers."""
        end = self.at + count * self.integer.itemsize
        if count < 0 or end > len(self.raw):
            raise SceneError(f"{self.path}: {CUT}")
        found = np.frombuffer(self.raw, self.integer, count, self.at)
        self.at = end
        return found.astype(np.int64)

    def ends_at(self, end: int) -> bool:
        """Whether the file ends there, or another object begins."""
        return end == len(self.raw) or self.raw[end:].startswith(
            tuple(np.array(number, self.integer).tobytes() for number in KINDS.values())
        )

    def values(self, count: int) -> NDArray[np.float64]:
        """The numbers up to the end, as wide as this makes them."""
        width = next((w for w in NUMBERS if self.ends_at(self.at + count * w)), None)
        if width is None:
            raise SceneError(f"{self.path}: {CUT} for {count} numbers and {8 * self.integer.itemsize}-bit integers")
        if width == 16:
            raise SceneError(
                f"{self.path}: numbers of 16 bytes, as a PETSc for complex scalars writes them; a scene is real: write "
                "it by a PETSc for real scalars"
            )
        return np.frombuffer(self.raw, self.integer.str[0] + NUMBERS[width], count, self.at).astype(np.float64)

    def matrix(self) -> tuple[Any, int, int]:
        """Compressed rows or a dense array; number of rows and of columns."""
        rows, columns, entries = map(int, self.integers(3))
        if entries == -1:
            return self.values(rows * columns).reshape(rows, columns), rows, columns
        counts = self.integers(rows)
        indices = self.integers(entries)
        if (counts < 0).any() or counts.sum() != entries:
            raise SceneError(f"{self.path}: damaged: its rows do not have {entries} entries in all")
        return CSR(np.concatenate([[0], np.cumsum(counts)]), indices, self.values(entries)), rows, columns

    def vector(self) -> NDArray[np.float64]:
        """Numbers."""
        return self.values(int(self.integers(1)[0]))

    def index_set(self) -> Integers:
        """Row numbers, from 0."""
        found = self.integers(int(self.integers(1)[0]))
        if not self.ends_at(self.at):
            raise SceneError(f"{self.path}: {CUT}")
        return found
