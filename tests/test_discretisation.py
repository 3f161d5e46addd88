"""Known solutions against what defines them, and runs against the known solutions."""

import csv
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from petsc_fs.cli import main
from petsc_fs.errors import UsageError
from petsc_fs.porepy.analytic import Consolidation, Mandel, Medium, SlidingFracture
from petsc_fs.porepy.discretisation import (
    CASES,
    Run,
    Study,
    from_json,
    joined,
    measure,
    needed_tolerance,
    orders,
    to_csv,
    to_json,
)
from petsc_fs.porepy.discretisation_page import page

TIMES = (1e-4, 1e-2, 0.1, 1.0)
MEDIA = (
    Medium(storage=0.5),
    Medium(shear_modulus=2.0, lame_lambda=0.7, biot_coefficient=0.8, storage=0.3, mobility=3.0),
)
POINTS = np.linspace(0.05, 0.9, 9)
STEP = 1e-4


def slope(function, at, step=STEP):
    return (function(at + step) - function(at - step)) / (2 * step)


def curvature(function, at, step=STEP):
    return (function(at + step) - 2 * function(at) + function(at - step)) / step**2


@pytest.mark.parametrize("medium", [Medium(), *MEDIA])
@pytest.mark.parametrize("t", TIMES[1:])
def test_consolidation_meets_equations_and_boundary_conditions(medium, t):
    column = Consolidation(medium=medium, load=2.0)
    p, u = (lambda y: column.pressure(y, t)), (lambda y: column.displacement(y, t))
    assert_allclose(p(np.array([1.0])), 0, atol=1e-12)  # drained
    assert_allclose(slope(p, np.zeros(1)), 0, atol=1e-8)  # tight
    assert u(np.zeros(1)) == 0
    in_time = slope(lambda s: column.pressure(POINTS, s), t, 1e-4 * t)
    assert_allclose(in_time, medium.diffusivity * curvature(p, POINTS), rtol=1e-3, atol=1e-4)
    stress = medium.oedometric_modulus * slope(u, POINTS) - medium.biot_coefficient * p(POINTS)
    assert_allclose(stress, -column.load, rtol=1e-6)


@pytest.mark.parametrize("medium", [Medium(), *MEDIA])
def test_consolidation_begins_undrained_and_ends_drained(medium):
    column = Consolidation(medium=medium)
    soon = 5e-5 / medium.diffusivity
    assert_allclose(column.pressure(POINTS, soon), column.initial_pressure, rtol=1e-6)
    assert_allclose(column.displacement(POINTS, soon), column.displacement(POINTS, 0.0), atol=1e-6)
    # Undrained: no fluid has left, S p + alpha du/dy = 0.
    strain = slope(lambda y: column.displacement(y, 0.0), POINTS)
    assert_allclose(medium.storage * column.initial_pressure + medium.biot_coefficient * strain, 0, atol=1e-10)
    assert_allclose(column.pressure(POINTS, 50.0), 0, atol=1e-12)
    assert_allclose(column.displacement(POINTS, 50.0), -POINTS / medium.oedometric_modulus)


@pytest.mark.parametrize("medium", MEDIA)
@pytest.mark.parametrize("t", TIMES[1:])
def test_mandel_meets_equations_and_boundary_conditions(medium, t):
    slab = Mandel(medium=medium, force=3.0)
    G, lame, alpha = medium.shear_modulus, medium.lame_lambda, medium.biot_coefficient
    p, u = (lambda x: slab.pressure(x, t)), (lambda x: slab.displacement_x(x, t))
    strain_y = slope(lambda y: slab.displacement_y(y, t), 0.5)
    assert_allclose(p(np.ones(1)), 0, atol=1e-10)  # drained sides
    assert_allclose(slope(p, np.zeros(1)), 0, atol=1e-7)  # symmetry
    assert_allclose(u(np.zeros(1)), 0, atol=1e-12)
    # No stress across the free side, and the same across every vertical section.
    stress_x = (lame + 2 * G) * slope(u, POINTS) + lame * strain_y - alpha * p(POINTS)
    assert_allclose(stress_x, 0, atol=2e-6)
    # The plate carries the force.
    x = np.linspace(0, 1, 2001)
    inner = (x[1:] + x[:-1]) / 2
    stress_y = lame * slope(u, inner) + (lame + 2 * G) * strain_y - alpha * p(inner)
    assert_allclose(np.mean(stress_y), -slab.force, rtol=1e-5)

    def content(s):  # S p + alpha div u
        strain = slope(lambda x: slab.displacement_x(x, s), POINTS) + slope(lambda y: slab.displacement_y(y, s), 0.5)
        return medium.storage * slab.pressure(POINTS, s) + alpha * strain

    assert_allclose(slope(content, t, 1e-3 * t), medium.mobility * curvature(p, POINTS), rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("medium", MEDIA)
def test_mandel_begins_undrained_and_pressure_rises_first(medium):
    slab = Mandel(medium=medium)
    assert_allclose(slab.pressure(POINTS, 1e-5), slab.initial_pressure, rtol=1e-2)
    div = slope(lambda x: slab.displacement_x(x, 0.0), 0.5) + slope(lambda y: slab.displacement_y(y, 0.0), 0.5)
    assert_allclose(medium.storage * slab.initial_pressure + medium.biot_coefficient * div, 0, atol=1e-10)
    middle = [slab.pressure(np.zeros(1), t)[0] for t in (0.0, 0.01, 0.02, 0.05, 2.0)]
    assert max(middle[1:4]) > 1.02 * middle[0] > 10 * middle[-1]  # the Mandel-Cryer effect


def test_sliding_fracture_is_in_balance_and_on_the_friction_bound():
    fracture = SlidingFracture()
    G, lame = fracture.medium.shear_modulus, fracture.medium.lame_lambda
    rng = np.random.default_rng(0)
    sine, cosine = np.sin(fracture.angle), np.cos(fracture.angle)
    along, across = np.array([cosine, sine]), np.array([-sine, cosine])

    def stress(x, y, step=1e-4):
        ux = (fracture.displacement(x + step, y) - fracture.displacement(x - step, y)) / (2 * step)
        uy = (fracture.displacement(x, y + step) - fracture.displacement(x, y - step)) / (2 * step)
        trace = ux[0] + uy[1]
        shear = G * (uy[0] + ux[1])
        return np.array([[lame * trace + 2 * G * ux[0], shear], [shear, lame * trace + 2 * G * uy[1]]])

    x, y = rng.uniform(1, 3, (2, 20))
    h = 1e-2
    force = (stress(x + h, y) - stress(x - h, y))[:, 0] + (stress(x, y + h) - stress(x, y - h))[:, 1]
    assert_allclose(force / (2 * h), 0, atol=1e-4 * fracture.compression)
    far = stress(np.array([300.0]), np.array([200.0]), 1e-2)[..., 0]
    assert_allclose(far, [[0, 0], [0, -fracture.compression]], atol=1e-5 * fracture.compression)
    s = 0.4 * np.linspace(-1, 1, 9)
    for side in (1, -1):
        points = np.outer(along, s) + side * 2e-4 * across[:, None]
        traction = np.einsum("ijn,j->in", stress(*points, 1e-5), across)
        assert (across @ traction < 0).all()
        assert_allclose(np.abs(along @ traction), fracture.friction * np.abs(across @ traction), rtol=1e-2)
    walls = [fracture.displacement(*(np.outer(along, s) + side * 1e-9 * across[:, None])) for side in (1, -1)]
    jump = walls[0] - walls[1]
    assert_allclose(np.abs(along @ jump), fracture.slip(s), rtol=1e-6)
    assert_allclose(across @ jump, 0, atol=1e-10)
    # Shear stress and slip do work against each other: friction takes energy.
    assert ((along @ traction) * (along @ jump) > 0).all()


def run(case="terzaghi", refinement=1.0, rtol=1e-10, error=0.1, **changes):
    values = {
        "cells": 4,
        "unknowns": 12,
        "solves": 2,
        "iterations": 10,
        "seconds": 2.0,
        "linear_seconds": 1.0,
    } | changes
    return Run(case=case, refinement=refinement, rtol=rtol, errors={"pressure": error, "displacement": error}, **values)


def test_orders_are_those_of_powers():
    runs = [run(refinement=g, error=g**-1.7) for g in (1, 2, 5)]
    assert_allclose(orders(runs, "pressure"), [1.7, 1.7])


@pytest.mark.parametrize(
    ("errors", "solves", "expected"),
    [
        ((0.1, 0.1, 0.1), (2, 2, 2), 1e-2),
        ((0.2, 0.102, 0.1), (2, 2, 2), 1e-4),
        ((0.09, 0.1, 0.1), (2, 2, 2), 1e-4),  # smaller by chance
        ((0.1, 0.2, 0.1), (2, 2, 2), 1e-10),  # tighter ones must do, too
        ((0.1, 0.1, 0.1), (3, 2, 2), 1e-4),  # costs a Newton step
    ],
)
def test_needed_tolerance_is_the_loosest_that_changes_nothing(errors, solves, expected):
    runs = [
        run(rtol=rtol, error=error, solves=n)
        for rtol, error, n in zip((1e-2, 1e-4, 1e-10), errors, solves, strict=True)
    ]
    assert needed_tolerance(runs) == expected


def example():
    return Study(
        [
            run(refinement=g, rtol=rtol, error=(1 + 50 * rtol) / g, linear_seconds=1 - 4 * rtol)
            for g in (1.0, 2.0)
            for rtol in (1e-2, 1e-4, 1e-10)
        ],
        {"PorePy": "1"},
    )


def test_files_hold_all_runs(tmp_path):
    study = example()
    file = tmp_path / "study.json"
    file.write_text(to_json(study))
    assert from_json(file) == study
    rows = list(csv.DictReader(to_csv(study).splitlines()))
    assert [float(row["error_pressure"]) for row in rows] == [r.errors["pressure"] for r in study.runs]
    assert joined([study, study]) == study
    with pytest.raises(UsageError, match="different versions"):
        joined([study, Study(study.runs, {"PorePy": "2"})])
    file.write_text("{}")
    with pytest.raises(UsageError, match="not a file of discretisation runs"):
        from_json(file)


def test_page_recommends_the_needed_tolerance():
    text = page(example())
    assert "| terzaghi | 2 | 12 | 0.0001 |" in text
    assert "0.0001 is enough" in text
    assert "| 2 | 4 | 12 | 2 | 5.00e-01 | 1.00 | 5.00e-01 | 1.00 |" in text


def test_pages_are_written_anew_from_results(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    file = tmp_path / "study.json"
    file.write_text(to_json(example()))
    out = tmp_path / "out"
    assert main(["discretisation", "--from", str(file), "--out", str(out)]) == 0
    assert sorted(p.suffix for p in out.iterdir()) == [".csv", ".json", ".md", ".png"]
    assert (out / "discretisation.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("wrong", [["nothing"], ["--rtol", "0"], ["--refine", "nan"]])
def test_wrong_arguments_are_refused_before_anything_runs(tmp_path, wrong, capsys):
    assert main(["discretisation", *wrong, "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.porepy
@pytest.mark.parametrize(
    ("case", "error", "least", "most"),
    [("terzaghi", "pressure", 0.9, 1.3), ("mandel", "pressure", 0.8, 1.3), ("sliding", "displacement", 0.5, 1.5)],
)
def test_errors_shrink_at_the_expected_order(case, error, least, most):
    """First order: implicit Euler in time, and the tips of a fracture in space."""
    pytest.importorskip("porepy", reason="PorePy is not installed")
    runs = [measure(case, g, 1e-8) for g in (1, 2)]
    (order,) = orders(runs, error)
    assert least < order < most
    assert runs[1].errors[error] < 0.02
    assert runs[1].solves >= runs[1].refinement and runs[1].linear_seconds < runs[1].seconds


@pytest.mark.porepy
def test_a_loose_tolerance_shows():
    pytest.importorskip("porepy", reason="PorePy is not installed")
    loose, tight = (measure("terzaghi", 1, rtol) for rtol in (0.3, 1e-10))
    assert loose.iterations < tight.iterations
    assert needed_tolerance([loose, tight]) == tight.rtol
    assert all(math.isfinite(e) for e in loose.errors.values())


@pytest.mark.porepy
def test_series_agree_with_those_of_porepy():
    """PorePy's examples have them too, from other sources."""
    pytest.importorskip("porepy", reason="PorePy is not installed")
    from porepy.examples import mandel_biot, terzaghi_biot

    class Stand:
        """What PorePy's series ask of a model."""

        params: dict = {}  # noqa: RUF012
        column, slab = Consolidation(), Mandel()
        poisson_coefficient = staticmethod(lambda: Stand.slab.medium.poisson_ratio)
        undrained_poisson_coefficient = staticmethod(lambda: Stand.slab.medium.undrained_poisson_ratio)
        fluid_diffusivity = staticmethod(lambda: Stand.slab.medium.diffusivity)
        vertical_load = staticmethod(lambda: Stand.slab.force)
        applied_load = staticmethod(lambda: Stand.column.load)
        nondim_length = staticmethod(lambda y: y)
        nondim_time = staticmethod(lambda t: t * Stand.column.medium.diffusivity)

        @staticmethod
        def skempton_coefficient():
            return 3 * Stand.slab.initial_pressure / (1 + Stand.slab.medium.undrained_poisson_ratio)

        class domain:
            bounding_box = {"xmax": 1.0}  # noqa: RUF012

    for t in (0.01, 0.1):
        theirs = terzaghi_biot.TerzaghiExactSolution(Stand).pressure(POINTS, t)
        assert_allclose(Stand.column.pressure(POINTS, t), theirs, rtol=1e-10)
        theirs = mandel_biot.MandelExactSolution(Stand).pressure_profile(POINTS, t)
        assert_allclose(Stand.slab.pressure(POINTS, t), theirs, rtol=1e-8)


def test_every_case_names_what_it_measures():
    for name, case in CASES.items():
        assert case.errors and case.options_file.endswith(".opts"), name
