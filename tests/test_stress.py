"""Extreme scenes: the catalogue, what counts as right, that units change no answer, that no field can hide."""

import json
from dataclasses import replace

import numpy as np
import pytest
from broken import attempt
from hypothesis import given, settings
from hypothesis import strategies as st
from mpi4py import MPI
from petsc4py import PETSc

from petsc_fs import cli, options, stress
from petsc_fs.cli import tree_for
from petsc_fs.conditioning import field_conditions, magnitudes
from petsc_fs.fixed_stress import analytic_coefficients
from petsc_fs.measure import EMPTY
from petsc_fs.solver import Solver
from petsc_fs.stress_cases import RECIPES, catalogue, in_units, load, scaled, with_block_of_cell

CASES = {case.name: case for case in catalogue()}
comm = MPI.COMM_WORLD


@pytest.fixture
def solve():
    """Solve a scene by its smallest tree, with further options."""
    inserted = []

    def run(scene, **more):
        for name, value in more.items():
            PETSc.Options().setValue(name, value)
        new = options.insert_all(tree_for(scene, comm).options)
        inserted.extend([*new, *more])
        try:
            return Solver(scene, comm).solve()
        finally:
            options.delete_all(inserted)

    return run


def test_the_catalogue_has_enough_cases_and_says_what_is_hard():
    assert len(CASES) >= 80
    assert len(CASES) == len(catalogue())
    assert all(case.hard and case.source for case in CASES.values())
    assert sum(case.quick for case in CASES.values()) >= 20


@pytest.mark.parametrize("name", RECIPES)
def test_exported_scenes_fit_together(name):
    load(name).validate()


@pytest.mark.mpi
@pytest.mark.parametrize("units", [{}, {"m": 1e-3}, {"s": 3600.0}, {"kg": 1e10, "m": 1e-3, "s": 3600.0}], ids=str)
def test_units_change_neither_answer_nor_accuracy(solve, units):
    scene = load("base")
    exact = solve(scene, ksp_rtol="1e-12", ksp_atol="0")
    result = solve(in_units(scene, **units))
    assert result.converged
    assert max(result.estimated_error_by_field.values()) < 1e-6
    other = in_units(replace(scene, reference={}), **units)
    assert other.metadata.units == {"kg": 1.0, "m": 1.0, "s": 1.0} | units
    assert exact.converged


@pytest.mark.mpi
def test_a_field_that_hides_in_the_norm_is_found_out(solve):
    """Mass balance 1e-8 of the rest: the residual is met at once, by an answer without a correct digit."""
    scene = scaled(load("base"), rows={"mass": 1e-8})
    blind = solve(scene, petsc_fs_error_factor="0")
    assert blind.converged
    seeing = solve(scene)
    assert not seeing.converged or max(seeing.estimated_error_by_field.values()) <= 1e-3


@pytest.mark.mpi
def test_a_nearly_singular_block_is_named_with_its_cell(solve):
    result = solve(with_block_of_cell(load("base"), "intf_force", 3, 1e-13))
    assert not result.converged
    assert any("J_22 (intf_force) is nearly singular at cell 3" in note for note in result.notes)


@pytest.mark.mpi
def test_rows_are_scaled_by_powers_of_two_and_the_solution_stays(solve):
    scene = load("base")
    a, b = solve(scene, ksp_rtol="1e-12"), solve(scene, ksp_rtol="1e-12", petsc_fs_scaling="always")
    assert a.converged and b.converged
    for f in scene.fields:
        difference = comm.allreduce(float(np.sum((a.solution[f] - b.solution[f]) ** 2)))
        size = comm.allreduce(float(np.sum(a.solution[f] ** 2)))
        assert difference <= 1e-12 * size


@pytest.mark.mpi
def test_without_any_storage_fixed_stress_has_its_limit(solve):
    scene = load("no_storage")
    coefficients = analytic_coefficients(scene)
    assert np.isfinite(coefficients).all()
    assert solve(scene).converged


def test_an_absolute_tolerance_met_at_once_is_no_answer(solve):
    result = solve(CASES["tiny_rhs"].make())
    assert result.converged
    assert max(result.estimated_error_by_field.values()) < 1e-3
    assert result.iterations > 0


def test_conditions_bound_errors():
    """The theorem that makes errors right: perturbed right-hand sides move no field further than its condition says."""
    from petsc_fs import reference

    scene = load("cut_through")
    exact = reference.solve(scene, "direct")
    conditions = field_conditions(scene, exact.solution)
    sizes = magnitudes(scene, exact.solution)
    random, eta = np.random.default_rng(1), 1e-9
    rhs = {}
    for f, b in scene.rhs.items():
        r = random.standard_normal(b.size)
        rhs[f] = b + eta * sizes[f] * r / np.linalg.norm(r)
    moved = reference.solve(replace(scene, rhs=rhs), "direct").solution
    errors = reference.ruler(scene, exact).errors(moved).by_field
    for f, error in errors.items():
        assert error <= 1.1 * np.sqrt(len(errors)) * eta * conditions[f]


def truth(**more) -> stress.Truth:
    known = {
        "name": "x", "group": "", "hard": "", "source": "", "fields": ("mass",), "unknowns": 1, "path": "x.h5",
        "reference": "x.npz", "no_reference": "", "conditions": {"mass": 1e3}, "singular": False,
    }  # fmt: skip
    return stress.Truth(**(known | more))


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
    record = EMPTY | {"kind": kind, "message": "", "error_by_field": None if error is None else {"mass": error}}
    assert stress.judge(truth(), "x.opts", 1, record).outcome == outcome


def test_without_a_reference_the_equations_decide():
    record = EMPTY | {"kind": "converged", "message": "", "backward_error": {"normwise": 0.0, "componentwise": 1e-3}}
    assert stress.judge(truth(reference=""), "x.opts", 1, record).outcome == "wrong"


def test_the_command_reports_and_draws(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    report, page = tmp_path / "r.json", tmp_path / "s.md"
    cases = ["cut_through", "one_cell"]
    words = ["stress", "--only", *cases, "--files", stress.SMALLEST, "--report", str(report), "--page", str(page)]
    assert cli.main([*words, "-n", "1"]) == 0
    found = json.loads(report.read_text())
    assert found["counts"] == {"1": {"right": 2}}
    assert [case["name"] for case in found["cases"]] == ["one_cell", "cut_through"] or len(found["cases"]) == 2
    assert "cut_through" in page.read_text() and page.with_suffix(".png").stat().st_size > 1000
    assert "2 right, 0 refusal, 0 wrong" in capsys.readouterr().out


def test_a_misspelt_case_is_answered_by_its_like():
    assert cli.main(["stress", "--only", "cut_trough"]) == 2


@settings(max_examples=60)
@given(st.integers(0, 10**6))
def test_broken_input_gives_an_answer_or_one_clear_error(tmp_path_factory, number):
    folder = tmp_path_factory.mktemp("broken")
    with np.errstate(all="ignore"):
        assert attempt(number, folder) in ("answer", "not converged", "clear error")
