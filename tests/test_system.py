"""A scene as PETSc objects: values and patterns one after another, vectors there and back, and what is said of them."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from common import Layout, block_of, comm, confirm, gathered, load, noisy, rows_of, scaled, system_of, thinned
from sample import full_scene

from petsc_fs import nest
from petsc_fs.errors import LayoutError
from petsc_fs.scene import Scene
from petsc_fs.system import EPS, ROUNDING_UNITS, Check, System, row_exponents

pytestmark = pytest.mark.mpi
WAYS = ("whole", "share", "root")


def layout_of(scene: Scene, mixed: bool) -> Layout:
    """Even shares in the order of the scene, or any owners in any order."""
    if not mixed:
        return Layout.contiguous(comm, scene.dimension, scene.sizes)
    rng = np.random.default_rng(1)
    cells = {f: n // scene.block_size(f) for f, n in scene.sizes.items()}
    owners = {f: rng.integers(0, comm.size, n) for f, n in cells.items()}
    return Layout.from_owners(comm, scene.dimension, owners, {f: rng.random(n) for f, n in cells.items()})


def given(scene: Scene, way: str) -> Scene | None:
    """A scene as `System.take` takes it."""
    if way == "root":
        return scene if comm.rank == 0 else None
    even = Layout.contiguous(comm, scene.dimension, scene.sizes)
    return scene.restrict({f: even.rows(f) for f in scene.sizes}) if way == "share" and comm.size > 1 else scene


def places(layout: Layout, f: str) -> np.ndarray:
    """The scene's numbers of the rows of a field, in the order of the layout."""
    cells = layout.cells.get(f, np.arange(layout.sizes(f)[1] // layout.block_size(f)))
    return rows_of(cells, layout.block_size(f))


def assert_holds(system: System, scene: Scene) -> None:
    """Matrices, right-hand side, and what is composed on blocks are those of the scene."""
    layout, scale = system.layout, system.row_scale
    order = {f: places(layout, f) for f in scene.fields}
    for r, c in product(scene.fields, scene.fields):
        expected = np.ldexp(block_of(scene, r, c)[np.ix_(order[r], order[c])], scale[r])
        if (r, c) not in system.blocks:
            assert not expected.any()
            continue
        np.testing.assert_array_equal(gathered(system.blocks[r, c]), expected, err_msg=f"{r}, {c}")
        assert system.blocks[r, c].getBlockSizes() == (scene.block_size(r), scene.block_size(c))
    assert nest.field_names(system.J) == scene.fields
    assert {rc: m.handle for rc, m in nest.blocks_of(system.J).items()} == {
        rc: m.handle for rc, m in system.blocks.items()
    }
    b = system.gather({f: np.ldexp(v, -scale[f] - system.rhs_scale) for f, v in system.by_field(system.b).items()})
    assert (b is None) == (comm.rank > 0)
    for f, values in (b or {}).items():
        np.testing.assert_array_equal(values, scene.rhs[f])
    coordinates = system.blocks["momentum", "momentum"].query("coordinates").getArray()
    own = scene.cell_centers["momentum"][layout.own_cells("momentum"), : scene.dimension]
    np.testing.assert_array_equal(coordinates.reshape(own.shape), own)
    base = np.ldexp(system.blocks["mass", "mass"].query("fixed_stress_base").getArray(), -scale["mass"])
    rock = (scene.cell_dimension == scene.dimension)[layout.own_cells("mass")]
    m, cells = scene.material, layout.own_cells("mass")[rock]
    G, lame = m.shear_modulus[cells], m.lame_lambda[cells]
    volume = scene.cell_volumes["mass"][cells]
    expected = m.biot_coefficient**2 / (4 * G + 2 * lame) * volume * m.fluid_density / m.time_step
    np.testing.assert_allclose(base[rock], expected, rtol=1e-12)


@pytest.mark.parametrize("mixed", [False, True], ids=["even", "mixed"])
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("dimension", [2, 3])
def test_what_is_taken_is_the_scene_one_after_another(dimension, way, mixed):
    """New values, entries and whole blocks that come and go, other units, and the first scene again."""
    first = full_scene(dimension)
    first = replace(first, reference={})
    gone, bare = (
        replace(first, blocks={rc: b for rc, b in first.blocks.items() if rc != missing})
        for missing in (("momentum", "mass"), ("mass", "mass"))
    )
    fewer = thinned(thinned(first, ("mass", "mass"), slice(0, None, 3)), ("intf_force", "momentum"), slice(1, None, 2))
    others = thinned(first, ("mass", "mass"), slice(1, None, 3))
    steps = [first, noisy(first, 1), fewer, others, gone, bare, scaled(first, rows={"mass": 2.0**-30}), first]
    system = System(layout_of(first, mixed), root_only=way == "root")
    for scene in steps:
        system.take(given(scene, way))
        assert_holds(system, scene)
    system.destroy()
    system.destroy()


def test_a_scene_may_be_let_go_while_it_is_taken():
    scene = full_scene()
    system = System(layout_of(scene, mixed=True))
    part = replace(scene, blocks=dict(scene.blocks))
    system.take(part, release=True)
    assert not part.blocks
    assert_holds(system, scene)


def test_from_one_rank_only_what_has_another_pattern_is_made_anew():
    scene = full_scene()
    system = System(layout_of(scene, mixed=True), root_only=True)
    system.take(given(scene, "root"))
    handles = {rc: m.handle for rc, m in system.blocks.items()}
    system.take(given(noisy(scene, 2), "root"))
    assert {rc: m.handle for rc, m in system.blocks.items()} == handles
    assert system.renewals == 0
    system.take(given(thinned(scene, ("mass", "mass"), slice(0, None, 2)), "root"))
    assert {rc for rc, m in system.blocks.items() if m.handle != handles[rc]} == {("mass", "mass")}
    assert system.renewals == 1


def test_as_many_entries_in_other_places_are_another_pattern():
    scene = full_scene()
    b = scene.blocks["mass", "mass"]
    moved = scene.sizes["mass"] - 1 - b.indices
    for start, stop in zip(b.indptr[:-1], b.indptr[1:], strict=True):
        moved[start:stop].sort()
    other = replace(scene, blocks=scene.blocks | {("mass", "mass"): b._replace(indices=moved)})
    system = System(layout_of(scene, mixed=False), root_only=True)
    for each in (scene, other):
        system.take(given(each, "root"))
        assert_holds(system, each)


@pytest.mark.parametrize("way", WAYS)
def test_another_scene_or_share_is_refused_on_all_ranks(way):
    system = System(layout_of(full_scene(), mixed=False), root_only=way == "root")
    for wrong in (full_scene(3), full_scene().only(["mass"])):
        with pytest.raises(LayoutError, match=r"the rows of the scene are not those|scene has fields"):
            system.take(given(wrong, way))


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("way", WAYS)
def test_vectors_go_there_and_back(way, mixed):
    scene, rng = full_scene(), np.random.default_rng(5)
    system = System(layout_of(scene, mixed), root_only=way == "root")
    values = {f: rng.standard_normal(n) for f, n in scene.sizes.items()}
    even = Layout.contiguous(comm, scene.dimension, scene.sizes)
    local = {}
    for f, v in values.items():
        part = {"whole": v, "share": v[slice(*even.rows(f))], "root": v if comm.rank == 0 else None}[way]
        local[f] = system.to_layout(f, part)
        np.testing.assert_array_equal(local[f], v[system.layout.own_rows(f)])
    back = system.gather(local)
    assert (back is None) == (comm.rank > 0)
    for f, v in (back or {}).items():
        np.testing.assert_array_equal(v, values[f])
    for factor in (1.0, 1e-200, 1e200, 0.0):
        for f, n in system.norms({f: factor * v for f, v in local.items()})[0].items():
            assert n == pytest.approx(factor * np.linalg.norm(values[f]), rel=1e-13, abs=0.0)


@pytest.mark.parametrize("rhs", [0.0, 1e-300, 1e-150, 1.0, 1e150, 1e300])
def test_a_right_hand_side_of_any_size_is_brought_to_one(rhs):
    scene = full_scene()
    system = system_of(scene)
    system.set_rhs({f: rhs * v for f, v in scene.rhs.items()})
    size = system.b.norm(3)  # of the largest entry
    assert (size == 0.0) if rhs == 0.0 else (0.5 <= size < 1.0)
    whole = system.gather(
        {f: np.ldexp(v, -system.row_scale[f] - system.rhs_scale) for f, v in system.by_field(system.b).items()}
    )
    for f, v in (whole or {}).items():
        np.testing.assert_array_equal(v, rhs * scene.rhs[f])


def test_what_a_check_says_is_so():
    """Of any vector: exactly, and with a lower bound of the terms where that is all that is asked for."""
    scene, rng = load("model2"), np.random.default_rng(4)
    scene = scaled(scene, rows={"mass": 1e-7, "momentum": 1e3})
    system = system_of(scene)
    x, r = system.b.duplicate(), system.b.duplicate()
    local = {f: rng.standard_normal(system.layout.sizes(f)[0]) for f in scene.fields}
    x.setArray(np.concatenate([*local.values()]))
    whole = system.gather({f: np.ldexp(v, -system.rhs_scale) for f, v in local.items()})
    for exactly in (False, True):
        check = system.check(x, r, exactly=exactly)
        said = type("Said", (), {"converged": False, "true_relative_residual": check.relative})
        said.backward_error_by_field = check.backward
        said.residual_by_field = {f: v / np.linalg.norm([*check.rhs.values()]) for f, v in check.residual.items()}
        if whole is not None:
            confirm(scene, said, whole)
        residual = system.b.duplicate()
        system.J.mult(x, residual)
        residual.aypx(-1.0, system.b)
        residual.axpy(-1.0, r)
        assert residual.norm() <= 1e-12 * r.norm()
    assert all(check.terms[f] >= system.check(x, r).terms[f] * (1 - 1e-12) for f in scene.fields)


@pytest.mark.parametrize("name", ["biot", "contact", "model3"])
def test_the_imbalance_is_the_backward_error_of_the_sum_of_equations(name):
    scene, rng = load(name), np.random.default_rng(4)
    system = system_of(scene)
    x, r = system.b.duplicate(), system.b.duplicate()
    values = {f: rng.standard_normal(n) for f, n in scene.sizes.items()}
    x.setArray(np.concatenate([system.to_layout(f, v) for f, v in values.items()]))
    system.check(x, r)
    found = system.imbalance(x, r)
    for f, v in scene.rhs.items():
        weights = np.tile([1.0, 1 / 2, 1 / 3][: scene.block_size(f)], v.size // scene.block_size(f))
        rows = {c: weights @ block_of(scene, f, c) for c in scene.fields}
        rhs = np.ldexp(weights @ v, system.rhs_scale)
        missing = rhs - sum(row @ values[c] for c, row in rows.items())
        terms = abs(rhs) + sum(np.abs(row) @ np.abs(values[c]) for c, row in rows.items())
        assert found[f] == pytest.approx(abs(missing) / terms, rel=1e-3)  # fluxes cancel


def test_excess_is_the_worst_of_what_is_missed_but_for_rounding():
    check = Check({"a": 1e-6, "b": 1e-12}, {"a": 1.0, "b": 1e-8}, {"a": 0.5, "b": 0.0}, 1e-6)
    assert check.relative == pytest.approx(2e-6)
    assert check.backward == pytest.approx({"a": 1e-6, "b": 1e-4})
    assert check.excess(1e-7, 1e-2) == pytest.approx(20.0)
    assert check.excess(1e-3, 1e-6) == pytest.approx(100.0)
    unit = ROUNDING_UNITS * EPS
    for residual, balanced, fine in ((0.5 * unit, 1e-6, True), (2 * unit, 1e-6, False), (0.5 * unit, 1.0, False)):
        assert (Check({"a": residual}, {"a": 1.0}, {"a": 1e-12}, balanced).excess(1e-10, 1e-10) <= 1.0) == fine


def test_rows_are_scaled_so_that_units_do_not_matter():
    """Blocks of a size whatever the units of an equation; mechanics as it is, as one."""
    sizes = {("momentum", "momentum"): 4.0, ("momentum", "mass"): 2.0, ("mass", "momentum"): 2.0, ("mass", "mass"): 1.0}
    base = row_exponents(sizes)
    assert base["momentum"] == 0
    for k in (-40, 7, 300):
        other = {(r, c): n * (2.0**k if r == "mass" else 1.0) for (r, c), n in sizes.items()}
        assert row_exponents(other) == {"momentum": 0, "mass": base["mass"] - k}
    scaled_all = {rc: n * 1e200 for rc, n in sizes.items()}
    assert row_exponents(scaled_all) == base
    assert row_exponents(
        {("mass", "mass"): 1e-9, ("mass", "intf_flow"): 0.0, ("intf_flow", "intf_flow"): 3.0}
    ).keys() == {
        "mass",
        "intf_flow",
    }
