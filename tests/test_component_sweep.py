"""Displacements component by component: what the sweep is.

The contract of every PC is in test_pc.
"""

import numpy as np
import pytest
from common import MPI, block_of, comm, gathered, load, system_of, verified, with_block
from petsc4py import PETSc
from test_pc import LU, MECHANICS, python_pc, said, under

from petsc_fs import nest
from petsc_fs.errors import SceneError
from petsc_fs.solver import Solver

pytestmark = pytest.mark.mpi
DIRECT = under("component_", LU)


def mechanics(name: str, kind: str = "aij", on: MPI.Intracomm = comm) -> PETSc.Mat:
    """The block of mechanics of a bundled scene, in one matrix or in a nest."""
    J = system_of(load(name).only(MECHANICS), on).J
    return nest.one_matrix(J) if kind == "aij" else J


def random_vector(matrix: PETSc.Mat, seed: int) -> PETSc.Vec:
    """The same numbers on any number of ranks, one after the other as rank 0, 1, ... holds them."""
    x = matrix.createVecRight()
    x.setArray(np.random.default_rng(seed).standard_normal(x.getSize())[slice(*x.getOwnershipRange())])
    return x


def applied(pc: PETSc.PC, x: PETSc.Vec) -> np.ndarray:
    y = x.duplicate()
    y.set(1e6)  # which has no say in the outcome
    pc.apply(x, y)
    return y.getArray().copy()


@pytest.mark.parametrize("order", ["forward", "backward", "none"])
@pytest.mark.parametrize(("scene", "D"), [("model2", 2), ("model3", 3)])
def test_with_exact_inner_solves_it_inverts_the_triangle_of_components(clean, scene, D, order):
    matrix = mechanics(scene)
    pc = python_pc(matrix, "ComponentSweep", component_order=order, **DIRECT)
    x = random_vector(matrix, 3)
    whole = np.concatenate(comm.allgather(applied(pc, x)))
    indptr, indices, values = matrix.getValuesCSR()
    rows = np.repeat(np.arange(indptr.size - 1), np.diff(indptr))  # ranks begin with a first component
    k, m = rows % D, indices % D
    kept = {"forward": k >= m, "backward": k <= m, "none": k == m}[order]
    product = np.bincount(rows[kept], (values * whole[indices])[kept], minlength=indptr.size - 1)
    r = x.getArray() - product
    assert np.sqrt(comm.allreduce(np.vdot(r, r))) < 1e-8 * x.norm()
    pc.destroy()


def test_a_nest_is_as_good_as_one_matrix(clean):
    results = []
    for kind in ("aij", "nest"):
        pc = python_pc(mechanics("model3", kind), "ComponentSweep", **DIRECT)
        results.append(applied(pc, random_vector(mechanics("model3"), 5)))
        pc.destroy()
    np.testing.assert_allclose(results[1], results[0], rtol=1e-8, atol=1e-10 * np.abs(results[0]).max(initial=0))


def test_vectors_need_no_block_size(clean):
    matrix = mechanics("model3")
    pc = python_pc(matrix, "ComponentSweep", component_pc_type="jacobi")
    x = random_vector(matrix, 6)
    plain = PETSc.Vec().createMPI(x.getSizes(), comm=matrix.comm)
    x.copy(plain)
    assert plain.getBlockSize() == 1 < x.getBlockSize()
    for _ in range(2):
        np.testing.assert_array_equal(applied(pc, plain), applied(pc, x))
    pc.destroy()


def test_a_matrix_that_is_kept_may_have_new_values(clean):
    matrix = mechanics("model2")
    pc = python_pc(matrix, "ComponentSweep", component_pc_type="jacobi")
    x = random_vector(matrix, 4)
    first = applied(pc, x)
    matrix.scale(2.0)
    pc.setUp()
    np.testing.assert_allclose(applied(pc, x), first / 2, rtol=1e-12)
    pc.destroy()


@pytest.mark.parametrize(
    ("name", "order", "message"),
    [
        ("model2", "sideways", "-c_component_order sideways: expected forward or backward or none"),
        ("flow", "none", "has no components"),
    ],
)
def test_what_it_cannot_sweep_is_refused(clean, name, order, message):
    matrix = mechanics(name) if name == "model2" else system_of(load(name)).blocks["mass", "mass"]
    with pytest.raises(Exception, match=r".*") as caught:
        python_pc(matrix, "ComponentSweep", component_order=order, component_pc_type="jacobi")
    assert message in said(caught.value)


@pytest.mark.parametrize("name", ["model1", "model2", "model3"])
def test_the_fast_file_needs_at_most_a_few_more_iterations(database, clean, name):
    """Than the coupled multigrid of the published configuration; and it finds the same solution."""
    iterations = []
    for file in ("contact_poromechanics.opts", "contact_poromechanics_fast.opts"):
        for option in clean.getAll():
            clean.delValue(option)
        database(file)
        scene = load(name)
        result = verified(scene, Solver(scene))
        assert result.converged
        assert max(result.error_by_field.values()) < 1e-2
        iterations.append(result.passes[0])
    assert iterations[1] <= 1.6 * iterations[0]


def test_a_zero_diagonal_is_refused_before_hypre_crashes_on_it(database):
    database("poromechanics_fast.opts")
    A = block_of(load("biot"), "momentum", "momentum")
    A[2] = 0.0
    with pytest.raises(SceneError, match="component_: 1 equations of displacements have a zero on the diagonal"):
        Solver(with_block(load("biot"), "momentum", "momentum", A)).solve()


def test_its_matrices_are_those_of_the_scene():
    """What is swept above, against the scene's own numbers."""
    matrix, scene = mechanics("model2", on=MPI.COMM_SELF), load("model2")
    found, first = gathered(matrix), scene.sizes["intf_force"]
    np.testing.assert_array_equal(found[first:, first:], block_of(scene, "momentum", "momentum"))
