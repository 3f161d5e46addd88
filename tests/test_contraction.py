"""The terms of the convergence theorem, and Richardson iterations where it promises something."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from sample import SCENES, csr, dense

from petsc_fs.cli.main import main
from petsc_fs.errors import SceneError
from petsc_fs.io import hdf5
from petsc_fs.scene import Scene
from petsc_fs.tools.contraction import contact_rows, contraction_rate, coupling_term, evaluate, korn_trace
from petsc_fs.tools.reference import factors

C, UNIT, F = 0.7, 3e4, 0.4


@pytest.fixture(scope="module", params=["model1", "model2", "model3"])
def bundled(request):
    return hdf5.read(SCENES / f"{request.param}.h5")


@pytest.fixture(scope="module")
def model1():
    return hdf5.read(SCENES / "model1.h5")


def states(dimension, cells=9, seed=0):
    """Tractions, jumps and the laws' numbers of some fracture cells, a third in each state; tractions over UNIT."""
    rng = np.random.default_rng(seed)
    beta_b = rng.uniform(1, 5, cells) * 1e-6
    bound = rng.uniform(1, 2, cells)
    traction = rng.standard_normal((cells, dimension - 1))
    slip = rng.standard_normal((cells, dimension - 1))
    kind = np.arange(cells) % 3
    for i in range(cells):
        if kind[i] == 0:  # |y| below the bound
            traction[i] *= 0.3 * bound[i] / np.linalg.norm(traction[i])
            slip[i] *= 0.3 * bound[i] / np.linalg.norm(slip[i]) / C
        else:  # above it
            slip[i] *= 3 * bound[i] / np.linalg.norm(slip[i]) / C
    return kind, beta_b, bound, traction, slip


def synthetic(dimension, **changes):
    """A scene whose contact rows are written down from eq:contact_linearized, each fracture on an axis of its own."""
    kind, beta_b, bound, traction, slip = states(dimension)
    beta_b = changes.get("beta_b", beta_b)
    cells, bs = kind.size, dimension
    rng = np.random.default_rng(1)
    area = rng.uniform(1, 2, cells)
    J11, J12 = np.zeros((cells * bs,) * 2), np.zeros((cells * bs, 2 * cells * bs))
    J21, rhs = np.zeros((2 * cells * bs, cells * bs)), np.zeros((cells, bs))
    for i in range(cells):
        rotation = np.linalg.qr(rng.standard_normal((bs, bs)))[0]
        D, jump = np.zeros((bs, bs)), np.zeros((bs, bs))
        y = traction[i] + C * slip[i]
        if kind[i] == 2:
            D[:] = np.eye(bs)
        else:
            D[0, 0], jump[0, 0] = C * beta_b[i] * UNIT, -C
            D[1:, 0] = -F * (y if kind[i] else C * slip[i])
        eye = np.eye(bs - 1)
        if kind[i] == 0:
            jump[1:, 1:] = C * bound[i] * eye
            rhs[i, 1:] = -C * bound[i] * slip[i]
        elif kind[i] == 1:
            size = np.linalg.norm(y)
            turn = bound[i] * eye - np.outer(traction[i], y) / size
            D[1:, 1:], jump[1:, 1:] = turn - size * eye, C * turn
            rhs[i, 1:] = size * traction[i] - bound[i] * y
        own = slice(i * bs, (i + 1) * bs)
        J11[own, own] = D
        for wall, sign in ((2 * i, -1), (2 * i + 1, 1)):
            walls = slice(wall * bs, (wall + 1) * bs)
            J12[own, walls] = sign * jump @ rotation
            J21[walls, own] = sign * UNIT * area[i] * rotation.T
    sizes = {"contact": cells * bs, "intf_force": 2 * cells * bs}
    blocks = {("contact", "contact"): J11, ("contact", "intf_force"): J12, ("intf_force", "contact"): J21}
    return Scene(
        dimension=dimension,
        sizes=sizes,
        blocks={rc: csr(block) for rc, block in blocks.items()},
        rhs={"contact": rhs.ravel(), "intf_force": np.zeros(sizes["intf_force"])},
        cell_volumes={"contact": area},
        contact_state=kind,
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_contact_rows_give_back_the_numbers_they_are_made_of(dimension):
    kind, beta_b, bound, traction, slip = states(dimension)
    rows = contact_rows(synthetic(dimension))
    y = traction + C * slip
    size = np.linalg.norm(y, axis=1)
    sticking, sliding = kind == 0, kind == 1
    np.testing.assert_array_equal(rows.sticking, sticking)
    np.testing.assert_array_equal(rows.sliding, sliding)
    np.testing.assert_array_equal(rows.closed, kind < 2)
    assert_allclose(rows.constant, C * UNIT)
    assert_allclose(rows.beta_b[kind < 2], beta_b[kind < 2])
    assert_allclose(rows.friction[kind < 2], F)
    assert_allclose(rows.slip[sticking], np.linalg.norm(slip, axis=1)[sticking])
    assert_allclose(rows.bound[sticking], bound[sticking] * UNIT)
    assert_allclose(rows.trial[sliding], size[sliding] * UNIT)
    along = np.einsum("ni,ni->n", y, traction)[sliding] / size[sliding]
    assert_allclose(rows.mismatch[sliding], (along - bound[sliding]) * UNIT)
    for values in (rows.beta_b[kind == 2], rows.slip[~sticking], rows.trial[~sliding], rows.mismatch[~sliding]):
        assert np.isnan(values).all()


def test_contact_terms_are_those_of_the_condition():
    kind, beta_b, bound, traction, slip = states(2)
    found = evaluate(synthetic(2))
    y = np.abs(traction + C * slip)[:, 0]
    epsilon = np.sign(traction + C * slip)[:, 0] * traction[:, 0] - bound
    sliding = kind == 1
    resistance = UNIT * (y + epsilon)[sliding].min()
    least = beta_b[kind < 2].min()
    assert_allclose(found.theorem["normal"], 2 / least)
    worst = max(UNIT * epsilon[sliding].max(), 0)
    assert_allclose(found.theorem["mismatch"], 2 * C * UNIT * worst / resistance)
    assert_allclose(found.theorem["friction"], 2 * F * UNIT * y[sliding].max() / (resistance * least))
    assert found.verdict == "not evaluated" and found.demand is None
    assert any("material" in note for note in found.notes)


def test_terms_scale_with_the_stiffness_of_the_fracture():
    beta_b = states(2)[1]
    soft, stiff = (evaluate(synthetic(2, beta_b=beta_b / k)).theorem for k in (1, 1000))
    assert_allclose(stiff["normal"], 1000 * soft["normal"])
    assert_allclose(stiff["friction"], 1000 * soft["friction"])
    assert_allclose(stiff["mismatch"], soft["mismatch"])
    rigid = evaluate(synthetic(2, beta_b=0 * beta_b))
    assert rigid.theorem["normal"] == np.inf
    assert any("K_n = 0" in note for note in rigid.notes)


def test_bundled_scenes_hold_the_friction_coefficient_and_states_of_their_models(bundled):
    rows = contact_rows(bundled)
    known = ~np.isnan(rows.friction)
    assert known.any()
    assert_allclose(rows.friction[known], 0.577, rtol=1e-6)
    np.testing.assert_array_equal(rows.sticking & rows.closed, bundled.contact_state == 0)
    np.testing.assert_array_equal(rows.sliding & rows.closed, bundled.contact_state == 1)
    np.testing.assert_array_equal(~rows.closed, bundled.contact_state == 2)
    # Barton-Bandis: no closed cell is softer than where it just closes, 1 / K_n.
    assert (rows.beta_b[rows.closed] * 0.12 < 1 + 1e-12).all()


def test_open_fractures_have_no_contact_terms():
    """All cells open: their rows are those of no traction, whatever is on the walls."""
    scene = synthetic(2)
    cells = scene.sizes["contact"] // 2
    scene.blocks["contact", "contact"] = csr(np.eye(2 * cells))
    del scene.blocks["contact", "intf_force"]
    rows = contact_rows(scene)
    assert not (rows.closed | rows.sticking | rows.sliding).any()
    assert evaluate(scene).theorem == {"normal": 0, "mismatch": 0, "friction": 0}


def test_condition_fails_on_the_models_of_the_paper(bundled):
    """It is sufficient, not necessary: the terms exceed 4 G D by orders of magnitude, and yet the models are solved."""
    found = evaluate(bundled)
    assert found.stiffness is not None and found.demand is not None
    assert found.verdict == "fails"
    assert found.demand > 1e3 * found.stiffness[1]
    assert found.dominant == max(found.theorem, key=lambda name: found.theorem[name])


def test_without_coupling_there_is_nothing_to_contract(model1):
    assert contraction_rate(with_material(model1, biot_coefficient=0.0)) == 0
    assert np.isinf(coupling_term(with_material(model1, biot_coefficient=0.0))).all()


def test_coupling_vanishes_where_rock_and_fluid_store_nothing(model1):
    """The case 1/M + c_f phi = 0, where flow and rock are coupled the most and q = 1."""
    scene = with_material(model1, biot_coefficient=1.0, porosity=0.0)
    assert (coupling_term(scene)[model1.contact_state == 2] == 0).all()
    assert contraction_rate(scene) == 1


def with_material(scene, **changes):
    return replace(scene, material=replace(scene.material, **changes))


def test_stiffness_bounds_agree_with_dense_eigenvalues(model1):
    rows = contact_rows(model1)
    M = dense(model1, ("contact", *model1.fields[1:]))
    n, m = (model1.sizes[f] for f in ("intf_force", "momentum"))
    start = model1.sizes["contact"]
    mechanics = M[start : start + n + m, start : start + n + m]
    B = np.zeros((n + m, start))
    for i in range(n):
        entries = slice(*rows.jump.indptr[i : i + 2])
        B[i, rows.jump.indices[entries]] = rows.jump.data[entries]
    root = np.sqrt(np.repeat(rows.area, 2))
    with factors(csr(mechanics)) as (solve, _):
        compliance = root[:, None] * (B.T @ np.column_stack([solve(b) for b in B.T])) * root
    eigenvalues = np.linalg.eigvalsh((compliance + compliance.T) / 2)
    assert eigenvalues[0] > 0 or eigenvalues[-1] < 0  # tractions on the walls always do work of one sign
    low, high = korn_trace(model1, rows)
    assert_allclose(high, 2 / np.abs(eigenvalues).max(), rtol=0.01)
    assert_allclose(low, high / (1 + 2 * 1.2 / 2.4))


def richardson(scene, iterations):
    """Norms of (volumetric stress, its fracture counterpart) of each change in the theorem's scheme."""
    mechanics = tuple(f for f in ("contact", "intf_force", "momentum") if f in scene.sizes)
    flow = tuple(f for f in ("intf_flow", "mass") if f in scene.sizes)
    J = dense(scene, mechanics + flow)
    k = sum(scene.sizes[f] for f in mechanics)
    cells = scene.sizes["mass"]
    data = {n: np.broadcast_to(np.asarray(v, dtype=float), cells) for n, v in scene.material.cell_data().items()}
    names = ("lame_lambda", "biot_coefficient", "fluid_compressibility", "fluid_density", "normal_jump")
    lame, alpha, c_f, rho, jump = (data[n] for n in names)
    volume = scene.cell_volumes["mass"]
    scale = volume * rho / scene.material.time_step
    rock, fracture = (scene.cell_dimension == scene.dimension - i for i in (0, 1))
    fixed = scene.fixed_stress_coefficients()[:, 0]  # gamma_c in fractures
    S = J[k:, k:].copy()
    S[range(-cells, 0), range(-cells, 0)] += np.where(rock, alpha**2 / lame * scale, fixed)
    b = np.concatenate([scene.rhs[f] for f in mechanics + flow])
    x, norms = np.zeros(b.size), []
    lame_beta = 1 / contraction_rate(scene)
    with factors(csr(J[:k, :k])) as (solve_mechanics, _), factors(csr(S)) as (solve_flow, _):
        for _ in range(iterations):
            r = b - J @ x
            p = solve_flow(r[k:])
            u = solve_mechanics(r[:k] - J[:k, k:] @ p)
            x += np.concatenate([u, p])
            squeezed = (J[-cells:, :k] @ u) / scale  # alpha div u in the rock, [u]_n in fractures
            p = p[-cells:]
            stress = np.sqrt(np.sum((volume * (alpha * p - lame / alpha * squeezed) ** 2)[rock]))
            chi = np.sqrt(jump * c_f / (lame * (lame_beta - 1)))[fracture]
            fracture_stress = ((fixed / scale) * p - squeezed)[fracture] / chi
            norms.append((stress, np.sqrt(np.sum(volume[fracture] * fracture_stress**2))))
    return np.array(norms)


def test_scheme_contracts_as_promised_without_fractures():
    """There the theorem asks for nothing: every iteration gains the factor q in the volumetric stress."""
    scene = hdf5.read(SCENES / "biot.h5")
    found = evaluate(scene)
    assert found.verdict == "holds" and 0 < found.rate < 1
    stress = richardson(scene, 12)[:, 0]
    assert (stress[1:] <= found.rate * stress[:-1]).all()


@pytest.mark.porepy
def test_scheme_contracts_as_promised_where_the_condition_holds():
    """A fracture so soft, in rock that stores so little, that the condition holds; the norm is that of the theorem."""
    checked = 0
    for scene in soft_fracture(porosity=1e-4):
        found = evaluate(scene)
        if found.verdict == "holds":
            norms = np.hypot(*richardson(scene, 25).T)
            assert (norms[1:] <= found.rate * norms[:-1]).all()
            checked += 1
    assert checked == 2


@pytest.mark.porepy
def test_scheme_may_diverge_where_the_condition_fails():
    """The same fracture with more to store in the rock: the coupling term alone is too large."""
    scene = soft_fracture(porosity=2e-2, residual_aperture=1.0)[1]
    found = evaluate(scene)
    assert found.verdict == "fails" and found.dominant == "coupling"
    norms = np.hypot(*richardson(scene, 25).T)
    assert norms[-1] > 1e3 * norms[0]


@pytest.mark.porepy
def test_rows_agree_with_the_model_they_come_from():
    pytest.importorskip("porepy", reason="PorePy is not installed")
    from petsc_fs.porepy.adapter import evaluate as value

    def look(model, fractures):
        t_n = value(model, model.normal_component(fractures) @ model.contact_traction(fractures))
        return t_n * value(model, model.characteristic_contact_traction(fractures))

    scene, traction = run_to("model1", (1, 3), look, friction=0.3)
    rows = contact_rows(scene)
    stiffness, closure = 1.2e9 / 1e10, 5e-5
    closed = rows.closed
    expected = closure**2 * stiffness / (closure * stiffness - traction) ** 2
    assert_allclose(rows.beta_b[closed], expected[closed], rtol=1e-9)
    assert_allclose(rows.friction[rows.sliding], 0.3, rtol=1e-9)
    assert_allclose(rows.bound[rows.sticking], -0.3 * traction[rows.sticking], rtol=1e-9)


def soft_fracture(porosity, residual_aperture=0.12):
    """The first Newton steps of model 1 with other rock and an elastic closure of up to 100 m."""
    pytest.importorskip("porepy", reason="PorePy is not installed")
    from petsc_fs.porepy.cases import Rock

    opening = {"maximum_elastic_fracture_opening": 100.0, "residual_aperture": residual_aperture}
    changes = {"rock": Rock(biot_coefficient=1.0, porosity=porosity, **opening), "physics": "restricted"}
    scenes = []
    run_to("model1", (1, 2), scenes=scenes, friction=0.1, normal_stiffness=5e4, **changes)
    return scenes


def run_to(name, step, look=None, scenes=None, **changes):
    """Scene, and what `look` sees in the model, at a Newton step of a run at refinement 1; scenes up to there."""
    from petsc_fs.porepy import make_model, run
    from petsc_fs.porepy.adapter import Adapter
    from petsc_fs.porepy.direct import solve
    from petsc_fs.porepy.models import StopRun

    found = []

    def hook(model, _):
        adapter = Adapter(model)
        scene = adapter.scene()
        if scenes is not None:
            scenes.append(scene)
        if (model.time_manager.time_index, model.nonlinear_solver_statistics.num_iteration) == step:
            found.extend([scene, look and look(model, adapter.grids("contact"))])
            raise StopRun

    run(make_model(name, **changes), on_newton_step=hook, linear_solve=lambda model: solve(*model.linear_system))
    return found


def test_grids_that_do_not_match_are_refused():
    scene = synthetic(2)
    block = scene.blocks["intf_force", "contact"]
    scene.blocks["intf_force", "contact"] = block._replace(data=block.data * np.linspace(1, 2, block.data.size))
    with pytest.raises(SceneError, match="two interface cells of its own size"):
        contact_rows(scene)
    assert any("contact terms not evaluated" in note for note in evaluate(scene).notes)


def test_json_and_table_say_the_same(tmp_path, capsys):
    file = tmp_path / "condition.json"
    assert main(["inspect", "model1.h5", "--contraction", "--json", str(file)]) == 0
    data = json.loads(file.read_text())
    text = capsys.readouterr().out
    assert data["verdict"] == "fails" and "condition: fails" in text
    assert f"{data['dominant']} dominates" in text
    assert f"{data['right_hand_side']:.2e}" in text
    assert data["terms"]["normal"]["cells"] == 9
    assert_allclose(sum(term["theorem"] for term in data["terms"].values()), data["right_hand_side"])


@pytest.mark.mpi
def test_rank_0_evaluates_for_all():
    assert main(["inspect", "model1.h5", "--contraction"]) == 0


def test_what_is_unknown_is_said(capsys):
    assert main(["inspect", "contact.h5", "--contraction"]) == 0
    text = capsys.readouterr().out
    assert re.search(r"^coupling +0 +\?$", text, re.MULTILINE)
    assert "condition: not evaluated" in text and "no material data" in text
    assert main(["inspect", "flow.h5", "--contraction"]) == 0
    assert "no fracture with contact" in capsys.readouterr().out
