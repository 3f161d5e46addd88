"""Matrices without their small entries, against dense algebra."""

import numpy as np
import pytest
from common import comm, gathered, load, system_of
from petsc4py import PETSc
from test_component_sweep import mechanics
from test_pc import LU, inner_matrix, python_pc, under

from petsc_fs import nest
from petsc_fs.pc import component_sweep
from petsc_fs.pc.sparser import sparser

pytestmark = pytest.mark.mpi


def expected(A: np.ndarray, share: float) -> np.ndarray:
    """What is left of a dense matrix whose zeros are no entries."""
    limits = np.minimum(share, 1 / np.count_nonzero(A, axis=1)) * np.abs(np.diag(A))
    left = np.where(np.abs(A) < limits[:, None], 0.0, A)
    return left + np.diag((A - left).sum(axis=1))


def a_component() -> PETSc.Mat:
    return component_sweep._component([[mechanics("model3")]], 3, 1, 1)


def distributed(A: np.ndarray) -> PETSc.Mat:
    """A dense matrix without its zeros, as PETSc distributes it."""
    start, stop = PETSc.Vec().createMPI(len(A), comm=comm).getOwnershipRange()
    rows, own = A[start:stop], (stop - start, len(A))
    indptr = np.concatenate([[0], np.cumsum(np.count_nonzero(rows, axis=1))]).astype(PETSc.IntType)
    csr = indptr, rows.nonzero()[1].astype(PETSc.IntType), rows[rows != 0]
    return PETSc.Mat().createAIJ((own, own), csr=csr, comm=comm)


@pytest.mark.parametrize("share", [0.01, 0.03, 0.9])
def test_small_entries_go_to_the_diagonal(share):
    A = gathered(a_component())
    B = sparser(a_component(), share)
    found = gathered(B)
    np.testing.assert_allclose(found, expected(A, share), rtol=0, atol=1e-13 * np.abs(A).max())
    assert np.count_nonzero(found) < 0.5 * np.count_nonzero(A)
    assert B.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"] == np.count_nonzero(found)
    assert (np.diag(found) * np.diag(A) > 0).all()


def test_where_few_would_go_the_matrix_stays():
    for share in (0.0, 1e-6):
        A = a_component()
        assert sparser(A, share) is A


def test_rows_without_a_diagonal_stay_and_no_diagonal_changes_sign():
    A = np.full((12, 12), -0.05)
    np.fill_diagonal(A, 1.0)
    A[4] = np.linspace(-1, 1, 12)
    A[4, 4] = 0.0
    A[7, 7] = -1.0  # whose other entries add up to more than half of it
    for row in (0, 11):
        A[row] = 0.0
    A[0, 0] = 2.0
    A[11, 11] = 1e-9
    B = sparser(distributed(A), 0.06)
    np.testing.assert_allclose(gathered(B), expected(A, 0.06), rtol=1e-14, atol=1e-15)
    assert np.count_nonzero(gathered(B)) == 10 + 12 - 1 + 1


def test_pcs_take_it_for_what_their_inner_pcs_see(clean):
    A = mechanics("model3")
    pc = python_pc(A, "ComponentSweep", component_drop="0.01", **under("component_", LU))
    for k, inner in enumerate(pc.getPythonContext().inners):
        whole = gathered(component_sweep._component([[A]], 3, k, k))
        found = gathered(inner.getOperators()[1])
        np.testing.assert_allclose(found, expected(whole, 0.01), rtol=0, atol=1e-13 * np.abs(whole).max())
    pc.destroy()
    J = system_of(load("model3").only(["intf_flow", "mass"])).J
    inside = []
    for drop in ("0", "0.005"):
        pc = python_pc(J, "FixedStress", fs_drop=drop, fs_pc_type="none")
        inside.append(gathered(nest.blocks_of(inner_matrix(pc))["mass", "mass"]))
        pc.destroy()
    np.testing.assert_allclose(inside[1], expected(inside[0], 0.005), rtol=0, atol=1e-13 * np.abs(inside[0]).max())
    assert np.count_nonzero(inside[1]) < 0.5 * np.count_nonzero(inside[0])
