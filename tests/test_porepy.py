"""Scenes from PorePy models: numbering, blocks, physics and files."""

import argparse
import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from numpy.testing import assert_allclose, assert_array_equal

import petsc_fs
from petsc_fs.errors import LayoutError, SceneError, SolveError, UsageError
from petsc_fs.porepy import export as export_module
from petsc_fs.porepy import parity, parity_page, published_code
from petsc_fs.porepy.cases import CASES, CELL, ModelParameters
from petsc_fs.porepy.direct import solve
from petsc_fs.porepy.export import BUNDLED, Steps, add_arguments, export
from petsc_fs.scene import CONTACT_STATES, contact_state_counts

pytestmark = pytest.mark.porepy

FIELDS = {
    "model1": ("contact", "intf_force", "momentum", "intf_flow", "mass"),
    "model2": ("contact", "intf_force", "momentum", "intf_flow", "mass"),
    "model3": ("contact", "intf_force", "momentum", "intf_flow", "mass"),
    "biot": ("momentum", "mass"),
    "flow": ("intf_flow", "mass"),
    "contact": ("contact", "intf_force", "momentum"),
}
COARSE = {"model3": 0.25}
UNKNOWNS = {"model1": 798, "model2": 1260, "model3": 3154}
"""Of the published runs, at refinement 1 in 2D and 0.25 in 3D."""


@pytest.fixture(scope="module")
def pp():
    return pytest.importorskip("porepy", reason="PorePy is not installed")


@pytest.fixture(scope="module")
def captured(pp):
    """Run a model up to a Newton step; model, scene, PorePy's solution and matrix there. Cached."""
    cache = {}

    def capture(name, steps="2:0", **changes):
        key = name, steps, tuple(changes.items())
        if key not in cache:
            cache[key] = run_to(name, Steps.parse(steps), **changes)
        return cache[key]

    return capture


def run_to(name, steps, **changes):
    from petsc_fs.porepy import Adapter, make_model, run
    from petsc_fs.porepy.models import StopRun

    found = []

    def look(model, solution):
        step = model.time_manager.time_index, model.nonlinear_solver_statistics.num_iteration
        adapter = Adapter(model)
        scene = adapter.scene()
        counts = contact_state_counts([] if scene.contact_state is None else scene.contact_state)
        if step in steps.numbers or (steps.mixed and all(counts.values())):
            found.extend([model, adapter, scene, solution, indicators(model)])
            raise StopRun

    model = make_model(name, **({"refinement": COARSE.get(name, 1)} | changes))
    run(model, on_newton_step=look, linear_solve=lambda model: solve(*model.linear_system))
    assert found, f"{name} has no Newton step {steps}"
    return found


def indicators(model):
    """Contact state by PorePy's own line-search indicators."""
    from petsc_fs.porepy.adapter import evaluate

    if not hasattr(model, "opening_indicator"):
        return None
    fractures = model.mdg.subdomains(dim=model.nd - 1)
    if not fractures:
        return None
    is_open = evaluate(model, model.opening_indicator(fractures)) < 0
    sliding = evaluate(model, model.sliding_indicator(fractures)) > 0
    return np.where(is_open, 2, np.where(sliding, 1, 0))


def assemble(scene):
    from scipy.sparse import bmat, csr_matrix

    def block(r, c):
        shape = scene.sizes[r], scene.sizes[c]
        b = scene.blocks.get((r, c))
        return csr_matrix(shape) if b is None else csr_matrix((b.data, b.indices, b.indptr), shape)

    return bmat([[block(r, c) for c in scene.fields] for r in scene.fields], format="csr")


def backward_errors(scene, solution):
    """Per field the norm of b - A x over that of |A| |x| + |b|."""
    A = assemble(scene)
    x, b = (np.concatenate([v[f] for f in scene.fields]) for v in (solution, scene.rhs))
    residual, size = abs(A @ x - b), abs(A) @ abs(x) + abs(b)
    ends = np.cumsum([scene.sizes[f] for f in scene.fields])[:-1]
    parts = zip(scene.fields, np.split(residual, ends), np.split(size, ends), strict=True)
    return {f: np.linalg.norm(r) / np.linalg.norm(s) for f, r, s in parts}


def dense(scene, r, c):
    from scipy.sparse import csr_matrix

    b = scene.blocks[r, c]
    return csr_matrix((b.data, b.indices, b.indptr), (scene.sizes[r], scene.sizes[c])).toarray()


def diagonal_blocks(scene, name):
    bs = scene.block_size(name)
    J = dense(scene, name, name)
    return np.stack([J[i : i + bs, i : i + bs] for i in range(0, J.shape[0], bs)])


@pytest.mark.parametrize("name", CASES)
def test_fields_and_sizes(captured, name):
    model, _, scene, *_ = captured(name)
    assert scene.fields == FIELDS[name]
    assert sum(scene.sizes.values()) == UNKNOWNS.get(name, model.equation_system.num_dofs())
    subdomains, interfaces = model.mdg.subdomains(), model.mdg.interfaces()
    cells = {
        "contact": sum(g.num_cells for g in subdomains if g.dim == model.nd - 1),
        "intf_force": sum(g.num_cells for g in interfaces if g.dim == model.nd - 1),
        "momentum": sum(g.num_cells for g in subdomains if g.dim == model.nd),
        "intf_flow": sum(g.num_cells for g in interfaces),
        "mass": sum(g.num_cells for g in subdomains),
    }
    for field, size in scene.sizes.items():
        assert size == cells[field] * scene.block_size(field), field
        assert scene.cell_centers[field].shape == (cells[field], 3)
        assert (scene.cell_volumes[field] > 0).all()


@pytest.mark.parametrize("name", CASES)
def test_scene_has_the_solution_of_the_model(captured, name):
    _, adapter, scene, solution, _ = captured(name)
    b = np.concatenate([scene.rhs[f] for f in scene.fields])
    x = solve(assemble(scene), b)
    ends = np.cumsum([0] + [scene.sizes[f] for f in scene.fields])
    fields = {f: x[ends[k] : ends[k + 1]] for k, f in enumerate(scene.fields)}
    expected = adapter.from_porepy(solution)
    for f in scene.fields:
        assert np.linalg.norm(fields[f] - expected[f]) < 1e-8 * np.linalg.norm(expected[f]), f
    assert_array_equal(adapter.to_porepy(expected), solution)


@pytest.mark.parametrize("name", CASES)
def test_matrix_is_permuted_only(captured, name):
    model, adapter, scene, *_ = captured(name)
    matrix, rhs = model.linear_system
    rows = np.concatenate([adapter.rows[f] for f in scene.fields])
    columns = np.concatenate([adapter.columns[f] for f in scene.fields])
    assert_array_equal(np.sort(rows), np.arange(rows.size))
    assert_array_equal(np.sort(columns), np.arange(rows.size))
    assert abs(matrix.tocsr()[rows][:, columns] - assemble(scene)).max() == 0
    assert_array_equal(rhs[rows], np.concatenate([scene.rhs[f] for f in scene.fields]))


@pytest.mark.parametrize("name", ["model1", "model2", "model3", "contact"])
def test_contact_rows_and_columns_pair_up_per_cell(captured, name):
    _, _, scene, *_ = captured(name, "mixed")
    D = scene.dimension
    J11 = dense(scene, "contact", "contact")
    blocks = diagonal_blocks(scene, "contact")
    for i in range(0, J11.shape[0], D):
        J11[i : i + D, i : i + D] = 0
    assert not J11.any(), "J11 couples fracture cells"
    state = scene.contact_state
    # C_n of an open cell is t_n = 0; of a closed one it does not have t_n beyond the elastic opening.
    assert_allclose(blocks[state == 2][:, 0], np.eye(D)[None, 0].repeat((state == 2).sum(), 0), atol=1e-12)
    assert (np.abs(blocks[state != 2][:, 0, 0]) < 0.1).all()
    assert_array_equal(blocks[:, 0, 1:], 0)
    # The columns are right too: a fracture cell touches the interface cells on its two sides.
    touched = np.abs(dense(scene, "intf_force", "contact")).reshape(-1, D, state.size, D).sum(axis=(1, 3)) > 0
    centers = scene.cell_centers
    assert_array_equal(touched.sum(axis=0), 2)
    interface, fracture = np.nonzero(touched)
    assert_allclose(centers["intf_force"][interface], centers["contact"][fracture], atol=1e-8)


@pytest.mark.parametrize("name", ["model1", "model2", "model3", "contact"])
@pytest.mark.parametrize("field", ["intf_force", "momentum"])
def test_diagonal_blocks_are_regular(captured, name, field):
    blocks = diagonal_blocks(captured(name, "mixed")[2], field)
    assert (np.linalg.cond(blocks) < 100).all()


def test_first_contact_component_is_normal(captured):
    """On the horizontal fracture of model 1 the normal traction pushes along y."""
    scene = captured("model1")[2]
    J = np.abs(dense(scene, "intf_force", "contact")).reshape(-1, 2, scene.contact_state.size, 2)
    x_by_y = J.sum(axis=(0, 2))
    assert_allclose([x_by_y[0, 0], x_by_y[1, 1]], 0, atol=1e-12 * x_by_y.max())


@pytest.mark.parametrize("name", ["model1", "model2", "model3", "contact"])
def test_contact_state_is_that_of_the_indicators(captured, name):
    _, _, scene, _, expected = captured(name, "mixed")
    assert all(contact_state_counts(scene.contact_state).values()), CONTACT_STATES
    assert_array_equal(scene.contact_state, expected)


def test_contact_state_needs_no_indicators(pp, tmp_path, monkeypatch):
    """A model without the line-search mixin gets its contact states too."""
    monkeypatch.chdir(tmp_path)  # gmsh writes there
    from petsc_fs.porepy import scene_from_model

    class Plain(pp.poromechanics.Poromechanics):
        def set_fractures(self):
            self._fractures = [pp.LineFracture(np.array([[0.25, 0.75], [0.5, 0.5]]))]

    model = Plain({"meshing_arguments": {"cell_size": 0.25}, "fracture_indices": [0], "times_to_export": []})
    model.prepare_simulation()
    with pytest.raises(SceneError, match="assemble_linear_system"):
        scene_from_model(model)
    model.before_nonlinear_loop()
    model.before_nonlinear_iteration()
    model.assemble_linear_system()
    scene = scene_from_model(model)
    assert scene.contact_state.size == 2
    assert scene.metadata.model == "Plain"


def test_mass_cells_come_by_dimension(captured):
    scene = captured("model2")[2]
    assert (np.diff(scene.cell_dimension) <= 0).all()
    assert set(scene.cell_dimension) == {0, 1, 2}
    fracture = scene.cell_dimension == 1
    assert_array_equal(scene.cell_centers["mass"][fracture], scene.cell_centers["contact"])
    assert_array_equal(scene.cell_centers["mass"][scene.cell_dimension == 2], scene.cell_centers["momentum"])


def test_material_is_scaled(captured):
    scene = captured("model2", "mixed")[2]
    m = scene.material
    kg = scene.metadata.units["kg"]
    assert kg == 1e10
    assert_allclose(m.shear_modulus, 1.2)
    assert_allclose(m.lame_lambda, 1.2)
    assert_allclose(m.fluid_compressibility, 4.559e-10 * kg)
    assert (m.biot_coefficient, m.porosity, m.time_step) == (0.47, 1.3e-2, 900.0)
    assert m.fluid_density.min() > 997 / kg
    assert m.fluid_density.max() < 1010 / kg
    assert_array_equal(m.normal_jump[scene.cell_dimension != 1], 0)
    jump = m.normal_jump[scene.cell_dimension == 1]
    assert jump[scene.contact_state == 2].min() > 0


def test_material_of_partial_physics(captured):
    assert captured("contact")[2].material is None
    material = captured("flow")[2].material
    assert material.biot_coefficient == 0
    assert_array_equal(material.normal_jump, 0)
    assert_array_equal(captured("biot")[2].material.normal_jump, 0)


def test_metadata(captured):
    scene = captured("model1", "2:0")[2]
    meta = scene.metadata
    assert (meta.model, meta.time_step_index, meta.newton_index, meta.time) == ("model1", 2, 0, 86400.0)
    assert meta.producers["porepy"].startswith("1.1")
    assert meta.units == {"m": 1.0, "s": 1.0, "kg": 1e10}
    changed = captured("model1", "1:0", friction=0.1)[2].metadata.model
    assert changed == "model1 (friction=0.1)"


def test_order_of_equations_does_not_matter(captured):
    """Equations set in another order give the same scene."""
    from petsc_fs.porepy import Adapter

    model, _, expected, *_ = captured("model2", "mixed")
    system = model.equation_system
    names = list(system.equations)
    before = {n: (system.equations[n], *_image(system, n)) for n in names}
    try:
        for name in [names[3], names[0], names[5]]:
            system.remove_equation(name)
            system.set_equation(*before[name])
        assert list(system.equations) != names
        system_before = model.linear_system
        model.assemble_linear_system()
        scene = Adapter(model).scene()
    finally:
        for name in names:
            system.remove_equation(name)
            system.set_equation(*before[name])
        model.linear_system = system_before
    assert scene.sizes == expected.sizes
    assert abs(assemble(scene) - assemble(expected)).max() <= 1e-13 * abs(assemble(expected)).max()


def _image(system, name):
    return list(system._equation_image_space_composition[name]), system._equation_image_size_info[name]


def test_maps_are_computed_once(captured):
    adapter = captured("model1")[1]
    assert adapter.rows["mass"] is adapter.rows["mass"]
    assert [g.dim for g in adapter.grids("mass")] == [2, 1]


def test_missing_equation(captured):
    from petsc_fs.porepy import Adapter

    model = captured("model1")[0]
    system = model.equation_system
    name = "tangential_fracture_deformation_equation"
    equation, image = system.equations[name], _image(system, name)
    system.remove_equation(name)
    try:
        with pytest.raises(LayoutError, match="contact: the model has only some of the equations"):
            Adapter(model)
    finally:
        system.set_equation(equation, *image)


def test_reduced_system(captured):
    from petsc_fs.porepy import Adapter

    model = captured("model1")[0]
    full = model.linear_system
    model.linear_system = (full[0][:10, :10], full[1][:10])
    try:
        with pytest.raises(LayoutError, match="10 x 10"):
            Adapter(model).scene()
    finally:
        model.linear_system = full


@pytest.mark.parametrize("columns", [2, 3])
def test_zeros_and_entries_given_twice_make_no_difference(captured, columns):
    """Each entry comes as two halves, and as a third a zero somewhere."""
    from scipy.sparse import csr_matrix

    model, adapter, *_ = captured("model1", "mixed")
    full = model.linear_system
    expected = adapter.scene()
    A = full[0].tocsr()
    indices = np.stack([A.indices, A.indices, np.zeros_like(A.indices)], axis=1)[:, :columns]
    data = A.data[:, None] * np.array([0.5, 0.5, 0.0])[:columns]
    model.linear_system = (csr_matrix((data.ravel(), indices.ravel(), columns * A.indptr), A.shape), full[1])
    try:
        found = adapter.scene()
    finally:
        model.linear_system = full
    assert found.blocks.keys() == expected.blocks.keys()
    for rc, block in found.blocks.items():
        for mine, other in zip(block, expected.blocks[rc], strict=True):
            assert_array_equal(mine, other)


def test_solution_of_wrong_length(captured):
    adapter = captured("model1")[1]
    with pytest.raises(LayoutError, match="contact: expected 12 values, found nothing"):
        adapter.to_porepy({})


def test_temperature_is_not_supported(pp, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # gmsh writes there
    from petsc_fs.porepy import Adapter

    class Thermal(pp.thermoporomechanics.Thermoporomechanics):
        pass

    model = Thermal({"times_to_export": []})
    with pytest.raises(SceneError, match="prepare_simulation"):
        Adapter(model)
    model.prepare_simulation()
    with pytest.raises(LayoutError, match=r"unknowns temperature and equations energy_balance.*not supported"):
        Adapter(model)


def test_parameters(pp):
    from petsc_fs.porepy import MODELS, make_model

    assert list(MODELS) == list(CASES)
    model = MODELS["model1"](refinement=2, normal_stiffness=0)
    assert model.params["meshing_arguments"]["cell_size"] == CELL / 2
    with pytest.raises(UsageError, match=r"unknown model 'model4'; models are model1, model2"):
        make_model("model4")
    with pytest.raises(UsageError, match="unknown parameter fricton; parameters are refinement, friction"):
        make_model("model1", fricton=0.1)
    with pytest.raises(UsageError, match="refinement: must be positive"):
        ModelParameters(refinement=0)


def test_stiffness_zero_turns_elastic_opening_off(captured):
    from petsc_fs.porepy.adapter import solid

    model = captured("model1", "1:1", normal_stiffness=0.0)[0]
    assert solid(model, "maximum_elastic_fracture_opening") == 0


@pytest.mark.parametrize("permeability", ["unit", "cubic", "constant"])
def test_fracture_permeability(captured, permeability):
    from petsc_fs.porepy.adapter import evaluate

    model = captured("model2", "1:0", fracture_permeability=permeability)[0]
    fractures = model.mdg.subdomains(dim=1)
    value = evaluate(model, model.fracture_permeability(fractures)).reshape(-1, 9)[:, 0]
    # Nothing has opened yet.
    assert_allclose(value, {"unit": 1, "cubic": 1e-8 / 12, "constant": 1e-14}[permeability])


def test_restricted_mass_is_linear(captured):
    """Storage of the restricted model: rho V (1/M + phi c_f) dp in the rock, whatever the pressure."""
    model = captured("model1", "1:1", physics="restricted")[0]
    from petsc_fs.porepy.adapter import evaluate

    system = model.equation_system
    name = model.pressure_variable
    rock = model.mdg.subdomains(dim=2)
    before = evaluate(model, model.fluid_mass(rock))
    dofs = system.dofs_of([v for v in system.variables if v.name == name and v.domain in rock])
    state = system.get_variable_values(iterate_index=0)
    masses = []
    for factor in (1, 2):
        changed = state.copy()
        changed[dofs] += factor * 1e-4
        system.set_variable_values(changed, iterate_index=0)
        masses.append(evaluate(model, model.fluid_mass(rock)) - before)
    system.set_variable_values(state, iterate_index=0)
    assert_allclose(masses[1], 2 * masses[0], rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1:3,2:0", Steps(frozenset({(1, 3), (2, 0)}))),
        ("last", Steps(last=True)),
        ("mixed, all", Steps(mixed=1, every=True)),
        ("mixed@3", Steps(mixed=3)),
    ],
)
def test_steps(text, expected):
    assert Steps.parse(text) == expected


@pytest.mark.parametrize("text", ["", "1", "0:1", "1:-1", "first", "mixed@0", "1:2:3", "last@2"])
def test_steps_that_cannot_be_read(text):
    with pytest.raises(UsageError, match="steps: cannot read"):
        Steps.parse(text)


def test_export_writes_the_steps(pp, tmp_path):
    from petsc_fs.io.hdf5 import read

    lines = []
    paths = export("model1", 1, tmp_path / "new", steps="1:0,1:2,mixed", reference=True, progress=lines.append)
    assert [p.name for p in paths[:2]] == ["model1_g1_t1_n0.h5", "model1_g1_t1_n2.h5"]
    assert len(paths) == 3
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == sorted(p.name for p in paths)
    assert lines[0] == "time step 1, Newton step 0: 6 sticking, 0 sliding, 0 open"
    scene = read(paths[2])
    assert all(contact_state_counts(scene.contact_state).values())
    assert max(backward_errors(scene, scene.reference).values()) < 1e-12


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_scenes(name):
    """They have what they are there for: all contact states, and an accurate reference."""
    pytest.importorskip("scipy")
    from petsc_fs.io.hdf5 import read

    scene = read(Path(petsc_fs.__path__[0]) / "scenes" / f"{name}.h5")
    assert scene.fields == FIELDS[name]
    if "contact" in scene.fields:
        assert all(contact_state_counts(scene.contact_state).values())
    assert max(backward_errors(scene, scene.reference).values()) < 1e-12


def test_export_of_steps_that_do_not_occur(pp, tmp_path):
    with pytest.raises(UsageError, match="no Newton step 1:40"):
        export("contact", 1, tmp_path, steps="1:40")
    with pytest.raises(UsageError, match="no Newton step of the run has sticking, sliding and open"):
        export("biot", 1, tmp_path, steps="mixed")
    with pytest.raises(UsageError, match="unknown model"):
        export("model9", 1, tmp_path)


def test_porepys_own_solver_runs(pp):
    """Without a replacement, PorePy solves; it is a few digits short, which the direct solver is not."""
    from petsc_fs.porepy import Adapter, make_model, run
    from petsc_fs.porepy.models import StopRun

    found = {}

    def look(model, solution):
        adapter = Adapter(model)
        found["plain"] = adapter.from_porepy(solution)
        found["direct"] = adapter.from_porepy(solve(*model.linear_system))
        raise StopRun

    run(make_model("flow"), on_newton_step=look)
    for field, values in found["direct"].items():
        assert_allclose(found["plain"][field], values, rtol=1e-2, atol=1e-3 * abs(values).max())


def test_direct_solver():
    csr_matrix = pytest.importorskip("scipy.sparse").csr_matrix

    scale = 10.0 ** np.array([-12, 0, 9])
    B = np.array([[4.0, 1, 0], [1, 3, 1], [0, 1, 2]])
    y = np.array([1.0, 2.0, -1.0])
    A = csr_matrix(scale[:, None] * B / scale)
    assert_allclose(solve(A, scale * (B @ y)), scale * y, rtol=1e-13)
    with pytest.raises(SolveError, match="row or column of zeros"):
        solve(csr_matrix((2, 2)), np.ones(2))
    with pytest.raises(SolveError, match="cannot be factorised"):
        solve(csr_matrix(np.ones((2, 2))), np.ones(2))
    with pytest.raises(SolveError, match="not finite"):
        solve(csr_matrix(np.eye(2)), np.array([1.0, np.nan]))


def test_arguments(pp, tmp_path):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    args = parser.parse_args(["flow", "--out", str(tmp_path), "--steps", "1:0", "--refine", "0.5"])
    assert export_module.command(args, [], MPI.COMM_WORLD) == 0
    assert [p.name for p in tmp_path.iterdir()] == ["flow_g0.5_t1_n0.h5"]


# FieldSplitSolver


@pytest.fixture
def field_split_model(pp):
    """Make a model that solves by petsc_fs, or one that solves directly."""
    from petsc_fs.porepy import FieldSplitSolver, make_model

    def make(name, **params):
        model = make_model(name, refinement=COARSE.get(name, 1), mixins=(FieldSplitSolver,))
        model.params.update(params)
        return model

    return make


def stop_in_time_step(number):
    from petsc_fs.porepy.models import StopRun

    def look(model, _):
        if model.time_manager.time_index >= number:
            raise StopRun

    return look


def first_solve(model):
    """Record and update of the first linear solve."""
    from petsc_fs.porepy import run
    from petsc_fs.porepy.models import StopRun

    found = []

    def look(model, update):
        found.extend([model.linear_solves[-1], update])
        raise StopRun

    run(model, on_newton_step=look)
    return found


def test_field_split_solver_finds_the_same_state(field_split_model):
    """After the first time step the unknowns are those of the direct solver, to Newton's tolerance."""
    from petsc_fs.porepy import Adapter, make_model, run

    ours, direct = field_split_model("model1"), make_model("model1")
    run(ours, on_newton_step=stop_in_time_step(2))
    run(direct, on_newton_step=stop_in_time_step(2), linear_solve=lambda model: solve(*model.linear_system))
    states = [m.equation_system.get_variable_values(time_step_index=0) for m in (ours, direct)]
    found, expected = (Adapter(m).from_porepy(v) for m, v in zip((ours, direct), states, strict=True))
    for field, values in expected.items():
        assert np.linalg.norm(found[field] - values) < 1e-4 * np.linalg.norm(values), field


@pytest.mark.parametrize("name", ["model1", "biot", "flow", "contact"])
def test_field_split_solver_records_every_solve(field_split_model, name):
    from petsc_fs.porepy import run

    seen = []

    def look(model, update):
        assert np.isfinite(update).all()
        seen.append((model.time_manager.time_index, model.nonlinear_solver_statistics.num_iteration))

    model = field_split_model(name)
    run(model, on_newton_step=look)
    solves = model.linear_solves
    assert [(s.time_step, s.newton_index) for s in solves] == seen
    assert seen[-1][0] == CASES[name].time_steps
    fracture_cells = sum(g.num_cells for g in model.mdg.subdomains(dim=model.nd - 1))
    for record in solves:
        assert record.converged
        assert record.reason.startswith("CONVERGED")
        assert 0 < record.iterations < 60
        assert np.isfinite(record.true_relative_residual)
        assert record.unknowns == model.equation_system.num_dofs()
        assert sum(record.contact_states.values()) == (fracture_cells if "contact" in FIELDS[name] else 0)
        assert 0 < record.setup_seconds + record.solve_seconds <= record.seconds


def test_field_split_solver_in_3d(field_split_model):
    record, update = first_solve(field_split_model("model3"))
    assert record.converged
    assert record.unknowns == update.size == UNKNOWNS["model3"]
    assert 10 < record.iterations < 30


def test_field_split_solver_is_a_mixin_for_any_model(pp, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # gmsh writes there
    from petsc_fs.porepy import FieldSplitSolver

    class Mine(FieldSplitSolver, pp.SinglePhaseFlow):
        def bc_values_pressure(self, boundary_grid):
            return boundary_grid.cell_centers[0]

    model = Mine({"petsc_fs_options_file": "direct.opts", "times_to_export": []})
    pp.run_time_dependent_model(model, {"progressbars": False})
    assert [s.contact_states for s in model.linear_solves] == [{}] * len(model.linear_solves) != []


def test_options_are_in_the_database_during_solves_only(field_split_model):
    """What stands there goes first, as the command line does, and stays."""
    from petsc4py import PETSc

    database = PETSc.Options()
    before = database.getAll()
    database.setValue("ksp_max_it", 3)
    try:
        record, update = first_solve(field_split_model("model1"))
        assert database.getAll() == before | {"ksp_max_it": "3"}
    finally:
        database.delValue("ksp_max_it")
    assert (record.iterations, record.converged) == (3, False)
    assert record.reason.startswith("DIVERGED")
    assert np.isfinite(update).all()
    database.setValue("mine_ksp_max_it", 4)
    try:
        record, _ = first_solve(field_split_model("model1", petsc_fs_options_prefix="mine_"))
    finally:
        database.delValue("mine_ksp_max_it")
    assert record.iterations == 4
    assert first_solve(field_split_model("model1"))[0].converged


def test_options_file_of_a_model(field_split_model, tmp_path):
    file = tmp_path / "typo.opts"
    file.write_text("-ksp_type gmres\n-ksp_rtoll 1e-3\n-pc_type none\n-ksp_max_it 5\n")
    with pytest.raises(UsageError, match=r"option -ksp_rtoll from typo.opts was not used; did you mean -ksp_rtol"):
        first_solve(field_split_model("flow", petsc_fs_options_file=str(file)))
    with pytest.raises(UsageError, match=r"flow.opts is for models with the fields intf_flow, mass; this one has"):
        first_solve(field_split_model("model1", petsc_fs_options_file="flow.opts"))
    with pytest.raises(UsageError, match="no such file"):
        first_solve(field_split_model("flow", petsc_fs_options_file="nothing.opts"))


# Parity with the published code

SOME = [[[12, 6, 0, 0], [13, 0, 6, 0]], [[15, 3, 3, 0]]]


def test_published_counts():
    origin, counts = parity.published()
    assert "d9b687b" in origin
    assert list(counts) == list(parity.RUNS)
    means = {name: round(parity.mean_iterations(history), 2) for name, history in counts.items()}
    assert (means["model1_g1"], means["model2_g5"], means["model3_g1"]) == (14.45, 19.71, 26.19)
    assert means["richardson_Kn1.2e+09_F0.577"] == 25.0
    assert all(len(history) == CASES[parity.RUNS[name].model].time_steps for name, history in counts.items())


@pytest.mark.parametrize(
    ("theirs", "expected"),
    [
        (SOME, ((2, 2), (1, 1), (2, 2), None, ([], []))),
        ([[[9, 6, 0, 0], [9, 0, 6, 0]], [[9, 2, 4, 0]]], ((1, 2), (1, 1), (1, 2), (2, 0), ([3, 3, 0], [2, 4, 0]))),
        ([[[12, 6, 0, 0]], [[15, 3, 3, 0]]], ((2, 2), (0, 0), (1, 2), (1, 1), ([0, 6, 0], []))),
    ],
    ids=["equal", "states", "newton steps"],
)
def test_comparison_of_histories(theirs, expected):
    found = parity.compare(SOME, theirs)
    assert (found.starts, found.later, found.ends, found.first, found.first_states) == expected


@pytest.mark.parametrize("name", ["model1_g1", "richardson_Kn1.2e+09_F0.577"])
def test_parity(pp, name):
    lines = []
    measured = parity.run(name, lines.append)
    assert parity.missed({"petsc_fs": {name: measured}}) == []
    assert measured.unconverged == 0
    assert len(lines) == sum(len(step) for step in measured.history)
    assert lines[0].startswith(f"{name}: time step 1, Newton step 0: {measured.history[0][0][0]} iterations, ")


def test_parity_page(tmp_path):
    """Results survive their file; the page has them, and what is too far off is named."""
    _, counts = parity.published()
    results = parity.read(tmp_path / "new.json")
    off = [[[n + 2, *states] for n, *states in step] for step in counts["model2_g1"]]
    for name, history in {"model1_g1": counts["model1_g1"], "model2_g1": off}.items():
        results["petsc_fs"][name] = parity.Measured(9876, 1.5, {"PorePy": "1.11"}, history)
    again = [[row[0] + 1 for row in step] for step in counts["model1_g1"]]
    results["published_code"]["model1_g1"] = parity.Measured(9876, 2.5, {}, counts["model1_g1"], again)
    parity.write(results, tmp_path / "new.json")
    assert parity.read(tmp_path / "new.json") == results
    (line,) = parity.missed(results)
    assert line == "model2_g1: mean Krylov iterations differ by +2.00, allowed 1.0"
    page = parity_page.report(results)
    assert (
        "| model1, refinement 1 | 9,876 | 3.67 (7 4 4 2 3 2) | 3.67 (7 4 4 2 3 2) | 14.45 | 14.45 | +0.00 | yes |"
        in page
    )
    assert "| 19.53 | 17.53 | +2.00 | NO |" in page
    assert "Of 22 systems 0 took the same number of iterations, and 22 differ by at most one" in page
    (tmp_path / "bad.json").write_text("[]")
    with pytest.raises(UsageError, match="not a file of parity results"):
        parity.read(tmp_path / "bad.json")


def test_runs_that_do_not_exist(tmp_path):
    with pytest.raises(UsageError, match="unknown run 'model4_g1'; runs are model1_g1, "):
        parity.find_run("model4_g1")
    pytest.importorskip("porepy")
    with pytest.raises(UsageError, match="not the published code"):
        published_code.run("model1_g1", tmp_path)


def test_a_missing_porepy_is_named(tmp_path):
    """Without PorePy the arguments can be listed; a run says what to install."""
    program = (
        "import sys, argparse; sys.modules['porepy'] = None\n"
        "from petsc_fs.errors import UsageError\n"
        "from petsc_fs.porepy import export\n"
        "export.add_arguments(argparse.ArgumentParser())\n"
        "import petsc_fs.porepy\n"
        f"for call in (lambda: export.export('flow', directory={str(tmp_path)!r}), "
        "lambda: petsc_fs.porepy.Adapter):\n"
        "    try: call()\n"
        "    except UsageError as e: print(e)\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    lines = run.stdout.splitlines()
    assert len(lines) == 2
    assert all("PorePy is not installed" in line and "pip install" in line for line in lines)


def test_import_is_lazy():
    program = "import petsc_fs.porepy.export, sys\nsys.exit('porepy' in sys.modules or 'petsc4py.PETSc' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        importlib.import_module("petsc_fs.porepy").nothing  # noqa: B018
