"""PorePy's systems with affine parts kept, and discretisation in parts: the same numbers."""

import os
import signal

import numpy as np
import pytest
from programs import Program
from scipy.sparse import issparse

pytestmark = pytest.mark.porepy


@pytest.fixture(scope="module")
def pp():
    return pytest.importorskip("porepy", reason="PorePy is not installed")


def prepared(name, **changes):
    """A model that stands before its first Newton step."""
    from petsc_fs.porepy import FieldSplitSolver, make_model

    model = make_model(name, mixins=(FieldSplitSolver,), **changes)
    model.prepare_simulation()
    model.before_nonlinear_loop()
    model.before_nonlinear_iteration()
    return model


def kept_parts(system):
    return [part for parts in system._kept.values() for part in parts]


def confirm(model, state=None):
    """The system of the model is PorePy's, to rounding of its terms, with and without Jacobian."""
    import porepy as pp

    system = model.equation_system
    matrix, rhs = system.assemble(state=state)
    rows = system.assembled_equation_indices
    expected, right = pp.ad.EquationSystem.assemble(system, state=state)
    x = system.get_variable_values(iterate_index=0) if state is None else state
    size = abs(expected) @ np.abs(x) + np.abs(right)
    assert abs(matrix - expected).max() <= 1e-14 * abs(expected).max()
    for found in (rhs, system.assemble(evaluate_jacobian=False, state=state)):
        assert (np.abs(found - right) <= 1e-12 * size).all()
    for name, indices in system.assembled_equation_indices.items():
        np.testing.assert_array_equal(rows[name], indices)


@pytest.mark.parametrize("name", ["model1", "flow", "contact", "cold2"])
def test_systems_of_a_run_are_those_of_porepy(pp, name):
    from petsc_fs.porepy import FieldSplitSolver, make_model, run
    from petsc_fs.porepy.models import StopRun

    model = make_model(name, refinement=0.5, mixins=(FieldSplitSolver,))
    solves = []

    def look(model, update):
        confirm(model, model.equation_system.get_variable_values(iterate_index=0) + 0.5 * update)
        solves.append(model.time_manager.time_index)
        if solves[-1] == 2 and len(solves) > 2:  # time step and boundary values have changed once
            raise StopRun

    run(model, on_newton_step=look)
    assert solves[-1] > solves[0]
    parts = kept_parts(model.equation_system)
    assert {part.name for part in parts} & ({"Darcy_flux"} if name == "flow" else {"momentum_balance_equation"})


def test_what_a_part_is_made_of_may_change(pp):
    """By value, by another matrix, and within a matrix; whatever is kept has to notice."""
    model = prepared("biot", refinement=0.5)
    system = model.equation_system
    confirm(model)
    parts = kept_parts(system)
    before = [part._ad for part in parts]
    rng = np.random.default_rng(1)
    confirm(model, rng.random(system.num_dofs()))
    assert [part._ad for part in parts] == before  # nothing was evaluated again
    model.ad_time_step.set_value(2 * model.ad_time_step._value)
    confirm(model)
    (rock,) = model.mdg.subdomains()
    data = model.mdg.subdomain_data(rock)
    matrices = data[pp.DISCRETIZATION_MATRICES][model.stress_keyword]
    matrices["stress"].data[7] *= 3.0
    confirm(model)
    matrices["stress"] = 2.0 * matrices["stress"]
    confirm(model)
    boundary = model.mdg.subdomain_to_boundary_grid(rock)
    name = model.bc_data_fluid_flux_key if hasattr(model, "bc_data_fluid_flux_key") else model.bc_data_darcy_flux_key
    values = rng.random(boundary.num_cells)
    pp.set_solution_values(name, values, model.mdg.boundary_grid_data(boundary), iterate_index=0)
    confirm(model)
    assert all(part._ad is not old for part, old in zip(parts, before, strict=True) if "momentum" in part.name)


def test_what_is_not_affine_is_not_kept(pp):
    from petsc_fs.porepy.equations import _terms

    model = prepared("flow", refinement=0.5)
    p = model.pressure(model.mdg.subdomains())
    two, square = pp.ad.Scalar(2.0), pp.ad.Function(lambda x: x**2, "square")
    for operator in (p * p, two / p, p**two, two**p, square(p), square(two), p + p * p):
        assert _terms(operator) is None
    for operator in (p, two * p, p / two, p - two, two * (p + two * p)):
        assert not _terms(operator).is_constant
    assert _terms(two * two / two).is_constant
    assert _terms(p.previous_timestep()).is_constant


def test_keeping_can_be_switched_off(pp, clean):
    clean.setValue("petsc_fs_keep_affine", "no")
    model = prepared("flow", refinement=0.5)
    model.assemble_linear_system()
    assert kept_parts(model.equation_system) == []


class AllRanks:
    """The ranks of a server, one after the other."""

    def __init__(self, ranks):
        self.comm = type("Communicator", (), {"size": ranks})
        self.shared = 0

    def share(self, function, tasks):
        assert len(tasks) == self.comm.size
        self.shared += 1
        return [function(task) for task in tasks]


@pytest.mark.parametrize("ranks", [2, 5])
@pytest.mark.parametrize("name", ["model1", "model3", "flow", "contact"])
def test_parts_of_a_discretisation_make_the_whole(pp, monkeypatch, name, ranks):
    from petsc_fs.porepy import equations

    monkeypatch.setattr(equations, "SMALLEST_PART", 5)
    model = prepared(name, refinement=0.25 if name == "model3" else 1)
    system, mdg = model.equation_system, model.mdg
    at = {sd: mdg.subdomain_data(sd).get(pp.DISCRETIZATION_MATRICES, {}) for sd in mdg.subdomains()}
    whole = {sd: {key: dict(found) for key, found in matrices.items()} for sd, matrices in at.items()}
    for found in (found for matrices in at.values() for found in matrices.values()):
        found.clear()
    system._client = AllRanks(ranks)
    system.discretize()
    assert system._client.shared == (1 if name in {"flow", "contact"} else 2)
    for sd, expected in whole.items():
        compare(at[sd], expected)


def compare(found, expected):
    """Dictionaries of matrices are alike, to the order of sums."""
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, dict):
            compare(found[name], value)
        elif issparse(value):
            scale = np.abs(value.data).max(initial=0.0)
            assert found[name].shape == value.shape
            assert np.abs((found[name] - value).data).max(initial=0.0) <= 1e-12 * scale


SHARED = """
import os, signal, time
import petsc4py; petsc4py.init(["program"])
from mpi4py import MPI
from petsc_fs.porepy import FieldSplitSolver, equations, make_model

rank = MPI.COMM_WORLD.rank
with open(f"pid{rank}", "w") as file:
    file.write(str(os.getpid()))
equations.SMALLEST_PART = 5
def discretize(self, own=equations.Part.discretize):
    if self.rank == 1:
        print("now", flush=True)
        ENDING
    return own(self)
equations.Part.discretize = discretize
model = make_model("flow", mixins=(FieldSplitSolver,))
model.prepare_simulation()
print("after")
"""


def test_an_error_while_ranks_discretise_ends_all(pp, tmp_path):
    program = Program(tmp_path, SHARED.replace("ENDING", "raise RuntimeError('broken grid')"))
    code, out, err = program.end(120)
    assert code != 0
    assert "after" not in out
    assert err.count("Traceback") == 1
    assert err.count("RuntimeError: broken grid") == 1


@pytest.mark.parametrize("victim", [0, 1])
def test_a_killed_rank_while_ranks_discretise_ends_all(pp, tmp_path, victim):
    program = Program(tmp_path, SHARED.replace("ENDING", "time.sleep(60)"))
    program.wait_for("now", 120)
    assert "after" not in program.end_killed(int((tmp_path / f"pid{victim}").read_text()))


def test_an_interrupt_while_ranks_discretise_comes_when_they_are_through(pp, tmp_path):
    program = Program(tmp_path, SHARED.replace("ENDING", "time.sleep(3)"))
    program.wait_for("now", 120)
    os.kill(int((tmp_path / "pid0").read_text()), signal.SIGINT)
    code, out, err = program.end(60)
    assert code != 0
    assert "after" not in out
    assert err.count("KeyboardInterrupt") == 1
