"""The fixed-stress diagonal from the matrix alone: its formula, what it bounds, what it follows, and what it costs."""

from dataclasses import replace

import numpy as np
import pytest
from common import gathered, load
from mpi4py import MPI
from petsc4py import PETSc
from sample import SCENES, csr, dense

from petsc_fs import nest
from petsc_fs.fields import POTENTIALS
from petsc_fs.io import hdf5
from petsc_fs.options import find_options_file, inserted
from petsc_fs.pc import FixedStress, fixed_stress
from petsc_fs.pc.algebraic import SHARE, stabilisation
from petsc_fs.scene import CSR, Scene
from petsc_fs.solver import Solver

comm = MPI.COMM_WORLD
MECHANICS = ("intf_force", "momentum")

Block = tuple[str, str]


@pytest.fixture(scope="module")
def model2() -> Scene:
    return hdf5.read(SCENES / "model2.h5")


def aij(M: np.ndarray, comm: MPI.Intracomm, block_size: int = 1) -> PETSc.Mat:
    """Even shares of the rows of a dense matrix, in whole cells."""

    def share(n: int) -> int:
        cells = n // block_size
        return block_size * (cells // comm.size + (comm.rank < cells % comm.size))

    sizes = [(share(n), n) for n in M.shape]
    last = comm.scan(sizes[0][0])
    indptr, indices, data = csr(M[last - sizes[0][0] : last])
    return PETSc.Mat().createAIJ(sizes, csr=(indptr.astype("i4"), indices.astype("i4"), data), comm=comm)


def blocks(scene: Scene) -> dict[Block, np.ndarray]:
    """The blocks of mechanics and mass, dense."""
    names = (*MECHANICS, "mass")
    whole = dense(scene)
    start = dict(zip(scene.fields, np.cumsum([0, *(scene.sizes[f] for f in scene.fields)]), strict=False))
    at = {f: slice(start[f], start[f] + scene.sizes[f]) for f in names}
    return {(r, c): whole[at[r], at[c]] for r in names for c in names}


def nests(J: dict[Block, np.ndarray], comm: MPI.Intracomm) -> tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat]:
    """A, B and C as they are between fields: A and what couples it in blocks, without those that are zero."""

    def nest(rows: tuple[str, ...], columns: tuple[str, ...]) -> PETSc.Mat:
        grid = [[aij(J[r, c], comm) if J[r, c].any() else None for c in columns] for r in rows]
        return PETSc.Mat().createNest(grid, comm=comm)

    return nest(MECHANICS, MECHANICS), nest(MECHANICS, ("mass",)), nest(("mass",), MECHANICS)


def stacked(J: dict[Block, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and C, dense."""
    A = np.block([[J[r, c] for c in MECHANICS] for r in MECHANICS])
    return A, np.vstack([J[r, "mass"] for r in MECHANICS]), np.hstack([J["mass", c] for c in MECHANICS])


def sums(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both sums of the formula, by numpy."""
    a = abs(np.diag(A))
    norms = abs(B).T @ a**-0.5
    w = np.divide(1.0, norms, out=np.zeros_like(norms), where=norms > 0)
    return abs(C) @ (abs(B).sum(axis=1) / a), abs(C) @ (abs(B) @ w / a) * norms


def serial(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> np.ndarray:
    return stabilisation(*(aij(M, MPI.COMM_SELF) for M in (A, B, C)))


@pytest.mark.mpi
def test_blocks_give_the_formula_on_any_number_of_ranks(model2):
    J = blocks(model2)
    expected = SHARE * np.minimum(*sums(*stacked(J)))
    alone = stabilisation(*nests(J, MPI.COMM_SELF))
    together = np.concatenate(comm.allgather(stabilisation(*nests(J, comm))))
    np.testing.assert_allclose(alone, expected, rtol=1e-12)
    np.testing.assert_allclose(together, expected, rtol=1e-12)
    assert (expected[model2.cell_dimension == 0] == 0).all()
    assert (expected[model2.cell_dimension == 2] > 0).all()


@pytest.mark.parametrize("kind", ["aij", "nest", "hypre"])
def test_storage_of_the_matrices_does_not_matter(model2, kind):
    J = blocks(model2)
    A, B, C = nests(J, MPI.COMM_SELF)
    if kind != "nest":
        A = aij(stacked(J)[0], MPI.COMM_SELF).convert(kind, PETSc.Mat())
        B = B.convert("aij", PETSc.Mat())
    np.testing.assert_allclose(stabilisation(A, B, C), serial(*stacked(J)), rtol=1e-12)


def test_each_sum_bounds_the_eigenvalues_of_the_schur_complement_of_the_diagonal():
    rng = np.random.default_rng(2)
    A, B, C = (rng.standard_normal(shape) for shape in ((60, 60), (60, 40), (40, 60)))
    S = C @ (B / np.diag(A)[:, None])
    for D in sums(A, B, C):
        assert abs(np.linalg.eigvals(S / D[:, None])).max() <= 1 + 1e-12
        assert (D >= abs(np.diag(S))).all()
    np.testing.assert_allclose(serial(A, B, C), SHARE * np.minimum(*sums(A, B, C)), rtol=1e-12)


def test_units_of_equations_and_unknowns_carry_over():
    """Rows of the mass balance as they are scaled, displacements not at all, pressures to within their own coupling."""
    rng = np.random.default_rng(0)
    A, B, C = (rng.standard_normal(shape) for shape in ((12, 12), (12, 8), (8, 12)))
    plain = serial(A, B, C)
    rows, columns = 10.0 ** rng.integers(-8, 9, (2, 8))
    np.testing.assert_allclose(serial(A, B, rows[:, None] * C), rows * plain, rtol=1e-12)
    np.testing.assert_allclose(serial(A, 1e-5 * B, C), 1e-5 * plain, rtol=1e-12)
    s = 10.0 ** rng.integers(-8, 9, 12)
    np.testing.assert_allclose(serial(s[:, None] * A * s, s[:, None] * B, C * s), plain, rtol=1e-12)
    scaled = serial(A, B * columns, C)
    S = abs(C) @ (abs(B) / abs(np.diag(A))[:, None])
    assert (scaled <= SHARE * columns * sums(A, B, C)[1] * (1 + 1e-12)).all()
    assert (scaled >= SHARE * columns * np.diag(S) * (1 - 1e-12)).all()


def test_nothing_acts_through_a_zero_on_the_diagonal_of_mechanics():
    A, B, C = np.diag([2.0, 0.0]), np.array([[4.0, 0.0], [1.0, 1.0]]), np.array([[-3.0, 5.0], [1.0, 1.0]])
    np.testing.assert_allclose(serial(A, B, C), [SHARE * 6.0, 0.0])


def test_cost_is_linear_in_the_number_of_cells():
    rng = np.random.default_rng(1)
    A, B, C = (rng.standard_normal(shape) for shape in ((12, 12), (12, 8), (8, 12)))

    def work(tiles: int) -> float:
        matrices = [aij(np.kron(np.eye(tiles), M), MPI.COMM_SELF) for M in (A, B, C)]
        before = PETSc.Log.getFlops()
        stabilisation(*matrices)
        return float(PETSc.Log.getFlops() - before)

    assert work(8) == pytest.approx(4 * work(2), rel=0.02)


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("poromechanics", "biot"),
        ("poromechanics_fast", "undrained"),
        ("contact_poromechanics", "model1"),
        ("contact_poromechanics_fast", "model2"),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_scenes_without_material_data_take_no_more_iterations(clean, file, name, sign):
    """Whatever sign the mass balance is written with."""
    scene = hdf5.read(SCENES / f"{name}.h5")
    blocks = {rc: CSR(b.indptr, b.indices, sign * b.data) if rc[0] == "mass" else b for rc, b in scene.blocks.items()}
    bare = replace(scene, material=None, blocks=blocks, rhs=scene.rhs | {"mass": sign * scene.rhs["mass"]})
    with inserted(find_options_file(f"{file}.opts")):
        with_data, without = Solver(scene).solve(), Solver(bare).solve()
    assert without.converged
    assert without.iterations <= with_data.iterations + 1


@pytest.mark.mpi
def test_fractures_may_have_a_multiple_of_it(clean, model2):
    """And rock what it has anyway."""
    added = {}
    for factor in ("0", "3"):
        with inserted({"qr_fieldsplit_1_fieldsplit_1_fs_fractures": factor}):
            with inserted(find_options_file("contact_poromechanics.opts")):
                solver = Solver(model2)
                solver.set_up()
            found = [pc for pc in nest.levels(solver.ksp.getPC()) if pc.getType() == "python"]
            (pc,) = [pc for pc in found if isinstance(pc.getPythonContext(), FixedStress)]
        complement, operator = pc.getOperators()
        before, after = operator, pc.getPythonContext().inners[0].getOperators()[1]
        mass, S = (nest.blocks_of(M)["mass", "mass"] for M in (before, after))
        added[factor] = S.getDiagonal().getArray() - mass.getDiagonal().getArray()
        rock = mass.query("fixed_stress_ratio").getArray() != 1.0
        algebraic = stabilisation(*fixed_stress._mechanics(complement, 1, mass.getSizes()[0], ""))
    limit = 1e-12 * abs(mass.getDiagonal().getArray()).max(initial=0.0)
    np.testing.assert_allclose(abs(added["3"][~rock]), 3 * algebraic[~rock], rtol=1e-8, atol=limit)
    np.testing.assert_array_equal(added["3"][rock], added["0"][rock])
    assert comm.allreduce(np.count_nonzero(abs(added["3"]) > 10 * abs(added["0"]))) > 10


@pytest.mark.mpi
@pytest.mark.parametrize("drop", [False, True])
def test_temperature_may_be_part_of_it(clean, drop):
    """[[1, t], [e, e t]] times D_55, where temperature moves mechanics t times as much as pressure does."""
    scene = load("cold2")
    if drop:  # a block that the diagonal is all of
        scene = replace(scene, blocks={rc: b for rc, b in scene.blocks.items() if rc != ("mass", "energy")})
    with inserted({"qr_fieldsplit_1_fieldsplit_1_fs_heat": "energy"}):
        with inserted(find_options_file("contact_thermoporomechanics.opts")):
            solver = Solver(scene)
            solver.set_up()
    (pc,) = [
        pc
        for pc in nest.levels(solver.ksp.getPC())
        if pc.getType() == "python" and isinstance(pc.getPythonContext(), FixedStress)
    ]
    complement, operator = pc.getOperators()
    names = nest.field_names(operator)

    def whole(M):
        if M.getType() != "nest":
            return gathered(M)
        rows, columns = (range(n) for n in M.getNestSize())
        return np.block([[whole(M.getNestSubMatrix(i, j)) for j in columns] for i in rows])

    places = {f: (names.index(f), operator.getNestSubMatrix(*2 * [names.index(f)]).getSizes()[0]) for f in POTENTIALS}
    parts = [fixed_stress._mechanics(complement, *places[f], "") for f in POTENTIALS]
    (B, C), (B_h, C_h) = ([whole(M) for M in part[1:]] for part in parts)
    t, e = ((A * H).sum(axis=0) / (A**2).sum(axis=0).clip(1e-300) for A, H in ((B, B_h), (C.T, C_h.T)))
    assert np.count_nonzero(t) > 100
    assert np.count_nonzero(e) > 100
    np.testing.assert_allclose(B * t, B_h, atol=1e-9 * abs(B_h).max())
    before, after = (nest.blocks_of(M) for M in (operator, pc.getPythonContext().inners[0].getOperators()[1]))

    def added(*rc):
        start = np.diag(gathered(before[rc])) if rc in before else 0.0
        return np.diag(gathered(after[rc])) - start

    D = added("mass", "mass")
    for rc, factor in {("mass", "energy"): t, ("energy", "mass"): e, ("energy", "energy"): e * t}.items():
        size = abs(gathered(after[rc])).max()
        np.testing.assert_allclose(added(*rc), factor * D, rtol=1e-6, atol=1e-12 * size)
