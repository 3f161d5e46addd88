"""The command line as a user meets it: exit codes, one clear line per error, whole files or none.

Commands run in processes of their own, on one rank and on two, with a limit of time: a hang is a failure. Errors on one
rank are provoked in this process.
"""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
import pytest
from sample import SCENES

import petsc_fs
from petsc_fs import options
from petsc_fs.cli.main import main, split_arguments
from petsc_fs.errors import SceneError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.io.bundled import check_targets, find_scene
from petsc_fs.porepy.cases import describe_permeability
from petsc_fs.scene import contact_state_counts

MPIEXEC = Path(petsc_fs.__path__[0]).parent / "scripts" / "mpiexec"
LIMIT = 60
MISSPELT = "-qr_fieldsplit_1_fieldsplit_mechanics_component_pc_hypre_boomeramg_stong_threshold"
ENVIRONMENT = dict(os.environ, OMP_NUM_THREADS="1")
"""As this session was started: MPI has added to what a process below it would get otherwise."""

Done = subprocess.CompletedProcess[str]


def run(*arguments: object, cwd: Path, ranks: int = 1, environment: Mapping[str, str] | None = None) -> Done:
    """`petsc-fs` with these arguments in a folder."""
    command = [sys.executable, "-m", "petsc_fs", *map(str, arguments)]
    if ranks > 1:
        command = [str(MPIEXEC), "-n", str(ranks), *command]
    everything = ENVIRONMENT | dict(environment or {})
    return subprocess.run(
        command, cwd=cwd, env=everything, capture_output=True, text=True, errors="replace", timeout=LIMIT, check=False
    )


@pytest.fixture
def here(tmp_path, clean, monkeypatch, capsys):
    """The working directory, and `petsc-fs` in this process."""
    monkeypatch.chdir(tmp_path)

    def call(arguments: list[str]) -> Done:
        code = main(arguments)
        return Done(arguments, code, *capsys.readouterr())

    return tmp_path, call


def ours(done: Done, ranks: int) -> list[str]:
    """Lines on stderr, without those that mpiexec adds about ranks that exit with an error."""
    lines = done.stderr.splitlines()
    return lines if ranks == 1 else [line for line in lines if "petsc" in line.lower() or "Traceback" in line]


# Scenes and options files that are wrong in one way


@pytest.fixture(scope="module")
def wrong(tmp_path_factory) -> Path:
    """A folder full of them."""
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "text.h5").write_text("fields: mass\n" * 100)
    whole = (SCENES / "flow.h5").read_bytes()
    (folder / "truncated.h5").write_bytes(whole[: len(whole) // 2])
    with edited("flow.h5", folder / "nan.h5") as file:
        file["blocks/mass/mass/data"][5] = np.nan
    with edited("flow.h5", folder / "short.h5") as file:
        replace(file, "fields/mass/rhs", file["fields/mass/rhs"][:-1])
    with edited("contact.h5", folder / "singular.h5") as file:
        zero_diagonal_block(file["blocks/intf_force/intf_force"], cell=17, size=2)
    with edited("flow.h5", folder / "newer.h5") as file:
        file.attrs["encoding-version"] = 2
    (folder / "syntax.opts").write_text("# mine\n-ksp_type gmres\nksp_rtol 1e-8\n")
    (folder / "binary.opts").write_bytes(whole[:500])
    (folder / "self.opts").write_text("-options_file self.opts\n")
    os.mkfifo(folder / "pipe.h5")
    return folder


def edited(name: str, target: Path) -> h5py.File:
    """A copy of a bundled scene, open."""
    return h5py.File(shutil.copy(SCENES / name, target), "r+")


def replace(group: h5py.Group, name: str, values: np.ndarray) -> None:
    del group[name]
    group.create_dataset(name, data=values, compression="gzip", shuffle=True)


def zero_diagonal_block(group: h5py.Group, cell: int, size: int) -> None:
    rows = np.repeat(np.arange(group["indptr"].size - 1), np.diff(group["indptr"]))
    inside = (rows // size == cell) & (group["indices"][:] // size == cell)
    assert inside.sum() == size * size
    replace(group, "data", np.where(inside, 0.0, group["data"]))


FAILURES = {
    "missing_scene": (3, ["solve", "nowhere.h5"], ["nowhere.h5: no such file", "model1.h5"]),
    "scene_is_text": (3, ["solve", "text.h5"], ["text.h5: not an HDF5 file"]),
    "scene_is_a_folder": (3, ["solve", "."], ["is a directory, not a scene"]),
    "truncated_scene": (3, ["solve", "truncated.h5"], ["truncated.h5: the file is truncated"]),
    "newer_scene": (3, ["solve", "newer.h5"], ["written in version 2", "update petsc_fs"]),
    "nan": (3, ["solve", "nan.h5"], ["block (mass, mass): row 0", "not finite"]),
    "short_field": (3, ["solve", "short.h5"], ["mass: rhs has shape (1125,), expected (1126,)"]),
    "singular_D22": (3, ["solve", "singular.h5"], ["D_22, block of intf_force: singular at cell 17"]),
    "inspect_nan": (3, ["inspect", "nan.h5"], ["block (mass, mass): row 0", "not finite"]),
    "options_nan": (3, ["options", "nan.h5"], ["block (mass, mass): row 0", "not finite"]),
    "missing_options_file": (
        2,
        ["solve", "flow.h5", "-options_file", "nowhere.opts"],
        ["options file nowhere.opts: no such file; shipped are", "flow.opts"],
    ),
    "options_file_is_no_text": (
        2,
        ["solve", "flow.h5", "-options_file", "binary.opts"],
        ["options file binary.opts: not readable as text"],
    ),
    "options_file_with_syntax_error": (
        2,
        ["solve", "flow.h5", "-options_file", "syntax.opts"],
        ["syntax.opts:3: 'ksp_rtol' is not an option; options start with '-'"],
    ),
    "options_file_without_name": (2, ["solve", "flow.h5", "-options_file"], ["-options_file without the name"]),
    "options_file_that_includes_itself": (2, ["solve", "flow.h5", "-options_file", "self.opts"], ["includes itself"]),
    "value_that_is_no_number": (
        2,
        ["solve", "flow.h5", "-ksp_rtol", "nan"],
        ["-ksp_rtol nan: expected a number from 0"],
    ),
    "missing_value": (2, ["solve", "-ksp_rtol", "flow.h5"], ["-ksp_rtol without a value"]),
    "stray_word": (2, ["solve", "flow.h5", "-ksp_rtol", "1e-10", "5"], ["unrecognized arguments: 5"]),
    "equals": (2, ["solve", "flow.h5", "-ksp_rtol=1e-3"], ["-ksp_rtol=1e-3: a space, no '='"]),
    "options_file_for_other_fields": (
        2,
        ["solve", "flow.h5", "-options_file", "poromechanics.opts"],
        ["poromechanics.opts is for scenes with the fields momentum, mass; this one has intf_flow, mass"],
    ),
    "misspelt_option": (
        2,
        ["solve", "model1.h5", MISSPELT, "0.7"],
        [f"option {MISSPELT} from the command line was not used; did you mean {MISSPELT.replace('stong', 'strong')}"],
    ),
    "misspelt_own_option": (
        2,
        ["solve", "model1.h5", "-qr_sidee", "left"],
        ["option -qr_sidee from the command line was not used; did you mean -qr_side?"],
    ),
    "impossible_value": (
        2,
        ["solve", "flow.h5", "-petsc_fs_partition", "foo"],
        ["-petsc_fs_partition foo: expected auto or "],
    ),
    "wrong_subcommand": (2, ["slove", "flow.h5"], ["invalid choice: 'slove' (choose from "]),
    "no_scene": (2, ["solve"], ["the following arguments are required: SCENE"]),
    "petsc_option_elsewhere": (2, ["inspect", "flow.h5", "-ksp_view"], ["-ksp_view: PETSc options go with solve"]),
    "report_into_missing_folder": (
        2,
        ["solve", "flow.h5", "--report", "nowhere/report.json"],
        ["nowhere/report.json: the folder", "does not exist"],
    ),
    "save_over_a_folder": (2, ["solve", "flow.h5", "--save", "folder"], ["folder: cannot be written: it is a folder"]),
    "pipe": (3, ["solve", "pipe.h5"], ["pipe.h5: a pipe or device, not a scene"]),
}


ON_TWO_RANKS = (
    *("missing_scene", "truncated_scene", "nan", "short_field", "singular_D22", "inspect_nan"),
    *("missing_options_file", "options_file_with_syntax_error", "options_file_for_other_fields", "misspelt_option"),
    *("wrong_subcommand", "report_into_missing_folder", "save_over_a_folder", "options_nan", "misspelt_own_option"),
    *("value_that_is_no_number", "stray_word"),
)
CASES = [(name, 1) for name in FAILURES] + [(name, 2) for name in ON_TWO_RANKS]


@pytest.mark.parametrize(("name", "ranks"), CASES, ids=[f"{name}-{ranks}" for name, ranks in CASES])
def test_an_error_is_one_clear_line_and_leaves_no_file(wrong, here, name, ranks):
    tmp_path, call = here
    code, arguments, fragments = FAILURES[name]
    for word in arguments:
        if (wrong / word).is_file() or (wrong / word).is_fifo():
            (tmp_path / word).symlink_to(wrong / word)
    (tmp_path / "folder").mkdir()
    before = sorted(p.name for p in tmp_path.rglob("*"))
    if arguments[0] == "solve" and len(arguments) > 1:
        extra = {"--report": "report.json", "--save": "solution.h5"}
        order = [w for k, v in extra.items() if k not in arguments for w in (k, v)]
        arguments = ["solve", *order, *arguments[1:]] if "folder" not in arguments else arguments
    done = run(*arguments, cwd=tmp_path, ranks=ranks) if ranks > 1 else call(arguments)
    lines = ours(done, ranks)
    assert [line.startswith("petsc-fs: ") for line in lines] == [True], done.stderr
    assert all(text in lines[0] for text in fragments), lines[0]
    assert (done.returncode, done.stdout) == (code, "")
    assert sorted(p.name for p in tmp_path.rglob("*")) == before


def test_several_unused_options_are_all_named(tmp_path):
    done = run("solve", "flow.h5", "-ksp_rtoll", "1e-3", "-zzzzzzzz", cwd=tmp_path)
    assert done.returncode == 2
    first, *others = done.stderr.splitlines()
    assert first == "petsc-fs: 2 options were not used:"
    assert len(others) == 2
    assert others[0].startswith("  option -ksp_rtoll from the command line was not used; did you mean -ksp_rtol ")
    assert others[1] == "  option -zzzzzzzz from the command line was not used"


@pytest.mark.parametrize("ranks", [1, 2], ids=["1_rank", "2_ranks"])
def test_a_solve_that_stops_early_is_reported_and_exits_1(tmp_path, ranks):
    done = run("solve", "biot.h5", "-ksp_max_it", 2, "--report", "r.json", cwd=tmp_path, ranks=ranks)
    assert (done.returncode, ours(done, ranks)) == (1, [])
    assert "not converged" in done.stdout.lower()
    report = json.loads((tmp_path / "r.json").read_text())
    assert (report["converged"], report["iterations"], report["reason"]) == (False, 2, "DIVERGED_MAX_IT")
    assert report["true_relative_residual"] > report["tolerance"]


def test_the_preconditioner_alone_is_judged_like_any_solver(here):
    _, call = here
    done = call(["solve", "flow.h5", "-ksp_type", "preonly", "--report", "r.json"])
    report = json.loads(Path("r.json").read_text())
    assert (done.returncode, report["converged"], report["iterations"]) == (1, False, 1)
    assert report["true_relative_residual"] > report["tolerance"]
    assert "not converged" in done.stdout.lower()


@pytest.mark.parametrize("ranks", [1, 2], ids=["1_rank", "2_ranks"])
def test_the_report_says_what_was_done_and_how_well(tmp_path, ranks):
    arguments = ["-options_file", "contact_poromechanics.opts", "-ksp_max_it", 80]
    done = run("solve", "--report", "r.json", "model1.h5", *arguments, cwd=tmp_path, ranks=ranks)
    assert (done.returncode, done.stderr) == (0, "")
    assert [p.name for p in tmp_path.iterdir()] == ["r.json"]
    report = json.loads((tmp_path / "r.json").read_text())
    scene = hdf5.read(SCENES / "model1.h5")
    assert report["scene"] == "model1.h5"
    assert report["fields"] == scene.sizes
    assert (report["ranks"], report["dimension"]) == (ranks, 2)
    assert (report["converged"], report["reason"][:9]) == (True, "CONVERGED")
    assert isinstance(report["iterations"], int)
    assert 5 < report["iterations"] < 30
    assert 0 < report["true_relative_residual"] < 1e-8
    assert max(report["backward_error_by_field"].values()) <= report["field_tolerance"]
    for what in ("residual_by_field", "error_by_field"):
        assert list(report[what]) == list(scene.fields)
        assert all(isinstance(v, float) for v in report[what].values())
    squares = sum(v**2 for v in report["residual_by_field"].values())
    assert np.sqrt(squares) == pytest.approx(report["true_relative_residual"])
    for what in ("read_seconds", "setup_seconds", "solve_seconds"):
        assert 0 < report[what] < LIMIT
    assert report["options_file"] == "contact_poromechanics.opts"
    shipped = options.parse(options.shipped_folder() / "contact_poromechanics.opts")
    assert report["options"] == {**shipped, "ksp_max_it": "80"}
    assert report["left_out"] == []
    assert {"petsc_fs", "petsc", "hdf5", "python", "numpy"} <= set(report["versions"])
    assert f"{report['iterations']} iterations" in done.stdout
    assert report["verdict"] in " ".join(done.stdout.split())
    assert done.stdout.isascii()
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert all(f in done.stdout for f in scene.fields)


@pytest.mark.parametrize("ranks", [1, 2], ids=["1_rank", "2_ranks"])
def test_the_saved_solution_is_the_reference(tmp_path, ranks):
    done = run("solve", "contact.h5", "--save", "x.h5", "-ksp_rtol", 1e-11, cwd=tmp_path, ranks=ranks)
    assert (done.returncode, done.stderr) == (0, "")
    assert [p.name for p in tmp_path.iterdir()] == ["x.h5"]
    scene = hdf5.read(SCENES / "contact.h5")
    with h5py.File(tmp_path / "x.h5") as file:
        assert set(file) == set(scene.fields)
        for f, reference in scene.reference.items():
            assert np.linalg.norm(file[f] - reference) < 1e-6 * np.linalg.norm(reference)


def test_a_file_in_the_way_is_replaced_whole(tmp_path):
    (tmp_path / "r.json").write_text("x" * 100000)
    assert run("solve", "flow.h5", "--report", "r.json", cwd=tmp_path).returncode == 0
    assert json.loads((tmp_path / "r.json").read_text())["scene"] == "flow.h5"


def test_own_options_files_are_taken_beside_shipped_ones(tmp_path):
    (tmp_path / "mine.opts").write_text("-ksp_rtol 1e-3\n")
    arguments = ["-options_file", "flow.opts", "-options_file", "mine.opts", "--report", "r.json"]
    assert run("solve", "flow.h5", *arguments, cwd=tmp_path).returncode == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert (report["options"]["ksp_rtol"], report["tolerance"]) == ("1e-3", 1e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--help"], ["solve", "inspect", "convert", "export", "two dashes"]),
        (["solve", "-h"], ["--report", "--save", "-options_file", "exit codes: 0 ", "1 not converged", "3 a scene"]),
        (["inspect", "--help"], ["SCENE", "--plot"]),
        (["convert", "--help"], ["SOURCE", "TARGET", "matrix.petsc", "--dimension"]),
        (["export", "--help"], ["--steps", "--out"]),
    ],
    ids=["main", "solve", "inspect", "convert", "export"],
)
def test_help_names_what_there_is(tmp_path, arguments, words):
    done = run(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    text = " ".join(done.stdout.split())
    assert [word for word in words if word not in text] == []


def test_help_is_printed_once(tmp_path):
    done = run("--help", cwd=tmp_path, ranks=2)
    assert (done.returncode, done.stdout.count("usage: ")) == (0, 1)


@pytest.mark.parametrize("ranks", [1, 2], ids=["1_rank", "2_ranks"])
def test_inspect_shows_fields_and_contact_states_once(tmp_path, ranks):
    done = run("inspect", "model2.h5", cwd=tmp_path, ranks=ranks)
    assert (done.returncode, done.stderr) == (0, "")
    scene = hdf5.read(SCENES / "model2.h5")
    rows = [line.split() for line in done.stdout.splitlines()]
    assert max(map(len, done.stdout.splitlines())) <= 80
    for f, size in scene.sizes.items():
        assert sum(row[:1] == [f] and f"{size:,}" in row for row in rows) >= 1
        entries = [f"{scene.blocks[f, c].data.size:,}" if (f, c) in scene.blocks else "." for c in scene.fields]
        assert [f, *entries] in rows
    states = ", ".join(f"{n} {state}" for state, n in contact_state_counts(scene.contact_state).items())
    assert done.stdout.count(f"contact states: {states}\n") == 1
    assert "kg = 1e+10" in done.stdout
    assert "porepy 1.11" in done.stdout
    assert "fracture permeability: 1 m^2 as in the published code, not the cubic law\n" in done.stdout


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ("model1", "not the cubic law"),
        ("model2 (refinement=2, fracture_permeability=cubic)", r"the cubic law, aperture\^2"),
        ("model1 (friction=0.1, physics=restricted)", "that of the rock"),
        ("contact (refinement=2)|biot|mine", "^$"),
    ],
)
def test_scenes_of_models_tell_the_permeability_of_fractures(model, words):
    for name in model.split("|"):
        assert re.search(words, describe_permeability(name))


@pytest.mark.parametrize("words", [["inspect", "flow.h5"], ["solve", "flow.h5", "-ksp_monitor"], ["--help"]], ids=str)
def test_output_that_nobody_reads_ends_with_a_line(tmp_path, words):
    process = subprocess.Popen(
        [sys.executable, "-m", "petsc_fs", *words],
        cwd=tmp_path,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    process.stdout.close()
    errors = process.stderr.read()
    assert (errors, process.wait(LIMIT)) == ("petsc-fs: standard output was closed before all was written\n", 141)


BROKEN_PCS = """
import sys
import numpy as np

class Value:
    def setUp(self, pc): raise ValueError("two\\nlines")

class Apply:
    def apply(self, pc, x, y): raise ValueError("in apply")

class Exit:
    def setUp(self, pc): sys.exit(0)

class Memory:
    def setUp(self, pc): self.much = np.empty(2**45)

class OneRank:
    def apply(self, pc, x, y):
        if pc.comm.rank == pc.comm.size - 1: raise ValueError("here only")
        pc.comm.tompi4py().barrier()
"""


@pytest.mark.parametrize("ranks", [1, 2], ids=["1_rank", "2_ranks"])
@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("Value", "ValueError: two lines"),
        ("Apply", "ValueError: in apply"),
        ("Exit", "SystemExit: 0"),
        ("Memory", "out of memory: Unable to allocate"),
        ("OneRank", "ValueError: here only"),
    ],
)
def test_a_python_pc_that_fails_is_one_clear_line(tmp_path, kind, expected, ranks):
    (tmp_path / "broken_pcs.py").write_text(BROKEN_PCS)
    options = ["-pc_type", "python", "-pc_python_type", f"broken_pcs.{kind}"]
    done = run("solve", "flow.h5", *options, cwd=tmp_path, ranks=ranks)
    errors = done.stderr.replace("\0", "")  # Open MPI 5 ends its own texts so
    lines = [line for line in errors.splitlines() if line.startswith("petsc-fs: ")]
    assert [expected in line for line in lines] == [True], done.stderr
    assert "Traceback" not in done.stderr
    assert (done.returncode, done.stdout) == (1, "")


def test_options_of_other_programs_in_the_environment_are_only_told(tmp_path):
    environment = {"PETSC_OPTIONS": "-snes_monitor -mat_type aij"}
    done = run("solve", "flow.h5", cwd=tmp_path, environment=environment)
    assert done.returncode == 0
    assert done.stderr.startswith("petsc-fs: warning: 2 options were not used:\n  option -mat_type from PETSC_OPTIONS")
    done = run("solve", "flow.h5", "-snes_monitor", cwd=tmp_path, environment=environment)
    assert done.returncode == 2
    assert done.stderr == "petsc-fs: option -snes_monitor from the command line was not used\n"
    assert run("solve", "flow.h5", cwd=tmp_path, environment={"PETSC_OPTIONS": "-ksp_rtol nan"}).returncode == 2


def test_the_petscrc_of_a_folder_is_read_only_where_it_is_asked_for(tmp_path):
    (tmp_path / ".petscrc").write_text("-ksp_max_it 1\n")
    assert run("solve", "flow.h5", cwd=tmp_path).returncode == 0
    assert run("solve", "flow.h5", "--petscrc", cwd=tmp_path).returncode == 1


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_any_terminal_will_do(tmp_path, encoding):
    (tmp_path / "größe 中.h5").symlink_to(SCENES / "flow.h5")
    words = [["solve", "größe 中.h5"], ["inspect", "model1.h5", "--contraction"]]
    for done in (run(*w, cwd=tmp_path, environment={"PYTHONIOENCODING": encoding}) for w in words):
        assert (done.returncode, done.stderr) == (0, "")


def test_a_decimal_comma_of_the_program_does_not_matter(tmp_path):
    program = "import locale; locale.setlocale(locale.LC_ALL, ''); from petsc_fs.cli.main import main; "
    program += "assert main(['solve', 'flow.h5']) == 0; assert locale.localeconv()['decimal_point'] == '.'"
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=ENVIRONMENT, check=True, timeout=LIMIT)


needs_matplotlib = pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="no matplotlib")


@needs_matplotlib
def test_inspect_draws_a_picture(tmp_path):
    done = run("inspect", "contact.h5", "--plot", "blocks.svg", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.endswith("block structure drawn in blocks.svg\n")
    texts = set(re.findall("<!-- (.*) -->", (tmp_path / "blocks.svg").read_text(encoding="utf-8")))
    legend = {"empty", "block of $J$", "block that the step changes", "singular block", "entry of $J$"}
    assert texts > legend | {"1 contact", "3 momentum", "$J_{23}$"}


@needs_matplotlib
@pytest.mark.parametrize("target", ["blocks.nonsense", "nowhere/blocks.png"])
def test_a_picture_that_cannot_be_drawn_is_an_error(tmp_path, target):
    done = run("inspect", "flow.h5", "--plot", target, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith(f"petsc-fs: {target}: {'the folder' if '/' in target else 'cannot be drawn: '}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["convert", "export"])
def test_commands_for_one_rank_say_so(tmp_path, command):
    arguments = ["flow.h5", "folder"] if command == "convert" else ["model1"]
    done = run(command, *arguments, cwd=tmp_path, ranks=2)
    assert done.returncode == 2
    assert len(ours(done, 2)) == 1
    assert f"petsc-fs: {command} runs on one rank" in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(importlib.util.find_spec("porepy") is not None, reason="PorePy is installed")
def test_export_without_porepy_says_how_to_get_it(tmp_path):
    done = run("export", "model1", "--out", "scenes", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("petsc-fs: ")
    assert "pip install" in done.stderr
    assert list(tmp_path.iterdir()) == []


# In this process


@pytest.mark.parametrize(
    ("words", "own", "petsc"),
    [
        ("solve a.h5", "solve a.h5", ""),
        ("solve a.h5 -ksp_view -ksp_rtol 1e-3", "solve a.h5", "-ksp_view -ksp_rtol 1e-3"),
        ("solve a.h5 -s -1 -2.5e3 x --save b.h5", "solve a.h5 -2.5e3 x --save b.h5", "-s -1"),
        ("solve -ksp_view a.h5", "solve a.h5", "-ksp_view"),
        ("solve -ksp_view hdf5:a.h5 a.h5", "solve a.h5", "-ksp_view hdf5:a.h5"),
        ("solve a.h5 -options_file b.h5 -petsc_fs_retry c.h5", "solve a.h5", "-options_file b.h5 -petsc_fs_retry c.h5"),
        ("solve -ksp_rtol 1e-3 a.h5", "solve a.h5", "-ksp_rtol 1e-3"),
        ("solve a.h5 -info -inf", "solve a.h5", "-info -inf"),
        ("solve --save b.h5 a.h5 -k", "solve --save b.h5 a.h5", "-k"),
        ("solve -k 3 --report=r.json", "solve --report=r.json", "-k 3"),
        ("solve -k 3 -h", "solve -h", "-k 3"),
    ],
)
def test_one_dash_is_petscs_and_two_are_ours(words, own, petsc):
    assert split_arguments(words.split()) == (own.split(), petsc.split())


def test_a_scene_is_found_by_path_or_by_bundled_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_scene("flow.h5") == SCENES / "flow.h5"
    assert find_scene("model2_run.h5") == SCENES.parent / "sequences" / "model2_run.h5"
    assert find_scene(str(SCENES / "flow.h5")) == SCENES / "flow.h5"
    Path("flow.h5").write_text("mine")
    assert find_scene("flow.h5") == Path("flow.h5")
    with pytest.raises(SceneError, match=r"nowhere/flow\.h5: no such file; bundled scenes are biot\.h5, "):
        find_scene("nowhere/flow.h5")


def test_an_existing_scene_of_any_name_is_no_value(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine").symlink_to(SCENES / "flow.h5")
    Path("lu").write_text("no scene")
    assert split_arguments(["solve", "-ksp_view", "mine"]) == (["solve", "mine"], ["-ksp_view"])
    assert split_arguments(["solve", "-pc_type", "lu"]) == (["solve"], ["-pc_type", "lu"])


def test_nothing_that_is_read_or_asked_for_twice_is_written_over(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene, link = Path("scene.h5"), Path("link.h5")
    scene.write_text("")
    link.symlink_to(scene)
    check_targets(None, Path("a"), tmp_path / "b", link.parent / "scene.json", sources=[scene])
    for targets, message in (
        ((scene,), "scene.h5: cannot be written: it is what is read, and would be lost"),
        ((link,), "link.h5: cannot be written: it is what is read, and would be lost"),
        ((Path("a"), None, tmp_path / "a"), "a: cannot be written: it is asked for twice"),
        ((Path("nowhere/a"),), "nowhere/a: the folder .* does not exist"),
        ((tmp_path,), "cannot be written: it is a folder"),
        ((Path("x" * 256),), "cannot be written: it has too long a name"),
        *(((Path(name),), "pipe or device") for name in ("/dev/null", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1")),
    ):
        with pytest.raises(UsageError, match=message):
            check_targets(*targets, sources=[scene])
