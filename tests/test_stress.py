"""Extreme scenes: the catalogue, what counts as right, that units change no answer, that no field can hide."""

import json

import h5py
import numpy as np
import pytest
from broken import BAD, Broken, Damage, attempt, inputs
from hypothesis import example, given, settings
from mpi4py import MPI
from sample import CELLS, SCENES, full_scene

from petsc_fs import options
from petsc_fs.cli import main as cli
from petsc_fs.errors import SceneError
from petsc_fs.io import hdf5
from petsc_fs.solver import Solver
from petsc_fs.tools import reference, stress
from petsc_fs.tools.measure import EMPTY
from petsc_fs.tools.stress_cases import (
    HELD_OUT,
    RECIPES,
    catalogue,
    held_out,
    in_units,
    load,
    scaled,
    unknowns_in_units,
    with_block_of_cell,
)

CASES = {case.name: case for case in catalogue()}
UNIT_SYSTEMS = ({}, {"m": 1e-3}, {"s": 3600.0}, {"kg": 1e10, "m": 1e-3, "s": 3600.0})
comm = MPI.COMM_WORLD


def solve(scene, **more):
    """By the default solver, with further options: the result, and the whole solution on all ranks."""
    with options.inserted(more):
        solver = Solver(scene, comm)
        result = solver.solve()
        whole = comm.bcast(solver.system.gather(result.solution))
        solver.destroy()
    return result, whole


def worst_error(scene, solution):
    """Of all fields, against a reference."""
    exact = reference.solve(scene, "direct").solution
    return max(reference.forward_error(scene, exact, solution)[1].values())


def test_the_catalogue_has_enough_cases_and_says_what_is_hard():
    assert len(CASES) >= 80
    assert len(CASES) == len(catalogue())
    assert all(case.hard and case.source for case in CASES.values())
    assert sum(c.quick for c in CASES.values()) >= 20


@pytest.mark.parametrize("name", [*RECIPES, *HELD_OUT])
def test_exported_scenes_fit_together(name):
    load(name).validate()


@pytest.mark.mpi
@pytest.mark.parametrize("units", UNIT_SYSTEMS, ids=str)
@pytest.mark.parametrize("name", ["base", "cold2"])
def test_units_change_neither_answer_nor_accuracy(name, units):
    """The same answer, field by field, in four unit systems: what is left is what the tolerance leaves."""
    scene = load(name) if name == "base" else hdf5.read(SCENES / f"{name}.h5")
    exact, known = solve(scene, ksp_rtol="1e-13", ksp_atol="0")
    changed = in_units(scene, **units)
    assert changed.metadata.units == {"kg": 1.0, "m": 1.0, "s": 1.0} | units
    result, solution = solve(changed)
    assert exact.converged and result.converged
    for f, factor in unknowns_in_units(scene, **units).items():
        assert np.linalg.norm(solution[f] / factor - known[f]) < 1e-7 * np.linalg.norm(known[f]), f


@pytest.mark.parametrize("name", ["one_cell", "cold2"])
def test_units_are_those_of_the_equations(name):
    """The direct solution in other units is the same one, so that equations and unknowns go together."""
    scene = load(name) if name == "one_cell" else hdf5.read(SCENES / f"{name}.h5")
    units = {"kg": 1e10, "m": 1e-3, "s": 3600.0}
    here = reference.solve(scene, "direct").solution
    there = reference.solve(in_units(scene, **units), "direct").solution
    for f, factor in unknowns_in_units(scene, **units).items():
        np.testing.assert_allclose(there[f], factor * here[f], rtol=1e-9, atol=1e-9 * np.abs(factor * here[f]).max())


@pytest.mark.mpi
@pytest.mark.parametrize(
    "scene",
    [scaled(load("base"), rows={"mass": 1e-8}), with_block_of_cell(load("base"), "intf_force", 3, 1e-13)],
    ids=["mass balance hides", "D_22 of a cell nearly singular"],
)
def test_a_small_residual_alone_is_no_answer(scene):
    """A residual that is met at once, by an answer without a correct digit in a field that is small in its norm."""
    result, solution = solve(scene)
    assert not result.converged or worst_error(scene, solution) <= 1e-3


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["no_storage", "tiny_rhs"])
def test_limits_have_an_answer(name):
    """No storage, where fixed stress has its limit; a right-hand side that meets any absolute tolerance at once."""
    scene = CASES[name].make()
    result, solution = solve(scene)
    assert result.converged and result.iterations > 0
    assert worst_error(scene, solution) < 1e-3


MADE_UP = EMPTY | {"variant": "x.opts", "ranks": 1}


def case(**more):
    known = {
        "name": "x", "group": "", "hard": "", "source": "", "fields": ("mass",), "unknowns": 1, "path": "x.h5",
        "reference": "x.npz", "no_reference": "", "conditions": {"mass": 1e3}, "singular": False, "solvable": True,
        "held_out": False,
    }  # fmt: skip
    return known | more


@pytest.mark.parametrize(
    ("kind", "error", "outcome"),
    [
        ("converged", 1e-9, "right"),
        ("converged", 0.5, "wrong"),
        ("converged", float("nan"), "wrong"),
        ("stagnated", 0.5, "refusal"),
        ("failed", None, "refusal"),
        ("hang", None, "hang"),
        ("crash", None, "crash"),
    ],
)
def test_outcomes(kind, error, outcome):
    record = MADE_UP | {"kind": kind, "message": "", "error_by_field": None if error is None else {"mass": error}}
    assert stress.judge(case(), record)["outcome"] == outcome


@pytest.mark.parametrize(
    ("about", "fieldwise", "outcome"),
    [
        ({"singular": True}, 0.0, "right"),
        ({"singular": True, "solvable": False}, 0.0, "wrong"),
        ({}, 1e-3, "wrong"),
    ],
    ids=["singular", "no solution", "a residual"],
)
def test_without_a_reference_the_equations_decide(about, fieldwise, outcome):
    record = MADE_UP | {"kind": "converged", "message": "", "backward_error": {"fieldwise": fieldwise}}
    assert stress.judge(case(reference="", **about), record)["outcome"] == outcome


def test_the_command_reports_and_draws(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    report, page = tmp_path / "r.json", tmp_path / "s.md"
    cases = ["cut_through", "one_cell"]
    words = ["stress", "--only", *cases, "--files", stress.DEFAULT, "--report", str(report), "--page", str(page)]
    assert cli.main([*words, "-n", "1"]) == 0
    found = json.loads(report.read_text())
    assert found["counts"] == {"1": {"right": 2}}
    assert [case["name"] for case in found["cases"]] == cases
    assert "cut_through" in page.read_text() and page.with_suffix(".png").stat().st_size > 1000
    assert "2 right, 0 refusal, 0 wrong" in capsys.readouterr().out


def test_a_misspelt_case_is_answered_by_its_like():
    assert cli.main(["stress", "--only", "cut_trough"]) == 2


def test_held_out_cases_are_drawn_alike_each_time_and_are_none_of_the_catalogue():
    names = [case.name for case in held_out()]
    assert len(set(names)) == len(names) >= 20
    assert not set(names) & set(CASES)
    assert all(case.held_out and not case.quick for case in held_out())
    drawn = next(c for c in held_out() if c.name.startswith("held_out_flow"))
    first, second = drawn.make(), drawn.make()
    for f in first.fields:
        np.testing.assert_array_equal(first.rhs[f], second.rhs[f])


def finding(name, outcome, ranks=1):
    record = MADE_UP | {"kind": "converged", "message": "", "iterations": 7, "ranks": ranks}
    return stress.judge(case(name=name), record) | {"outcome": outcome}


def test_reports_are_merged_the_later_one_wins(tmp_path):
    cases = [case(name=name) for name in ("friction_0", "friction_1.5")]
    old = stress.report(cases, [finding("friction_0", "refusal")], "old")
    new = stress.report(cases, [finding("friction_0", "right", n) for n in (1, 2)], "new")
    merged = stress.merge([old, new])
    assert merged["counts"] == {"1": {"right": 1}, "2": {"right": 1}}
    assert [case["name"] for case in merged["cases"]] == ["friction_0", "friction_1.5"]
    path = tmp_path / "r.json"
    path.write_text(json.dumps(merged))
    assert stress.read_report(path)["counts"] == merged["counts"]
    path.write_text("{}")
    assert cli.main(["stress", "--read", str(path)]) == 2


MASS = Damage("lost", 0.148, "group")
"""Of a scene with nothing but a mass balance: its only block, on whose empty matrix hypre crashes."""


@pytest.mark.mpi
@settings(max_examples=30)
@given(inputs)
@example(Broken(2, {"mass": 3}, 52, (MASS,)))
@example(Broken(2, {"mass": 3}, 205, (Damage("block", 0.0, "missing", 0.5),)))  # on two ranks hypre crashes on it
@example(Broken(3, {"momentum": 5}, 164, (Damage("array", 0.541, "S3", 0.98),)))  # text for cell centres
@example(Broken(2, dict(CELLS), 125, (Damage("array", 0.6968, "order", 0.0991),)))  # ranks need single components
@example(Broken(2, dict(CELLS), 116, (), "contact_poromechanics_fast.opts", (("value", 0.127, "true"),)))
def test_broken_input_gives_an_answer_or_one_clear_error(broken):
    with np.errstate(all="ignore"):
        outcome = attempt(broken, comm)
    assert outcome.partition(":")[0] not in BAD, outcome


def test_no_array_of_a_scene_may_hold_a_number_that_is_not_finite(tmp_path):
    path = tmp_path / "scene.h5"
    hdf5.write(full_scene(), path)
    with h5py.File(path) as file:
        names = []
        file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        names = [name for name in names if file[name].dtype.kind == "f" and file[name].size]
    assert len(names) > 40
    for name in names:
        for value in (np.nan, np.inf):
            hdf5.write(full_scene(), path)
            with h5py.File(path, "r+") as file:
                file[name][-1] = value
            with pytest.raises(SceneError, match=r"not finite|positive|range"):
                hdf5.read(path)


def test_a_damaged_heap_is_refused_before_hdf5_goes_round_in_it_without_end(tmp_path):
    path = tmp_path / "scene.h5"
    hdf5.write(full_scene(), path)
    assert hdf5.read(path).fields
    raw = bytearray(path.read_bytes())
    at = raw.index(b"GCOL") + 16
    raw[at : at + 16] = bytes(16)  # free space of size 0
    path.write_bytes(raw)
    with pytest.raises(SceneError, match="heap"):
        hdf5.read(path)
