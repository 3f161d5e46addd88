"""Nearly singular blocks: lifted in the preconditioner alone, and named with cell and contact state."""

import re
from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc

from petsc_fs import options
from petsc_fs.cli.main import tree_for
from petsc_fs.diagnostics import explain_weakness, transformed_contact_block
from petsc_fs.errors import SceneError, UsageError
from petsc_fs.partition import Layout
from petsc_fs.scene import CONTACT_STATES, CSR, Scene, diagonal_blocks
from petsc_fs.solver import Solver
from petsc_fs.system import System
from petsc_fs.tools.stress_cases import load, with_block_of_cell

comm = MPI.COMM_WORLD
FAST = "contact_poromechanics_fast.opts"
pytestmark = pytest.mark.mpi


@pytest.fixture
def solver(clean):
    """Solvers by an options file or the smallest tree, with further options."""

    def create(scene: Scene, file: str = "", **more: str) -> Solver:
        options.insert_all(more)
        options.insert_all(options.parse(options.find_options_file(file)) if file else tree_for(scene, comm).options)
        return Solver(scene, comm)

    return create


def weak(name: str = "intf_force", factor: float = 1e-13, cell: int = 3) -> Scene:
    return with_block_of_cell(load("base"), name, cell, factor)


def without_contact_block(cell: int) -> Scene:
    """J_11 changed at one cell so that J~_11 vanishes there, which leaves J as regular as it was."""
    scene = load("base")
    alone = MPI.COMM_SELF
    system = System(scene, Layout.contiguous(alone, scene.dimension, scene.sizes))
    transformed = transformed_contact_block(system.problem)
    assert transformed is not None
    D = scene.dimension
    wrong = diagonal_blocks(CSR(*transformed.getValuesCSR()), D)[cell]
    dense = np.zeros((scene.sizes["contact"],) * 2)
    block = scene.blocks["contact", "contact"]
    rows = np.repeat(np.arange(len(dense)), np.diff(block.indptr))
    dense[rows, block.indices] = block.data
    here = slice(D * cell, D * cell + D)
    dense[here, here] -= wrong
    filled = np.nonzero(dense)
    indptr = np.concatenate([[0], np.cumsum(np.bincount(filled[0], minlength=len(dense)))])
    changed = CSR(indptr, filled[1], dense[filled])
    return replace(scene, blocks={**scene.blocks, ("contact", "contact"): changed}, reference={})


def error(solver: Solver, solution: dict, exact: dict) -> float:
    """Largest relative error of any field against the solution of another solver with the same layout."""
    difference = solver.system.field_norms({f: solution[f] - exact[f] for f in exact})
    size = solver.system.field_norms(exact)
    return max(difference[f] / size[f] for f in size)


@pytest.mark.parametrize(
    ("make", "block", "least", "file"),
    [
        (weak, "J_22 (intf_force)", 1e-2, ""),
        (weak, "J_22 (intf_force)", 1e-2, FAST),
        (lambda: weak("intf_force", 0.0), "J_22 (intf_force)", 1e-2, ""),
        (lambda: weak("intf_flow"), "J_44 (intf_flow)", 1e-2, FAST),
        (lambda: weak("intf_flow", 0.0), "J_44 (intf_flow)", 1e-2, ""),
        (lambda: without_contact_block(3), "J~_11 (contact)", 0.1, FAST),
    ],
    ids=["d22", "d22_fast", "zero_d22", "j44_fast", "zero_j44", "j11_fast"],
)
def test_weak_blocks_are_lifted_in_the_preconditioner_and_the_answer_is_that_of_the_matrix(
    solver, make, block, least, file
):
    one = solver(make(), file, petsc_fs_regularize=str(least), ksp_rtol="1e-11")
    given = {rc: matrix.norm() for rc, matrix in one.system.blocks.items()}
    result = one.solve()
    assert result.converged and result.iterations <= 50  # with restarts for what the estimate leaves in doubt
    (note,) = [note for note in result.notes if "for the preconditioner only" in note]
    state = CONTACT_STATES[load("base").contact_state[3]]
    assert f"{block} was lifted to {least:.1e} of what is usual at cell 3 ({state}) from " in note
    scales = one.system.row_scale  # powers of two
    assert {rc: matrix.norm() / scales[rc[0]] for rc, matrix in one.system.blocks.items()} == given
    residual = one.system.b.duplicate()
    one.system.J.mult(one.x, residual)
    assert (residual - one.system.b).norm() <= result.tolerance * one.system.b.norm()
    for name in ("ksp_type", "pc_type", "petsc_fs_mat_type"):
        PETSc.Options().delValue(name)
    direct = solver(make(), "retry.opts").solve()
    assert direct.converged
    assert error(one, result.solution, direct.solution) < 1e-5


def test_nothing_is_lifted_by_default_or_where_nothing_is_weak(solver):
    assert solver(load("base"), petsc_fs_regularize="1e-2").solve().notes == ()
    PETSc.Options().delValue("petsc_fs_regularize")
    with pytest.raises(SceneError, match=r"D_22.*singular at cell 3;.*-petsc_fs_regularize \(try 0.01\)"):
        solver(weak(factor=0.0)).solve()


def test_the_next_matrix_is_looked_at_anew(solver):
    one = solver(weak(), petsc_fs_regularize="1e-2")
    assert "at cell 3 " in one.solve().notes[0]
    one.update(load("base"))
    result = one.solve()
    assert result.notes == ()
    one.update(weak(cell=5))
    again = one.solve()
    assert again.converged and "at cell 5 " in again.notes[0]


@pytest.mark.parametrize("value", ["-1", "1"])
def test_an_impossible_strength_is_refused(solver, value):
    with pytest.raises(UsageError, match="-petsc_fs_regularize"):
        solver(load("base"), petsc_fs_regularize=value)


@pytest.mark.parametrize(
    ("name", "cell"), [("intf_force", 8), ("intf_force", 9), ("intf_force", 30), ("intf_flow", 20)]
)
def test_a_weak_block_is_named_with_its_contact_state(solver, name, cell):
    """Cells of an interface are where those of its fracture are, on either side."""
    scene = weak(name, cell=cell)
    place = scene.cell_centers[name][cell]
    state = CONTACT_STATES[scene.contact_state[np.linalg.norm(scene.cell_centers["contact"] - place, axis=1).argmin()]]
    one = solver(scene)
    (line,) = explain_weakness(one.system.problem, one.scene)
    assert re.search(rf"\({name}\) is nearly singular at cell {cell} \({state}\): \d\.\de-\d+ of what is usual", line)


def test_without_geometry_the_cell_alone_is_named(solver):
    result = solver(replace(weak(), cell_centers={}), petsc_fs_restarts="0").solve()
    assert not result.converged
    assert any("J_22 (intf_force) is nearly singular at cell 3: " in note for note in result.notes)
