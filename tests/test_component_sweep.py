"""Displacements component by component: what the sweep is, and the contract that every PC must meet."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from test_solver import database  # noqa: F401

import petsc_fs
from petsc_fs.dm import one_matrix
from petsc_fs.errors import SceneError
from petsc_fs.io import hdf5
from petsc_fs.partition import Layout, rows_of
from petsc_fs.pc import contact_transform
from petsc_fs.scene import CSR, Scene
from petsc_fs.solver import Solver
from petsc_fs.system import System

pytestmark = pytest.mark.mpi
comm = MPI.COMM_WORLD
SCENES = Path(petsc_fs.__path__[0]) / "scenes"
DIRECT = {"component_pc_type": "lu", "component_pc_factor_mat_solver_type": "mumps"}
MECHANICS = ("intf_force", "momentum")


def load(name: str) -> Scene:
    return hdf5.read(SCENES / f"{name}.h5")


def mechanics(name: str, mat_type: str, on: MPI.Intracomm = comm) -> PETSc.Mat:
    """The block of mechanics of a bundled scene."""
    scene = load(name).only(MECHANICS)
    layout = Layout.contiguous(on, scene.dimension, scene.sizes)
    system = System(scene.restrict({f: layout.rows(f) for f in layout.fields}), layout)
    return one_matrix(layout.fields, system.blocks, layout, mat_type=mat_type)


def sweep_of(matrix: PETSc.Mat, **choices: str) -> PETSc.PC:
    """A ComponentSweep for a matrix, set up."""
    for option, value in choices.items():
        PETSc.Options()["c_" + option] = value
    pc = PETSc.PC().create(matrix.comm)
    pc.setOptionsPrefix("c_")
    pc.setOperators(matrix, matrix)
    pc.setType("python")
    pc.setPythonType("petsc_fs.pc.ComponentSweep")
    pc.setUp()
    return pc


def random_vector(matrix: PETSc.Mat, seed: int) -> PETSc.Vec:
    """The same numbers on any number of ranks, one after the other as rank 0, 1, ... holds them."""
    x = matrix.createVecRight()
    start, stop = x.getOwnershipRange()
    x.setArray(np.random.default_rng(seed).standard_normal(x.getSize())[start:stop])
    return x


def applied(pc: PETSc.PC, x: PETSc.Vec) -> PETSc.Vec:
    y = x.duplicate()
    pc.apply(x, y)
    return y


def residual_of_triangle(matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec, order: str, D: int) -> float:
    """|x - M y| / |x| with M the block triangle of components of a matrix, entry by entry."""
    indptr, indices, values = matrix.getValuesCSR()
    rows = np.repeat(np.arange(indptr.size - 1), np.diff(indptr)) % D
    kept = {"forward": rows >= indices % D, "backward": rows <= indices % D, "none": rows == indices % D}[order]
    whole = np.concatenate(matrix.comm.tompi4py().allgather(y.getArray()))
    sums = np.concatenate([[0.0], np.cumsum(np.where(kept, values * whole[indices], 0.0))])
    r = x.getArray() - np.diff(sums[indptr])
    squares = matrix.comm.tompi4py().allreduce(np.vdot(r, r))
    return float(np.sqrt(squares) / x.norm())


@pytest.mark.parametrize("order", ["forward", "backward", "none"])
@pytest.mark.parametrize(("scene", "D"), [("model2", 2), ("model3", 3)])
def test_with_exact_inner_solves_it_inverts_the_triangle_of_components(clean, scene, D, order):
    matrix = mechanics(scene, "aij")
    pc = sweep_of(matrix, component_order=order, **DIRECT)
    x = random_vector(matrix, 3)
    assert residual_of_triangle(matrix, x, applied(pc, x), order, D) < 1e-8
    pc.destroy()


def test_a_nest_is_as_good_as_one_matrix(clean):
    results = []
    for mat_type in ("aij", "nest"):
        matrix = mechanics("model3", mat_type)
        pc = sweep_of(matrix, **DIRECT)
        results.append(applied(pc, random_vector(mechanics("model3", "aij"), 5)).getArray().copy())
        pc.destroy()
    np.testing.assert_allclose(results[1], results[0], rtol=1e-8, atol=1e-10 * np.abs(results[0]).max(initial=0))


def test_it_is_linear_leaves_its_input_and_ignores_old_output(clean):
    matrix = mechanics("model2", "nest")
    pc = sweep_of(matrix, component_pc_type="jacobi")
    u, v = (random_vector(mechanics("model2", "aij"), seed) for seed in (1, 2))
    before = u.getArray().copy()
    combined = u.copy()
    combined.axpby(-3.0, 2.0, v)
    expected = applied(pc, u)
    expected.axpby(-3.0, 2.0, applied(pc, v))
    found = u.duplicate()
    found.set(1e6)
    pc.apply(combined, found)
    found.axpy(-1.0, expected)
    assert found.norm() <= 1e-12 * expected.norm()
    np.testing.assert_array_equal(u.getArray(), before)
    pc.destroy()
    pc.destroy()


def test_vectors_need_no_block_size(clean):
    matrix = mechanics("model3", "aij")
    pc = sweep_of(matrix, component_pc_type="jacobi")
    x = random_vector(matrix, 6)
    plain = PETSc.Vec().createMPI(x.getSizes(), comm=matrix.comm)
    x.copy(plain)
    assert plain.getBlockSize() == 1 < x.getBlockSize()
    for _ in range(2):
        np.testing.assert_array_equal(applied(pc, plain).getArray(), applied(pc, x).getArray())
    pc.destroy()


def test_a_second_set_up_sees_new_values(clean):
    matrix = mechanics("model2", "aij")
    pc = sweep_of(matrix, component_pc_type="jacobi")
    x = random_vector(matrix, 4)
    first = applied(pc, x)
    matrix.scale(2.0)
    pc.setUp()
    second = applied(pc, x)
    second.axpby(-1.0, 2.0, first)
    assert second.norm() <= 1e-13 * first.norm()


def test_a_wrong_order_is_refused(clean):
    with pytest.raises(Exception, match=r"forward or backward or none|error code 101"):
        sweep_of(mechanics("model2", "aij"), component_order="sideways", component_pc_type="jacobi")


@pytest.mark.parametrize("file", ["contact_poromechanics", "contact_poromechanics_fast", "contact_poromechanics_left"])
def test_blocks_by_reference_and_copies_of_them_are_as_good(database, monkeypatch, file):  # noqa: F811
    """The former for scenes with many rows per rank, the latter where there are few; also after new values."""
    database(f"{file}.opts")
    scene = load("model2")
    doubled = replace(scene, blocks={rc: b._replace(data=2.0 * b.data) for rc, b in scene.blocks.items()})
    histories = []
    for rows in (0, contact_transform.FEW_ROWS):
        monkeypatch.setattr(contact_transform, "FEW_ROWS", rows)
        solver = Solver(scene)
        assert solver.solve().converged
        histories.append(solver.history())
        solver.update(doubled)
        result = solver.solve()
        assert result.converged
        for f, values in result.solution.items():
            expected = 0.5 * scene.reference[f][rows_of(solver.layout.own_cells(f), scene.block_size(f))]
            whole = np.sqrt(comm.allreduce(np.vdot(values - expected, values - expected)))
            assert whole < 1e-2 * np.linalg.norm(scene.reference[f])
        solver.destroy()
    np.testing.assert_allclose(histories[0][:8], histories[1][:8], rtol=1e-6)


@pytest.mark.parametrize("scene", ["model1", "model2", "model3"])
def test_the_fast_file_needs_at_most_a_few_more_iterations(database, scene):  # noqa: F811
    """Than the coupled multigrid of the published configuration; and it finds the same solution."""
    counts = {}
    for file in ("contact_poromechanics.opts", "contact_poromechanics_fast.opts"):
        database(file)
        result = Solver(load(scene)).solve()
        assert result.converged
        assert max(result.error_by_field.values()) < 1e-2
        counts[file] = result.iterations
        for name in PETSc.Options().getAll():
            if name.startswith(("ksp_", "pc_", "qr_")):
                PETSc.Options().delValue(name)
    base, fast = counts.values()
    assert fast <= 1.6 * base


def test_a_zero_diagonal_is_refused_before_hypre_crashes_on_it(database):  # noqa: F811
    database("poromechanics_fast.opts")
    scene = load("biot")
    stiffness = scene.blocks["momentum", "momentum"]
    data = stiffness.data.copy()
    data[stiffness.indptr[2] : stiffness.indptr[3]] = 0.0
    blocks = scene.blocks | {("momentum", "momentum"): CSR(stiffness.indptr, stiffness.indices, data)}
    with pytest.raises(SceneError, match="component_: 1 equations of displacements have a zero on the diagonal"):
        Solver(replace(scene, blocks=blocks)).solve()
