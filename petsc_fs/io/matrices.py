"""Linear systems of other programs, told apart by what is in their files.

A matrix is in Matrix Market's format (coordinate or array), scipy's .npz, numpy's .npy, hypre's IJ files (one per rank,
PREFIX.00000, PREFIX.00001, ..., as HYPRE_IJMatrixPrint writes them), or PETSc's binary format. A vector is in any of
them or in a text file of numbers; row numbers are in the latter, .npy or PETSc's.

Which rows belong to which field is said as `momentum=0:100,mass=100:150`: slices as in Python, single numbers, or @FILE
with numbers; several for one field follow each other, and -1 stands for an unknown that was eliminated. With a map of
degrees of freedom (hypre's dofmap: per rank a count, and a label for each row) the numbers are labels instead.
"""

from __future__ import annotations

import itertools
import re
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from petsc_fs.csr import CSR, Floats, Integers, whole_numbers
from petsc_fs.errors import SceneError, UsageError
from petsc_fs.fields import FIELD, FIELD_NAMES, field_of
from petsc_fs.io import hdf5, petsc_binary
from petsc_fs.io.files import check_regular
from petsc_fs.scene import Scene

MATRIX_MARKET, NPZ, NPY = b"%%MatrixMarket", b"PK\x03\x04", b"\x93NUMPY"
UNREADABLE = (ValueError, OSError, LookupError, TypeError, OverflowError, EOFError, zipfile.BadZipFile)
OF_A_RANK = r"\.\d{5}"


def to_scene(
    source: Path,
    target: Path,
    *,
    rhs: Path,
    rows: str,
    dimension: int,
    order: str = "cell",
    dofmap: Path | None = None,
) -> list[Path]:
    """Write a scene from a matrix and a right-hand side in files.

    Args:
        source: the matrix.
        target: scene in HDF5.
        rhs: the right-hand side.
        rows: of each field, see the module.
        dimension: of the rock matrix.
        order: of the rows of vector fields, see `Scene.from_matrix`.
        dofmap: labels of the rows.

    Raises:
        SceneError: a file cannot be read, or they do not fit together.
        UsageError: `rows` cannot be read, or scipy is needed.
    """
    b, matrix = read_vector(rhs), read_matrix(source)
    n = matrix.indptr.size - 1 if isinstance(matrix, CSR) else (*matrix.shape, 0)[0]
    labels = None if dofmap is None else read_labels(dofmap)
    if labels is not None and labels.size != n:
        raise SceneError(f"{dofmap}: has {labels.size} labels, the matrix has {n} rows")
    fields = parse_rows(rows, n, labels)
    try:
        scene = Scene.from_matrix(matrix, b, fields, dimension=dimension, order=order)
    except SceneError as e:
        raise type(e)(f"{source}: {e}") from e
    return [hdf5.write(scene, target)]


def read_matrix(path: Path) -> Any:
    """A matrix in a form that `Scene.from_matrix` takes.

    Raises:
        SceneError: the file is missing, damaged or something else.
        UsageError: scipy is needed and missing.
    """
    parts, found = _load(path, "matrix")
    if found is not None:
        return found
    first, size, entries = _ij(parts, 2)
    row, column = (whole_numbers(entries[:, k] - first, f"{path}: numbers of rows and columns") for k in (0, 1))
    order = np.argsort(row, kind="stable")
    indptr = np.searchsorted(row[order], np.arange(size + 1))
    return CSR(indptr, column[order], entries[order, 2])


def read_vector(path: Path) -> Floats:
    """A vector; see `read_matrix`."""
    parts, found = _load(path, "vector")
    if found is None and re.fullmatch(f".*{OF_A_RANK}", parts[0].name):
        first, size, entries = _ij(parts, 1)
        found = np.zeros(size)
        found[whole_numbers(entries[:, 0] - first, f"{path}: numbers of rows")] = entries[:, 1]
    elif found is None:
        found = _numbers(path)
    dense = np.asarray(found.toarray() if hasattr(found, "toarray") else found)
    return dense.ravel() if dense.size == max(dense.shape, default=0) else dense


def read_rows(path: Path) -> Integers:
    """Row numbers, also of a mask; see `read_matrix`."""
    found = _load(path, "index set")[1]
    if found is not None and found.dtype.kind == "b":
        return np.flatnonzero(found)
    return whole_numbers(_numbers(path) if found is None else found, f"{path}: row numbers").ravel()


def read_labels(path: Path) -> Integers:
    """Labels of the rows, of all ranks one after the other; see `read_matrix`."""
    found = []
    for part in _parts(path):
        numbers = whole_numbers(_numbers(part), f"{part}: labels")
        if not numbers.size or numbers[0] != numbers.size - 1:
            raise SceneError(f"{part}: expected the number of labels, and then so many labels")
        found.append(numbers[1:])
    return np.concatenate(found)


def parse_rows(text: str, n: int, labels: Integers | None = None) -> dict[str, Integers]:
    """Rows of each field from the words of the command line, see the module.

    Args:
        text: the words.
        n: number of rows.
        labels: of the rows; the numbers in the text are then labels.

    Raises:
        UsageError: it cannot be read.
    """
    found: dict[str, list[Integers]] = {}
    every = np.arange(n if labels is None else labels.max(initial=-1) + 1)
    name = ""
    for word in text.split(","):
        before, _, spec = (part.strip() for part in word.rpartition("="))
        name = field_of(before) or name
        if name and name not in FIELD:
            raise UsageError(f"--rows: unknown field {name!r}; fields are {', '.join(FIELD_NAMES)}; see --fields")
        if not name or not re.fullmatch(r"@.+|-?\d+|-?\d*:-?\d*", spec):
            raise UsageError(
                f"--rows: cannot read {word!r}; expected for example momentum=0:100,mass=100:150,mass=@FILE"
            )
        if spec.startswith("@"):
            ids = read_rows(Path(spec[1:]))
        elif ":" in spec:
            ends = [int(end) if end else None for end in spec.split(":")]
            if any(end is not None and abs(end) > every.size for end in ends):
                raise UsageError(
                    f"--rows: {word!r} goes beyond the {every.size} {'rows' if labels is None else 'labels'}"
                )
            ids = every[slice(*ends)]
        else:
            ids = np.array([int(spec)])
        found.setdefault(name, []).append(ids)
    chosen = {name: np.concatenate(ids) for name, ids in found.items()}
    return chosen if labels is None else {name: np.flatnonzero(np.isin(labels, ids)) for name, ids in chosen.items()}


def _parts(path: Path) -> list[Path]:
    """The files that a name stands for: one, or those of all ranks that have its prefix."""
    prefix = re.sub(f"{OF_A_RANK}$", "", path.name)
    found = [p for p in path.parent.glob("*") if re.fullmatch(re.escape(prefix) + OF_A_RANK, p.name)]
    parts = sorted(found) if found and not (path.exists() and prefix == path.name) else [path]
    for part in parts:
        check_regular(part, "matrix or vector")
    return parts


def _load(path: Path, kind: str) -> tuple[list[Path], Any]:
    """The files that a name stands for; what a library, or PETSc's format, has in the first of them, None if text."""
    parts = _parts(path)
    with parts[0].open("rb") as file:
        head = file.read(16)
    if petsc_binary.is_petsc(head):
        content = petsc_binary.File(path, kind)
        return parts, {"matrix": lambda: content.matrix()[0], "vector": content.vector}.get(kind, content.index_set)()
    if head.startswith(NPY):
        return parts, _read(path, np.load)
    if head.startswith((NPZ, MATRIX_MARKET)):
        try:
            import scipy.io
            import scipy.sparse
        except ModuleNotFoundError as e:
            raise UsageError(f"{path}: to read it, scipy is needed: pip install 'petsc_fs[convert]'") from e
        return parts, _read(path, scipy.sparse.load_npz if head.startswith(NPZ) else scipy.io.mmread)
    return parts, None


def _read(path: Path, read: Callable[[Path], Any]) -> Any:
    """What a library reads from a file, with one line about what it does not like."""
    try:
        return read(path)
    except UNREADABLE as e:
        raise SceneError(f"{path}: cannot be read: {' '.join(str(e).split())}") from e


def _numbers(path: Path) -> Floats:
    """The numbers in a text file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of words that are no numbers
            return np.fromfile(path, sep=" ")
    except (DeprecationWarning, *UNREADABLE) as e:
        raise SceneError(f"{path}: neither a format that is known, nor a text file of numbers") from e


def _ij(parts: list[Path], dimensions: int) -> tuple[int, int, Floats]:
    """First row, number of rows and entries of hypre's files: numbers of row and column, and value, in a line.

    The first line has the first and last row of the rank, and, of a matrix, column.
    """
    entries, ends = [], []
    for part in parts:
        numbers = _numbers(part)
        head, rest = numbers[: 2 * dimensions], numbers[2 * dimensions :]
        if head.size < 2 * dimensions or rest.size % (dimensions + 1):
            raise SceneError(f"{part}: cut short, or not one of hypre's IJ files")
        lines = rest.reshape(-1, dimensions + 1)
        ends.append(whole_numbers(head, f"{part}: first and last row")[:2])
        if not ((ends[-1][0] <= lines[:, 0]) & (lines[:, 0] <= ends[-1][1])).all():
            raise SceneError(f"{part}: a row is outside {ends[-1][0]} to {ends[-1][1]}, which the first line announces")
        entries.append(lines)
    first, last = int(ends[0][0]), int(ends[-1][1])
    if any(after[0] != before[1] + 1 for before, after in itertools.pairwise(ends)):
        raise SceneError(f"{parts[0]}: the rows of its ranks do not follow each other")
    return first, last + 1 - first, np.concatenate(entries)
