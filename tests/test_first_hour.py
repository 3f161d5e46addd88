"""What meets somebody new: short texts of objects, tables for 80 columns, options explained, one default everywhere."""

import ast
import importlib
import json
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from common import NAMES, Layout, load
from programs import ENVIRONMENT, MPIEXEC, ROOT

from petsc_fs.cli import manual
from petsc_fs.porepy.forcing import EisenstatWalkerParameters
from petsc_fs.solver import Solver

PAGE = ROOT / "docs" / "options.md"
SOURCES = sorted((ROOT / "petsc_fs").rglob("*.py"))
ASK = ("getString", "getReal", "getInt", "getBool", "choice", "text", "number", "_option")


def petsc_fs(*words: str, folder: Path, ranks: int = 1, code: int = 0) -> str:
    """Standard output of the command line in a terminal of 80 columns."""
    start = [str(MPIEXEC), "-n", str(ranks)] if ranks > 1 else []
    done = subprocess.run(
        [*start, sys.executable, "-m", "petsc_fs", *words],
        cwd=folder,
        env=ENVIRONMENT | {"COLUMNS": "80"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == code, done.stderr
    return done.stdout


# Objects


def test_texts_of_objects_are_one_short_line():
    scene = load("model2")
    solver = Solver(scene)
    result = solver.solve()
    layout = Layout.contiguous(solver.layout.comm, 2, scene.sizes)
    half = scene.restrict(
        {f: (0, scene.block_size(f) * (n // scene.block_size(f) // 2)) for f, n in scene.sizes.items()}
    )
    for thing in (scene, half, solver, layout, result):
        assert len(repr(thing)) < 300
        assert "\n" not in repr(thing)
    for thing in (scene, half, solver, layout):
        assert "momentum 2,136" in repr(thing)
    assert "part of one rank" in repr(half)
    assert "part of one rank" not in repr(scene)
    assert "contact_poromechanics_fast.opts" in repr(solver)
    assert f"converged: residual {result.true_relative_residual:.2e}" in repr(result)
    assert f"{result.iterations} iterations" in repr(result)
    solver.destroy()


def test_a_solver_by_the_database_says_so(database):
    database("flow.opts")
    assert "options of the database" in repr(Solver(load("flow")))


@pytest.mark.parametrize("name", NAMES)
def test_a_solver_without_options_is_that_of_the_command_line(tmp_path, name):
    petsc_fs("solve", f"{name}.h5", "--report", "report.json", folder=tmp_path)
    report = json.loads((tmp_path / "report.json").read_text())
    solver = Solver(load(name))
    assert f"by {report['options_file']} for" in repr(solver)
    assert solver.solve().iterations == report["iterations"]
    solver.destroy()


# Tables and help

COMMANDS = ("solve", "inspect", "compare", "sweep", "stress", "run", "export", "options", "lint", "convert")


@pytest.mark.parametrize(
    "words",
    [
        "inspect model3.h5",
        "inspect model2_run.h5",
        "inspect model3.h5 --contraction",
        "solve model1.h5",
        "solve model1.h5 -options_file direct.opts",
        "solve model2_run.h5",
        "compare flow.h5 model1.h5 --base direct.opts --repeat 1 --options contact_poromechanics_direct.opts",
        "compare flow.h5 --rtol 1e-4..1e-8:2 --repeat 1 --out out",
        "stress --only base --files direct.opts",
        "stress --list",
    ],
)
def test_tables_are_for_80_columns(tmp_path, words):
    lines = petsc_fs(*words.split(), folder=tmp_path).splitlines()
    assert lines
    assert [line for line in lines if len(line) > 80] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_help_is_for_80_columns_and_has_our_options_where_they_go(tmp_path, command):
    found = petsc_fs(command, "--help", folder=tmp_path)
    usage, _, rest = found.partition("\n\n")
    assert usage.startswith(f"usage: petsc-fs {command} ")
    assert [line for line in rest.splitlines() if len(line) > 80] == []
    assert (manual.text() in found) == (command in ("solve", "compare", "stress", "run"))


def test_help_with_one_dash(tmp_path):
    """Without a scene that of the command; with one, our options and what PETSc says of the solver at hand."""
    assert petsc_fs("-help", folder=tmp_path) == petsc_fs("--help", folder=tmp_path)
    assert petsc_fs("solve", "-help", folder=tmp_path) == petsc_fs("solve", "--help", folder=tmp_path)
    found = petsc_fs("solve", "flow.h5", "-help", folder=tmp_path, ranks=2)
    assert found.count(manual.text()) == 1
    assert "-ksp_gmres_restart" in found
    assert "converged: residual" in found


# Options of this package


def asked_for() -> dict[str, object]:
    """Options that the package asks PETSc for by a name in its source, with the default where that is a constant."""
    found = {}
    for path in (path for path in SOURCES if path.parent.name != "tools"):  # whose options are all argparse's
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call):
                continue
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            words = [a for a in node.args if not (isinstance(a, ast.Name) and a.id == "pc")]
            if name not in ASK or not words or not isinstance(words[0], ast.Constant):
                continue
            if words[0].value.startswith(("ksp_", "pc_")):  # PETSc's own
                continue
            try:
                code = compile(ast.Expression(words[1]), str(path), "eval")
                default = eval(code, vars(importlib.import_module(module)))
            except (NameError, IndexError):
                default = None
            found[words[0].value] = default[0] if isinstance(default, tuple) else default
    return found


def test_the_page_of_options_is_up_to_date():
    made = subprocess.run(
        [sys.executable, "-m", "petsc_fs.cli.manual"], env=ENVIRONMENT, capture_output=True, text=True, check=True
    ).stdout
    assert made == PAGE.read_text(), "python -m petsc_fs.cli.manual >docs/options.md"


def test_every_option_that_is_asked_for_is_explained_with_its_default():
    explained = {option.name: option for option in manual.own_options()}
    asked = asked_for()
    assert {"petsc_fs_retry", "petsc_fs_on_failure", "qr_side", "fs_damping", "component_order"} <= set(asked)
    assert [name for name in asked if name not in explained] == []
    constant = {name: default for name, default in asked.items() if default is not None}
    assert {name: explained[name].default for name in constant} == {n: str(d) for n, d in constant.items()}
    for f in fields(EisenstatWalkerParameters):
        assert explained[f"petsc_fs_ew_{f.name}"].default == f"{f.default:g}"


def test_every_option_that_is_explained_is_there():
    source = "".join(path.read_text() for path in SOURCES)
    names = {o.name for o in manual.own_options() if "*" not in o.name and "_ew_" not in o.name}
    assert len(names) > 10
    assert [name for name in names if f'"{name}"' not in source] == []


def test_an_entry_of_another_form_is_refused():
    with pytest.raises(ValueError, match="is not of the form"):
        manual._option("here", "-petsc_fs_new a|b: what")


def test_values_of_choices_are_those_of_the_code():
    from petsc_fs import partition
    from petsc_fs.pc import component_sweep
    from petsc_fs.porepy import solver

    values = {option.name: tuple(option.values.split(", ")) for option in manual.own_options()}
    assert values["petsc_fs_partition"] == partition.KINDS
    assert values["petsc_fs_ordering"] == partition.ORDERINGS
    assert values["petsc_fs_on_failure"] == solver.ON_FAILURE
    assert values["petsc_fs_forcing"] == solver.FORCING
    assert values["component_order"] == component_sweep.ORDERS
