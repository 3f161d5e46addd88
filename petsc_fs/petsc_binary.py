"""Scenes in PETSc's own binary format, for C and Fortran programs (MatLoad, VecLoad, ISLoad).

    FOLDER/matrix.petsc          the Jacobian, one AIJ, fields one after the other
    FOLDER/rhs.petsc             right-hand side
    FOLDER/reference.petsc       reference solution, if known
    FOLDER/fields/NAME.petsc     index set: rows and columns of the field in the matrix, with block size
    FOLDER/scene.h5              what this format has no place for: cell data, material, units
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from petsc4py import PETSc

from petsc_fs import hdf5
from petsc_fs.errors import SceneError, UsageError
from petsc_fs.fields import FIELD, FIELD_NAMES
from petsc_fs.layout import Layout
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
    written = [_store(system.J, folder / MATRIX), _store(system.b, folder / RHS)]
    if set(scene.reference) == set(scene.fields):
        system.set_rhs(scene.reference)
        written.append(_store(system.b, folder / REFERENCE))
    start = 0
    for name in scene.fields:
        iset = PETSc.IS().createStride(scene.sizes[name], start, 1, comm=PETSc.COMM_SELF)
        general = PETSc.IS().createGeneral(iset.getIndices(), comm=PETSc.COMM_SELF)
        general.setBlockSize(scene.block_size(name))
        written.append(_store(general, folder / FIELDS / f"{name}.petsc"))
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


def to_scene(folder: Path, target: Path) -> list[Path]:
    """Write a scene from a folder in PETSc's format; index sets may be in any order and interleaved.

    Args:
        folder: as `from_scene` writes it; reference.petsc and scene.h5 may be missing.
        target: scene in HDF5.

    Raises:
        SceneError: a file is missing or not PETSc's, or the parts do not fit together.
    """
    names = [name for name in FIELD_NAMES if (folder / FIELDS / f"{name}.petsc").exists()]
    if not names:
        raise SceneError(f"{folder}: no {FIELDS}/NAME.petsc there; fields are {', '.join(FIELD_NAMES)}")
    matrix = _load(PETSc.Mat(), folder / MATRIX)
    rhs = _load(PETSc.Vec(), folder / RHS).getArray()
    sets = {name: _load(PETSc.IS(), folder / FIELDS / f"{name}.petsc") for name in names}
    rows = {name: np.array(iset.getIndices()) for name, iset in sets.items()}
    known = {}
    vectors = [name for name in names if FIELD[name].vector]
    dimension = sets[vectors[0]].getBlockSize() if vectors else 3
    if (folder / REST).exists():
        rest = hdf5.read(folder / REST)
        dimension = rest.dimension
        known = {
            "cell_centers": rest.cell_centers,
            "cell_volumes": rest.cell_volumes,
            "cell_dimension": rest.cell_dimension,
            "contact_state": rest.contact_state,
            "material": rest.material,
            "metadata": rest.metadata,
        }
    if (folder / REFERENCE).exists():
        solution = _load(PETSc.Vec(), folder / REFERENCE).getArray()
        known["reference"] = {name: solution[rows[name]] for name in names}
    (n, columns) = matrix.getSize()
    if n != columns or n != rhs.size:
        raise SceneError(f"{folder}: the matrix is {n} x {columns}, the right-hand side has {rhs.size} rows")
    scene = Scene.from_matrix(_CsrView(matrix), rhs, rows, dimension=dimension, **known)
    return [hdf5.write(scene, target)]


class _CsrView:
    """A sequential AIJ matrix as compressed rows."""

    def __init__(self, matrix: PETSc.Mat) -> None:
        self.indptr, self.indices, self.data = matrix.getValuesCSR()


def _store(thing: PETSc.Object, path: Path) -> Path:
    viewer = PETSc.Viewer().createBinary(str(path), mode="w", comm=PETSc.COMM_SELF)
    thing.view(viewer)
    viewer.destroy()
    Path(f"{path}.info").unlink(missing_ok=True) if not isinstance(thing, PETSc.IS) else None
    return path


def _load(thing: PETSc.Object, path: Path) -> PETSc.Object:
    if not path.is_file():
        raise SceneError(f"{path}: no such file")
    try:
        thing.create(comm=PETSc.COMM_SELF)
        viewer = PETSc.Viewer().createBinary(str(path), mode="r", comm=PETSc.COMM_SELF)
        thing.load(viewer)
        viewer.destroy()
    except PETSc.Error as e:
        raise SceneError(f"{path}: not a file in PETSc's binary format, or of another kind than its name says") from e
    return thing
