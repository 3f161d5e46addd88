"""Scenes from PorePy models: numbering, blocks, physics and files; and the solver in PorePy models."""

import argparse
import io
import json
import lzma
import subprocess
import sys
from contextlib import contextmanager
from importlib import import_module
from unittest.mock import patch

import numpy as np
import pytest
from mpi4py import MPI
from numpy.testing import assert_allclose, assert_array_equal
from programs import ENVIRONMENT, ROOT
from sample import assert_same

from petsc_fs.errors import LayoutError, SceneError, SolveError, UsageError
from petsc_fs.porepy import export as export_module
from petsc_fs.porepy.cases import CASES, CELL, ModelParameters
from petsc_fs.porepy.direct import solve
from petsc_fs.porepy.export import Steps, add_arguments, export
from petsc_fs.scene import contact_state_counts

pytestmark = pytest.mark.porepy

HOT = ("contact", "intf_force", "momentum", "intf_flow", "intf_fourier", "intf_enthalpy", "mass", "energy")
ALL = ("contact", "intf_force", "momentum", "intf_flow", "mass")
FIELDS = {
    "model1": ALL,
    "model2": ALL,
    "model3": ALL,
    "biot": ("momentum", "mass"),
    "flow": ("intf_flow", "mass"),
    "contact": ("contact", "intf_force", "momentum"),
    "cold2": HOT,
    "cold3": HOT,
}
BUNDLED = [name for name in FIELDS if name != "cold3"]
WITH_CONTACT = [name for name, fields in FIELDS.items() if "contact" in fields]
COARSE = {"model3": 0.25, "cold3": 0.25}
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


def blocks_of(scene, r, c):
    """Dense, (cells of r, cells of c, block size, block size)."""
    b, m, n = scene.blocks[r, c], scene.block_size(r), scene.block_size(c)
    found = np.zeros((scene.sizes[r], scene.sizes[c]))
    found[np.repeat(np.arange(scene.sizes[r]), np.diff(b.indptr)), b.indices] = b.data
    return found.reshape(scene.sizes[r] // m, m, scene.sizes[c] // n, n).swapaxes(1, 2)


def with_system(model, matrix, rhs):
    """Have a model with another linear system within a block."""
    return patch.object(model, "linear_system", (matrix, rhs))


# Scenes


@pytest.mark.parametrize("name", CASES)
def test_a_scene_is_the_system_of_the_model_permuted(captured, name):
    model, adapter, scene, solution, _ = captured(name)
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
    cells |= dict.fromkeys(("intf_fourier", "intf_enthalpy"), cells["intf_flow"]) | {"energy": cells["mass"]}
    for field, size in scene.sizes.items():
        assert size == cells[field] * scene.block_size(field), field
        assert scene.cell_centers[field].shape == (cells[field], 3)
        assert (scene.cell_volumes[field] > 0).all()
    matrix, rhs = model.linear_system
    rows = np.concatenate([adapter.rows[f] for f in scene.fields])
    columns = np.concatenate([adapter.columns[f] for f in scene.fields])
    assert_array_equal(np.sort(rows), np.arange(rows.size))
    assert_array_equal(np.sort(columns), np.arange(rows.size))
    assert abs(matrix.tocsr()[rows][:, columns] - assemble(scene)).max() == 0
    assert_array_equal(rhs[rows], np.concatenate([scene.rhs[f] for f in scene.fields]))
    assert_array_equal(adapter.to_porepy(adapter.from_porepy(solution)), solution)
    scene.validate()


@pytest.mark.parametrize("name", WITH_CONTACT)
def test_contact_rows_and_columns_pair_up_per_cell(captured, name):
    _, _, scene, _, expected = captured(name, "mixed")
    D, state, cells = scene.dimension, scene.contact_state, np.arange(scene.contact_state.size)
    assert all(contact_state_counts(state).values())
    assert_array_equal(state, expected)
    J11 = blocks_of(scene, "contact", "contact")
    own = J11[cells, cells]
    J11[cells, cells] = 0
    assert not J11.any(), "J11 couples fracture cells"
    # C_n of an open cell is t_n = 0; of a closed one it does not have t_n beyond the elastic opening.
    assert_allclose(own[state == 2][:, 0], np.eye(D)[None, 0].repeat((state == 2).sum(), 0), atol=1e-12)
    assert (np.abs(own[state != 2][:, 0, 0]) < 0.1).all()
    assert_array_equal(own[:, 0, 1:], 0)
    # The columns are right too: a fracture cell touches the interface cells on its two sides.
    touched = np.abs(blocks_of(scene, "intf_force", "contact")).sum(axis=(2, 3)) > 0
    assert_array_equal(touched.sum(axis=0), 2)
    interface, fracture = np.nonzero(touched)
    centers = scene.cell_centers
    assert_allclose(centers["intf_force"][interface], centers["contact"][fracture], atol=1e-8)
    for field in ("intf_force", "momentum"):
        every = np.arange(scene.sizes[field] // D)
        diagonal = blocks_of(scene, field, field)[every, every]
        assert (np.linalg.cond(diagonal) < 100).all(), field


def test_first_contact_component_is_normal(captured):
    """On the horizontal fracture of model 1 the normal traction pushes along y."""
    x_by_y = np.abs(blocks_of(captured("model1")[2], "intf_force", "contact")).sum(axis=(0, 1))
    assert_allclose([x_by_y[0, 0], x_by_y[1, 1]], 0, atol=1e-12 * x_by_y.max())


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


def test_material_and_metadata(captured):
    scene = captured("model2", "mixed")[2]
    m, kg = scene.material, scene.metadata.units["kg"]
    assert kg == 1e10
    assert_allclose([m.shear_modulus, m.lame_lambda, m.fluid_compressibility], [1.2, 1.2, 4.559e-10 * kg])
    assert (m.biot_coefficient, m.porosity, m.time_step) == (0.47, 1.3e-2, 900.0)
    assert 997 / kg < m.fluid_density.min() < m.fluid_density.max() < 1010 / kg
    assert_array_equal(m.normal_jump[scene.cell_dimension != 1], 0)
    assert m.normal_jump[scene.cell_dimension == 1][scene.contact_state == 2].min() > 0
    assert captured("contact")[2].material is None
    assert captured("flow")[2].material.biot_coefficient == 0
    for name in ("flow", "biot"):
        assert_array_equal(captured(name)[2].material.normal_jump, 0)
    meta = captured("model1", "2:0")[2].metadata
    assert (meta.model, meta.time_step_index, meta.newton_index, meta.time) == ("model1", 2, 0, 86400.0)
    assert meta.producers["porepy"].startswith("1.1")
    assert meta.units == {"m": 1.0, "s": 1.0, "kg": 1e10}
    assert captured("model1", "1:0", friction=0.1)[2].metadata.model == "model1 (friction=0.1)"


@contextmanager
def without_equations(system, names):
    """Some equations of a model taken away within a block, and how to set them again."""
    image, size = system._equation_image_space_composition, system._equation_image_size_info
    before = {n: (system.equations[n], list(image[n]), size[n]) for n in system.equations}
    try:
        for name in names:
            system.remove_equation(name)
        yield before
    finally:
        for name in list(system.equations):
            system.remove_equation(name)
        for equation, grids, sizes in before.values():
            system.set_equation(equation, grids, sizes)


def test_order_of_equations_does_not_matter(captured):
    """Equations set in another order give the same scene."""
    from petsc_fs.porepy import Adapter

    model, _, expected, *_ = captured("model2", "mixed")
    system, names = model.equation_system, list(model.equation_system.equations)
    last = [names[3], names[0], names[5]]
    with without_equations(system, last) as before, with_system(model, *model.linear_system):
        for name in last:
            system.set_equation(*before[name])
        assert list(system.equations) != names
        model.assemble_linear_system()
        scene = Adapter(model).scene()
    assert scene.sizes == expected.sizes
    assert abs(assemble(scene) - assemble(expected)).max() <= 1e-13 * abs(assemble(expected)).max()


def test_cutting_remembers_patterns(captured):
    """Over systems with the pattern of the one before or another one, as over those of as many models."""
    from petsc_fs.porepy import Adapter

    model, adapter, *_ = captured("model1")
    assert adapter.rows["mass"] is adapter.rows["mass"]
    assert [g.dim for g in adapter.grids("mass")] == [2, 1]
    A, b = model.linear_system
    A = A.tocsr().sorted_indices()
    with with_system(model, A, b):
        first = adapter.scene()
    for k, factor in enumerate((2.0, 3.0, 3.0, 1.0)):
        changed = (A * factor).tolil()
        if k in (1, 2):  # rows of contact and of mass lose entries
            for row in (adapter.rows["contact"][0], adapter.rows["mass"][3]):
                changed[row, [c for c in changed.rows[row] if c != row][:2]] = 0
        with with_system(model, changed.tocsr(), b):
            found = adapter.scene()
            assert_same(found, Adapter(model).scene())
        kept = [rc for rc, block in found.blocks.items() if block.indices is first.blocks[rc].indices]
        assert ("momentum", "momentum") in kept
        assert (("contact", "intf_force") in kept) == (k == 0)


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
    other = csr_matrix((data.ravel(), indices.ravel(), columns * A.indptr), A.shape)
    with with_system(model, other, full[1]):
        assert_same(adapter.scene(), expected)


def test_systems_that_are_none_of_ours(captured):
    from petsc_fs.porepy import Adapter

    model, adapter, *_ = captured("model1")
    A, b = model.linear_system
    with with_system(model, A[:10, :10], b[:10]), pytest.raises(LayoutError, match="10 x 10"):
        adapter.scene()
    broken = A.tocsr().copy()
    broken.data[broken.indptr[adapter.rows["mass"][2]]] = np.nan
    with with_system(model, broken, b), pytest.raises(SceneError, match=r"\(mass, .*row 2 .*not finite"):
        adapter.scene()
    with pytest.raises(LayoutError, match="contact: expected 12 values, found nothing"):
        adapter.to_porepy({})
    missing = without_equations(model.equation_system, ["tangential_fracture_deformation_equation"])
    left = f"unknowns {model.contact_traction_variable} and the equations normal_fracture_deformation_equation"
    with missing, pytest.raises(LayoutError, match=left):
        Adapter(model)


def test_unknowns_and_equations_that_do_not_pair_up_are_told_before_anything_is_discretised(pp, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # gmsh writes there
    from petsc_fs.porepy import Adapter, FieldSplitSolver

    class Tracer(FieldSplitSolver, pp.SinglePhaseFlow):
        def create_variables(self):
            super().create_variables()
            self.equation_system.create_variables("tracer", {"cells": 1}, self.mdg.subdomains())

        def rediscretize(self):
            raise AssertionError

        def initial_condition(self):
            super().initial_condition()
            zero = np.zeros(sum(sd.num_cells for sd in self.mdg.subdomains()))
            self.equation_system.set_variable_values(zero, ["tracer"], time_step_index=0, iterate_index=0)

    model = Tracer({"times_to_export": []})
    with pytest.raises(SceneError, match="prepare_simulation"):
        Adapter(model)
    with pytest.raises(LayoutError, match="left are the unknowns tracer and the equations none"):
        model.prepare_simulation()
    assert not any(m for _, d in model.mdg.subdomains(return_data=True) for m in d[pp.DISCRETIZATION_MATRICES].values())


def test_temperatures_are_where_pressures_are(captured):
    """So are fluxes; and what flows carries enthalpy, which Fourier's law does not notice."""
    scene = captured("cold2", "1:2")[2]
    for centers in (scene.cell_centers, scene.cell_volumes):
        assert_array_equal(centers["energy"], centers["mass"])
        for flux in ("intf_fourier", "intf_enthalpy"):
            assert_array_equal(centers[flux], centers["intf_flow"])
    assert ("intf_enthalpy", "intf_flow") in scene.blocks
    assert ("intf_fourier", "intf_flow") not in scene.blocks


# Models


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

    assert solid(captured("model1", "1:1", normal_stiffness=0.0)[0], "maximum_elastic_fracture_opening") == 0


@pytest.mark.parametrize(("permeability", "expected"), [("unit", 1), ("cubic", 1e-8 / 12), ("constant", 1e-14)])
def test_fracture_permeability(captured, permeability, expected):
    """Before anything has opened."""
    from petsc_fs.porepy.adapter import evaluate

    model = captured("model2", "1:0", fracture_permeability=permeability)[0]
    value = evaluate(model, model.fracture_permeability(model.mdg.subdomains(dim=1)))
    assert_allclose(value.reshape(-1, 9)[:, 0], expected)


def test_restricted_mass_is_linear(captured):
    """Storage of the restricted model: rho V (1/M + phi c_f) dp in the rock, whatever the pressure."""
    from petsc_fs.porepy.adapter import evaluate

    model = captured("model1", "1:1", physics="restricted")[0]
    system, rock = model.equation_system, model.mdg.subdomains(dim=2)
    pressure = [v for v in system.variables if v.name == model.pressure_variable and v.domain in rock]
    dofs, state = system.dofs_of(pressure), system.get_variable_values(iterate_index=0)
    masses = []
    for factor in (1, 2, 0):
        changed = state.copy()
        changed[dofs] += factor * 1e-4
        system.set_variable_values(changed, iterate_index=0)
        masses.append(evaluate(model, model.fluid_mass(rock)))
    assert_allclose(masses[1] - masses[2], 2 * (masses[0] - masses[2]), rtol=1e-6)


# Export


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


def test_export_of_steps_that_do_not_occur(pp, tmp_path):
    with pytest.raises(UsageError, match="no Newton step 1:40"):
        export("contact", 1, tmp_path, steps="1:40")
    with pytest.raises(UsageError, match="no Newton step of the run has sticking, sliding and open"):
        export("biot", 1, tmp_path, steps="mixed")
    with pytest.raises(UsageError, match="unknown model"):
        export("model9", 1, tmp_path)


def test_export_on_the_command_line(pp, tmp_path):
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    given = ["--steps", "last", "--refine", "0.5", "--solver", "fieldsplit", "--time-steps", "1"]
    args = parser.parse_args(["flow", "--out", str(tmp_path), *given])
    assert export_module.command(args, [], MPI.COMM_WORLD) == 0
    assert [p.name[:12] for p in tmp_path.iterdir()] == ["flow_g0.5_t1"]


@pytest.mark.parametrize("script", ["make_scenes", "stress_scenes"])
def test_scenes_that_come_along_can_be_made_anew(pp, tmp_path, script):
    from petsc_fs.io.hdf5 import read
    from petsc_fs.tools.stress_cases import COLLECTION

    arguments = ["x.h5.xz", "--only", "base"] if script == "stress_scenes" else [".", "--only", "flow"]
    command = [sys.executable, ROOT / "scripts" / script, *arguments]
    subprocess.run(command, cwd=tmp_path, env=ENVIRONMENT, check=True, capture_output=True)
    if script == "make_scenes":
        ours, bundled = (read(folder / "scenes" / "flow.h5") for folder in (tmp_path, ROOT / "petsc_fs"))
    else:
        ours, bundled = (read_collected(path, "base") for path in (tmp_path / "x.h5.xz", COLLECTION))
    assert ours.sizes == bundled.sizes
    for field, values in bundled.rhs.items():
        assert np.linalg.norm(ours.rhs[field]) == pytest.approx(np.linalg.norm(values), rel=0.05, abs=1e-9)


def read_collected(path, name):
    import h5py

    from petsc_fs.io.hdf5 import read_group

    with h5py.File(io.BytesIO(lzma.decompress(path.read_bytes())), "r") as file:
        return read_group(file[name])


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_scenes(name):
    """They have what they are there for: all contact states, and an accurate reference."""
    pytest.importorskip("scipy")
    from petsc_fs.io.hdf5 import read

    scene = read(ROOT / "petsc_fs" / "scenes" / f"{name}.h5")
    assert scene.fields == FIELDS[name]
    if "contact" in scene.fields:
        assert all(contact_state_counts(scene.contact_state).values())
    assert max(backward_errors(scene, scene.reference).values()) < 1e-12


def test_porepys_own_solver_runs(pp):
    """Without a replacement, PorePy solves; it is a few digits short, which the direct solver is not."""
    from petsc_fs.porepy import Adapter, make_model

    def look(model, solution):
        adapter = Adapter(model)
        plain, direct = map(adapter.from_porepy, (solution, solve(*model.linear_system)))
        for field, values in direct.items():
            assert_allclose(plain[field], values, rtol=1e-2, atol=1e-3 * abs(values).max())

    stopped_after_one_solve(make_model("flow"), look)


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


# FieldSplitSolver


@pytest.fixture
def field_split_model(pp):
    """Make a model that solves by petsc_fs."""
    from petsc_fs.porepy import FieldSplitSolver, make_model

    def make(name, **params):
        model = make_model(name, refinement=COARSE.get(name, 1), mixins=(FieldSplitSolver,))
        model.params.update(params)
        return model

    return make


def stopped_after_one_solve(model, look=lambda model, update: None):
    """Record of the first linear solve, where the model keeps one."""
    from petsc_fs.porepy import run
    from petsc_fs.porepy.models import StopRun

    def stop(model, update):
        assert np.isfinite(update).all()
        look(model, update)
        raise StopRun

    run(model, on_newton_step=stop)
    return model.linear_solves[-1] if hasattr(model, "linear_solves") else None


@pytest.mark.parametrize("name", ["model1", "biot", "flow", "contact"])
def test_every_solve_is_recorded(field_split_model, name):
    from petsc_fs.porepy import run

    seen = []

    def look(model, update):
        assert np.isfinite(update).all()
        seen.append((model.time_manager.time_index, model.nonlinear_solver_statistics.num_iteration))

    model = field_split_model(name)
    run(model, on_newton_step=look)
    assert [(s.time_step, s.newton_index) for s in model.linear_solves] == seen
    assert seen[-1][0] == CASES[name].time_steps
    fracture_cells = sum(g.num_cells for g in model.mdg.subdomains(dim=model.nd - 1))
    for record in model.linear_solves:
        assert record.converged
        assert record.reason.startswith("CONVERGED")
        assert 0 < record.iterations < 60
        assert np.isfinite(record.true_relative_residual)
        assert record.unknowns == model.equation_system.num_dofs()
        assert sum(record.contact_states.values()) == (fracture_cells if "contact" in FIELDS[name] else 0)
        assert 0 < record.setup_seconds + record.solve_seconds <= record.seconds


def test_iterations_and_contact_states_are_those_of_the_published_code(pp, monkeypatch):
    """Each solve from the same contact states takes as many iterations, stopped as the published code stops."""
    monkeypatch.syspath_prepend(ROOT / "scripts")
    page = import_module("page.paper_tables")
    ours, theirs = page.make_run("model1_g1"), page.published("model1_g1")
    assert (ours["unknowns"], ours["missed"], len(ours["history"])) == (798, 0, len(theirs["history"]))
    alike = page.differences(ours, theirs)
    assert max(alike) <= 1
    assert len(alike) >= 18
    assert [row[1:] for row in ours["history"][0]] == [row[1:] for row in theirs["history"][0]]
    newton, krylov = np.subtract(page.means(ours), page.means(theirs))
    assert abs(newton) < 0.5 and abs(krylov) < 0.5


def test_richardson_takes_the_published_iterations_and_its_runs_are_kept(pp, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    page = import_module("page.paper_tables")
    name = "richardson_Kn1.2e+09_F0.1"
    ours = page.make_run(name)
    alike = page.differences(ours, page.published(name))
    assert max(alike) <= 1 and len(alike) == 13
    assert page.means(ours) == pytest.approx((13 / 6, 17.2), abs=0.2)  # as the paper prints
    assert page.shown(ours | {"history": ours["history"][:1]}).endswith("\\*")
    assert page.shown(ours | {"failed": "time step 1"}) == "fails"
    kept = json.loads((ROOT / "docs" / "paper_tables.json").read_text(encoding="utf-8"))
    assert kept.keys() >= {n for n, run in page.RUNS.items() if run.steps == page.STEPS}  # of the others some may miss
    assert [n for n, record in kept.items() if record["digest"] != page.RUNS[n].digest()] == []
    assert max(page.differences(ours, kept[name])) <= 1


def test_three_dimensions(field_split_model):
    record = stopped_after_one_solve(field_split_model("model3"))
    assert record.converged
    assert record.unknowns == UNKNOWNS["model3"]
    assert 10 < record.iterations < 30


def test_it_is_a_mixin_for_any_model(pp, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # gmsh writes there
    from petsc_fs.porepy import FieldSplitSolver

    class Mine(FieldSplitSolver, pp.SinglePhaseFlow):
        def bc_values_pressure(self, boundary_grid):
            return boundary_grid.cell_centers[0]

    model = Mine({"petsc_fs_options_file": "direct.opts", "times_to_export": []})
    pp.run_time_dependent_model(model, {"progressbars": False})
    assert [s.contact_states for s in model.linear_solves] == [{}] * len(model.linear_solves) != []


def test_a_mixin_that_would_do_nothing_is_refused(pp):
    from petsc_fs.porepy import FieldSplitSolver

    with pytest.raises(
        UsageError, match=r"Mine: FieldSplitSolver comes after SolutionStrategy.* put it first: class M"
    ):

        class Mine(pp.SinglePhaseFlow, FieldSplitSolver):
            pass


def test_options_are_in_the_database_during_solves_only(field_split_model, clean):
    """What stands there goes first, as the command line does, and stays."""
    before = clean.getAll()
    clean.setValue("ksp_max_it", 3)
    record = stopped_after_one_solve(field_split_model("model1"))
    assert clean.getAll() == before | {"ksp_max_it": "3"}
    clean.delValue("ksp_max_it")
    assert (record.iterations, record.converged) == (3, False)
    assert record.reason.startswith("DIVERGED")
    clean.setValue("mine_ksp_max_it", 4)
    assert stopped_after_one_solve(field_split_model("model1", petsc_fs_options_prefix="mine_")).iterations == 4
    clean.delValue("mine_ksp_max_it")
    assert stopped_after_one_solve(field_split_model("model1")).converged


def test_options_file_of_a_model(field_split_model, tmp_path):
    file = tmp_path / "typo.opts"
    file.write_text("-ksp_type gmres\n-ksp_rtoll 1e-3\n-pc_type none\n-ksp_max_it 5\n")
    for name, given, message in (
        ("flow", str(file), r"option -ksp_rtoll from typo.opts was not used; did you mean -ksp_rtol"),
        ("model1", "flow.opts", r"flow.opts is for scenes with the fields intf_flow, mass; this one has"),
        ("flow", "nothing.opts", "no such file"),
    ):
        with pytest.raises(UsageError, match=message):
            stopped_after_one_solve(field_split_model(name, petsc_fs_options_file=given))


# Without PorePy


def test_porepy_is_imported_no_earlier_than_it_is_used():
    """The command line can be described without it; where it is missing, what to install is said."""
    program = (
        "import sys, petsc_fs.porepy.export, petsc_fs.porepy.simulation\n"
        "assert 'porepy' not in sys.modules and 'petsc4py.PETSc' not in sys.modules\n"
        "sys.modules['porepy'] = None\n"
        "try: petsc_fs.porepy.Adapter\n"
        "except petsc_fs.porepy.PorePyMissingError as e: print(e)\n"
        "petsc_fs.porepy.nothing"
    )
    run = subprocess.run([sys.executable, "-c", program], env=ENVIRONMENT, capture_output=True, text=True, check=False)
    assert "PorePy is not installed" in run.stdout
    assert "pip install" in run.stdout
    assert run.stderr.endswith("AttributeError: module 'petsc_fs.porepy' has no attribute 'nothing'\n")
