"""Scenes in PETSc's binary format: there and back, from matrices of any numbering, and from C."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from petsc4py import PETSc
from sample import SCENES, assert_same, csr, dense, full_scene

from petsc_fs.errors import LayoutError, SceneError, UsageError
from petsc_fs.io import hdf5, petsc_binary
from petsc_fs.scene import Scene

BUNDLED = sorted(p.stem for p in SCENES.glob("*.h5") if p.stem != "model3")
FILES = ("matrix.petsc", "rhs.petsc", "reference.petsc", "fields/mass.petsc")


def load(thing: PETSc.Object, path: Path) -> PETSc.Object:
    thing.create(comm=PETSc.COMM_SELF)
    viewer = PETSc.Viewer().createBinary(str(path), "r", comm=PETSc.COMM_SELF)
    thing.load(viewer)
    viewer.destroy()
    return thing


def store(thing: PETSc.Object, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    viewer = PETSc.Viewer().createBinary(str(path), "w", comm=PETSc.COMM_SELF)
    thing.view(viewer)
    viewer.destroy()


def store_by_hand(folder: Path, A: np.ndarray, b: np.ndarray, sets: dict[str, np.ndarray]) -> None:
    """A folder as a C program would write it: any numbering, no scene.h5."""
    matrix = PETSc.Mat().createAIJ(A.shape, nnz=A.shape[1], comm=PETSc.COMM_SELF)
    for i, j in np.argwhere(A):
        matrix.setValue(i, j, A[i, j])
    matrix.assemble()
    store(matrix, folder / "matrix.petsc")
    store(PETSc.Vec().createWithArray(b, comm=PETSc.COMM_SELF), folder / "rhs.petsc")
    for name, numbers in sets.items():
        iset = PETSc.IS().createGeneral(numbers.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        store(iset, folder / f"fields/{name}.petsc")


@pytest.fixture
def folder(tmp_path) -> Path:
    """A full scene in PETSc's format."""
    petsc_binary.from_scene(hdf5.write(full_scene(), tmp_path / "full.h5"), tmp_path / "petsc")
    return tmp_path / "petsc"


@pytest.mark.parametrize("name", BUNDLED)
def test_there_and_back_is_the_identity(tmp_path, name):
    written = petsc_binary.from_scene(SCENES / f"{name}.h5", tmp_path / "petsc")
    assert {p for p in (tmp_path / "petsc").rglob("*") if p.is_file()} == set(written)
    assert petsc_binary.to_scene(tmp_path / "petsc", tmp_path / "back.h5") == [tmp_path / "back.h5"]
    assert_same(hdf5.read(SCENES / f"{name}.h5"), hdf5.read(tmp_path / "back.h5"))


def test_everything_a_scene_has_survives(folder, tmp_path):
    petsc_binary.to_scene(folder, tmp_path / "back.h5")
    assert_same(full_scene(), hdf5.read(tmp_path / "back.h5"))


@pytest.mark.parametrize("name", ["model1", "flow"])
def test_petsc_loads_the_same_system(tmp_path, name):
    petsc_binary.from_scene(SCENES / f"{name}.h5", tmp_path)
    scene = hdf5.read(SCENES / f"{name}.h5")
    J, b, x = load(PETSc.Mat(), tmp_path / FILES[0]), load(PETSc.Vec(), tmp_path / FILES[1]), PETSc.Vec()
    load(x, tmp_path / FILES[2])
    product = J.createVecLeft()
    J.mult(x, product)
    sets = {f: load(PETSc.IS(), tmp_path / f"fields/{f}.petsc").getIndices() for f in scene.fields}
    assert sorted(np.concatenate(list(sets.values()))) == list(range(J.getSize()[0]))
    for f in scene.fields:
        np.testing.assert_array_equal(b.getArray()[sets[f]], scene.rhs[f])
        np.testing.assert_array_equal(x.getArray()[sets[f]], scene.reference[f])
        expected = np.zeros(scene.sizes[f])
        size = np.zeros(scene.sizes[f])
        for (r, c), (indptr, indices, data) in scene.blocks.items():
            if r == f:
                terms = data * scene.reference[c][indices]
                rows = np.repeat(np.arange(indptr.size - 1), np.diff(indptr))
                expected += np.bincount(rows, terms, minlength=expected.size)
                size += np.bincount(rows, abs(terms), minlength=expected.size)
        np.testing.assert_array_less(abs(product.getArray()[sets[f]] - expected), 1e-13 * size + 1e-300)


@pytest.mark.parametrize("seed", range(3))
def test_index_sets_may_come_in_any_order_and_interleaved(tmp_path, seed):
    rng = np.random.default_rng(seed)
    A, b = full_scene(seed=seed), np.zeros(0)
    n = sum(A.sizes.values())
    matrix, b = np.zeros((n, n)), np.zeros(n)
    place = rng.permutation(n)
    matrix[np.ix_(place, place)] = dense(A)
    b[place] = np.concatenate([A.rhs[f] for f in A.fields])
    sets = dict(zip(A.fields, np.split(place, np.cumsum([A.sizes[f] for f in A.fields])[:-1]), strict=True))
    store_by_hand(tmp_path / "petsc", matrix, b, sets)
    petsc_binary.to_scene(tmp_path / "petsc", tmp_path / "back.h5", dimension=2)
    back = hdf5.read(tmp_path / "back.h5")
    assert (back.sizes, back.dimension, back.reference, back.material) == (A.sizes, 2, {}, None)
    np.testing.assert_array_equal(dense(back), dense(A))
    for f in A.fields:
        np.testing.assert_array_equal(back.rhs[f], A.rhs[f])


def test_block_size_of_a_matrix_from_elsewhere_does_not_matter(tmp_path):
    """PETSc notes it in matrix.petsc.info, and puts it into the options database when it loads."""
    matrix = PETSc.Mat().createAIJ((6, 6), bsize=2, nnz=6, comm=PETSc.COMM_SELF)
    matrix.setDiagonal(PETSc.Vec().createWithArray(np.arange(1.0, 7), comm=PETSc.COMM_SELF))
    matrix.assemble()
    store_by_hand(tmp_path, np.eye(6), np.ones(6), {"mass": np.arange(3), "intf_flow": np.arange(3, 6)})
    store(matrix, tmp_path / "matrix.petsc")
    assert (tmp_path / "matrix.petsc.info").exists()
    petsc_binary.to_scene(tmp_path, tmp_path / "back.h5", dimension=3)
    assert hdf5.read(tmp_path / "back.h5").blocks["mass", "mass"].data.tolist() == [1, 2, 3]


def test_a_folder_is_replaced_by_another_scene(folder, tmp_path):
    scene = full_scene(cells={"intf_flow": 3, "mass": 6})
    scene.reference = {}
    petsc_binary.from_scene(hdf5.write(scene, tmp_path / "flow.h5"), folder)
    petsc_binary.to_scene(folder, tmp_path / "back.h5")
    assert_same(scene, hdf5.read(tmp_path / "back.h5"))


def test_the_dimension_must_be_known(folder, tmp_path):
    with pytest.raises(UsageError, match="has dimension 2, not 3"):
        petsc_binary.to_scene(folder, tmp_path / "back.h5", dimension=3)
    (folder / "scene.h5").unlink()
    with pytest.raises(UsageError, match=r"no scene\.h5 there to tell the dimension; say --dimension 2 or 3"):
        petsc_binary.to_scene(folder, tmp_path / "back.h5")
    petsc_binary.to_scene(folder, tmp_path / "back.h5", dimension=2)
    assert hdf5.read(tmp_path / "back.h5").dimension == 2
    with pytest.raises(LayoutError, match="not a multiple of block size 3"):
        petsc_binary.to_scene(folder, tmp_path / "back.h5", dimension=3)


@pytest.mark.parametrize("name", ["matrix.petsc", "rhs.petsc"])
def test_a_missing_file_is_named(folder, tmp_path, name):
    (folder / name).unlink()
    with pytest.raises(SceneError, match=f"{name}: no such file"):
        petsc_binary.to_scene(folder, tmp_path / "back.h5")
    assert not (tmp_path / "back.h5").exists()


def test_a_field_without_index_set_leaves_rows_without_field(folder, tmp_path):
    (folder / "scene.h5").unlink()
    (folder / "fields/mass.petsc").unlink()
    with pytest.raises(LayoutError, match="6 rows belong to no field, the first is 25"):
        petsc_binary.to_scene(folder, tmp_path / "back.h5", dimension=2)


def test_a_folder_without_index_sets_says_which_there_could_be(folder, tmp_path):
    shutil.rmtree(folder / "fields")
    with pytest.raises(SceneError, match=r"no fields/NAME\.petsc there; fields are contact, intf_force"):
        petsc_binary.to_scene(folder, tmp_path / "back.h5")


NOT_PETSC, CUT = "not a file in PETSc's binary format, or of another kind", "cut short, or damaged"
JUNK = {
    "text": (lambda data, other: b"hello\n" * 50, NOT_PETSC),
    "empty": (lambda data, other: b"", NOT_PETSC),
    "header_only": (lambda data, other: data[:8], CUT),
    "cut_in_half": (lambda data, other: data[: len(data) // 2], CUT),
    "last_byte_missing": (lambda data, other: data[:-1], CUT),
    "more_at_the_end": (lambda data, other: data + b"\0" * 12, CUT),
    "random": (lambda data, other: np.random.default_rng(0).bytes(400), NOT_PETSC),
    "other_kind": (lambda data, other: other, NOT_PETSC),
    "two_thousand_million_rows": (lambda data, other: with_first(data, 2**31 - 16), CUT),
    "negative_length": (lambda data, other: with_first(data, -16), CUT),
}


def with_first(data: bytes, number: int) -> bytes:
    """Another number after the one that tells the kind."""
    width = np.dtype(PETSc.IntType).itemsize
    return data[:width] + np.array(number, f">i{width}").tobytes() + data[2 * width :]


@pytest.mark.parametrize(("make", "message"), JUNK.values(), ids=JUNK)
@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_not_petscs_is_named(folder, tmp_path, name, make, message):
    other = folder / ("matrix.petsc" if name != "matrix.petsc" else "rhs.petsc")
    (folder / name).write_bytes(make((folder / name).read_bytes(), other.read_bytes()))
    with pytest.raises(SceneError, match=f"{name}: {message}") as error:
        petsc_binary.to_scene(folder, tmp_path / "back.h5")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "back.h5").exists()


def test_a_fifo_is_refused_at_once(folder, tmp_path):
    (folder / "rhs.petsc").unlink()
    os.mkfifo(folder / "rhs.petsc")
    with pytest.raises(SceneError, match=r"rhs\.petsc: is a device, FIFO or socket"):
        petsc_binary.to_scene(folder, tmp_path / "back.h5")


def store_raw(
    folder: Path, scene: Scene, integer: str = ">i4", number: str = ">f8", dense_matrix: bool = False
) -> None:
    """A folder as PETSc writes it that was built for other integers and numbers."""

    def raw(name: str, *parts: object) -> None:
        kinds = [np.asarray(part).astype(integer if np.asarray(part).dtype.kind == "i" else number) for part in parts]
        (folder / name).write_bytes(b"".join(part.tobytes() for part in kinds))

    A, n, start = dense(scene), sum(scene.sizes.values()), 0
    (folder / "fields").mkdir(parents=True)
    block = csr(A)
    if dense_matrix:
        raw("matrix.petsc", [1211216, n, n, -1], A)
    else:
        raw("matrix.petsc", [1211216, n, n, block.data.size], np.diff(block.indptr), block.indices, block.data)
    raw("rhs.petsc", [1211214, n], np.concatenate([scene.rhs[f] for f in scene.fields]))
    for f in scene.fields:
        raw(f"fields/{f}.petsc", [1211218, scene.sizes[f]], np.arange(start, start + scene.sizes[f]))
        start += scene.sizes[f]


@pytest.mark.parametrize("dense_matrix", [False, True], ids=["aij", "dense"])
@pytest.mark.parametrize("number", [">f8", "<f8", ">f4"])
@pytest.mark.parametrize("integer", [">i4", ">i8", "<i4"])
def test_folders_of_other_builds_of_petsc_are_read(tmp_path, integer, number, dense_matrix):
    scene = full_scene()
    store_raw(tmp_path / "petsc", scene, integer, integer[0] + number[1:], dense_matrix)
    petsc_binary.to_scene(tmp_path / "petsc", tmp_path / "back.h5", dimension=2)
    back = hdf5.read(tmp_path / "back.h5")
    kind = np.float32 if number == ">f4" else np.float64
    np.testing.assert_array_equal(dense(back), dense(scene).astype(kind))
    for f in scene.fields:
        np.testing.assert_array_equal(back.rhs[f], scene.rhs[f].astype(kind))


@pytest.mark.parametrize("integer", [">i4", ">i8"])
@pytest.mark.parametrize("only", ["matrix.petsc", "rhs.petsc"])
def test_complex_numbers_are_named(tmp_path, integer, only):
    store_raw(tmp_path / "complex", full_scene(), integer, ">c16")
    store_raw(tmp_path / "petsc", full_scene(), integer)
    shutil.copy(tmp_path / "complex" / only, tmp_path / "petsc")
    with pytest.raises(SceneError, match=f"{only}: numbers of 16 bytes, as a PETSc for complex scalars writes them"):
        petsc_binary.to_scene(tmp_path / "petsc", tmp_path / "back.h5", dimension=2)


def test_what_follows_in_the_file_of_the_matrix_does_not_matter(folder, tmp_path):
    matrix = folder / "matrix.petsc"
    matrix.write_bytes(matrix.read_bytes() + (folder / "rhs.petsc").read_bytes())
    petsc_binary.to_scene(folder, tmp_path / "back.h5")
    assert_same(full_scene(), hdf5.read(tmp_path / "back.h5"))


@pytest.mark.parametrize("name", ["rhs.petsc", "reference.petsc"])
def test_vectors_must_be_as_long_as_the_matrix(folder, tmp_path, name):
    store(PETSc.Vec().createWithArray(np.ones(5), comm=PETSc.COMM_SELF), folder / name)
    with pytest.raises(SceneError, match="5 rows"):
        petsc_binary.to_scene(folder, tmp_path / "back.h5")


@pytest.mark.parametrize("numbers", [np.arange(20, 26), np.arange(26, 32), -np.arange(6)], ids=["twice", "far", "neg"])
def test_index_sets_must_name_each_row_once(folder, tmp_path, numbers):
    iset = PETSc.IS().createGeneral(numbers.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
    store(iset, folder / "fields/mass.petsc")
    with pytest.raises(LayoutError, match=r"mass: a row (is listed twice|number is outside)"):
        petsc_binary.to_scene(folder, tmp_path / "back.h5")


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match="file: cannot be made"):
        petsc_binary.from_scene(SCENES / "flow.h5", tmp_path / "file")


def petsc_fs(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "petsc_fs", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, env=dict(os.environ), check=False)


def test_convert_both_ways_on_the_command_line(tmp_path):
    there = petsc_fs("convert", "flow.h5", tmp_path / "petsc")
    assert (there.returncode, there.stderr) == (0, "")
    assert all(name in there.stdout for name in (*FILES, "fields/intf_flow.petsc", "scene.h5"))
    (tmp_path / "petsc/scene.h5").unlink()
    lost = petsc_fs("convert", tmp_path / "petsc", tmp_path / "back.h5")
    assert (lost.returncode, lost.stdout, lost.stderr.count("\n")) == (2, "", 1)
    assert "say --dimension 2 or 3" in lost.stderr
    back = petsc_fs("convert", tmp_path / "petsc", tmp_path / "back.h5", "--dimension", 2)
    assert (back.returncode, back.stderr, back.stdout) == (0, "", f"written: {tmp_path / 'back.h5'}\n")
    scene, original = hdf5.read(tmp_path / "back.h5"), hdf5.read(SCENES / "flow.h5")
    assert set(scene.blocks) == set(original.blocks)
    np.testing.assert_array_equal(scene.blocks["mass", "mass"].data, original.blocks["mass", "mass"].data)


C_PROGRAM = r"""
#include <petscmat.h>
int main(int argc, char **argv) {
  PetscViewer viewer; Mat A; Vec b; IS rows; PetscInt i, n; PetscReal norm;
  PetscCall(PetscInitialize(&argc, &argv, NULL, NULL));
  PetscCall(PetscViewerBinaryOpen(PETSC_COMM_SELF, "matrix.petsc", FILE_MODE_READ, &viewer));
  PetscCall(MatCreate(PETSC_COMM_SELF, &A));
  PetscCall(MatLoad(A, viewer));
  PetscCall(PetscViewerDestroy(&viewer));
  PetscCall(MatNorm(A, NORM_FROBENIUS, &norm));
  PetscCall(PetscPrintf(PETSC_COMM_SELF, "matrix %.15e\n", (double)norm));
  PetscCall(PetscViewerBinaryOpen(PETSC_COMM_SELF, "rhs.petsc", FILE_MODE_READ, &viewer));
  PetscCall(VecCreate(PETSC_COMM_SELF, &b));
  PetscCall(VecLoad(b, viewer));
  PetscCall(PetscViewerDestroy(&viewer));
  for (i = 1; i < argc; i++) {
    char path[256]; Mat block; Vec part;
    PetscCall(PetscSNPrintf(path, sizeof(path), "fields/%s.petsc", argv[i]));
    PetscCall(PetscViewerBinaryOpen(PETSC_COMM_SELF, path, FILE_MODE_READ, &viewer));
    PetscCall(ISCreate(PETSC_COMM_SELF, &rows));
    PetscCall(ISLoad(rows, viewer));
    PetscCall(PetscViewerDestroy(&viewer));
    PetscCall(ISGetLocalSize(rows, &n));
    PetscCall(MatCreateSubMatrix(A, rows, rows, MAT_INITIAL_MATRIX, &block));
    PetscCall(MatNorm(block, NORM_FROBENIUS, &norm));
    PetscCall(PetscPrintf(PETSC_COMM_SELF, "%s %d %.15e", argv[i], (int)n, (double)norm));
    PetscCall(VecGetSubVector(b, rows, &part));
    PetscCall(VecNorm(part, NORM_2, &norm));
    PetscCall(PetscPrintf(PETSC_COMM_SELF, " %.15e\n", (double)norm));
  }
  return PetscFinalize();
}
"""


def compiler_flags() -> tuple[str, list[str]]:
    """MPI's C compiler and PETSc's flags, or skip."""
    cc = shutil.which("mpicc")
    if cc is None or shutil.which("pkg-config") is None:
        pytest.skip("no mpicc or no pkg-config")
    for name in ("petsc", "PETSc"):
        found = subprocess.run(["pkg-config", "--cflags", "--libs", name], capture_output=True, text=True, check=False)
        if found.returncode == 0:
            return cc, found.stdout.split()
    pytest.skip("pkg-config knows no PETSc")


@pytest.mark.skipif(np.dtype(PETSc.IntType).itemsize != 4, reason="pkg-config's PETSc has integers of 32 bits")
def test_a_c_program_loads_the_folder(tmp_path):
    cc, flags = compiler_flags()
    (tmp_path / "load.c").write_text(C_PROGRAM)
    subprocess.run([cc, "load.c", "-o", "load", *flags], cwd=tmp_path, check=True, timeout=60)
    petsc_binary.from_scene(SCENES / "model1.h5", tmp_path)
    scene = hdf5.read(SCENES / "model1.h5")
    done = subprocess.run(
        ["./load", *scene.fields],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        env=dict(os.environ),
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    lines = [line.split() for line in done.stdout.splitlines()]
    entries = np.concatenate([block.data for block in scene.blocks.values()])
    assert lines[0][0] == "matrix"
    assert float(lines[0][1]) == pytest.approx(np.linalg.norm(entries), rel=1e-12)
    assert [line[0] for line in lines[1:]] == list(scene.fields)
    for name, size, block_norm, rhs_norm in lines[1:]:
        assert int(size) == scene.sizes[name]
        assert float(block_norm) == pytest.approx(np.linalg.norm(scene.blocks[name, name].data), rel=1e-12)
        assert float(rhs_norm) == pytest.approx(np.linalg.norm(scene.rhs[name]), rel=1e-12)
