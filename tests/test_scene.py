"""Scenes: cutting a matrix into blocks and back, what does not fit together, parts of one rank."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample import SCENES, assert_same, csr, dense, full_scene, sparse_random

from petsc_fs.errors import LayoutError, SceneError, UsageError
from petsc_fs.io import hdf5
from petsc_fs.scene import CSR, Scene, contact_state_counts

N = 12  # three cells in 2D: 6 displacements, 3 fluxes, 3 pressures


@pytest.fixture
def matrix():
    return sparse_random(np.random.default_rng(1), (N, N))


def permuted(A: np.ndarray, scene: Scene, rows: dict, columns: dict) -> np.ndarray:
    """What `dense(scene)` must be."""
    r = np.concatenate([np.arange(N)[rows[f]] for f in scene.fields])
    c = np.concatenate([np.arange(N)[columns[f]] for f in scene.fields])
    return A[np.ix_(r, c)]


SPECS = {
    "ranges": {"momentum": range(6), "intf_flow": range(6, 9), "mass": range(9, 12)},
    "slices": {"momentum": slice(0, 6), "intf_flow": slice(6, 9), "mass": slice(9, None)},
    "lists": {"momentum": [*range(6)], "intf_flow": [6, 7, 8], "mass": [9, 10, 11]},
    "arrays": {"momentum": np.arange(6), "intf_flow": np.arange(6, 9), "mass": np.arange(9, 12)},
    "other_order_of_fields": {"mass": range(3), "intf_flow": range(3, 6), "momentum": range(6, 12)},
    "interleaved": {"momentum": [0, 1, 4, 5, 8, 9], "intf_flow": slice(2, None, 4), "mass": slice(3, None, 4)},
    "backwards": {"momentum": range(11, 5, -1), "intf_flow": [5, 4, 3], "mass": slice(2, None, -1)},
}


@pytest.mark.parametrize("fields", SPECS.values(), ids=SPECS)
def test_blocks_put_together_give_the_permuted_matrix(matrix, fields):
    b = np.arange(N) + 0.5
    scene = Scene.from_matrix(csr(matrix), b, fields, dimension=2)
    assert scene.fields == ("momentum", "intf_flow", "mass")
    assert scene.sizes == {"momentum": 6, "intf_flow": 3, "mass": 3}
    index = {f: np.arange(N)[list(i) if isinstance(i, range) else i] for f, i in fields.items()}
    np.testing.assert_array_equal(dense(scene), permuted(matrix, scene, index, index))
    for f in scene.fields:
        np.testing.assert_array_equal(scene.rhs[f], b[index[f]])


@given(seed=st.integers(0, 2**32 - 1), momentum=st.integers(0, 3), density=st.sampled_from([0.0, 0.1, 0.6, 1.0]))
def test_rows_and_columns_may_be_any_permutations(seed, momentum, density):
    rng = np.random.default_rng(seed)
    A = sparse_random(rng, (N, N), density)
    cut = 2 * momentum
    rows, columns = ({"momentum": p[:cut], "mass": p[cut:]} for p in (rng.permutation(N), rng.permutation(N)))
    scene = Scene.from_matrix(csr(A), rng.random(N), rows, columns=columns, dimension=2)
    np.testing.assert_array_equal(dense(scene), permuted(A, scene, rows, columns))


def reversed_rows(A: CSR) -> CSR:
    order = np.concatenate([np.arange(a, b)[::-1] for a, b in zip(A.indptr[:-1], A.indptr[1:], strict=True)])
    return CSR(A.indptr, A.indices[order], A.data[order])


class ToCsr:
    """What scipy's other formats offer."""

    format = "coo"

    def __init__(self, A: CSR) -> None:
        self.A = A

    def tocsr(self) -> CSR:
        return self.A


def typed(indices: str, data: str):
    return lambda A: CSR(csr(A).indptr.astype(indices), csr(A).indices.astype(indices), csr(A).data.astype(data))


FORMS = {
    "columns_in_any_order": lambda A: reversed_rows(csr(A)),
    "dense": lambda A: A,
    "lists": lambda A: A.tolist(),
    "np_matrix": np.matrix,
    "by_tocsr": lambda A: ToCsr(csr(A)),
    "halves_of_entries": lambda A: CSR(csr(A).indptr * 2, np.repeat(csr(A).indices, 2), np.repeat(csr(A).data / 2, 2)),
    "uint64": typed("u8", "f8"),
    "int16": typed("i2", "f8"),
    "big_endian": typed(">i4", ">f8"),
    "float_columns": typed("f8", "f8"),
    "long_double": typed("i4", "g"),
}


@pytest.mark.filterwarnings("ignore:the matrix subclass")
@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("name", ["ranges", "interleaved", "backwards"])
def test_a_matrix_may_have_any_form(matrix, form, name):
    fields = SPECS[name]
    expected = Scene.from_matrix(csr(matrix), np.ones(N), fields, dimension=2)
    assert_same(Scene.from_matrix(form(matrix), np.ones(N), fields, dimension=2), expected)


@pytest.mark.parametrize("make", [lambda A: A.astype(np.float32), lambda A: A > 0, lambda A: np.sign(A).astype("i1")])
def test_numbers_of_other_types_become_double(matrix, make):
    scene = Scene.from_matrix(make(matrix), make(matrix)[0], SPECS["ranges"], dimension=2)
    np.testing.assert_array_equal(dense(scene), make(matrix).astype(float))
    assert {block.data.dtype for block in scene.blocks.values()} | {scene.rhs["mass"].dtype} == {np.dtype(float)}


def test_zeros_that_are_stored_stay_in_the_pattern(matrix):
    A = csr(np.ones((N, N)))._replace(data=matrix.ravel())
    scene = Scene.from_matrix(A, np.ones(N), SPECS["interleaved"], dimension=2)
    assert sum(block.data.size for block in scene.blocks.values()) == N**2
    np.testing.assert_array_equal(
        dense(scene), dense(Scene.from_matrix(matrix, np.ones(N), SPECS["interleaved"], dimension=2))
    )


@pytest.mark.parametrize("module", ["csc", "coo", "bsr", "lil", "dia", "csr"])
def test_matrices_of_scipy_in_any_format(matrix, module):
    sparse = pytest.importorskip("scipy.sparse")
    for make in (getattr(sparse, f"{module}_matrix"), getattr(sparse, f"{module}_array")):
        scene = Scene.from_matrix(make(matrix), sparse.csc_matrix(np.ones((N, 1))), SPECS["interleaved"], dimension=2)
        np.testing.assert_array_equal(
            dense(scene), dense(Scene.from_matrix(matrix, np.ones(N), SPECS["interleaved"], dimension=2))
        )


@pytest.mark.parametrize("rhs", [np.arange(N)[:, None], list(range(N)), np.arange(N)[None]])
def test_a_right_hand_side_may_be_a_list_or_a_column(matrix, rhs):
    scene = Scene.from_matrix(matrix, rhs, SPECS["ranges"], dimension=2)
    assert scene.rhs["mass"].tolist() == [9.0, 10.0, 11.0]


def test_rows_of_a_field_may_be_a_mask_or_whole_floats(matrix):
    expected = Scene.from_matrix(matrix, np.ones(N), SPECS["ranges"], dimension=2)
    masks = {f: np.isin(np.arange(N), rows) for f, rows in SPECS["ranges"].items()}
    floats = {f: np.asarray(rows, dtype=float) for f, rows in SPECS["ranges"].items()}
    for fields in (masks, floats, {f: mask.tolist() for f, mask in masks.items()}):
        assert_same(Scene.from_matrix(matrix, np.ones(N), fields, dimension=2), expected)


CHAIN = 20


@pytest.mark.parametrize("order", ["cell", "component"])
def test_unknowns_that_were_eliminated_come_back_as_equations_of_their_own(order):
    rng = np.random.default_rng(3)
    n = 30
    A, b = rng.standard_normal((3 * n, 3 * n)) + 9 * np.eye(3 * n), rng.standard_normal(3 * n)
    fixed = np.array([0, 3, 4, 5, 31, 3 * n - 1])  # one component of a cell, both of another, a pressure
    keep = np.setdiff1d(np.arange(3 * n), fixed)
    place = np.full(3 * n, -1)
    place[keep] = np.arange(keep.size)
    fields = {"momentum": place[: 2 * n], "mass": place[2 * n :]}
    before = {f: ids.copy() for f, ids in fields.items()}
    scene = Scene.from_matrix(A[np.ix_(keep, keep)], b[keep], fields, dimension=2, order=order)
    x = np.linalg.solve(dense(scene), np.concatenate([scene.rhs["momentum"], scene.rhs["mass"]]))
    if order == "component":
        x[: 2 * n] = x[: 2 * n].reshape(n, 2).T.ravel()
    np.testing.assert_allclose(x[keep], np.linalg.solve(A[np.ix_(keep, keep)], b[keep]))
    assert not x[fixed].any()
    for f, ids in fields.items():
        np.testing.assert_array_equal(ids, before[f])


def chain(dimension: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacements of cells in a row, coupled in all components; its rows cell by cell, and component by component."""
    neighbours = 2 * np.eye(CHAIN) - np.eye(CHAIN, k=1) - np.eye(CHAIN, k=-1)
    A = np.kron(neighbours, np.eye(dimension) + 0.3)
    numbers = np.arange(dimension * CHAIN)
    return A, numbers, numbers.reshape(CHAIN, dimension).T.ravel()


@pytest.mark.parametrize("dimension", [2, 3])
def test_unknowns_numbered_by_component_are_refused_or_renumbered(dimension):
    A, cell, component = chain(dimension)
    b = np.arange(cell.size) + 0.5
    expected = Scene.from_matrix(A, b, {"momentum": cell}, dimension=dimension)
    B, c = A[np.ix_(component, component)], b[component]
    with pytest.raises(LayoutError, match=r'^momentum: .* numbered component by component .* order="component"'):
        Scene.from_matrix(B, c, {"momentum": cell}, dimension=dimension)
    for order in ("component", {"momentum": "component", "mass": "cell"}):
        assert_same(Scene.from_matrix(B, c, {"momentum": cell}, dimension=dimension, order=order), expected)
    for order in ("cells", {"momentum": "xyz"}):
        with pytest.raises(UsageError, match="order: expected cell or component"):
            Scene.from_matrix(A, b, {"momentum": cell}, dimension=dimension, order=order)


@pytest.mark.parametrize("name", sorted(p.name for p in SCENES.glob("*.h5")))
def test_the_pattern_tells_the_order_of_bundled_scenes(name):
    scene = hdf5.read(SCENES / name)
    for field in {"momentum", "intf_force"} & set(scene.fields):
        size, bs = scene.sizes[field], scene.block_size(field)
        cell_by_cell = scene.blocks[field, field]
        by_component = Scene.from_matrix(
            cell_by_cell, np.ones(size), {"mass": np.arange(size).reshape(-1, bs).T.ravel()}, dimension=2
        ).blocks["mass", "mass"]
        scene.blocks[field, field] = by_component
        with pytest.raises(LayoutError, match=f"{field}: the unknowns are numbered component by component"):
            scene.validate()
        scene.blocks[field, field] = cell_by_cell
    scene.validate()


@pytest.mark.parametrize("seed", range(30))
def test_random_patterns_raise_no_alarm(seed):
    rng = np.random.default_rng(seed)
    A = sparse_random(rng, (36, 36), rng.random())
    Scene.from_matrix(A, np.ones(36), {"momentum": range(36)}, dimension=int(rng.integers(2, 4)))


@pytest.mark.parametrize("stored", [True, False], ids=["zeros", "no_entries"])
@pytest.mark.parametrize("part", [False, True], ids=["whole", "part"])
def test_equations_without_entries_are_named(stored, part):
    scene = full_scene()
    scene.check_rows()
    for (r, c), block in scene.blocks.items():
        if r == "momentum":
            A = np.zeros((scene.sizes[r], scene.sizes[c]))
            A[np.repeat(np.arange(A.shape[0]), np.diff(block.indptr)), block.indices] = block.data
            A[[7, 9]] = 0
            zero = np.isin(np.repeat(np.arange(A.shape[0]), np.diff(block.indptr)), [7, 9])
            scene.blocks[r, c] = block._replace(data=np.where(zero, 0, block.data)) if stored else csr(A)
    if part:
        scene = scene.restrict({f: (n // 2 // 2 * 2, n) for f, n in scene.sizes.items()})
    with pytest.raises(SceneError, match=r"^momentum: the equation of cell 3, component y, has no entry .*\(2 such eq"):
        scene.check_rows()


def test_unknowns_in_no_equation_are_named_and_identity_rows_are_fine():
    A = np.eye(4)
    fields = {"intf_flow": range(1), "mass": range(1, 4)}
    Scene.from_matrix(A, np.ones(4), fields, dimension=2).check_rows()
    A[2] = [0, 0, 0, 1]
    with pytest.raises(
        SceneError, match=r"^mass: the unknown of cell 1 has no entry or only zeros in the matrix, which"
    ):
        Scene.from_matrix(A, np.ones(4), fields, dimension=2).check_rows()
    with pytest.raises(SceneError, match=r"^mass: the equation of cell 0 has no entry"):
        Scene(dimension=3, sizes={"mass": 2}, blocks={}, rhs={"mass": np.ones(2)}).check_rows()


def test_blocks_without_entries_are_left_out():
    fields = {"intf_flow": range(6), "mass": range(6, N)}
    scene = Scene.from_matrix(csr(np.eye(N)), np.ones(N), fields, dimension=3)
    assert set(scene.blocks) == {("intf_flow", "intf_flow"), ("mass", "mass")}


def test_further_attributes_are_passed_on(matrix):
    volumes = {"mass": np.arange(3.0)}
    fields = SPECS["ranges"]
    assert Scene.from_matrix(csr(matrix), np.ones(N), fields, dimension=2, cell_volumes=volumes).cell_volumes is volumes


def in_mass(**more) -> dict:
    return {"fields": {"intf_flow": range(6), "mass": range(6, N)}, **more}


class Transposed:
    """Compressed columns, as scipy has them."""

    format = "csc"
    indptr, indices, data = csr(np.eye(N))


MISFITS = {
    "unknown_field": (in_mass(fields={"temperature": range(N)}), "unknown field 'temperature'"),
    "row_in_two_fields": (in_mass(fields={"intf_flow": range(7), "mass": range(6, N)}), "mass: a row is listed twice"),
    "row_listed_twice": (in_mass(fields={"mass": [*range(N), 3]}), "mass: a row is listed twice"),
    "row_in_no_field": (in_mass(fields={"mass": range(2, N)}), "2 rows belong to no field, the first is 0"),
    "row_outside": (in_mass(fields={"mass": range(1, N + 1)}), "mass: a row number is outside 0:12"),
    "negative_row": (in_mass(fields={"mass": range(-2, N - 2)}), "mass: a row number is outside 0:1[23]"),
    "all_shifted_by_one": (in_mass(fields={"mass": range(-1, N - 1)}), "1 rows belong to no field, the first is 11"),
    "eliminated_in_rows_alone": (
        in_mass(fields={"mass": [*range(N), -1]}, columns={"mass": [-1, *range(N)]}),
        "mass: rows and columns must be -1 at the same places",
    ),
    "column_in_two_fields": (
        in_mass(columns={"intf_flow": range(6), "mass": range(5, N - 1)}),
        "mass: a column is listed twice or belongs to two fields",
    ),
    "column_in_no_field": (in_mass(columns={"mass": range(6, N)}), "columns are given for mass"),
    "rows_and_columns_differ": (
        in_mass(columns={"intf_flow": range(5), "mass": range(5, N)}),
        "intf_flow: 6 rows but 5 columns",
    ),
    "no_whole_cells": (
        {"fields": {"momentum": range(7), "mass": range(7, N)}},
        "momentum: 7 rows.* not a multiple of block size 2 in 2D; if fixed unknowns were eliminated, give -1",
    ),
    "short_rhs": (in_mass(rhs=np.ones(N - 1)), "matrix has 12 rows, rhs has shape"),
    "rhs_of_two_columns": (in_mass(rhs=np.ones((N // 2, 2))), "rhs has shape"),
    "column_number_too_large": (in_mass(matrix=csr(np.ones((N, N + 1)))), "matrix: a column number is outside"),
    "compressed_columns": (in_mass(matrix=Transposed), "expected compressed rows"),
    "unknown_columns": (in_mass(columns={"mass": range(N)}), "columns are given for mass; rows for intf_flow, mass"),
    "rectangular": (in_mass(matrix=np.ones((N, N + 3))), "matrix: has 12 rows and 15 columns, and must be square"),
    "one_dimension": (in_mass(matrix=np.ones(N)), "expected compressed rows .* or a dense array .*, found ndarray"),
    "lists_of_different_lengths": (in_mass(matrix=[[1.0], [2.0, 3.0]]), "found list"),
    "no_matrix": (in_mass(matrix=object()), "found object"),
    "fractional_columns": (in_mass(matrix=csr(np.eye(N))._replace(indices=np.arange(N) + 0.5)), "must be integers"),
    "values_missing": (
        in_mass(matrix=csr(np.eye(N))._replace(data=np.ones(3))),
        "matrix: indptr ends at 12, but there",
    ),
    "complex_matrix": (in_mass(matrix=csr(1j * np.eye(N))), "matrix is complex; a scene is real"),
    "complex_dense_matrix": (in_mass(matrix=1j * np.eye(N)), "matrix is complex"),
    "complex_rhs": (in_mass(rhs=np.full(N, 1j)), "rhs is complex"),
    "rhs_of_words": (in_mass(rhs=["one"] * N), "rhs is not made of numbers"),
    "fractional_rows": (in_mass(fields={"mass": np.arange(N) + 0.5}), "mass: row numbers must be integers"),
    "rows_of_words": (in_mass(fields={"mass": "all"}), "mass: row numbers must be integers"),
    "rows_not_finite": (in_mass(fields={"mass": [*range(N - 1), np.nan]}), "mass: row numbers must be integers"),
    "short_mask": (in_mass(fields={"mass": np.ones(N - 1, dtype=bool)}), r"a mask has shape \(11,\), expected \(12,\)"),
    "unfit_attribute": (in_mass(cell_volumes={"mass": np.ones(5)}), r"mass: cell_volumes has shape \(5,\)"),
}


@pytest.mark.parametrize(("arguments", "message"), MISFITS.values(), ids=MISFITS)
def test_a_matrix_that_does_not_fit_is_refused(arguments, message):
    arguments = {"matrix": csr(np.eye(N)), "rhs": np.ones(N), "dimension": 2, **arguments}
    with pytest.raises(SceneError, match=message):
        Scene.from_matrix(**arguments)


def test_a_full_scene_is_valid():
    for dimension in (2, 3):
        full_scene(dimension).validate()


BAD = [np.nan, np.inf, -np.inf]


@pytest.mark.parametrize("bad", BAD, ids=str)
@pytest.mark.parametrize("what", ["rhs", "reference", "cell_centers", "cell_volumes"])
def test_arrays_must_be_finite(what, bad):
    scene = full_scene()
    getattr(scene, what)["intf_force"].flat[-1] = bad
    with pytest.raises(SceneError, match=f"intf_force: {what} has an entry that is not finite"):
        scene.validate()


@pytest.mark.parametrize("bad", BAD, ids=str)
def test_matrix_entries_must_be_finite_and_the_row_is_named(bad):
    scene = full_scene()
    block = scene.blocks["momentum", "mass"]
    block.data[block.indptr[7]] = bad
    with pytest.raises(SceneError, match=r"block \(momentum, mass\): row 7 has an entry that is not finite"):
        scene.validate()


def test_the_row_of_a_part_is_named_by_its_global_number():
    scene = full_scene()
    part = scene.restrict({f: (n // 2 // 2 * 2, n) for f, n in scene.sizes.items()})
    block = part.blocks["momentum", "momentum"]
    block.data[block.indptr[3]] = np.nan
    with pytest.raises(SceneError, match="row 7 has"):
        part.validate()


@pytest.mark.parametrize("bad", BAD, ids=str)
def test_material_must_be_finite(bad):
    for name, message in (("porosity", "porosity has an entry"), ("fluid_density", "fluid_density is not finite")):
        scene = full_scene()
        value = np.asarray(getattr(scene.material, name), dtype=float).copy()
        value.flat[0] = bad
        with pytest.raises(SceneError, match=message):
            replace(scene, material=replace(scene.material, **{name: value})).validate()


@pytest.mark.parametrize("step", [0.0, -1.0, np.nan, np.inf], ids=str)
def test_time_step_must_be_positive(step):
    scene = full_scene()
    with pytest.raises(SceneError, match="time_step must be positive"):
        replace(scene, material=replace(scene.material, time_step=step)).validate()


def changed_block(**new) -> Scene:
    scene = full_scene()
    scene.blocks["mass", "momentum"] = scene.blocks["mass", "momentum"]._replace(**new)
    return scene


def with_block(rc: tuple[str, str]) -> Scene:
    scene = full_scene()
    scene.blocks[rc] = scene.blocks["mass", "mass"]
    return scene


PLAIN = full_scene()
BLOCK = PLAIN.blocks["mass", "momentum"]


def swapped(values: np.ndarray, i: int, j: int) -> np.ndarray:
    new = values.copy()
    new[[i, j]] = new[[j, i]]
    return new


def at(values: np.ndarray, i: int, value: float) -> np.ndarray:
    new = values.copy()
    new[i] = value
    return new


INVALID = {
    "dimension": (lambda: replace(PLAIN, dimension=1), "dimension: expected 2 or 3, found 1"),
    "no_field": (lambda: Scene(dimension=2, sizes={}, blocks={}, rhs={}), "the scene has no field"),
    "unknown_field": (
        lambda: Scene(dimension=2, sizes={"heat": 2}, blocks={}, rhs={}),
        "unknown field 'heat'; fields are contact, intf_force, momentum, intf_flow, intf_fourier, ",
    ),
    "no_rhs": (lambda: replace(PLAIN, rhs={}), "contact: rhs is missing"),
    "rhs_length": (
        lambda: replace(PLAIN, rhs={**PLAIN.rhs, "mass": np.ones(5)}),
        r"mass: rhs has shape \(5,\), expected \(6,\)",
    ),
    "reference_length": (
        lambda: replace(PLAIN, reference={"contact": np.ones(5)}),
        r"contact: reference has shape \(5,\), expected \(4,\)",
    ),
    "centers_of_two_coordinates": (
        lambda: replace(PLAIN, cell_centers={"momentum": np.ones((5, 2))}),
        r"momentum: cell_centers has shape \(5, 2\), expected \(5, 3\)",
    ),
    "volumes_per_unknown": (
        lambda: replace(PLAIN, cell_volumes={"momentum": np.ones(10)}),
        r"momentum: cell_volumes has shape \(10,\), expected \(5,\)",
    ),
    "misspelt_reference": (lambda: replace(PLAIN, reference={"mas": np.ones(6)}), "reference: .* no field 'mas'"),
    "misspelt_centers": (lambda: replace(PLAIN, cell_centers={"mas": np.ones((6, 3))}), "cell_centers: .*'mas'"),
    "block_row": (lambda: with_block(("heat", "mass")), r"block \(heat, mass\): the scene has no field 'heat'"),
    "block_column": (lambda: with_block(("mass", "heat")), r"block \(mass, heat\): the scene has no field 'heat'"),
    "block_of_other_height": (
        lambda: with_block(("intf_flow", "contact")),
        r"block \(intf_flow, contact\): indptr has 7 entries, expected 4",
    ),
    "indptr_starts_late": (lambda: changed_block(indptr=at(BLOCK.indptr, 0, 1)), "indptr must start at 0"),
    "indptr_decreases": (
        lambda: changed_block(indptr=swapped(BLOCK.indptr, 2, 4)),
        "indptr must start at 0 and not decrease",
    ),
    "unsigned_indptr_decreases": (
        lambda: changed_block(indptr=swapped(BLOCK.indptr, 2, 4).astype(np.uint64)),
        "indptr must start at 0 and not decrease",
    ),
    "too_few_indices": (lambda: changed_block(indices=BLOCK.indices[:-1]), "indptr ends at .* but there are"),
    "too_few_values": (lambda: changed_block(data=BLOCK.data[:-1]), "indptr ends at .* but there are"),
    "too_many_values": (lambda: changed_block(data=np.append(BLOCK.data, 1.0)), "indptr ends at .* but there are"),
    "unsorted_columns": (lambda: changed_block(indices=swapped(BLOCK.indices, 0, 1)), "must increase"),
    "unsorted_unsigned_columns": (
        lambda: changed_block(indices=swapped(BLOCK.indices, 0, 1).astype(np.uint32)),
        "must increase",
    ),
    "duplicate_columns": (lambda: changed_block(indices=at(BLOCK.indices, 1, BLOCK.indices[0])), "without duplicates"),
    "column_too_large": (lambda: changed_block(indices=at(BLOCK.indices, -1, 10)), "a column number is outside 0:10"),
    "column_negative": (lambda: changed_block(indices=at(BLOCK.indices, 0, -1)), "a column number is outside 0:10"),
    "fractional_columns": (lambda: changed_block(indices=BLOCK.indices + 0.5), "indptr and indices must be integers"),
    "state_three": (
        lambda: replace(PLAIN, contact_state=np.array([0, 3])),
        r"contact_state: expected 0 \(sticking\), 1 \(sliding\) or 2 \(open\)",
    ),
    "state_negative": (lambda: replace(PLAIN, contact_state=np.array([-1, 0])), "contact_state: expected 0"),
    "states_per_unknown": (lambda: replace(PLAIN, contact_state=np.zeros(4)), r"contact_state has shape \(4,\)"),
    "cell_dimension_too_large": (
        lambda: replace(PLAIN, cell_dimension=np.full(6, 3)),
        "cell_dimension must lie between 0 and 2",
    ),
    "cell_dimension_negative": (
        lambda: replace(PLAIN, cell_dimension=np.full(6, -1)),
        "cell_dimension must lie between 0 and 2",
    ),
    "cell_dimension_length": (lambda: replace(PLAIN, cell_dimension=np.zeros(5)), r"cell_dimension has shape \(5,\)"),
    "material_length": (
        lambda: replace(PLAIN, material=replace(PLAIN.material, porosity=np.ones(7))),
        r"material: porosity has shape \(7,\), expected \(6,\)",
    ),
}


@pytest.mark.parametrize(("make", "message"), INVALID.values(), ids=INVALID)
def test_parts_that_do_not_fit_together_are_refused(make, message):
    with pytest.raises(SceneError, match=message):
        make().validate()


def test_falling_columns_are_allowed_where_a_row_ends():
    """Also where rows are empty: first, last, and several in a row."""
    pattern = np.zeros((6, 6))
    pattern[1, [4, 5]] = pattern[4, [0, 5]] = 1
    Scene(dimension=2, sizes={"mass": 6}, blocks={("mass", "mass"): csr(pattern)}, rhs={"mass": np.ones(6)}).validate()


def parts(scene: Scene, ranks: int, rng: np.random.Generator) -> list[Scene]:
    """A scene cut at random cells, some ranks without rows."""
    cuts = {}
    for f, size in scene.sizes.items():
        bs = scene.block_size(f)
        cuts[f] = bs * np.concatenate([[0], np.sort(rng.integers(0, size // bs + 1, ranks - 1)), [size // bs]])
    return [scene.restrict({f: (c[k], c[k + 1]) for f, c in cuts.items()}) for k in range(ranks)]


def joined(cut: list[Scene]) -> Scene:
    """The scene whose parts these are."""
    first = cut[0]

    def join(what: str) -> dict:
        return {f: np.concatenate([getattr(p, what)[f] for p in cut]) for f in getattr(first, what)}

    blocks = {}
    for rc in first.blocks:
        ends = np.cumsum([0, *(p.blocks[rc].indptr[-1] for p in cut)])
        indptr = [p.blocks[rc].indptr[1:] + end for p, end in zip(cut, ends, strict=False)]
        indices, data = (np.concatenate([p.blocks[rc][k] for p in cut]) for k in (1, 2))
        blocks[rc] = CSR(np.concatenate([[0], *indptr]), indices, data)
    return replace(
        first,
        blocks=blocks,
        rhs=join("rhs"),
        reference=join("reference"),
        cell_centers=join("cell_centers"),
        cell_volumes=join("cell_volumes"),
        cell_dimension=np.concatenate([p.cell_dimension for p in cut]),
        contact_state=np.concatenate([p.contact_state for p in cut]),
        material=replace(
            first.material,
            **{
                name: np.concatenate([getattr(p.material, name) for p in cut])
                for name, value in first.material.cell_data().items()
                if np.ndim(value)
            },
        ),
        rows=None,
    )


@pytest.mark.parametrize("dimension", [2, 3])
@given(seed=st.integers(0, 2**32 - 1), ranks=st.integers(1, 5))
def test_parts_put_together_give_the_whole(dimension, seed, ranks):
    rng = np.random.default_rng(seed)
    scene = full_scene(dimension)
    cut = parts(scene, ranks, rng)
    for part in cut:
        part.validate()
    assert [part.row_range("mass")[0] for part in cut[1:]] == [part.row_range("mass")[1] for part in cut[:-1]]
    assert_same(joined(cut), scene)


BAD_RANGES = {
    "through_a_cell": ({"momentum": (0, 3)}, "momentum: .*0:3, is not a multiple of block size 2"),
    "beyond_the_end": ({"momentum": (0, 12)}, r"momentum: row range \(0, 12\) is not inside 0:10"),
    "backwards": ({"momentum": (4, 2)}, r"momentum: row range \(4, 2\) is not inside"),
    "negative": ({"momentum": (-2, 2)}, r"momentum: row range \(-2, 2\) is not inside"),
    "missing": ({"momentum": None}, "momentum: row range None"),
}


@pytest.mark.parametrize(("wrong", "message"), BAD_RANGES.values(), ids=BAD_RANGES)
def test_impossible_row_ranges_are_refused(wrong, message):
    scene = full_scene()
    rows = {f: wrong.get(f, (0, n)) for f, n in scene.sizes.items()}
    with pytest.raises(LayoutError, match=message):
        scene.restrict({f: r for f, r in rows.items() if r is not None})


def test_a_part_cannot_be_cut_again():
    scene = full_scene()
    rows = {f: (0, n) for f, n in scene.sizes.items()}
    with pytest.raises(LayoutError, match="already the part of one rank"):
        scene.restrict(rows).restrict(rows)


def test_contact_states_are_counted_by_name():
    assert contact_state_counts([2, 0, 0, 2, 2]) == {"sticking": 2, "sliding": 0, "open": 3}


def test_importing_the_package_initialises_nothing():
    program = """
import sys, petsc_fs
assert petsc_fs.__version__
assert not {"h5py", "numpy", "petsc4py", "petsc4py.PETSc", "mpi4py.MPI", "porepy"} & set(sys.modules)
from petsc_fs import Scene, hdf5, options, sequence
assert not {"petsc4py.PETSc", "porepy", "scipy"} & set(sys.modules)
import petsc_fs.io.hdf5, petsc_fs.io.sequence, petsc_fs.scene, petsc_fs.solver
assert (hdf5, sequence) == (petsc_fs.io.hdf5, petsc_fs.io.sequence)
assert (Scene, petsc_fs.Solver) == (petsc_fs.scene.Scene, petsc_fs.solver.Solver)
assert not hasattr(petsc_fs, "nothing")
"""
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)
