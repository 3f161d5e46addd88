"""Partition: balance, fields of one place on one rank, solutions in the order of the scene, the same iterations."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI
from sample import CELLS, SCENES, full_scene

from petsc_fs import options
from petsc_fs.errors import LayoutError, SceneError, UsageError
from petsc_fs.fields import FIELD
from petsc_fs.io import hdf5
from petsc_fs.io.reader import read_distributed
from petsc_fs.partition import Layout, rows_of
from petsc_fs.partition import (
    KINDS,
    Coupling,
    Places,
    anchors,
    bisect,
    chosen,
    has_partitioner,
    match,
    morton,
    partition,
    parts_of,
)
from petsc_fs.scene import Scene
from petsc_fs.solver import Solver

comm = MPI.COMM_WORLD
HERE = [kind for kind in KINDS if kind != "ptscotch" or has_partitioner(kind)]
needs_ptscotch = pytest.mark.skipif("ptscotch" not in HERE, reason="this PETSc has no PTScotch")
NAMES = [path.stem for path in sorted(SCENES.glob("*.h5"))]


def load(name: str) -> Scene:
    return hdf5.read(SCENES / f"{name}.h5")


@pytest.fixture
def database():
    """Puts an options file and more options into the database, which is emptied afterwards."""
    from petsc4py import PETSc

    def fill(file: str, **more: str) -> None:
        options.insert(options.find_options_file(file))
        options.insert_all(more)

    before = PETSc.Options().getAll()
    yield fill
    for name in set(PETSc.Options().getAll()) - set(before):
        PETSc.Options().delValue(name)


# --- recursive coordinate bisection


@given(n=st.integers(0, 60), parts=st.integers(1, 13), seed=st.integers(0, 1000), ties=st.booleans())
def test_parts_of_equal_weights_differ_by_three_points_at_most(n, parts, seed, ties):
    """Each cut is off by half a point, and passes on at most two thirds of what it inherits: 1.5 in all."""
    points = np.random.default_rng(seed).random((n, 3))
    points = np.round(points, 1) if ties else points
    part = bisect(points, np.ones(n), parts)
    sizes = np.bincount(part, minlength=parts)
    assert sizes.size == parts
    assert (np.abs(sizes - n / parts) <= 1.5).all()


def test_parts_are_boxes():
    points = np.random.default_rng(3).random((500, 3)) * [8, 1, 1]
    part = bisect(points, np.ones(500), 4)
    x = [points[part == k, 0] for k in range(4)]
    assert all(a.max() < b.min() for a, b in pairwise(x))


def test_heavy_points_count_for_more():
    points = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    weights = np.array([1, 1, 1, 1, 1, 1, 1, 1, 1, 9.0])
    np.testing.assert_array_equal(bisect(points, weights, 2), [0] * 9 + [1])


def test_rounding_errors_do_not_move_a_cut():
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    noise = 1e-13 * np.random.default_rng(0).standard_normal(grid.shape)
    for parts in (2, 3, 4, 5):
        weights = np.ones(len(grid))
        np.testing.assert_array_equal(bisect(grid, weights, parts), bisect(grid + noise, weights, parts))


# --- co-location


def without_centers(scene: Scene) -> Scene:
    return replace(scene, cell_centers={})


def coupling(scene: Scene, r: str, c: str) -> Coupling:
    return Coupling.of(scene.blocks[r, c], scene.block_size(r), scene.block_size(c))


def ranks_of(scene: Scene, ranks: int, kind: str = "auto"):
    return parts_of(Places.of(scene), ranks, kind).owners


@pytest.mark.parametrize("strip", [False, pytest.param(True, marks=needs_ptscotch)], ids=["rcb", "ptscotch"])
@pytest.mark.parametrize("name", NAMES)
def test_fields_of_one_place_are_on_one_rank(name, strip):
    scene = without_centers(load(name)) if strip else load(name)
    for ranks in (2, 3, 8):
        owners = ranks_of(scene, ranks)
        assert all(0 <= rank.min() and rank.max() < ranks for rank in owners.values())
        rock = np.ones(0)
        if scene.cell_dimension is not None:
            rock = scene.cell_dimension == scene.dimension
            fracture = scene.cell_dimension == scene.dimension - 1
            if "momentum" in owners:
                np.testing.assert_array_equal(owners["mass"][rock], owners["momentum"])
        for pair in (("contact", "intf_force"), ("intf_force", "contact")):
            if pair in scene.blocks:
                across = coupling(scene, *pair)
                np.testing.assert_array_equal(owners[pair[0]][across.rows], owners[pair[1]][across.columns])
        for walls in ("intf_force", "intf_flow"):
            if (walls, "mass") in scene.blocks:  # pressure acts on the two walls of its fracture cell, and these only
                own = coupling(scene, walls, "mass")
                keep = fracture[own.columns]
                rows, columns = own.rows[keep], own.columns[keep]
                once = np.bincount(rows, minlength=owners[walls].size)[rows] == 1  # else it is at an intersection
                np.testing.assert_array_equal(owners[walls][rows[once]], owners["mass"][columns[once]])
        beside = ("intf_force", "momentum") if "intf_force" in owners else ("intf_flow", "mass")
        if beside in scene.blocks:
            near = coupling(scene, *beside)
            keep = slice(None) if beside[1] == "momentum" else rock[near.columns]
            rows, columns = near.rows[keep], near.columns[keep]
            here = owners[beside[0]][rows] == owners[beside[1]][columns]
            groups = Places.of(scene)
            of_cell = anchors(groups)[beside[0]][rows]  # one fracture cell, both walls
            assert set(of_cell[here]) == set(of_cell)


@pytest.mark.parametrize("name", NAMES)
def test_centers_and_pattern_find_the_same_anchors(name):
    scene = load(name)
    for f, anchor in anchors(Places.of(without_centers(scene))).items():
        np.testing.assert_array_equal(anchor, anchors(Places.of(scene))[f])


@pytest.mark.parametrize("name", NAMES)
def test_unknowns_are_balanced(name):
    scene = load(name)
    for ranks in (2, 3, 4, 8):
        load_of = sum(
            np.bincount(rank, minlength=ranks) * scene.block_size(f)
            for f, rank in ranks_of(scene, ranks, "rcb").items()
        )
        assert load_of.max() < 1.05 * load_of.mean()


SUBSETS = [
    ("contact",),
    ("intf_flow",),
    ("mass",),
    ("contact", "intf_force"),
    ("contact", "mass"),
    ("contact", "intf_force", "mass"),
    ("intf_force", "intf_flow", "mass"),
    ("contact", "momentum"),
    tuple(CELLS),
]


@pytest.mark.parametrize("kind", HERE)
@pytest.mark.parametrize("fields", SUBSETS, ids="-".join)
def test_any_fields_on_any_number_of_ranks(fields, kind):
    """Random scenes, whose couplings and dimensions of cells mean nothing, with fewer cells than ranks."""
    scene = full_scene().only(fields)
    for case in (scene, replace(scene, blocks={(f, f): scene.blocks[f, f] for f in fields}, cell_dimension=None)):
        for ranks in (1, 2, 5, 20):
            owners = ranks_of(case, ranks, kind)
            assert {f: rank.size for f, rank in owners.items()} == {f: CELLS[f] for f in fields}
            assert all(0 <= rank.min() and rank.max() < ranks for rank in owners.values())


def test_a_field_without_cells_has_no_owners():
    scene = full_scene(cells={**CELLS, "momentum": 0, "contact": 0})
    assert {f: rank.size for f, rank in ranks_of(scene, 3).items()} == {**CELLS, "momentum": 0, "contact": 0}


def test_points_find_those_at_the_same_place():
    points = np.random.default_rng(2).random((30, 3))
    order = np.random.default_rng(5).permutation(30)
    np.testing.assert_array_equal(match(points[order] + 1e-12, points), order)
    np.testing.assert_array_equal(match(np.array([[9.0, 9.0, 9.0]]), points), [-1])


def test_what_is_missing_is_named(database):
    scene = without_centers(load("biot"))
    with pytest.raises(UsageError, match=r"-x_petsc_fs_partition rcb: no cell_centers of momentum in the scene; use"):
        parts_of(Places.of(scene), 2, "rcb", prefix="x_")
    with pytest.raises(UsageError, match=r"-x_petsc_fs_ordering morton: no cell_centers of momentum in the scene; use"):
        parts_of(Places.of(scene), 1, ordering="morton", prefix="x_")
    with pytest.raises(UsageError, match="-petsc_fs_ordering morton: -petsc_fs_partition contiguous keeps the scene's"):
        parts_of(Places.of(load("biot")), 2, "contiguous", "morton")
    database("direct.opts", petsc_fs_mat_partitioning_type="nothing")
    with pytest.raises(UsageError, match="this PETSc has no such partitioner"):
        parts_of(Places.of(scene), 2, "ptscotch")
    database("direct.opts", petsc_fs_ordering="rcm")
    with pytest.raises(UsageError, match="-petsc_fs_ordering rcm: expected auto or natural or morton"):
        chosen()
    database("direct.opts", petsc_fs_partition="metis")
    with pytest.raises(UsageError, match="-petsc_fs_partition metis: expected auto or rcb or ptscotch or contiguous"):
        chosen()


def test_the_curve_visits_each_octant_in_turn():
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    np.testing.assert_array_equal(np.argsort(morton(corners)), np.argsort(corners @ [1, 2, 4]))
    points = np.random.default_rng(3).random((4096, 3))
    along = points[np.argsort(morton(points))]
    octant = (along > 0.5) @ [1, 2, 4]
    assert np.count_nonzero(np.diff(octant)) == 7
    step = np.linalg.norm(np.diff(along, axis=0), axis=1)
    assert step.mean() < 0.2 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.ones((5, 3))], ids=["none", "one place"])
def test_the_curve_has_a_place_for_all(points):
    np.testing.assert_array_equal(morton(points), np.zeros(len(points)))


@pytest.mark.parametrize("ranks", [1, 3])
def test_cells_are_ordered_where_there_are_many(ranks, monkeypatch):
    places = Places.of(load("model3"))
    natural = parts_of(places, ranks)
    np.testing.assert_array_equal(natural.order["momentum"], np.arange(places.cells["momentum"]))
    monkeypatch.setattr("petsc_fs.partition.CELLS_IN_CACHE", places.cells["momentum"] // ranks - 1)
    ordered = parts_of(places, ranks)
    np.testing.assert_array_equal(ordered.order["momentum"], morton(places.centers["momentum"]))
    for f in places.cells:
        np.testing.assert_array_equal(natural.owners[f], ordered.owners[f])


# --- layout


def test_a_layout_knows_the_way_back():
    rng = np.random.default_rng(4)
    three = type("Three", (), {"rank": 1, "size": 3})()
    owners = {f: rng.integers(0, 3, n) for f, n in CELLS.items()}
    layout = Layout.from_owners(three, 2, owners, {f: rng.random(n) for f, n in CELLS.items()})
    for f, n in CELLS.items():
        bs = FIELD[f].block_size(2)
        cells = layout.cells.get(f, np.arange(n))
        np.testing.assert_array_equal(np.sort(cells), np.arange(n))
        np.testing.assert_array_equal(layout.places(f)[cells], np.arange(n))
        np.testing.assert_array_equal(layout.owners(f), owners[f])
        np.testing.assert_array_equal(owners[f][layout.own_cells(f)], 1)
        values = rng.random(n * bs)
        np.testing.assert_array_equal(layout.to_scene(f, values[rows_of(cells, bs)]), values)


def test_owners_must_be_ranks():
    one = type("One", (), {"rank": 0, "size": 1})()
    with pytest.raises(LayoutError, match="mass: owners must lie between 0 and 0"):
        Layout.from_owners(one, 2, {"mass": [0, 1]})
    with pytest.raises(LayoutError, match="mass: 2 owners, but 3 keys"):
        Layout.from_owners(one, 2, {"mass": [0, 0]}, {"mass": [1, 2, 3]})


# --- in parallel


@pytest.mark.mpi
@pytest.mark.parametrize("kind", HERE)
def test_solutions_come_back_in_the_order_of_the_scene(database, kind):
    scene = load("model2")
    database("contact_poromechanics.opts", petsc_fs_partition=kind)
    alone = Solver(scene, MPI.COMM_SELF)
    expected = alone.system.gather(alone.solve().solution)
    solver = Solver(scene)
    found = solver.system.gather(solver.solve().solution)
    solver.update(scene)
    again = solver.system.gather(solver.solve().solution)
    assert expected is not None
    assert (found is None) == (comm.rank > 0)
    for f in scene.fields if found is not None else ():
        assert np.linalg.norm(found[f] - expected[f]) < 1e-6 * np.linalg.norm(expected[f])
        np.testing.assert_allclose(again[f], found[f], rtol=1e-6, atol=1e-9 * np.abs(found[f]).max())


@pytest.mark.mpi
@pytest.mark.parametrize("name", ["model3", "flow"])
def test_the_order_of_cells_changes_no_solution(name, database):
    database("direct.opts")
    found = {}
    for ordering in ("natural", "morton"):
        scene, layout = read_distributed(SCENES / f"{name}.h5", comm, ordering=ordering)
        assert bool(layout.cells) == (ordering == "morton" or comm.size > 1)
        solver = Solver(scene, layout=layout)
        parts = comm.allgather(solver.solve().solution)
        solver.destroy()
        found[ordering] = {f: layout.to_scene(f, np.concatenate([p[f] for p in parts])) for f in layout.fields}
    for f, expected in found["natural"].items():
        np.testing.assert_allclose(found["morton"][f], expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


@pytest.mark.mpi
def test_only_rank_0_needs_the_scene():
    scene = load("model3")
    layout = partition(scene if comm.rank == 0 else None, comm)
    other = partition(scene, comm)
    for f in scene.fields:
        np.testing.assert_array_equal(layout.places(f), other.places(f))
        np.testing.assert_array_equal(layout.offsets[f], other.offsets[f])


@pytest.mark.mpi
@pytest.mark.parametrize("kind", ["rcb", pytest.param("ptscotch", marks=needs_ptscotch)])
def test_errors_name_cells_and_rows_of_the_scene(database, kind):
    scene = load("model2")
    database("contact_poromechanics.opts", petsc_fs_partition=kind)
    block = scene.blocks["intf_force", "intf_force"]
    block.data[block.indptr[2 * 17] : block.indptr[2 * 18]] = 0.0
    solver = Solver(scene)
    with pytest.raises(SceneError, match="D_22, block of intf_force: singular at cell 17;"):
        solver.set_up()
    block = scene.blocks["momentum", "mass"]
    block.data[block.indptr[1001]] = np.nan
    with pytest.raises(SceneError, match=r"block \(momentum, mass\): row 1001 has an entry that is not finite"):
        Solver(scene)


@pytest.mark.mpi
@pytest.mark.parametrize("fields", SUBSETS, ids="-".join)
def test_ranks_may_be_more_than_cells(fields, database):
    """Every scene below has fewer cells of a field than four ranks."""
    scene = full_scene(cells={f: 1 + k % 3 for k, f in enumerate(CELLS)}).only(fields)
    database("direct.opts")
    for kind in HERE:
        layout = partition(scene, comm, kind)
        part = scene.restrict(layout)
        for f in fields:
            gathered = comm.allgather(part.rhs[f])
            np.testing.assert_array_equal(layout.to_scene(f, np.concatenate(gathered)), scene.rhs[f])
        held = comm.allreduce(sum(block.data.size for block in part.blocks.values()))
        assert held == sum(block.data.size for block in scene.blocks.values())


PAIRS = [
    (file.path.name, name)
    for file in options.shipped()
    for name in NAMES
    if file.fits(hdf5.read_sizes(SCENES / f"{name}.h5")[1]) and name not in file.not_for
    if options.parse(file.path).get("pc_type") != "lu"  # iterations of direct solvers are rounding errors
]

MORE = {("flow_fast.opts", "flow"): 1, ("contact_poromechanics_gamg.opts", "model1"): 1}
"""Iterations beyond that, where multigrid coarsens otherwise along the boundary between ranks: with HMIS 10 on one rank
and 12 on two, with GAMG 29 on one and 33 on four."""


@pytest.mark.mpi
@pytest.mark.parametrize(("file", "name"), PAIRS, ids=["-".join(pair).replace(".opts", "") for pair in PAIRS])
def test_iterations_do_not_depend_on_ranks(database, file, name):
    """Within 10 %, rounded up to a whole iteration."""
    database(file)
    if file == "fixed_stress_richardson.opts":
        from petsc4py import PETSc

        # Its absolute tolerance lies below what rounding in the factorisations leaves of model1's preconditioned
        # residual, which wanders between 1e-10 and 2e-9 then: where it stops there is chance.
        PETSc.Options().setValue("ksp_atol", 1e-8)
        PETSc.Options().setValue("petsc_fs_error_factor", 0)  # whether it starts again would be chance, too
    scene = load(name)
    alone = comm.bcast(Solver(scene, MPI.COMM_SELF).solve().iterations if comm.rank == 0 else 0)
    result = Solver(scene).solve()
    assert result.converged
    assert result.iterations <= math.ceil(1.1 * alone) + MORE.get((file, name), 0)
