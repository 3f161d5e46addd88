"""Other builds of PETSc and MPI that are on this machine: what they solve, and what is refused in a line.

Debian's are found by themselves; PETSC_FS_DOLFINX_PYTHON names a Python with DOLFINx's wheels and h5py.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from petsc4py import PETSc
from programs import ENVIRONMENT, MPIEXEC, ROOT
from sample import SCENES

import petsc_fs
from petsc_fs import petsc_errors
from petsc_fs.errors import UsageError
from petsc_fs.io import hdf5

IN_USE = Path(PETSc.__file__).parents[2]
OTHERS = [p for p in sorted(Path("/usr/lib/petscdir").glob("petsc*[0-9].*/*/lib/python3/dist-packages")) if p != IN_USE]
PAGE = (ROOT / "docs" / "builds.md").read_text(encoding="utf-8")
LIMIT = 120
SOLVE = ["-m", "petsc_fs", "solve", "flow.h5"]


def run(*command: str, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A command, with petsc4py from another place."""
    paths = [str(path)] if path else []
    environment = ENVIRONMENT | {"PYTHONPATH": os.pathsep.join([*paths, ENVIRONMENT["PYTHONPATH"]])}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT, check=False)


def iterations(python: str, path: Path | None = None, ranks: int = 1) -> list[int]:
    """Of the bundled scenes, all of which have converged; those of the page are held against them."""
    start = [] if ranks == 1 else [str(MPIEXEC), "-n", str(ranks)]
    done = run(*start, python, str(ROOT / "tests" / "iterations.py"), path=path)
    assert done.returncode == 0, done.stderr
    build, _, _, *counts = done.stdout.strip("|\n ").split("|")
    row = rf"^\| {re.escape(build.split()[0])}{'[^|]*no hypre' * ('no hypre' in build)}[^|]*\| {ranks} \|(.*)\|$"
    for said in re.findall(row, PAGE, re.MULTILINE):
        assert np.array(said.split("|"), int) == pytest.approx(np.array(counts, int), abs=2)
    return [int(count) for count in counts]


def test_iterations_are_those_of_the_page():
    for ranks in (1, 2):
        assert len(iterations(sys.executable, ranks=ranks)) == len(list(SCENES.glob("*.h5")))


def in_words(paths: list[Path]) -> list[str]:
    return ["-".join(p.parts[4:6]) for p in paths]


REAL = [p for p in OTHERS if "complex" not in p.parts[5]]
COMPLEX = [p for p in OTHERS if "complex" in p.parts[5]]


@pytest.mark.parametrize("ranks", [1, 2])
@pytest.mark.parametrize("path", REAL, ids=in_words(REAL))
def test_integers_of_64_bits_change_nothing(path, ranks):
    assert iterations(sys.executable, path, ranks) == iterations(sys.executable, ranks=ranks)


@pytest.mark.skipif(not OTHERS, reason="no other PETSc of Debian's")
def test_set_up_has_chosen_the_plain_one():
    assert (np.dtype(PETSc.ScalarType), np.dtype(PETSc.IntType)) == (np.float64, np.int32)


@pytest.mark.parametrize("path", COMPLEX, ids=in_words(COMPLEX))
def test_complex_numbers_are_refused_in_a_line(path):
    for words in (SOLVE, [*SOLVE, "-pc_type", "jacobi"], ["-m", "petsc_fs", "options", "flow.h5"]):
        done = run(sys.executable, *words, path=path)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        assert done.stderr.startswith("petsc-fs: this PETSc is built for complex numbers")


def test_a_solver_refuses_complex_numbers(monkeypatch):
    scene = hdf5.read(SCENES / "flow.h5")
    monkeypatch.setattr(petsc_errors, "PETSc", SimpleNamespace(ScalarType=np.complex128))
    with pytest.raises(UsageError, match="built for complex numbers, and petsc_fs needs one for real numbers"):
        petsc_fs.Solver(scene)


@pytest.mark.parametrize("name", petsc_errors.LAUNCHERS)
def test_ranks_that_do_not_see_each_other_are_refused(monkeypatch, name):
    monkeypatch.setenv(name, "1")
    petsc_errors.check_build()
    monkeypatch.setenv(name, "2")
    with pytest.raises(UsageError, match=rf"mpiexec has started 2 ranks \({name}\), each of which is alone: it is not"):
        petsc_errors.check_build()


@pytest.mark.skipif(not shutil.which("mpiexec.mpich"), reason="no MPICH beside Open MPI")
def test_the_mpiexec_of_another_mpi_is_refused():
    done = run("mpiexec.mpich", "-n", "2", sys.executable, *SOLVE)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("petsc-fs: mpiexec has started 2 ranks (PMI_SIZE), each of which is alone") == 2


def test_the_scripts_mpiexec_does_not_start_itself(tmp_path):
    (tmp_path / "mpiexec").write_text(MPIEXEC.read_text())
    (tmp_path / "mpiexec").chmod(0o755)
    tools = tmp_path / "tools"
    tools.mkdir()
    for tool in ("bash", "env", "sed", "dirname", "realpath"):
        (tools / tool).symlink_to(shutil.which(tool))
    for more, code in ((os.environ["PATH"], 0), (tools, 2)):
        environment = {name: value for name, value in ENVIRONMENT.items() if name != "MPIEXEC"}
        environment["PATH"] = f"{tmp_path}{os.pathsep}{more}"
        done = subprocess.run(
            ["mpiexec", "--version"], env=environment, capture_output=True, text=True, timeout=LIMIT, check=False
        )
        assert (done.returncode, "found no mpiexec" in done.stderr) == (code, code == 2)


def test_a_file_with_hypre_says_what_else_there_is(monkeypatch):
    error = PETSc.Error(86)
    monkeypatch.setattr(PETSc.Error, "__str__", lambda _: "error code 86\n[0] Unable to find requested PC type hypre")
    assert petsc_errors.brief(error).endswith("PC type hypre")
    monkeypatch.setattr(PETSc, "Sys", SimpleNamespace(hasExternalPackage=lambda name: name != "hypre"))
    assert petsc_errors.brief(error).endswith("this PETSc has no hypre: take a file that ends in _gamg.opts, or none")


WHEEL = os.environ.get("PETSC_FS_DOLFINX_PYTHON", "")


@pytest.mark.skipif(not WHEEL, reason="PETSC_FS_DOLFINX_PYTHON names no Python")
def test_dolfinx_wheels_solve_without_hypre():
    assert len(iterations(WHEEL)) == len(list(SCENES.glob("*.h5")))
