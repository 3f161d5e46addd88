"""Extreme scenes: the catalogue, what counts as right, that units change no answer, that no field can hide."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from broken import BAD, Broken, Damage, attempt, inputs
from hypothesis import example, given, settings
from mpi4py import MPI
from petsc4py import PETSc
from sample import CELLS, full_scene

from petsc_fs import options
from petsc_fs.cli import main as cli
from petsc_fs.errors import SceneError
from petsc_fs.fallback import RUNGS
from petsc_fs.io import hdf5
from petsc_fs.solver import Solver
from petsc_fs.tools import reference, stress
from petsc_fs.tools.conditioning import field_conditions, fieldwise_backward_error, magnitudes
from petsc_fs.tools.measure import EMPTY
from petsc_fs.tools.stress_cases import (
    RECIPES,
    catalogue,
    in_units,
    load,
    scaled,
    unknowns_in_units,
    with_block_of_cell,
    with_rhs,
)
from petsc_fs.tools.stress_held_out import HELD_OUT, held_out
from petsc_fs.tools.stress_limits import AXES, write_limits
from petsc_fs.tools.stress_repairs import LADDER, REPAIRS, label, variants

CASES = {case.name: case for case in catalogue()}
UNIT_SYSTEMS = ({}, {"m": 1e-3}, {"s": 3600.0}, {"kg": 1e10, "m": 1e-3, "s": 3600.0})
comm = MPI.COMM_WORLD


@pytest.fixture
def solve():
    """Solve a scene by its smallest tree, with further options."""
    inserted = []

    def run(scene, **more):
        for name, value in more.items():
            PETSc.Options().setValue(name, value)
        new = options.insert_all(options.choose(options.Facts.of(scene, comm)).values)
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


@pytest.mark.parametrize("name", [*RECIPES, *HELD_OUT])
def test_exported_scenes_fit_together(name):
    load(name).validate()


@pytest.mark.mpi
@pytest.mark.parametrize("units", UNIT_SYSTEMS, ids=str)
def test_units_change_neither_answer_nor_accuracy(solve, units):
    """The same answer, field by field, in four unit systems: what is left is what the tolerance leaves."""
    scene = load("base")
    exact = solve(scene, ksp_rtol="1e-13", ksp_atol="0")
    changed = in_units(scene, **units)
    assert changed.metadata.units == {"kg": 1.0, "m": 1.0, "s": 1.0} | units
    result = solve(changed)
    assert exact.converged and result.converged
    for f, factor in unknowns_in_units(scene, **units).items():
        difference = comm.allreduce(float(np.sum((result.solution[f] / factor - exact.solution[f]) ** 2)))
        size = comm.allreduce(float(np.sum(exact.solution[f] ** 2)))
        assert np.sqrt(difference / size) < 1e-7, f


def test_units_are_those_of_the_equations():
    """The direct solution in other units is the same one, so that equations and unknowns go together."""
    scene = load("one_cell")
    units = {"kg": 1e10, "m": 1e-3, "s": 3600.0}
    here = reference.solve(scene, "direct").solution
    there = reference.solve(in_units(scene, **units), "direct").solution
    for f, factor in unknowns_in_units(scene, **units).items():
        np.testing.assert_allclose(there[f], factor * here[f], rtol=1e-9, atol=1e-9 * np.abs(factor * here[f]).max())


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
    coefficients = scene.fixed_stress_coefficients()
    assert np.isfinite(coefficients).all()
    assert solve(scene).converged


def test_an_absolute_tolerance_met_at_once_is_no_answer(solve):
    result = solve(CASES["tiny_rhs"].make())
    assert result.converged
    assert max(result.estimated_error_by_field.values()) < 1e-3
    assert result.iterations > 0


def test_conditions_bound_errors():
    """The theorem that makes errors right: perturbed right-hand sides move no field further than its condition says."""
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


def test_what_has_no_solution_has_no_answer():
    record = EMPTY | {"kind": "converged", "message": "", "backward_error": {"fieldwise": 0.0}}
    assert stress.judge(truth(reference="", singular=True), "x.opts", 1, record).outcome == "right"
    assert stress.judge(truth(reference="", singular=True, solvable=False), "x.opts", 1, record).outcome == "wrong"


def test_without_a_reference_the_equations_decide():
    record = EMPTY | {"kind": "converged", "message": "", "backward_error": {"normwise": 0.0, "fieldwise": 1e-3}}
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


def test_conditions_do_not_depend_on_the_size_of_the_right_hand_side():
    """Not even where the squares of its entries over- or underflow."""
    scene = load("one_cell")
    exact = reference.solve(scene, "direct").solution
    known = field_conditions(scene, exact)
    for factor in (2.0**-500, 2.0**500):
        other = replace(scene, rhs={f: factor * b for f, b in scene.rhs.items()})
        found = field_conditions(other, {f: factor * x for f, x in exact.items()})
        assert found == pytest.approx(known, rel=1e-6)


def test_fieldwise_backward_error_is_the_same_in_all_units():
    scene = load("one_cell")
    random = np.random.default_rng(0)
    x = {f: random.standard_normal(n) for f, n in scene.sizes.items()}
    assert 0 < fieldwise_backward_error(scene, x) <= 1
    factors = unknowns_in_units(scene, m=0.25, s=4.0)
    there = fieldwise_backward_error(in_units(scene, m=0.25, s=4.0), {f: factors[f] * v for f, v in x.items()})
    assert there == pytest.approx(fieldwise_backward_error(scene, x), rel=1e-12)
    zero = with_rhs(scene)
    assert fieldwise_backward_error(zero, {f: np.zeros(n) for f, n in zero.sizes.items()}) == 0


def test_held_out_cases_are_drawn_alike_each_time_and_are_none_of_the_catalogue():
    names = [case.name for case in held_out()]
    assert len(set(names)) == len(names) >= 20
    assert not set(names) & set(CASES)
    assert all(case.held_out and not case.quick for case in held_out())
    case = next(c for c in held_out() if c.name.startswith("held_out_flow"))
    first, second = case.make(), case.make()
    for f in first.fields:
        np.testing.assert_array_equal(first.rhs[f], second.rhs[f])


def test_repairs_differ_from_the_default_and_are_run_once():
    assert all(bool(r.before) != bool(r.after) for r in REPAIRS)
    assert set(variants()) == {""} | {label(r.before or r.after) for r in REPAIRS}
    assert LADDER == RUNGS


def test_axes_name_cases_and_increase():
    for axis in AXES:
        assert set(axis.values) <= set(CASES), axis.name
        assert len(set(axis.values.values())) == len(axis.values) >= 2


def finding(case: str, file: str, outcome: str, ranks: int = 1, error: float = 1e-6) -> stress.Finding:
    return stress.Finding(
        case=case, file=file, ranks=ranks, outcome=outcome, kind="converged", message="", iterations=7, reason=None,
        fallback="", true_residual=0.0, tolerance=1e-10, error_by_field={"mass": error},
        allowed_by_field={"mass": 1e-2}, backward_error={"componentwise": 1e-3, "fieldwise": 1e-12}, seconds=0.0,
    )  # fmt: skip


def test_reports_are_merged_the_later_one_wins(tmp_path):
    truths = [truth(name=name) for name in ("friction_0", "friction_1.5")]
    old = stress.report(truths, [finding("friction_0", "a.opts", "refusal")], "old")
    new = stress.report(truths, [finding("friction_0", "a.opts", "right", n) for n in (1, 2)], "new")
    merged = stress.merge([old, new])
    assert merged["counts"] == {"1": {"right": 1}, "2": {"right": 1}}
    assert [case["name"] for case in merged["cases"]] == ["friction_0", "friction_1.5"]
    path = tmp_path / "r.json"
    path.write_text(json.dumps(merged))
    assert stress.read_report(path)["counts"] == merged["counts"]
    path.write_text("{}")
    assert cli.main(["stress", "--read", str(path)]) == 2


def test_limits_say_how_far_a_file_is_right_on_all_ranks(tmp_path, monkeypatch):
    monkeypatch.setattr("petsc_fs.tools.stress_limits.RARE", 1)
    outcomes = {"friction_0": "refusal", "friction_0.01": "right", "friction_0.1": "right", "friction_1.5": "right"}
    found = [finding(c, "a.opts", o) for c, o in outcomes.items()] + [finding("friction_1.5", "a.opts", "refusal", 2)]
    write_limits(stress.report([truth(name=c) for c in outcomes], found, "x"), tmp_path / "l.md")
    text = (tmp_path / "l.md").read_text()
    assert "| friction F | 0, 0.01, 0.1, 0.577, 0.8, 1.5 | 0.01 to 0.1 |" in text


MASS = Damage("lost", 0.148, "group")
"""Of a scene with nothing but a mass balance: its only block, on whose empty matrix hypre crashes."""


@pytest.mark.mpi
@settings(max_examples=30)
@given(inputs)
@example(Broken(2, {"mass": 3}, 52, (MASS,)))
@example(Broken(2, {"mass": 3}, 205, (Damage("block", 0.0, "missing", 0.5),)))  # on two ranks hypre crashes on it
@example(Broken(3, {"momentum": 5}, 164, (Damage("array", 0.541, "S3", 0.98),)))  # text for cell centres
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
