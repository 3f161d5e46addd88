"""`petsc-fs lint`: shipped files pass; each way of writing a wrong one has its own message.

Every file is checked in a process of its own, as the options database of PETSc is one per process.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from petsc_fs import options

ENVIRONMENT = dict(os.environ, OMP_NUM_THREADS="1")
LIMIT = 60
GOOD = (options.shipped_folder() / "contact_poromechanics.opts").read_text()
POROMECHANICS = (options.shipped_folder() / "poromechanics.opts").read_text()


def lint(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "petsc_fs", "lint", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=LIMIT, check=False)


@pytest.mark.parametrize("file", options.shipped(), ids=lambda f: f.path.stem)
def test_shipped_file_passes(tmp_path, file):
    done = lint(file.path, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == f"{file.path}: nothing to complain about\n"


def edited(text: str, old: str, new: str) -> str:
    """The text with one place changed."""
    assert text.count(old) >= 1
    return text.replace(old, new, 1)


AMG = "-pc_hypre_type boomeramg\n"
MECHANICS = "qr_fieldsplit_1_fieldsplit_mechanics_"
BROKEN = {
    "no_dash": (edited(GOOD, "-ksp_rtol", "ksp_rtol"), ["mine.opts:", "'ksp_rtol' is not an option"]),
    "push_without_pop": (GOOD + "-prefix_push more_\n", ["mine.opts: 1 -prefix_push without a -prefix_pop"]),
    "pop_without_push": (GOOD + "-prefix_pop\n", ["mine.opts:", "-prefix_pop without a -prefix_push before it"]),
    "misspelt_option": (
        edited(GOOD, AMG, f"{AMG}      -pc_hypre_boomeramg_stong_threshold 0.7\n"),
        [
            f"option -{MECHANICS}pc_hypre_boomeramg_stong_threshold from mine.opts was not used; "
            f"did you mean -{MECHANICS}pc_hypre_boomeramg_strong_threshold"
        ],
    ),
    "misspelt_value": (
        edited(GOOD, "-pc_type hypre\n", "-pc_type hyper\n"),
        ["mine.opts: ", "PETSc refuses", "Unable to find requested PC type hyper"],
    ),
    "no_number": (
        edited(GOOD, "-ksp_rtol 1e-10", "-ksp_rtol abc"),
        ["mine.opts: -ksp_rtol abc: expected a number from 0 to below 1"],
    ),
    "no_ksp_type": (
        edited(GOOD, "-ksp_type preonly\n      -pc_type hypre", "-pc_type hypre"),
        [f"level -{MECHANICS} has no ksp_type; PETSc would take GMRES: name it"],
    ),
    "no_pc_type": (
        edited(GOOD, "    -pc_type pbjacobi\n", ""),
        ["level -qr_fieldsplit_contact_ has no pc_type; PETSc would take ILU or block Jacobi: name it"],
    ),
    "no_such_split": (
        edited(GOOD, "-prefix_push fieldsplit_mass_", "-prefix_push fieldsplit_pressure_"),
        ["no split has the prefix -qr_fieldsplit_1_fieldsplit_1_fs_fieldsplit_pressure_"],
    ),
    "field_number_out_of_range": (
        edited(POROMECHANICS, "-pc_fieldsplit_1_fields 1", "-pc_fieldsplit_1_fields 7"),
        ["mine.opts", "7"],
    ),
    "field_in_no_split": (
        edited(GOOD, "-pc_fieldsplit_1_fields 1,2,3", "-pc_fieldsplit_1_fields 1,2"),
        ["mine.opts: the solver cannot be set up"],
    ),
    "wrong_transformation": (edited(GOOD, "-qr_side right", "-qr_side rigth"), ["-qr_side rigth: expected right or"]),
    "wrong_fixed_stress": (
        edited(POROMECHANICS, "  -fs_pc_type", "  -fs_type analitic\n  -fs_pc_type"),
        ["-fieldsplit_mass_fs_type analitic: expected analytic or algebraic"],
    ),
    "wrong_partition": ("-petsc_fs_partition nested\n", ["-petsc_fs_partition nested: expected auto or "]),
    "no_text": (b"\x89HDF\xff\xfe\x00", ["mine.opts: not readable as text"]),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_broken_file_is_told_what_is_wrong(tmp_path, kind):
    text, expected = BROKEN[kind]
    (tmp_path / "mine.opts").write_bytes(text if isinstance(text, bytes) else text.encode())
    done = lint("mine.opts", cwd=tmp_path)
    assert done.returncode == 2, done.stdout
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) <= 5, done.stderr
    for part in expected:
        assert part in done.stderr


def test_several_mistakes_are_told_together(tmp_path):
    text = edited(GOOD, "    -pc_type pbjacobi\n", "") + "-my_option 1\n-ksp_rtoll 1e-3\n"
    (tmp_path / "mine.opts").write_text(text)
    lines = lint("mine.opts", cwd=tmp_path).stderr.splitlines()
    assert len(lines) == 3
    assert "no pc_type" in lines[0]
    assert "-ksp_rtoll from mine.opts was not used; did you mean -ksp_rtol" in lines[1]
    assert "-my_option from mine.opts was not used" in lines[2]


def test_file_for_another_scene_is_refused(tmp_path):
    done = lint("poromechanics.opts", "flow.h5", cwd=tmp_path)
    assert done.returncode == 2
    assert "none of the scenes has the fields momentum, mass" in done.stderr


def test_header_with_fields_that_no_scene_has(tmp_path):
    (tmp_path / "mine.opts").write_text("# mine\n# fields: contact mass\n-ksp_type gmres\n")
    done = lint("mine.opts", cwd=tmp_path)
    assert done.returncode == 2
    assert "none of the scenes has the fields contact, mass; name one" in done.stderr


@pytest.mark.parametrize("name", ["nowhere.opts", "secret.opts", "."])
def test_file_that_cannot_be_read(tmp_path, name):
    if name == "secret.opts":
        (tmp_path / name).write_text("")
        (tmp_path / name).chmod(0)
        if os.access(tmp_path / name, os.R_OK):
            pytest.skip("this user may read everything")
    done = lint(name, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert name in done.stderr


def test_idle_option_that_is_allowed_passes(tmp_path):
    (tmp_path / "mine.opts").write_text(GOOD + "-my_option 1\n-petsc_fs_allow_unused my_*\n")
    assert lint("mine.opts", cwd=tmp_path).returncode == 0
