"""Systems of other programs become the scene that `Scene.from_matrix` makes of them; junk is named in one line."""

import ctypes
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from petsc4py import PETSc
from sample import SCENES, assert_same, csr, full_scene
from test_petsc_binary import petsc_fs, store

from petsc_fs import fields
from petsc_fs.errors import LayoutError, SceneError, UsageError
from petsc_fs.io import hdf5, matrices, petsc_binary
from petsc_fs.scene import Scene

scipy = pytest.importorskip("scipy")
pytest.importorskip("scipy.io")
pytest.importorskip("scipy.sparse")

CELLS = 20
N = 3 * CELLS
ROWS = f"momentum=0:{2 * CELLS},mass={2 * CELLS}:{N}"


@pytest.fixture
def system() -> tuple[np.ndarray, np.ndarray]:
    """Two displacements and a pressure per cell, displacements first; matrix and right-hand side."""
    rng = np.random.default_rng(1)
    A = rng.standard_normal((N, N)) * (rng.random((N, N)) < 0.2) + 5 * np.eye(N)
    return A, rng.standard_normal(N)


def as_mtx(A, b, folder: Path) -> tuple[str, str]:
    scipy.io.mmwrite(folder / "A.mtx", scipy.sparse.coo_matrix(A), precision=17)
    scipy.io.mmwrite(folder / "b.mtx", b.reshape(-1, 1), precision=17)
    return "A.mtx", "b.mtx"


def as_dense_mtx(A, b, folder: Path) -> tuple[str, str]:
    scipy.io.mmwrite(folder / "A.mtx", A, precision=17)
    scipy.io.mmwrite(folder / "b.mtx", scipy.sparse.coo_matrix(b.reshape(-1, 1)), precision=17)
    return "A.mtx", "b.mtx"


def as_npz(kind: str) -> Callable[..., tuple[str, str]]:
    def write(A, b, folder: Path) -> tuple[str, str]:
        scipy.sparse.save_npz(folder / "A.npz", scipy.sparse.coo_matrix(A).asformat(kind))
        np.save(folder / "b.npy", b)
        return "A.npz", "b.npy"

    return write


def as_npy(A, b, folder: Path) -> tuple[str, str]:
    np.save(folder / "A.npy", A)
    (folder / "b.txt").write_text("\n".join(map(repr, b.tolist())) + "\n")
    return "A.npy", "b.txt"


def aij(A: np.ndarray) -> PETSc.Mat:
    indptr, indices, data = csr(A)
    arrays = (indptr.astype(PETSc.IntType), indices.astype(PETSc.IntType), data)
    return PETSc.Mat().createAIJ(A.shape, csr=arrays, comm=PETSc.COMM_SELF)


def as_petsc(A, b, folder: Path) -> tuple[str, str]:
    store(aij(A), folder / "A.petsc")
    store(PETSc.Vec().createWithArray(b, comm=PETSc.COMM_SELF), folder / "b.petsc")
    return "A.petsc", "b.petsc"


def as_ij(*ends: int, base: int = 0, named: str = "IJ.out.A") -> Callable[..., tuple[str, str]]:
    """As hypre prints them on so many ranks; the diagonal comes first in each row."""

    def write(A, b, folder: Path) -> tuple[str, str]:
        for rank, (start, stop) in enumerate(zip((0, *ends), (*ends, N), strict=True)):
            a, e = start + base, stop - 1 + base
            lines, values = [f"{a} {e} {a} {e}"], [f"{a} {e} "]
            for i in range(start, stop):
                columns = sorted(np.flatnonzero(A[i]), key=lambda j: (j != i, j))
                lines += [f"{i + base} {j + base} {A[i, j]:.17e}" for j in columns]
                values.insert(1, f"{i + base} {b[i]:.17e}")  # in any order
            (folder / f"IJ.out.A.{rank:05}").write_text("\n".join(lines) + "\n")
            (folder / f"IJ.out.b.{rank:05}").write_text("\n".join(values) + "\n")
        return named, "IJ.out.b"

    return write


FORMS = {
    "matrix_market": as_mtx,
    "matrix_market_array": as_dense_mtx,
    **{kind: as_npz(kind) for kind in ("csr", "csc", "coo")},
    "npy_and_text": as_npy,
    "petsc": as_petsc,
    "hypre": as_ij(),
    "hypre_three_ranks": as_ij(20, 33, named="IJ.out.A.00000"),
    "hypre_a_rank_without_rows": as_ij(20, 20),
    "hypre_from_one": as_ij(20, base=1),
}


@pytest.mark.parametrize("order", ["cell", "component"])
@pytest.mark.parametrize("write", FORMS.values(), ids=FORMS)
def test_every_form_gives_the_same_scene(system, tmp_path, write, order):
    A, b = system
    matrix, rhs = (tmp_path / name for name in write(A, b, tmp_path))
    matrices.to_scene(matrix, tmp_path / "a.h5", rhs=rhs, rows=ROWS, dimension=2, order=order)
    rows = {"momentum": range(2 * CELLS), "mass": range(2 * CELLS, N)}
    assert_same(Scene.from_matrix(A, b, rows, dimension=2, order=order), hdf5.read(tmp_path / "a.h5"))


def test_what_hypre_prints_is_read(system, tmp_path):
    hypre = ctypes.CDLL(PETSc.__file__)  # finds the functions of what PETSc is linked to
    if not all(hasattr(hypre, name) for name in ("MatHYPREGetParCSR", "hypre_ParCSRMatrixPrintIJ")):
        pytest.skip("PETSc has no hypre, or hides it")
    mat = aij(system[0]).convert("hypre", PETSc.Mat())
    inner = ctypes.c_void_p()
    assert hypre.MatHYPREGetParCSR(ctypes.c_void_p(mat.handle), ctypes.byref(inner)) == 0
    assert hypre.hypre_ParCSRMatrixPrintIJ(inner, 0, 0, str(tmp_path / "A").encode()) == 0
    found = matrices.read_matrix(tmp_path / "A")
    np.testing.assert_allclose(scipy.sparse.csr_matrix(found[::-1]).toarray(), system[0], rtol=1e-13)


def given(folder: Path, words: str) -> str:
    """Files for the words of `--rows`."""
    (folder / "u.txt").write_text("0 1 2 3\n\n4\n5\n")
    np.save(folder / "p.npy", np.arange(12) >= 6)
    store(PETSc.IS().createGeneral(np.arange(6, 12, dtype=PETSc.IntType), comm=PETSc.COMM_SELF), folder / "p.petsc")
    return words.replace("@", f"@{folder}/")


@pytest.mark.parametrize(
    ("words", "momentum", "mass"),
    [
        ("momentum=0:6,mass=6:12", range(6), range(6, 12)),
        ("momentum=:6,mass=6:", range(6), range(6, 12)),
        ("momentum=0:3,8,4:6, mass = 3,-1,6:8,9:", [0, 1, 2, 8, 4, 5], [3, -1, 6, 7, 9, 10, 11]),
        ("mass=-6:,momentum=:-6", range(6), range(6, 12)),
        ("momentum=@u.txt,mass=@p.npy", range(6), range(6, 12)),
        ("momentum=@u.txt,mass=@p.petsc", range(6), range(6, 12)),
        ("mass=6,momentum=0:6,mass=7:12", range(6), range(6, 12)),
    ],
)
def test_rows_in_words(tmp_path, words, momentum, mass):
    found = matrices.parse_rows(given(tmp_path, words), 12)
    assert {f: ids.tolist() for f, ids in found.items()} == {"momentum": [*momentum], "mass": [*mass]}


def test_rows_by_labels_of_hypre(tmp_path):
    (tmp_path / "dofmap.00000").write_text("5\n0\n1\n3\n0 1\n")
    (tmp_path / "dofmap.00001").write_text("3\n3\n0\n1\n")
    labels = matrices.read_labels(tmp_path / "dofmap")
    assert labels.tolist() == [0, 1, 3, 0, 1, 3, 0, 1]
    found = matrices.parse_rows("momentum=0:2,mass=3", 8, labels)
    assert {f: ids.tolist() for f, ids in found.items()} == {"momentum": [0, 1, 3, 4, 6, 7], "mass": [2, 5]}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("temperature=0:6", "unknown field 'temperature'; fields are contact"),
        ("0:6", "cannot read '0:6'; expected for example momentum=0:100"),
        ("mass=", "cannot read 'mass='"),
        ("mass=all", "cannot read 'mass=all'"),
        ("mass=1.5", "cannot read 'mass=1.5'"),
        ("mass=0:6,", "cannot read ''"),
        ("mass=0:12:0", "cannot read"),
        ("mass=@", "cannot read"),
        ("momentum=0:6,mass=6:13", "'mass=6:13' goes beyond the 12 rows"),
    ],
)
def test_words_that_say_no_rows_are_named(words, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        matrices.parse_rows(words, 12)


def spoil(name: str, change: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / name).write_bytes(change((folder / name).read_bytes()))

    return write


KNOWN_NOT = "neither a format that is known, nor a text file of numbers"
JUNK = {
    "missing_matrix": (as_mtx, lambda folder: (folder / "A.mtx").unlink(), "A.mtx: no such file"),
    "missing_rhs": (as_mtx, lambda folder: (folder / "b.mtx").unlink(), "b.mtx: no such file"),
    "missing_ij": (as_ij(), lambda folder: (folder / "IJ.out.b.00000").unlink(), "IJ.out.b: no such file"),
    "cut_mtx": (as_mtx, spoil("A.mtx", lambda data: data[: len(data) // 2]), "A.mtx: cannot be read: "),
    "mtx_of_words": (as_mtx, spoil("A.mtx", lambda data: data + b"1 1 many\n"), "A.mtx: cannot be read: "),
    "cut_npz": (as_npz("csr"), spoil("A.npz", lambda data: data[: len(data) // 2]), "A.npz: cannot be read: "),
    "cut_npy": (as_npy, spoil("A.npy", lambda data: data[: len(data) // 2]), "A.npy: cannot be read: "),
    "cut_petsc": (as_petsc, spoil("A.petsc", lambda data: data[: len(data) // 2]), "A.petsc: cut short"),
    "petsc_vector": (as_petsc, lambda folder: shutil.copy(folder / "b.petsc", folder / "A.petsc"), "A.petsc: not a"),
    "cut_ij": (as_ij(20), spoil("IJ.out.A.00001", lambda data: data[: data.rindex(b" ")]), "IJ.out.A.00001: cut short"),
    "ij_of_words": (as_ij(), spoil("IJ.out.A.00000", lambda data: data + b"x"), f"IJ.out.A.00000: {KNOWN_NOT}"),
    "ij_row_outside": (as_ij(), spoil("IJ.out.A.00000", lambda data: data + b"60 0 1.0\n"), "a row is outside 0 to 59"),
    "ij_column_outside": (
        as_ij(),
        spoil("IJ.out.A.00000", lambda data: data + b"0 60 1.0\n"),
        "IJ.out.A: matrix: a col",
    ),
    "ij_rank_missing": (as_ij(20, 33), lambda folder: (folder / "IJ.out.A.00001").unlink(), "do not follow each other"),
    "rhs_of_words": (as_npy, spoil("b.txt", lambda data: data + b"none"), f"b.txt: {KNOWN_NOT}"),
    "short_rhs": (as_npy, spoil("b.txt", lambda data: data[: data.rindex(b"\n", 0, -1)]), "A.npy: matrix has 60 rows"),
    "binary_junk": (as_npy, spoil("b.txt", lambda data: bytes(range(256))), f"b.txt: {KNOWN_NOT}"),
    "complex": (as_npy, lambda folder: np.save(folder / "A.npy", np.eye(N) * 1j), "A.npy: matrix is complex"),
    "objects": (as_npy, lambda folder: np.save(folder / "A.npy", np.array([None])), "A.npy: cannot be read: "),
    "a_folder": (as_npy, lambda folder: ((folder / "b.txt").unlink(), (folder / "b.txt").mkdir()), "is a directory"),
}


@pytest.mark.parametrize(("write", "harm", "message"), JUNK.values(), ids=JUNK)
def test_junk_is_named(system, tmp_path, write, harm, message):
    matrix, rhs = (tmp_path / name for name in write(*system, tmp_path))
    harm(tmp_path)
    with pytest.raises(SceneError, match=re.escape(message)) as error:
        matrices.to_scene(matrix, tmp_path / "a.h5", rhs=rhs, rows=ROWS, dimension=2)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "a.h5").exists()


@pytest.mark.parametrize("content", ["3\n0\n1\n", "", "0.5\n"])
def test_labels_must_be_as_many_as_announced(tmp_path, content):
    (tmp_path / "dofmap.00000").write_text(content)
    with pytest.raises(SceneError, match=r"dofmap.00000: "):
        matrices.read_labels(tmp_path / "dofmap")


def test_there_must_be_a_label_for_each_row(system, tmp_path):
    matrix, rhs = (tmp_path / name for name in as_npy(*system, tmp_path))
    (tmp_path / "dofmap.00000").write_text("3\n0\n1\n2\n")
    with pytest.raises(SceneError, match="dofmap: has 3 labels, the matrix has 60 rows"):
        matrices.to_scene(matrix, tmp_path / "a.h5", rhs=rhs, rows=ROWS, dimension=2, dofmap=tmp_path / "dofmap")


def test_scipy_is_asked_for(system, tmp_path, monkeypatch):
    matrix, rhs = (tmp_path / name for name in as_mtx(*system, tmp_path))
    monkeypatch.setitem(sys.modules, "scipy.io", None)
    with pytest.raises(UsageError, match=r"b\.mtx: to read it, scipy is needed: pip install 'petsc_fs\[convert\]'"):
        matrices.to_scene(matrix, tmp_path / "a.h5", rhs=rhs, rows=ROWS, dimension=2)


# Names of the user's own


@pytest.fixture
def aliases(monkeypatch):
    monkeypatch.setattr(fields, "ALIASES", {})
    return fields.learn_aliases


def renamed(target: Path) -> Path:
    """A bundled scene with other names in it."""
    with h5py.File(shutil.copy(SCENES / "biot.h5", target), "r+") as file:
        for ours, theirs in (("momentum", "u"), ("mass", "p")):
            file.move(f"fields/{ours}", f"fields/{theirs}")
            file.move(f"blocks/{ours}", f"blocks/{theirs}")
            for row in file["blocks"].values():
                if ours in row:
                    row.move(ours, theirs)
        file.attrs["fields"] = ["u", "p"]
    return target


def test_scenes_have_names_of_their_own(aliases, tmp_path):
    path = renamed(tmp_path / "theirs.h5")
    with pytest.raises(LayoutError, match=r"unknown field '[up]'; .* see --fields"):
        hdf5.read(path)
    aliases("u=momentum, p=mass")
    assert_same(hdf5.read(SCENES / "biot.h5"), hdf5.read(path))


def test_two_names_for_a_field_are_refused(aliases, tmp_path):
    aliases("u=mass,p=mass")
    with pytest.raises(LayoutError, match="two of p, u are the same field"):
        hdf5.read(renamed(tmp_path / "theirs.h5"))


@pytest.mark.parametrize("words", ["u", "u=", "=mass", "u=temperature", "u=momentum,,p=mass"])
def test_names_of_no_field_are_refused(aliases, words):
    with pytest.raises(UsageError, match=r"--fields: cannot read .*; expected NAME=FIELD"):
        aliases(words)


def test_folders_have_names_of_their_own(aliases, tmp_path):
    full = full_scene()
    hdf5.write(full, tmp_path / "full.h5")
    petsc_binary.from_scene(tmp_path / "full.h5", tmp_path / "petsc")
    (tmp_path / "petsc/fields/mass.petsc").rename(tmp_path / "petsc/fields/p.petsc")
    aliases("p=mass")
    petsc_binary.to_scene(tmp_path / "petsc", tmp_path / "back.h5")
    assert_same(full, hdf5.read(tmp_path / "back.h5"))


# The command line


def test_commands_take_names_of_the_users_own(tmp_path):
    path = renamed(tmp_path / "theirs.h5")
    ours, theirs = petsc_fs("inspect", SCENES / "biot.h5"), petsc_fs("inspect", path, "--fields", "u=momentum,p=mass")
    assert (theirs.returncode, theirs.stderr, theirs.stdout) == (0, "", ours.stdout)
    solved = petsc_fs("solve", path, "--fields", "u=momentum,p=mass")
    assert (solved.returncode, solved.stderr) == (0, "")
    written = petsc_fs("convert", path, tmp_path / "ours.h5", "--fields", "u=momentum,p=mass")
    assert (written.returncode, written.stderr) == (0, "")
    assert_same(hdf5.read(SCENES / "biot.h5"), hdf5.read(tmp_path / "ours.h5"))
    wrong = petsc_fs("solve", path, "--fields", "u=pressure")
    assert (wrong.returncode, wrong.stdout, wrong.stderr.count("\n")) == (2, "", 1)
    assert "--fields: cannot read 'u=pressure'" in wrong.stderr


def test_a_matrix_becomes_a_scene_on_the_command_line(tmp_path):
    matrix, rhs = as_mtx(5 * np.eye(N) - np.eye(N, k=3), np.ones(N), tmp_path)
    words = (tmp_path / matrix, tmp_path / "a.h5", "--rows", "u=0:40,p=40:60", "--fields", "u=momentum,p=mass")
    lacking = petsc_fs("convert", *words)
    assert (lacking.returncode, lacking.stdout, lacking.stderr.count("\n")) == (2, "", 1)
    assert "--rows: a matrix needs --rhs FILE and --dimension 2 or 3 besides" in lacking.stderr
    lacking = petsc_fs("convert", tmp_path / matrix, tmp_path / "a.h5", "--rhs", tmp_path / rhs)
    assert (lacking.returncode, lacking.stdout, lacking.stderr.count("\n")) == (2, "", 1)
    assert "a matrix, which needs --rows FIELD=ROWS,... too" in lacking.stderr
    done = petsc_fs("convert", *words, "--rhs", tmp_path / rhs, "--dimension", 2)
    assert (done.returncode, done.stderr, done.stdout) == (0, "", f"written: {tmp_path / 'a.h5'}\n")
    assert hdf5.read(tmp_path / "a.h5").sizes == {"momentum": 40, "mass": 20}
