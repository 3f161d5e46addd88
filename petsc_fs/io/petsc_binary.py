"""Scenes in PETSc's own binary format, for C and Fortran programs (MatLoad, VecLoad, ISLoad).

FOLDER/matrix.petsc          the Jacobian, one AIJ, fields one after the other
FOLDER/rhs.petsc             right-hand side
FOLDER/reference.petsc       reference solution, if known
FOLDER/fields/NAME.petsc     index set: rows and columns of the field in the matrix
FOLDER/scene.h5              what this format has no place for: cell data, material, units
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from petsc4py import PETSc

from petsc_fs.errors import SceneError, UsageError
from petsc_fs.fields import FIELD_NAMES
from petsc_fs.io import hdf5
from petsc_fs.partition import Layout
from petsc_fs.scene import Scene
from petsc_fs.system import System

MATRIX, RHS, REFERENCE, FIELDS, REST = "matrix.petsc", "rhs.petsc", "reference.petsc", "fields", "scene.h5"


def from_scene(source: Path, folder: Path) -> list[Path]:
    """Write a scene in PETSc's format.

    Args:
        source: scene in HDF5.
        folder: to write; made if missing.

    Returns:
        The files written.

    Raises:
        SceneError: the scene cannot be read.
        UsageError: the folder cannot be written.
    """
    from mpi4py import MPI

    scene = hdf5.read(source)
    try:
        (folder / FIELDS).mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise UsageError(f"{folder}: cannot be made: {e.strerror}") from e
    layout = Layout.contiguous(MPI.COMM_SELF, scene.dimension, scene.sizes)
    system = System(scene, layout, mat_type="aij")
    system.J.setBlockSizes(1, 1)
    for stale in [REFERENCE, *(f"{FIELDS}/{name}.petsc" for name in FIELD_NAMES)]:
        (folder / stale).unlink(missing_ok=True)
    written = [_store(system.J, folder / MATRIX), _store(system.b, folder / RHS)]
    if set(scene.reference) == set(scene.fields):
        system.set_rhs(scene.reference)
        written.append(_store(system.b, folder / REFERENCE))
    start = 0
    for name in scene.fields:
        rows = np.arange(start, start + scene.sizes[name], dtype=PETSc.IntType)
        iset = PETSc.IS().createGeneral(rows, comm=PETSc.COMM_SELF)
        written.append(_store(iset, folder / FIELDS / f"{name}.petsc"))
        start += scene.sizes[name]
    rest = Scene(
        dimension=scene.dimension,
        sizes=scene.sizes,
        blocks={},
        rhs=scene.rhs,
        cell_centers=scene.cell_centers,
        cell_volumes=scene.cell_volumes,
        cell_dimension=scene.cell_dimension,
        contact_state=scene.contact_state,
        material=scene.material,
        metadata=scene.metadata,
    )
    written.append(hdf5.write(rest, folder / REST))
    return written


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
    names = [name for name in FIELD_NAMES if (folder / FIELDS / f"{name}.petsc").exists()]
    if not names:
        raise SceneError(f"{folder}: no {FIELDS}/NAME.petsc there; fields are {', '.join(FIELD_NAMES)}")
    matrix = _load(PETSc.Mat(), folder / MATRIX)
    rhs = _load(PETSc.Vec(), folder / RHS).getArray()
    sets = {name: _load(PETSc.IS(), folder / FIELDS / f"{name}.petsc") for name in names}
    rows = {name: iset.getIndices() for name, iset in sets.items()}
    known: dict[str, Any] = {}
    (n, columns) = matrix.getSize()
    if n != columns or n != rhs.size:
        raise SceneError(f"{folder}: the matrix is {n} x {columns}, the right-hand side has {rhs.size} rows")
    if (folder / REST).exists():
        rest = hdf5.read(folder / REST)
        if dimension not in (None, rest.dimension):
            raise UsageError(f"{folder / REST} has dimension {rest.dimension}, not {dimension}")
        dimension = rest.dimension
        known = {
            "cell_centers": rest.cell_centers,
            "cell_volumes": rest.cell_volumes,
            "cell_dimension": rest.cell_dimension,
            "contact_state": rest.contact_state,
            "material": rest.material,
            "metadata": rest.metadata,
        }
    if dimension is None:
        raise UsageError(f"{folder}: no {REST} there to tell the dimension; say --dimension 2 or 3")
    scene = Scene.from_matrix(_CsrView(matrix), rhs, rows, dimension=dimension, **known)
    if (folder / REFERENCE).exists():
        solution = _load(PETSc.Vec(), folder / REFERENCE).getArray()
        if solution.size != n:
            raise SceneError(f"{folder / REFERENCE}: has {solution.size} rows, the matrix has {n}")
        scene.reference = {name: solution[rows[name]] for name in names}
    return [hdf5.write(scene, target)]


class _CsrView:
    """A sequential AIJ matrix as compressed rows."""

    def __init__(self, matrix: PETSc.Mat) -> None:
        self.indptr, self.indices, self.data = matrix.getValuesCSR()


def _store(thing: PETSc.Object, path: Path) -> Path:
    try:
        viewer = PETSc.Viewer().createBinary(str(path), mode="w", comm=PETSc.COMM_SELF)
        thing.view(viewer)
        viewer.destroy()
    except PETSc.Error as e:
        raise UsageError(f"{path}: cannot be written: PETSc error {e.ierr}") from e
    Path(f"{path}.info").unlink(missing_ok=True)
    return path


def _load(thing: PETSc.Object, path: Path) -> PETSc.Object:
    if not path.is_file():
        raise SceneError(f"{path}: no such file")
    unreadable = f"{path}: not a file in PETSc's binary format, or of another kind than its name says"
    if _promises_too_much(path):
        raise SceneError(unreadable)
    try:
        thing.create(comm=PETSc.COMM_SELF)
        viewer = PETSc.Viewer().createBinary(str(path), mode="r", comm=PETSc.COMM_SELF)
        thing.load(viewer)
        viewer.destroy()
    except PETSc.Error as e:
        raise SceneError(unreadable) from e
    finally:
        for kind in (
            "mat",
            "vec",
        ):  # from NAME.info, which PETSc reads into the database and applies to all that follow
            PETSc.Options().delValue(f"{kind}load_block_size")
    return thing


def _promises_too_much(path: Path) -> bool:
    """Whether the header announces more rows than the file has bytes: PETSc would allocate them first."""
    header = np.fromfile(path, dtype=np.dtype(PETSc.IntType).newbyteorder(">"), count=2)
    return bool(header.size == 2 and header[1] > path.stat().st_size)
