"""The Python PCs: the theorems they rest on, and the contract that every PC must meet."""

import gc
from dataclasses import replace

import numpy as np
import pytest
from common import (
    MPI,
    block_of,
    comm,
    csr,
    file_for,
    gathered,
    load,
    local_order,
    scaled_blocks,
    system_of,
    verified,
    with_block,
    without_stiffness,
)
from petsc4py import PETSc
from sample import full_scene

from petsc_fs import nest
from petsc_fs.errors import LayoutError, SceneError, UsageError
from petsc_fs.fields import FLOW, POTENTIALS
from petsc_fs.pc import contact_transform
from petsc_fs.scene import Scene
from petsc_fs.solver import Solver

pytestmark = pytest.mark.mpi
LU = {"pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
MECHANICS = ("intf_force", "momentum")


def under(prefix: str, options: dict[str, str]) -> dict[str, str]:
    return {prefix + name: value for name, value in options.items()}


def upper(prefix: str, first: str, second: str, precondition: str, pc: str) -> dict[str, str]:
    """A Schur complement of two fields, the second of them solved exactly."""
    own = {"type": "schur", "schur_fact_type": "upper", "schur_precondition": precondition}
    more = {f"fieldsplit_{first}_ksp_type": "preonly", f"fieldsplit_{first}_pc_type": pc}
    last = under(f"fieldsplit_{second}_", LU | {"ksp_type": "preonly"})
    return under(prefix, {"pc_type": "fieldsplit"} | under("pc_fieldsplit_", own) | more | last)


INNER_CONTACT = upper("qr_", "contact", "mechanics", "a11", "pbjacobi")
INNER_FLOW = upper("fs_", "intf_flow", "mass", "selfp", "jacobi")


def python_pc(operator: PETSc.Mat, name: str, prefix: str = "c_", **choices: str) -> PETSc.PC:
    """A Python PC, set up."""
    for option, value in choices.items():
        PETSc.Options()[prefix + option] = value
    pc = PETSc.PC().create(operator.comm)
    pc.setOptionsPrefix(prefix)
    pc.setOperators(operator, operator)
    pc.setType("python")
    pc.setPythonType(f"petsc_fs.pc.{name}")
    pc.setUp()
    return pc


def inner_matrix(pc: PETSc.PC) -> PETSc.Mat:
    return pc.getPythonContext().inners[0].getOperators()[1]


def said(error: BaseException | None) -> str:
    """Texts of an error and its causes: newer petsc4py wraps what a Python PC raises into an error of PETSc's."""
    return "" if error is None else f"{error}\n{said(error.__cause__ or error.__context__)}"


def regular() -> Scene:
    """A small scene of random numbers whose D_22 and J~_11 are invertible."""
    scene = full_scene()
    for f in ("contact", "intf_force"):
        scene = with_block(scene, f, f, block_of(scene, f, f) + 9.0 * np.eye(scene.sizes[f]))
    return scene


# Theorems


@pytest.mark.parametrize("side", ["right", "left", "none"])
@pytest.mark.parametrize("name", ["contact", "all fields"])
def test_transformed_blocks_are_those_of_the_paper(clean, name, side):
    """J~ = J Q_r (or Q_l J) and S^1 = J~ - J~_*1 J~_11^-1 J~_1*, compared with dense algebra, block by block."""
    scene = load(name) if name == "contact" else regular()
    if side == "none":
        scene = with_block(scene, "contact", "contact", np.eye(scene.sizes["contact"]) * 3.0)
    system = system_of(scene)
    J, fields, size = scaled_blocks(system, scene), scene.fields, scene.dimension
    start = dict(zip(fields, np.cumsum([0, *(scene.sizes[f] for f in fields)]), strict=False))
    part = {f: slice(start[f], start[f] + scene.sizes[f]) for f in fields}
    full = np.block([[J[r, c] for c in fields] for r in fields])
    cells = np.arange(scene.sizes["intf_force"]) // size
    D_inverse = np.linalg.inv(np.where(cells[:, None] == cells, J["intf_force", "intf_force"], 0.0))
    Q = np.eye(len(full))
    if side == "right":
        Q[part["intf_force"], part["contact"]] = -D_inverse @ J["intf_force", "contact"]
    elif side == "left":
        Q[part["contact"], part["intf_force"]] = -J["contact", "intf_force"] @ D_inverse
    transformed = full @ Q if side == "right" else Q @ full
    a, b = part["contact"], slice(scene.sizes["contact"], None)
    S = transformed.copy()
    cells = np.arange(scene.sizes["contact"]) // size
    local = np.where(cells[:, None] == cells, transformed[a, a], 0.0)  # all of J~_11, where the scene is one of contact
    S[b, b] -= transformed[b, a] @ np.linalg.solve(local, transformed[a, b])

    pc = python_pc(system.J, "ContactTransform", qr_side=side, qr_pc_type="none")
    P = inner_matrix(pc)
    groups = (("contact",), MECHANICS, *((f,) for f in fields if f not in ("contact", *MECHANICS)))
    assert nest.field_names(P) == tuple("mechanics" if group == MECHANICS else group[0] for group in groups)
    rows = [
        np.concatenate([np.arange(part[f].start, part[f].stop) for f in g])[local_order(system.layout, g)]
        for g in groups
    ]
    scale = np.abs(full).max()
    for i, j in np.ndindex(len(groups), len(groups)):
        found, expected = P.getNestSubMatrix(i, j), S[np.ix_(rows[i], rows[j])]
        if not found:
            assert not expected.any()
            continue
        if found.getType() == "nest":
            found = nest.one_matrix(found)
        np.testing.assert_allclose(gathered(found), expected, rtol=0, atol=1e-10 * scale, err_msg=f"{i}, {j}")
    pc.destroy()


def test_contact_block_is_singular_before_and_invertible_after(clean):
    scene = load("model1")
    sticking, every = scene.contact_state == 0, np.arange(12)
    assert sticking.any()
    before = block_of(scene, "contact", "contact").reshape(12, 2, 12, 2)[every, :, every, :]
    pc = python_pc(system_of(scene).J, "ContactTransform", qr_pc_type="none")
    after = gathered(inner_matrix(pc).getNestSubMatrix(0, 0)).reshape(12, 2, 12, 2).swapaxes(1, 2)
    assert not after[~np.eye(12, dtype=bool)].any()
    assert np.linalg.cond(before[sticking]).min() > 1e15
    assert np.linalg.cond(after[every, every]).max() < 1e6
    pc.destroy()


def test_exact_inverse_of_the_force_block_zeroes_the_lower_block(clean):
    """If J_22 is block-diagonal, D_22 is exact and E_21 = J_21 - J_22 D_22^-1 J_21 vanishes (eq:J_tilde)."""
    scene = load("contact")
    cells = np.arange(scene.sizes["intf_force"]) // 2
    J22 = np.where(cells[:, None] == cells, block_of(scene, "intf_force", "intf_force"), 0.0)
    pc = python_pc(system_of(with_block(scene, *2 * ("intf_force",), J22)).J, "ContactTransform", qr_pc_type="none")
    E21 = gathered(inner_matrix(pc).getNestSubMatrix(1, 0).getNestSubMatrix(0, 0))
    assert np.abs(E21).max() < 1e-14 * np.abs(block_of(scene, "intf_force", "contact")).max()
    pc.destroy()


@pytest.mark.parametrize("side", ["right", "left"])
def test_exact_subsolves_of_contact_mechanics_take_two_iterations(database, side):
    """Contact is eliminated exactly; with mechanics solved exactly too the minimal polynomial has degree 2."""
    exact = under("qr_fieldsplit_mechanics_", LU) | {"qr_mechanics_mat_type": "aij"}
    database("contact_mechanics.opts", qr_side=side, ksp_rtol="1e-9", **exact)
    scene = load("contact")
    result = verified(scene, Solver(scene))
    assert result.converged
    assert result.iterations <= 2


class ExactFlow:
    """The inverse of the Schur complement of mechanics that PCFIELDSPLIT hands over, from its columns."""

    def setUp(self, pc: PETSc.PC) -> None:
        S = pc.getOperators()[0]
        x, y = S.createVecs()
        self.mpi, (first, last) = S.comm.tompi4py(), x.getOwnershipRange()
        columns = []
        for k in range(S.getSize()[1]):
            x.setArray((np.arange(first, last) == k).astype(float))
            S.mult(x, y)
            columns.append(np.concatenate(self.mpi.allgather(y.getArray())))
        self.S, self.own = np.column_stack(columns), slice(first, last)

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        whole = np.concatenate(self.mpi.allgather(x.getArray(readonly=True)))
        y.setArray(np.linalg.solve(self.S, whole)[self.own])


@pytest.mark.parametrize("name", ["model1", "model2"])
def test_exact_schur_complements_take_two_iterations(database, name):
    exact = {"qr_fieldsplit_1_fieldsplit_1_pc_python_type": f"{__name__}.ExactFlow"}
    database("contact_poromechanics_direct.opts", ksp_rtol="1e-8", **exact)
    scene = load(name)
    solver = Solver(scene)
    assert verified(scene, solver).converged
    x, _ = solver.ksp.getOperators()[0].createVecs()
    solver.ksp.solve(solver.system.b, x)  # without the corrections that rounding may ask for
    assert solver.ksp.getIterationNumber() <= 2


def test_without_biot_coupling_two_iterations_are_enough(database):
    """Biot coefficient 0 takes coupling and fixed stress away, and J_44 diagonal makes diag(J_44) exact."""
    scene, flow = load("model2"), ("intf_flow", "mass")
    blocks = {(r, c): b for (r, c), b in scene.blocks.items() if (r in flow) == (c in flow)}
    blocks["intf_flow", "intf_flow"] = csr(np.diag(np.diag(block_of(scene, "intf_flow", "intf_flow"))))
    material = replace(scene.material, biot_coefficient=0.0)
    scene = replace(scene, blocks=blocks, material=material, reference={})
    database("contact_poromechanics_direct.opts", ksp_rtol="1e-9")
    result = verified(scene, Solver(scene))
    assert result.converged
    assert result.iterations <= 2


@pytest.mark.parametrize("damping", [1.0, 0.6])
def test_fixed_stress_diagonal_is_the_formula(clean, damping):
    """l_mat and l_frac of eq:fixed_stress_coefs, times volume, density over time step; 0 on intersections."""
    scene = load("model2")
    m = scene.material
    G, lame, alpha, phi, c_f = (
        float(np.mean(getattr(m, a)))
        for a in ("shear_modulus", "lame_lambda", "biot_coefficient", "porosity", "fluid_compressibility")
    )
    scale = scene.cell_volumes["mass"] * np.broadcast_to(m.fluid_density, scene.sizes["mass"]) / m.time_step
    l_min, l_mat = alpha**2 / (4 * G + 2 * lame), alpha**2 / (2 * G / 2 + lame)
    l_frac = np.broadcast_to(m.normal_jump, scale.shape) * alpha**2 * c_f
    l_frac = l_frac / (lame * ((alpha - phi) * (1 - alpha) / (lame + 2 * G / 3) + phi * c_f))
    rock = l_min * (l_mat / l_min) ** damping * scale
    expected = np.select([scene.cell_dimension == 2, scene.cell_dimension == 1], [rock, l_frac * scale], 0.0)
    assert (scene.cell_dimension == 0).any()

    system = system_of(scene.only(["intf_flow", "mass"]))
    mass = gathered(system.blocks["mass", "mass"])
    pc = python_pc(system.J, "FixedStress", fs_damping=str(damping), fs_pc_type="none")
    S = inner_matrix(pc)
    assert nest.field_names(S) == ("intf_flow", "mass")
    added = np.ldexp(gathered(S.getNestSubMatrix(1, 1)) - mass, -system.row_scale["mass"])
    np.testing.assert_allclose(added, np.diag(expected), rtol=1e-7, atol=1e-12 * np.abs(mass).max())
    pc.destroy()


@pytest.mark.parametrize("name", ["model2", "biot"])
def test_scenes_without_material_data_are_solved_algebraically(database, name):
    database(file_for(name))
    scene = load(name)
    bare = replace(scene, material=None)
    with_data, without = verified(scene, Solver(scene)), verified(bare, Solver(bare))
    assert without.converged
    assert without.iterations <= with_data.iterations + 4


@pytest.mark.parametrize("D", [2, 3])
def test_rigid_body_modes_are_in_the_kernel_of_the_stress(D):
    """Translations and linearised rotations have zero strain: their gradient is antisymmetric."""
    points = np.random.default_rng(1).normal(size=(20, D))
    block = PETSc.Mat().createAIJ(20 * D, bsize=D, nnz=1, comm=PETSc.COMM_SELF)
    block.assemble()
    vector = PETSc.Vec().createSeq(20 * D, bsize=D, comm=PETSc.COMM_SELF)
    assert nest.rigid_body_modes([block]) is None
    vector.setArray(points.ravel())
    block.compose("coordinates", vector)
    modes = [mode.getArray().copy() for mode in nest.rigid_body_modes([block]).getVecs()]
    assert len(modes) == D * (D + 1) // 2 == np.linalg.matrix_rank(modes)
    for mode in modes:
        fit = np.linalg.lstsq(np.column_stack([points, np.ones(20)]), mode.reshape(-1, D), rcond=None)[0]
        np.testing.assert_allclose(fit[:D] + fit[:D].T, 0, atol=1e-12)


# Errors


def test_singular_force_block_is_named_on_all_ranks(database):
    database("contact_poromechanics.opts")
    with pytest.raises(SceneError, match=r"D_22, block of intf_force: singular at cell 3"):
        Solver(without_stiffness(load("model1"), "intf_force", 3)).solve()


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("missing", [("contact", "intf_force"), ("intf_force", "contact")], ids="-".join)
def test_nothing_is_transformed_where_contact_does_not_act(database, side, missing):
    """With J_12 or J_21 zero and J_11 invertible, as with all cells open, the Jacobian stays as it is."""
    database("contact_mechanics.opts", qr_side=side)
    scene = with_block(load("contact"), "contact", "contact", np.eye(load("contact").sizes["contact"]))
    del scene.blocks[missing]
    solver = Solver(scene)
    assert verified(scene, solver).converged
    assert solver.ksp.getPC().getPythonContext().side == "none"


@pytest.mark.parametrize(
    ("file", "name", "given", "message"),
    [
        ("contact_poromechanics", "model1", {"qr_side": "middle"}, "-qr_side middle: expected right or left or none"),
        ("contact_poromechanics", "flow_of_one", {}, "ContactTransform needs a MatNest"),
        ("contact_poromechanics", "biot", {}, "needs a field 'contact'; there are momentum, mass"),
        ("contact_poromechanics", "model1", {"qr_interface": "walls"}, "-qr_interface NAME"),
        ("contact_poromechanics", "model1", {"qr_mechanics": "momentum,mass"}, "these fields must follow each other"),
        ("poromechanics", "biot", {"fieldsplit_mass_fs_type": "guess"}, "expected analytic or algebraic"),
        ("poromechanics", "biot", {"fieldsplit_mass_fs_type": "analytic"}, "use -fieldsplit_mass_fs_type algebraic"),
        ("contact_poromechanics", "model1", {"qr_fieldsplit_1_fieldsplit_1_fs_field": "heat"}, "_fs_field NAME"),
        (
            "contact_poromechanics",
            "model1",
            {"qr_fieldsplit_1_pc_fieldsplit_1_fields": "7"},
            "no field 7 at this level",
        ),
    ],
)
def test_what_a_pc_cannot_work_with_is_named_with_the_option(database, file, name, given, message):
    database(f"{file}.opts", **given)
    scene = load("flow").only(["mass"]) if name == "flow_of_one" else load(name)
    with pytest.raises((UsageError, LayoutError), match=message):
        Solver(replace(scene, material=None) if "use -" in message else scene).solve()


def test_algebraic_fixed_stress_needs_a_schur_complement(clean):
    with pytest.raises(Exception, match=r".*") as caught:
        python_pc(system_of(load("flow")).J, "FixedStress", fs_type="algebraic")
    assert "no Schur complement of PCFIELDSPLIT" in said(caught.value)


# Contract


CONTRACT = {
    "right": ("ContactTransform", "contact", "nest", INNER_CONTACT | {"qr_side": "right"}),
    "left": ("ContactTransform", "contact", "nest", INNER_CONTACT | {"qr_side": "left"}),
    "fixed-stress": ("FixedStress", "flow", "nest", INNER_FLOW),
    "fixed-stress-of-a-block": ("FixedStress", "flow", "block", {"fs_pc_type": "jacobi"}),
    "assembled": ("Assembled", "contact", "nest", under("assembled_", LU)),
    "assembled-block": ("Assembled", "mechanics", "block", under("assembled_", LU)),
    "sweep": ("ComponentSweep", "mechanics", "nest", under("component_", LU)),
    "sweep-of-a-block": ("ComponentSweep", "mechanics", "block", under("component_", LU)),
    "joined": ("Joined", "heat", "nest", upper("joined_", "fluxes", "potentials", "selfp", "jacobi")),
    "joined-to-one": ("Joined", "potentials", "nest", under("joined_", LU)),
}
BLOCK = {"flow": "mass", "mechanics": "momentum"}


def contract_scene(part: str) -> Scene:
    """Contact mechanics, or a part of a coupled scene: the flow has a fixed-stress diagonal other than zero."""
    chosen = {"flow": ("intf_flow", "mass"), "mechanics": MECHANICS, "heat": FLOW, "potentials": POTENTIALS}
    if part in ("heat", "potentials"):
        return load("cold2").only(chosen[part])
    return load("contact") if part == "contact" else load("model2").only(chosen[part])


class Case:
    """A PC on (a block of) a system, and vectors in the numbering of the scene."""

    def __init__(self, case: str, on: MPI.Intracomm = comm) -> None:
        self.name, part, kind, choices = CONTRACT[case]
        self.scene = contract_scene(part)
        self.system = system_of(self.scene, on)
        self.fields = (BLOCK[part],) if kind == "block" else self.scene.fields
        self.pc = python_pc(self.operator(), self.name, **choices)
        rng = np.random.default_rng(7)
        self.u, self.v = ({f: rng.normal(size=self.scene.sizes[f]) for f in self.fields} for _ in range(2))

    def operator(self) -> PETSc.Mat:
        return self.system.J if len(self.fields) > 1 else self.system.blocks[2 * self.fields]

    def vector(self, values: dict[str, np.ndarray]) -> PETSc.Vec:
        v = self.operator().createVecRight()
        v.setArray(np.concatenate([values[f][slice(*self.system.layout.rows(f))] for f in self.fields]))
        return v

    def apply(self, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        x = self.vector(values)
        y = x.duplicate()
        self.pc.apply(x, y)
        local = np.split(y.getArray(), np.cumsum([self.system.layout.sizes(f)[0] for f in self.fields])[:-1])
        parts = self.system.layout.comm.allgather(local)
        return {f: np.concatenate([p[k] for p in parts]) for k, f in enumerate(self.fields)}


@pytest.fixture(params=list(CONTRACT))
def case(request, clean):
    case = Case(request.param)
    yield case
    case.pc.destroy()
    case.system.destroy()


def assert_close(a: dict[str, np.ndarray], b: dict[str, np.ndarray], rtol: float = 1e-7) -> None:
    for f, found in a.items():
        np.testing.assert_allclose(found, b[f], rtol=0, atol=rtol * np.abs(b[f]).max(), err_msg=f)


def test_pc_is_linear(case):
    combined = case.apply({f: 2.0 * case.u[f] - 3.0 * case.v[f] for f in case.u})
    pu, pv = case.apply(case.u), case.apply(case.v)
    assert_close(combined, {f: 2.0 * pu[f] - 3.0 * pv[f] for f in pu})


def test_pc_leaves_its_input_and_ignores_old_output(case):
    x = case.vector(case.u)
    before = x.getArray().copy()
    first, second = x.duplicate(), x.duplicate()
    second.set(1e6)
    case.pc.apply(x, first)
    case.pc.apply(x, second)
    np.testing.assert_array_equal(x.getArray(), before)
    np.testing.assert_allclose(second.getArray(), first.getArray(), rtol=1e-8, atol=1e-12 * first.norm())


def test_pc_gives_the_same_on_any_number_of_ranks(case, request):
    alone = Case(request.node.callspec.params["case"], MPI.COMM_SELF)
    assert_close(case.apply(case.u), alone.apply(case.u), rtol=1e-6)
    alone.pc.destroy()


def test_second_set_up_sees_new_values_and_keeps_the_inner_pcs(case):
    material = case.scene.material and replace(case.scene.material, time_step=case.scene.material.time_step / 2)
    blocks = {rc: b._replace(data=2.0 * b.data) for rc, b in case.scene.blocks.items()}
    old, scales, inners = case.apply(case.u), case.system.row_scale, case.pc.getPythonContext().inners
    for _ in range(2):
        case.system.take(replace(case.scene, blocks=blocks, material=material))
        assert case.system.row_scale == scales
        case.pc.setOperators(case.operator(), case.operator())
        case.pc.setUp()
        assert_close(case.apply(case.u), {f: y / 2 for f, y in old.items()}, rtol=1e-6)
    assert case.pc.getPythonContext().inners == inners


def test_view_tells_pc_and_inner_pc(case, shared_tmp_path):
    path = shared_tmp_path / "view.txt"
    for level in nest.levels(case.pc):
        level.setUp()
    viewer = PETSc.Viewer().createASCII(str(path), comm=comm)
    case.pc.view(viewer)
    viewer.destroy()
    comm.barrier()
    assert f"{case.name}: " in path.read_text()
    assert path.read_text().count("type: ") > 1


def test_destroy_may_come_twice_and_lets_the_blocks_go(case):
    case.pc.destroy()
    before = {rc: matrix.getRefCount() for rc, matrix in case.system.blocks.items()}
    pc = python_pc(case.operator(), case.name)
    pc.setUp()
    context = pc.getPythonContext()
    context.destroy(pc)
    context.destroy(pc)
    pc.destroy()
    del context, pc
    gc.collect()
    PETSc.garbage_cleanup()
    assert {rc: matrix.getRefCount() for rc, matrix in case.system.blocks.items()} == before


# What they are built from


def test_fields_of_one_assembled_matrix_make_the_same_nest():
    scene = load("model1")
    system = system_of(scene)
    whole, layout, sets = nest.one_matrix(system.J), system.layout, {}
    first = whole.getOwnershipRange()[0]
    for f in scene.fields:
        rows = np.arange(first, first + layout.sizes(f)[0])
        sets[f] = PETSc.IS().createGeneral(rows.astype(PETSc.IntType), comm=comm)
        sets[f].setBlockSize(layout.block_size(f))
        first += rows.size
    found = nest.split(whole, sets)
    assert nest.field_names(found) == scene.fields
    blocks = nest.blocks_of(found)
    assert set(blocks) == set(system.blocks)
    for rc, block in blocks.items():
        np.testing.assert_array_equal(gathered(block), gathered(system.blocks[rc]), err_msg=str(rc))
        assert block.getBlockSizes() == system.blocks[rc].getBlockSizes()


def test_products_of_magnitudes():
    system = system_of(load("model2"))
    for (r, c), block in system.blocks.items():
        x = np.random.default_rng(2).standard_normal(block.getSize()[1])
        own = slice(*system.layout.rows(c))
        before = gathered(block)
        found = np.concatenate(comm.allgather(nest.multiply_absolute(block, x[own])))
        np.testing.assert_allclose(found, np.abs(before) @ np.abs(x), rtol=1e-12, err_msg=f"{r}, {c}")
        np.testing.assert_array_equal(gathered(block), before)


def test_names_must_differ():
    system = system_of(load("biot"))
    system.blocks["mass", "mass"].setName("momentum")
    with pytest.raises(LayoutError, match="one named block per field on its diagonal; found momentum, momentum"):
        nest.blocks_of(system.J)


@pytest.mark.parametrize("rows", [0, contact_transform.FEW_ROWS])
def test_blocks_by_reference_and_copies_of_them_are_as_good(database, monkeypatch, rows):
    """The former for scenes with many rows per rank, the latter where there are few; also after new values."""
    database("contact_poromechanics.opts")
    monkeypatch.setattr(contact_transform, "FEW_ROWS", rows)
    scene = load("model2")
    solver = Solver(scene)
    first = verified(scene, solver)
    twice = replace(scene, blocks={rc: b._replace(data=2.0 * b.data) for rc, b in scene.blocks.items()})
    twice = replace(twice, reference={f: v / 2 for f, v in scene.reference.items()})
    solver.update(twice)
    second = verified(twice, solver)
    for result in (first, second):
        assert result.converged
        assert max(result.error_by_field.values()) < 1e-4


def test_mechanics_may_be_kept_in_the_format_of_hypre(database):
    iterations = []
    for mat_type in ("aij", "hypre"):
        database("contact_poromechanics.opts", qr_mechanics_mat_type=mat_type)
        result = verified(load("model2"), Solver(load("model2")))
        assert result.converged
        iterations.append(result.iterations)
    assert iterations[0] == iterations[1]
