"""The Python PCs: the theorems they rest on, and the contract that every PC must meet."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from test_solver import database  # noqa: F401

import petsc_fs
from petsc_fs.dm import field_dm, rigid_body_modes
from petsc_fs.errors import SceneError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.partition import Layout
from petsc_fs.pc import ContactTransform, FixedStress
from petsc_fs.pc.fixed_stress import algebraic_diagonal
from petsc_fs.scene import CSR, Scene
from petsc_fs.solver import Solver, set_up_leaves
from petsc_fs.system import System

pytestmark = pytest.mark.mpi
comm = MPI.COMM_WORLD
SCENES = Path(petsc_fs.__path__[0]) / "scenes"


def load(name: str) -> Scene:
    return hdf5.read(SCENES / f"{name}.h5")


def dense(scene: Scene, r: str, c: str) -> np.ndarray:
    """A block of a whole scene as a dense array."""
    A = np.zeros((scene.sizes[r], scene.sizes[c]))
    if (r, c) in scene.blocks:
        indptr, indices, data = scene.blocks[r, c]
        A[np.repeat(np.arange(scene.sizes[r]), np.diff(indptr)), indices] = data
    return A


def gathered(matrix: PETSc.Mat, on: MPI.Intracomm = comm) -> np.ndarray:
    """A distributed matrix as a dense array, on every rank."""
    indptr, indices, values = matrix.getValuesCSR()
    part = np.zeros((indptr.size - 1, matrix.getSize()[1]))
    part[np.repeat(np.arange(indptr.size - 1), np.diff(indptr)), indices] = values
    return np.concatenate(on.allgather(part))


def block_diagonal(A: np.ndarray, size: int) -> np.ndarray:
    cells = np.arange(A.shape[0]) // size
    return np.where(cells[:, None] == cells[None, :], A, 0.0)


def csr(A: np.ndarray) -> CSR:
    rows, columns = np.nonzero(A)
    indptr = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=A.shape[0]))])
    return CSR(indptr, columns, A[rows, columns])


def system_of(scene: Scene, on: MPI.Intracomm = comm, mat_type: str = "nest") -> System:
    layout = Layout.contiguous(on, scene.dimension, scene.sizes)
    return System(scene.restrict({f: layout.rows(f) for f in layout.fields}), layout, mat_type=mat_type)


def python_pc(system: System, name: str, prefix: str, **choices: str) -> PETSc.PC:
    """A Python PC on a whole system, set up."""
    for option, value in choices.items():
        PETSc.Options()[prefix + option] = value
    pc = PETSc.PC().create(system.layout.comm)
    pc.setOptionsPrefix(prefix)
    pc.setOperators(system.J, system.J)
    pc.setDM(system.dm)
    pc.setType("python")
    pc.setPythonType(f"petsc_fs.pc.{name}")
    pc.setUp()
    return pc


INNER_CONTACT = {
    "qr_pc_type": "fieldsplit",
    "qr_pc_fieldsplit_type": "schur",
    "qr_pc_fieldsplit_schur_fact_type": "upper",
    "qr_pc_fieldsplit_schur_precondition": "a11",
    "qr_pc_fieldsplit_0_fields": "0",
    "qr_pc_fieldsplit_1_fields": "1",
    "qr_fieldsplit_contact_ksp_type": "preonly",
    "qr_fieldsplit_contact_pc_type": "pbjacobi",
    "qr_fieldsplit_mechanics_ksp_type": "preonly",
    "qr_fieldsplit_mechanics_pc_type": "lu",
    "qr_fieldsplit_mechanics_pc_factor_mat_solver_type": "mumps",
}


# Theorems


@pytest.mark.parametrize("side", ["right", "left"])
def test_transformed_blocks_are_those_of_the_paper(clean, side):
    """J~ = J Q_r (or Q_l J) and S^1 = J~ - J~_*1 J~_11^-1 J~_1*, compared with dense algebra."""
    scene = load("contact")
    J = {(r, c): dense(scene, r, c) for r in scene.fields for c in scene.fields}
    D_inverse = np.linalg.inv(block_diagonal(J["intf_force", "intf_force"], 2))
    n = [scene.sizes[f] for f in scene.fields]
    full = np.block([[J[r, c] for c in scene.fields] for r in scene.fields])
    Q = np.eye(sum(n))
    if side == "right":
        Q[n[0] : n[0] + n[1], : n[0]] = -D_inverse @ J["intf_force", "contact"]
        transformed = full @ Q
    else:
        Q[: n[0], n[0] : n[0] + n[1]] = -J["contact", "intf_force"] @ D_inverse
        transformed = Q @ full
    a, b = slice(0, n[0]), slice(n[0], None)
    S = transformed[b, b] - transformed[b, a] @ np.linalg.solve(transformed[a, a], transformed[a, b])

    system = system_of(scene)
    pc = python_pc(system, "ContactTransform", "t_", qr_side=side, **INNER_CONTACT)
    P = pc.getPythonContext().inner.getOperators()[1]
    size = np.abs(full).max()
    np.testing.assert_allclose(gathered(P.getNestSubMatrix(0, 0)), transformed[a, a], rtol=0, atol=1e-12 * size)
    merged = P.getNestSubMatrix(1, 1)
    order = np.concatenate(comm.allgather(local_order(system, ("intf_force", "momentum"))))
    np.testing.assert_allclose(gathered(merged), S[np.ix_(order, order)], rtol=0, atol=1e-11 * size)
    pc.destroy()


def local_order(system: System, fields: tuple[str, ...]) -> np.ndarray:
    """Place of each local row in the numbering field after field of the whole scene."""
    start, parts = 0, []
    for f in fields:
        a, b = system.layout.rows(f)
        parts.append(start + np.arange(a, b))
        start += system.layout.sizes(f)[1]
    return np.concatenate(parts)


def test_contact_block_is_singular_before_and_invertible_after(clean):
    scene = load("model1")
    assert (scene.contact_state == 0).any()
    before = dense(scene, "contact", "contact").reshape(12, 2, 12, 2)[np.arange(12), :, np.arange(12), :]
    pc = python_pc(system_of(scene), "ContactTransform", "i_", qr_pc_type="none")
    after = gathered(pc.getPythonContext().inner.getOperators()[1].getNestSubMatrix(0, 0))
    blocks = after.reshape(12, 2, 12, 2)[np.arange(12), :, np.arange(12), :]
    np.testing.assert_allclose(after, block_diagonal(after, 2), atol=0)
    assert np.linalg.cond(before[scene.contact_state == 0]).min() > 1e15
    assert np.linalg.cond(blocks).max() < 1e6
    pc.destroy()


def test_exact_inverse_of_the_force_block_zeroes_the_lower_block(clean):
    """If J_22 is block-diagonal, D_22 is exact and E_21 = J_21 - J_22 D_22^-1 J_21 vanishes (eq:J_tilde)."""
    scene = load("contact")
    J22 = block_diagonal(dense(scene, "intf_force", "intf_force"), 2)
    scene = replace(scene, blocks=scene.blocks | {("intf_force", "intf_force"): csr(J22)})
    pc = python_pc(system_of(scene), "ContactTransform", "z_", **INNER_CONTACT)
    column = pc.getPythonContext().inner.getOperators()[1].getNestSubMatrix(1, 0)
    E21, J21 = gathered(column.getNestSubMatrix(0, 0)), dense(scene, "intf_force", "contact")
    assert np.abs(E21).max() < 1e-14 * np.abs(J21).max()
    pc.destroy()


@pytest.mark.parametrize("side", ["right", "left"])
def test_exact_subsolves_of_contact_mechanics_take_two_iterations(database, side):  # noqa: F811
    """Contact is eliminated exactly; with mechanics solved exactly too the minimal polynomial has degree 2."""
    lu = {"pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    more = {f"qr_fieldsplit_mechanics_{k}": v for k, v in lu.items()}
    database("contact_mechanics.opts", qr_side=side, ksp_rtol="1e-9", **more)
    result = Solver(load("contact")).solve()
    assert result.converged
    assert result.iterations <= 2


class ExactFlow:
    """Solves with the exact Schur complement of mechanics on interface flow and mass; on one rank."""

    def setUp(self, pc):
        problem, members = pc.getDM().getAppCtx()
        flow = [f for _, fields in members for f in fields]
        mechanics = [f for f in problem.layout.fields if f in ("intf_force", "momentum")]

        def block(rows, columns):
            return np.block(
                [
                    [
                        gathered(problem.blocks[r, c], MPI.COMM_SELF)
                        if (r, c) in problem.blocks
                        else np.zeros((problem.layout.sizes(r)[1], problem.layout.sizes(c)[1]))
                        for c in columns
                    ]
                    for r in rows
                ]
            )

        K = block(mechanics, mechanics)
        self.S = block(flow, flow) - block(flow, mechanics) @ np.linalg.solve(K, block(mechanics, flow))

    def apply(self, pc, x, y):
        y.setArray(np.linalg.solve(self.S, x.getArray(readonly=True)))


@pytest.mark.skipif(comm.size > 1, reason="dense algebra of one rank")
@pytest.mark.parametrize("name", ["model1", "model2"])
def test_exact_schur_complements_take_two_iterations(database, name):  # noqa: F811
    exact = {"qr_fieldsplit_1_fieldsplit_1_pc_python_type": f"{__name__}.ExactFlow"}
    database("contact_poromechanics_direct.opts", ksp_rtol="1e-8", petsc_fs_error_factor="0", **exact)
    result = Solver(load(name)).solve()
    assert result.iterations <= 2
    assert result.true_relative_residual < 1e-6


def test_without_biot_coupling_two_iterations_are_enough(database):  # noqa: F811
    """Biot coefficient 0 takes coupling and fixed stress away, and J_44 diagonal makes diag(J_44) exact."""
    scene = load("model2")
    mechanics, flow = ("contact", "intf_force", "momentum"), ("intf_flow", "mass")
    blocks = {(r, c): b for (r, c), b in scene.blocks.items() if (r in flow) == (c in flow)}
    blocks["intf_flow", "intf_flow"] = csr(np.diag(np.diag(dense(scene, "intf_flow", "intf_flow"))))
    material = replace(scene.material, biot_coefficient=0.0)
    scene = replace(scene, blocks=blocks, material=material, reference={})
    assert all(f in scene.fields for f in mechanics)
    database("contact_poromechanics_direct.opts", ksp_rtol="1e-9")
    result = Solver(scene).solve()
    assert result.converged
    assert result.iterations <= 2


def test_fixed_stress_diagonal_is_the_formula(clean):
    """l_mat and l_frac of eq:fixed_stress_coefs, times volume, density over time step; 0 on intersections."""
    scene = load("model2")
    m = scene.material
    G, lame, alpha, phi, c_f = (
        float(np.mean(getattr(m, a)))
        for a in ("shear_modulus", "lame_lambda", "biot_coefficient", "porosity", "fluid_compressibility")
    )
    rho = np.broadcast_to(m.fluid_density, scene.sizes["mass"])
    scale = scene.cell_volumes["mass"] * rho / m.time_step
    l_mat = alpha**2 / (2 * G / 2 + lame)
    l_frac = np.broadcast_to(m.normal_jump, scale.shape) * alpha**2 * c_f
    l_frac = l_frac / (lame * ((alpha - phi) * (1 - alpha) / (lame + 2 * G / 3) + phi * c_f))
    expected = np.select([scene.cell_dimension == 2, scene.cell_dimension == 1], [l_mat * scale, l_frac * scale], 0.0)
    assert (scene.cell_dimension == 0).any()

    bare = replace(scene.only(["mass"]), blocks={("mass", "mass"): csr(1e-30 * np.eye(scene.sizes["mass"]))})
    system = system_of(bare)
    pc = python_pc(system, "FixedStress", "f_", fs_damping="1", fs_pc_type="none")
    S = pc.getPythonContext().inner.getOperators()[1]
    S = gathered(S.getNestSubMatrix(0, 0) if S.getType() == "nest" else S)
    np.testing.assert_allclose(S, np.diag(expected), rtol=1e-9, atol=1e-29)
    pc.destroy()


def test_algebraic_fixed_stress_is_exact_for_local_mechanics():
    """With mechanics block-diagonal by cell, local solves are the whole inverse: D = -diag(J_5m A^-1 J_m5)."""
    scene = load("biot")
    K = block_diagonal(dense(scene, "momentum", "momentum"), 2)
    scene = replace(scene, blocks=scene.blocks | {("momentum", "momentum"): csr(K)}, reference={})
    product = dense(scene, "mass", "momentum") @ np.linalg.solve(K, dense(scene, "momentum", "mass"))
    expected = np.maximum(-np.diag(product), 0)
    system = system_of(scene)
    found = np.concatenate(comm.allgather(algebraic_diagonal(system.dm.getAppCtx()[0])))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * expected.max())


def test_algebraic_fixed_stress_is_the_same_on_any_number_of_ranks():
    scene = load("model2")
    parallel = np.concatenate(comm.allgather(algebraic_diagonal(system_of(scene).dm.getAppCtx()[0])))
    alone = algebraic_diagonal(system_of(scene, MPI.COMM_SELF).dm.getAppCtx()[0])
    np.testing.assert_allclose(parallel, alone, rtol=1e-9)
    assert (alone >= 0).all()
    assert (alone[scene.cell_dimension == 0] == 0).all()
    assert (alone[scene.cell_dimension == 2] > 0).all()


@pytest.mark.parametrize(("file", "name"), [("contact_poromechanics", "model2"), ("poromechanics", "biot")])
def test_scenes_without_material_data_are_solved_algebraically(database, file, name):  # noqa: F811
    database(f"{file}.opts")
    scene = load(name)
    with_data = Solver(scene).solve()
    without = Solver(replace(scene, material=None)).solve()
    assert without.converged
    assert without.iterations <= with_data.iterations + 4


def test_rigid_body_modes_are_in_the_kernel_of_the_stress(clean):
    """Translations and linearised rotations have zero strain: their gradient is antisymmetric."""
    points = np.random.default_rng(1).normal(size=(20, 3))
    for D in (2, 3):
        modes = rigid_body_modes(points, D)
        assert len(modes) == D * (D + 1) // 2
        assert np.linalg.matrix_rank(np.array(modes)) == len(modes)
        for mode in modes:
            design = np.column_stack([points[:, :D], np.ones(20)])
            fit = np.linalg.lstsq(design, mode.reshape(-1, D), rcond=None)[0]
            np.testing.assert_allclose(fit[:D] + fit[:D].T, 0, atol=1e-12)


# Errors


def test_singular_force_block_is_named_on_all_ranks(database):  # noqa: F811
    database("contact_poromechanics.opts")
    scene = load("model1")
    A = dense(scene, "intf_force", "intf_force")
    A[6:8, 6:8] = 0
    broken = replace(scene, blocks=scene.blocks | {("intf_force", "intf_force"): csr(A)})
    with pytest.raises(SceneError, match=r"D_22.*singular at cell 3"):
        Solver(broken).solve()


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("missing", [("contact", "intf_force"), ("intf_force", "contact")], ids="-".join)
def test_nothing_is_transformed_where_contact_does_not_act(database, side, missing):  # noqa: F811
    """With J_12 or J_21 zero and J_11 invertible, as with all cells open, the Jacobian stays as it is."""
    database("contact_mechanics.opts", qr_side=side)
    scene = load("contact")
    blocks = {rc: b for rc, b in scene.blocks.items() if rc != missing}
    blocks["contact", "contact"] = csr(np.eye(scene.sizes["contact"]))
    solver = Solver(replace(scene, blocks=blocks, reference={}))
    result = solver.solve()
    assert result.converged
    assert solver.ksp.getPC().getPythonContext().side == "none"


def test_wrong_choice_names_the_option(database):  # noqa: F811
    database("contact_poromechanics.opts", qr_side="middle")
    with pytest.raises(UsageError, match=r"-qr_side middle: expected right or left"):
        Solver(load("model1")).solve()


def test_contact_transform_needs_blocks_and_its_fields(database):  # noqa: F811
    database("contact_poromechanics.opts", petsc_fs_mat_type="aij")
    with pytest.raises(UsageError, match="petsc_fs_mat_type"):
        Solver(load("model1")).solve()
    PETSc.Options().setValue("petsc_fs_mat_type", "nest")
    with pytest.raises(UsageError, match="needs a field 'contact'"):
        Solver(load("biot")).solve()


def test_analytic_fixed_stress_without_data_names_the_remedy(database):  # noqa: F811
    database("poromechanics.opts", fieldsplit_mass_fs_type="analytic")
    with pytest.raises(UsageError, match="use -fieldsplit_mass_fs_type algebraic"):
        Solver(replace(load("biot"), material=None)).solve()


# Contract


INNER_FLOW_NEST = {
    "fs_pc_type": "fieldsplit",
    "fs_pc_fieldsplit_type": "schur",
    "fs_pc_fieldsplit_schur_fact_type": "upper",
    "fs_pc_fieldsplit_schur_precondition": "selfp",
    "fs_fieldsplit_intf_flow_ksp_type": "preonly",
    "fs_fieldsplit_intf_flow_pc_type": "jacobi",
    "fs_fieldsplit_mass_ksp_type": "preonly",
    "fs_fieldsplit_mass_pc_type": "lu",
    "fs_fieldsplit_mass_pc_factor_mat_solver_type": "mumps",
}
INNER_FLOW_AIJ = {"fs_pc_type": "lu", "fs_pc_factor_mat_solver_type": "mumps"}
CONTRACT = {
    "ContactTransform-right": ("ContactTransform", "contact", "nest", INNER_CONTACT | {"qr_side": "right"}),
    "ContactTransform-left": ("ContactTransform", "contact", "nest", INNER_CONTACT | {"qr_side": "left"}),
    "FixedStress-nest": ("FixedStress", "flow", "nest", INNER_FLOW_NEST),
    "FixedStress-aij": ("FixedStress", "flow", "aij", INNER_FLOW_AIJ),
}


def contract_scene(name: str) -> Scene:
    """Contact mechanics, or the flow part of a coupled scene, whose fixed-stress diagonal is not zero."""
    return load("contact") if name == "contact" else load("model2").only(["intf_flow", "mass"])


def whole_vector(system: System, values: dict[str, np.ndarray]) -> PETSc.Vec:
    v = system.J.createVecRight()
    v.setArray(np.concatenate([values[f][slice(*system.layout.rows(f))] for f in system.layout.fields]))
    return v


def apply(system: System, pc: PETSc.PC, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """PC applied to a vector given in the numbering of the scene, as such a vector."""
    x = whole_vector(system, values)
    y = x.duplicate()
    pc.apply(x, y)
    arrays = system.by_field(y)
    parts = system.layout.comm.allgather(arrays)
    return {f: np.concatenate([p[f] for p in parts]) for f in system.layout.fields}


@pytest.fixture(params=list(CONTRACT))
def case(request, clean):
    """A PC, its system, its scene, and two random vectors in the scene's numbering."""
    name, part, mat_type, choices = CONTRACT[request.param]
    scene = contract_scene(part)
    rng = np.random.default_rng(7)
    u, v = ({f: rng.normal(size=n) for f, n in scene.sizes.items()} for _ in range(2))
    system = system_of(scene, mat_type=mat_type)
    pc = python_pc(system, name, "c_", **choices)
    yield scene, system, pc, u, v, (name, mat_type, choices)
    pc.destroy()


def assert_close(a: dict[str, np.ndarray], b: dict[str, np.ndarray], rtol: float = 1e-7) -> None:
    for f, found in a.items():
        np.testing.assert_allclose(found, b[f], rtol=0, atol=rtol * np.abs(b[f]).max(), err_msg=f)


def test_pc_is_linear(case):
    _, system, pc, u, v, _ = case
    combined = {f: 2.0 * u[f] - 3.0 * v[f] for f in u}
    left, pu, pv = apply(system, pc, combined), apply(system, pc, u), apply(system, pc, v)
    assert_close(left, {f: 2.0 * pu[f] - 3.0 * pv[f] for f in u})


def test_pc_leaves_its_input_and_ignores_old_output(case):
    _, system, pc, u, _, _ = case
    x = whole_vector(system, u)
    before = x.getArray().copy()
    first, second = x.duplicate(), x.duplicate()
    second.set(1e6)
    pc.apply(x, first)
    pc.apply(x, second)
    np.testing.assert_array_equal(x.getArray(), before)
    np.testing.assert_allclose(second.getArray(), first.getArray(), rtol=1e-8, atol=1e-12 * first.norm())


def test_pc_gives_the_same_on_any_number_of_ranks(case):
    scene, system, pc, u, _, (name, mat_type, choices) = case
    alone = system_of(scene, MPI.COMM_SELF, mat_type)
    other = python_pc(alone, name, "c_", **choices)
    assert_close(apply(system, pc, u), apply(alone, other, u), rtol=1e-6)
    other.destroy()


def test_second_set_up_sees_new_values(case):
    scene, system, pc, u, _, _ = case
    twice = {rc: CSR(b.indptr, b.indices, 2.0 * b.data) for rc, b in scene.blocks.items()}
    material = scene.material and replace(scene.material, time_step=scene.material.time_step / 2)
    other = replace(scene, blocks=twice, material=material)
    old = apply(system, pc, u)
    layout = system.layout
    system.update(other.restrict({f: layout.rows(f) for f in layout.fields}))
    pc.setOperators(system.J, system.J)
    pc.setUp()
    assert_close(apply(system, pc, u), {f: y / 2 for f, y in old.items()}, rtol=1e-6)


def test_view_tells_pc_and_inner_pc(case, shared_tmp_path):
    _, _, pc, _, _, (name, _, _) = case
    set_up_leaves(pc)
    path = shared_tmp_path / "view.txt"
    viewer = PETSc.Viewer().createASCII(str(path), comm=comm)
    pc.view(viewer)
    viewer.destroy()
    comm.barrier()
    text = path.read_text()
    assert f"{name}: " in text
    assert "mumps" in text or "MUMPS" in text


def test_destroy_may_come_twice_and_lets_the_blocks_go(clean):
    scene = load("contact")
    system = system_of(scene)
    before = {rc: m.getRefCount() for rc, m in system.blocks.items()}
    pc = python_pc(system, "ContactTransform", "d_", **INNER_CONTACT)
    context = pc.getPythonContext()
    assert isinstance(context, ContactTransform)
    context.destroy(pc)
    context.destroy(pc)
    pc.destroy()
    del context, pc
    PETSc.garbage_cleanup()
    assert {rc: m.getRefCount() for rc, m in system.blocks.items()} == before


def said(error: BaseException | None) -> str:
    """Texts of an error and its causes: newer petsc4py wraps what a Python PC raises into an error of PETSc's."""
    return "" if error is None else f"{error}\n{said(error.__cause__ or error.__context__)}"


def test_fixed_stress_needs_named_fields(clean):
    system = system_of(contract_scene("flow"))
    pc = PETSc.PC().create(comm)
    pc.setOperators(system.J, system.J)
    pc.setType("python")
    pc.setPythonContext(FixedStress())
    pc.setDM(PETSc.DMShell().create(comm=comm))
    with pytest.raises((UsageError, PETSc.Error)) as caught:
        pc.setUp()
    assert "field names" in said(caught.value)
    pc.setDM(field_dm(system.dm.getAppCtx()[0], [("intf_flow", ("intf_flow",))]))
    with pytest.raises((UsageError, PETSc.Error)) as caught:
        pc.setUp()
    assert "needs a field 'mass'" in said(caught.value)
    pc.destroy()
