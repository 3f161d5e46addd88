"""The solver on real scenes: accuracy, second solves, unequal layouts, how often leaves are set up."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

import petsc_fs
from petsc_fs import options
from petsc_fs.errors import SolveError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.partition import Layout
from petsc_fs.scene import CSR, Scene
from petsc_fs.solver import Solver
from petsc_fs.system import PatternChanged, System
from petsc_fs.tools import stress_cases

pytestmark = pytest.mark.mpi
comm = MPI.COMM_WORLD
SCENES = Path(petsc_fs.__path__[0]) / "scenes"
MECHANICS = "qr_fieldsplit_1_fieldsplit_mechanics_"


@pytest.fixture
def database():
    """Insert options files and options; all of them are gone after the test."""
    mine = PETSc.Options()
    before = mine.getAll()

    def insert(file: str | None, **more: str) -> None:
        for name, value in more.items():
            mine.setValue(name, value)
        if file is not None:
            options.insert(options.find_options_file(file))

    yield insert
    for name in set(mine.getAll()) - set(before):
        mine.delValue(name)


def load(name: str) -> Scene:
    return hdf5.read(SCENES / f"{name}.h5")


def scaled(scene: Scene, factor: float) -> Scene:
    """The same scene with the fracture part of its matrix and its right-hand side changed."""
    blocks = {
        rc: CSR(b.indptr, b.indices, b.data * (factor if "contact" in rc else 1.0)) for rc, b in scene.blocks.items()
    }
    return replace(scene, blocks=blocks, rhs={f: factor * v for f, v in scene.rhs.items()}, reference={})


@pytest.mark.parametrize("name", ["model1", "model2", "model3"])
def test_contact_poromechanics_finds_the_reference_solution(database, name):
    database("contact_poromechanics.opts", ksp_rtol="1e-12", ksp_atol="1e-50")
    result = Solver(load(name)).solve()
    assert result.converged
    assert max(result.error_by_field.values()) < 1e-6


@pytest.mark.parametrize("name", ["model1", "model2"])
def test_direct_subsolves_take_as_few_iterations_as_the_paper_says(database, name):
    database("contact_poromechanics_direct.opts", petsc_fs_error_factor="0")  # the paper judges by the residual
    assert Solver(load(name)).solve().iterations <= 6


@pytest.mark.parametrize("name", ["model1", "model2", "model3"])
def test_second_solve_sees_the_new_values(database, name):
    database("contact_poromechanics.opts")
    first, second = load(name), scaled(load(name), 1.7)
    solver = Solver(first)
    solver.solve()
    solver.update(second)
    again = solver.solve()
    fresh = Solver(second).solve()
    assert again.iterations == fresh.iterations
    assert again.true_relative_residual == pytest.approx(fresh.true_relative_residual, rel=1e-2)
    for f in first.fields:
        scale = comm.allreduce(np.abs(fresh.solution[f]).max(initial=0), MPI.MAX)
        np.testing.assert_allclose(again.solution[f], fresh.solution[f], rtol=0, atol=1e-7 * scale)


def test_update_keeps_the_matrices(database):
    database("contact_poromechanics.opts")
    solver = Solver(load("model1"))
    handles = {rc: m.handle for rc, m in solver.system.blocks.items()}
    solver.update(scaled(load("model1"), 2.0))
    assert {rc: m.handle for rc, m in solver.system.blocks.items()} == handles


def test_system_refuses_a_new_pattern_and_the_solver_adapts(database):
    database("contact_poromechanics.opts")
    full = load("model1")
    fewer = replace(full, blocks=dict(full.blocks))
    b = full.blocks["mass", "mass"]
    keep = np.repeat(np.arange(b.indptr.size - 1), np.diff(b.indptr)) == b.indices
    indptr = np.concatenate([[0], np.cumsum(np.bincount(b.indices[keep], minlength=b.indptr.size - 1))])
    fewer.blocks["mass", "mass"] = CSR(indptr, b.indices[keep], b.data[keep])
    layout = Layout.contiguous(comm, full.dimension, full.sizes)
    rows = {f: layout.rows(f) for f in layout.fields}
    system = System(fewer.restrict(rows), layout)
    with pytest.raises(PatternChanged):
        system.update(full.restrict(rows))
    solver = Solver(fewer)
    solver.update(full)
    assert solver.solve().converged


class CountingPC:
    """Jacobi that counts its set-ups and looks at its matrix."""

    set_ups = 0
    block_size = 0
    near_null_vectors = 0

    def setUp(self, pc):
        matrix = pc.getOperators()[1]
        CountingPC.set_ups += 1
        CountingPC.block_size = matrix.getBlockSize()
        CountingPC.near_null_vectors = len(matrix.getNearNullSpace().getVecs())
        self.inverse = matrix.getDiagonal()
        self.inverse.reciprocal()

    def apply(self, pc, x, y):
        y.pointwiseMult(x, self.inverse)


@pytest.mark.parametrize(("name", "modes"), [("model2", 3), ("model3", 6)])
def test_mechanics_leaf_is_set_up_once_per_matrix_with_block_size_and_rigid_body_modes(database, name, modes):
    leaf = {f"{MECHANICS}pc_type": "python", f"{MECHANICS}pc_python_type": f"{__name__}.CountingPC"}
    database("contact_poromechanics.opts", ksp_max_it="3", **leaf)
    CountingPC.set_ups = 0
    scene = load(name)
    solver = Solver(scene)
    solver.solve()
    solver.solve()
    assert CountingPC.set_ups == 1
    assert CountingPC.block_size == scene.dimension
    assert CountingPC.near_null_vectors == modes
    solver.update(scaled(scene, 1.5))
    solver.solve()
    assert CountingPC.set_ups == 2


def unequal(scene: Scene) -> Layout:
    """All fracture cells on the last rank, nothing but rock on the others."""
    cells = {}
    for f in scene.fields:
        n = scene.sizes[f] // scene.block_size(f)
        if f in ("momentum", "mass"):
            cells[f] = np.diff((n * np.arange(comm.size + 1)) // comm.size)
        else:
            cells[f] = np.where(np.arange(comm.size) == comm.size - 1, n, 0)
    return Layout.from_cells(comm, scene.dimension, cells)


@pytest.mark.parametrize("file", options.shipped(), ids=lambda file: file.path.name)
def test_ranks_without_a_fracture_cell(database, file):
    database(file.path.name)
    scene = next(scene for name in ("model1", "biot", "flow", "contact") if file.fits((scene := load(name)).fields))
    result = Solver(scene, layout=unequal(scene)).solve()
    assert result.converged, result


def test_ranks_that_own_nothing(database):
    database("contact_poromechanics.opts")
    scene = load("model2")
    cells = {f: np.where(np.arange(comm.size) == 0, scene.sizes[f] // scene.block_size(f), 0) for f in scene.fields}
    result = Solver(scene, layout=Layout.from_cells(comm, scene.dimension, cells)).solve()
    assert result.converged
    assert result.iterations == 18


def test_solution_comes_back_in_the_numbering_of_the_scene(database):
    database("direct.opts")
    scene = load("model2")
    solver = Solver(scene)
    whole = solver.system.gather(solver.solve().solution)
    assert (whole is None) == (comm.rank > 0)
    if whole is not None:
        for f in scene.fields:
            assert np.linalg.norm(whole[f] - scene.reference[f]) < 1e-6 * np.linalg.norm(scene.reference[f])


def test_residuals_by_field_add_up(database):
    database("contact_poromechanics.opts", ksp_rtol="1e-4")
    result = Solver(load("model2")).solve()
    total = np.linalg.norm(list(result.residual_by_field.values()))
    assert total == pytest.approx(result.true_relative_residual, rel=1e-10)


def test_too_few_iterations_are_not_convergence(database):
    database("contact_poromechanics.opts", ksp_max_it="2")
    result = Solver(load("model2")).solve()
    assert not result.converged
    assert result.reason == "DIVERGED_MAX_IT"
    assert result.iterations == 2


def test_a_block_of_zeros_in_the_residual_norm_is_not_excused_by_rounding(database):
    """A solve stopped early by a loose -ksp_rtol misses -petsc_fs_true_rtol and says so."""
    database("contact_poromechanics.opts", ksp_rtol="1e-3", petsc_fs_true_rtol="1e-9")
    result = Solver(load("model2")).solve()
    assert result.reason.startswith("CONVERGED")
    assert not result.converged
    assert not result.limited_by_rounding


class Spoiled:
    """Copies, until the fourth application gives no numbers."""

    applications = 0

    def apply(self, pc, x, y):
        Spoiled.applications += 1
        x.copy(y)
        if Spoiled.applications > 3:
            y.set(np.nan)


def test_numbers_that_are_not_finite_stop_a_solve_at_once_and_the_level_is_named(database):
    Spoiled.applications = 0
    database(
        "contact_poromechanics.opts",
        **{f"{MECHANICS}pc_type": "python", f"{MECHANICS}pc_python_type": f"{__name__}.Spoiled"},
    )
    with pytest.raises(SolveError, match=rf"after 3 iterations.*level -{MECHANICS} \(python\)"):
        Solver(load("model2")).solve()


@pytest.mark.parametrize("file", ["contact_poromechanics.opts", "contact_poromechanics_fast.opts"])
@pytest.mark.parametrize(("field", "level"), [("momentum", MECHANICS), ("mass", "fieldsplit_mass_")])
def test_an_entry_that_overflows_is_traced_to_its_level_or_field(database, file, field, level):
    database(file)
    scene = load("model2")
    block = scene.blocks[field, field]
    data = block.data.copy()
    data[data.size // 2] = 1e300
    result = Solver(replace(scene, blocks={**scene.blocks, (field, field): block._replace(data=data)})).solve()
    assert not result.converged
    assert result.reason == "DIVERGED_NANORINF"
    assert result.iterations == 0
    assert any("not finite" in note and (level in note or f"in {field}:" in note) for note in result.notes)


def test_a_right_hand_side_that_overflows_is_named(database):
    database("contact_poromechanics.opts")
    scene = load("model2")
    with pytest.raises(SolveError, match="right-hand side overflows in mass:"):
        Solver(replace(scene, rhs={**scene.rhs, "mass": np.full_like(scene.rhs["mass"], 1e200)})).solve()


def test_a_diverging_iteration_is_stopped(database):
    database("fixed_stress_richardson.opts")
    result = Solver(load("model2")).solve()
    assert result.reason == "DIVERGED_DTOL"
    assert not result.converged
    assert result.iterations < 100


def test_an_iteration_that_stands_still_is_stopped_and_says_so(database):
    """Richardson's iteration with next to no preconditioner, and PETSc's own test again for the next solve."""
    database(None, ksp_type="richardson", ksp_richardson_scale="1e-30", ksp_norm_type="unpreconditioned")
    database("direct.opts", ksp_max_it="1000", petsc_fs_stagnation_window="7", petsc_fs_stagnation_ratio="0.5")
    solver = Solver(load("model2"))
    result = solver.solve()
    assert result.reason == "STAGNATED"
    assert result.iterations == 7
    assert "stagnated: the residual fell by less than 0.5 of itself over the last 7 iterations" in result.notes
    solver.ksp.setTolerances(max_it=5)
    assert solver.solve().reason == "DIVERGED_MAX_IT"


def test_gmres_that_stands_still_is_stopped(database):
    """Without a preconditioner the units of the fields alone keep it from getting anywhere."""
    database(None, ksp_type="gmres", ksp_gmres_restart="5", ksp_pc_side="right", pc_type="none", ksp_rtol="1e-10")
    database(None, petsc_fs_stagnation_window="30", petsc_fs_stagnation_ratio="0.5", petsc_fs_restarts="0")
    result = Solver(load("model2")).solve()
    assert result.reason == "STAGNATED"
    assert 30 <= result.iterations < 1000


@pytest.mark.parametrize(
    "name",
    [
        "petsc_fs_restarts",
        "petsc_fs_true_rtol",
        "petsc_fs_error_factor",
        "petsc_fs_regularize",
        "petsc_fs_stagnation_window",
        "petsc_fs_stagnation_ratio",
        "petsc_fs_reuse_changed",
        "petsc_fs_reuse_age",
    ],
)
def test_what_is_no_number_is_refused(database, name):
    database("flow.opts", **{name: "many"})
    with pytest.raises(UsageError, match=f"-{name} many: expected a.* number"):
        Solver(load("flow"))


@pytest.mark.parametrize("value", [{"petsc_fs_stagnation_window": "-1"}, {"petsc_fs_stagnation_ratio": "1.5"}])
def test_impossible_stagnation_is_refused(database, value):
    database("contact_poromechanics.opts", **value)
    with pytest.raises(UsageError, match="petsc_fs_stagnation_window must not be negative"):
        Solver(load("model2"))


def test_a_hidden_field_is_found_out_without_singular_values(database):
    """Mass balance 1e-8 of the rest: Richardson's iteration stops at rounding, far from the solution."""
    database("fixed_stress_richardson.opts", ksp_max_it="60")
    scene = stress_cases.scaled(stress_cases.load("base"), rows={"mass": 1e-8})
    assert not Solver(scene).solve().converged
