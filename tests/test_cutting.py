"""A matrix cut from memory is what it is without."""

import numpy as np
import pytest
from sample import csr, dense, full_scene

from petsc_fs.cutting import Cutter
from petsc_fs.errors import LayoutError, SceneError
from petsc_fs.scene import CSR, Scene


def scrambled(seed: int, density: float = 0.3) -> tuple[CSR, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """A random sparse matrix with unsorted columns, and rows and columns of fields that lie anywhere in it."""
    rng = np.random.default_rng(seed)
    sizes = full_scene().sizes
    n = sum(sizes.values())
    A = csr(rng.standard_normal((n, n)) * (np.random.default_rng(1).random((n, n)) < density))
    for a, b in zip(A.indptr[:-1], A.indptr[1:], strict=True):
        order = np.random.default_rng(2).permutation(b - a)
        A.indices[a:b], A.data[a:b] = A.indices[a:b][order], A.data[a:b][order]
    places = [np.random.default_rng(k).permutation(n) for k in (3, 4)]
    bounds = np.cumsum([0, *sizes.values()])
    rows, columns = ({f: p[bounds[k] : bounds[k + 1]] for k, f in enumerate(sizes)} for p in places)
    return A, rows, columns


def assert_same_blocks(a: Scene, b: Scene) -> None:
    assert set(a.blocks) == set(b.blocks)
    for rc, block in a.blocks.items():
        for mine, other in zip(block, b.blocks[rc], strict=True):
            np.testing.assert_array_equal(mine, other)


def test_cut_from_memory_is_the_same_cut():
    cutter = Cutter()
    for number, seed in enumerate((5, 6, 7)):
        A, rows, columns = scrambled(seed)
        rhs = np.zeros(A.indptr.size - 1)
        expected = Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2)
        found = Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2, cutter=cutter)
        assert cutter.hits == number * len(rows)
        assert_same_blocks(found, expected)


def test_patterns_are_shared_but_values_are_not():
    cutter = Cutter()
    A, rows, columns = scrambled(5)
    rhs = np.zeros(A.indptr.size - 1)
    first = Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    before = dense(first)
    A.data[:] = 0.5
    second = Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    assert second.blocks["momentum", "momentum"].indices is first.blocks["momentum", "momentum"].indices
    np.testing.assert_array_equal(dense(first), before)


def test_only_fields_whose_rows_changed_are_cut_anew():
    cutter = Cutter()
    A, rows, columns = scrambled(5)
    rhs = np.zeros(A.indptr.size - 1)
    Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    row = rows["mass"][0]
    start, stop = A.indptr[row : row + 2]
    keep = np.ones(A.data.size, dtype=bool)
    keep[start] = stop == start
    indptr = A.indptr - (np.arange(A.indptr.size) > row)
    B = CSR(indptr, A.indices[keep], A.data[keep])
    found = Scene.from_matrix(B, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    assert cutter.hits == len(rows) - 1
    assert_same_blocks(found, Scene.from_matrix(B, rhs, rows, columns=columns, dimension=2))


@pytest.mark.parametrize("which", ["rows", "columns"])
def test_other_rows_or_columns_are_no_mistake(which):
    cutter = Cutter()
    A, rows, columns = scrambled(5)
    rhs = np.zeros(A.indptr.size - 1)
    Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    changed = {"rows": rows, "columns": columns}
    changed[which] = {f: index[::-1] for f, index in changed[which].items()}
    found = Scene.from_matrix(A, rhs, changed["rows"], columns=changed["columns"], dimension=2, cutter=cutter)
    assert_same_blocks(found, Scene.from_matrix(A, rhs, changed["rows"], columns=changed["columns"], dimension=2))


def changing(seed: int) -> list[CSR]:
    """Matrices in which entries of some rows come and go; now and then all rows change, or none."""
    rng = np.random.default_rng(seed)
    n = sum(full_scene().sizes.values())
    pattern = rng.random((n, n)) < 0.2
    matrices = []
    for rate in (0.0, 0.002, 0.0, 0.02, 0.002, 1.0, 0.002, 0.3):
        pattern = pattern ^ (rng.random((n, n)) < rate)
        A = csr(pattern * rng.standard_normal((n, n)))
        for a, b in zip(A.indptr[:-1], A.indptr[1:], strict=True):
            order = np.random.default_rng(b - a).permutation(b - a)
            A.indices[a:b], A.data[a:b] = A.indices[a:b][order], A.data[a:b][order]
        matrices.append(A)
    return matrices


@pytest.mark.parametrize("seed", range(4))
def test_rows_that_come_and_go_are_cut_as_without_memory(seed):
    """Fields that lie in one piece, and fields that do not; scenes from earlier cuts stay as they are."""
    cutter = Cutter()
    _, scattered, columns = scrambled(5)
    bounds = np.cumsum([0, *full_scene().sizes.values()])
    rows = scattered if seed % 2 else {f: np.arange(bounds[k], bounds[k + 1]) for k, f in enumerate(scattered)}
    pairs = []
    for A in changing(seed):
        rhs = np.zeros(A.indptr.size - 1)
        found = Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2, cutter=cutter)
        pairs.append((found, Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2)))
    for found, expected in pairs:
        assert_same_blocks(found, expected)


def test_a_block_keeps_its_arrays_where_only_others_of_its_rows_change():
    cutter = Cutter()
    A, rows, columns = scrambled(5)
    rhs = np.zeros(A.indptr.size - 1)
    first = Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    row_of = np.repeat(np.arange(A.indptr.size - 1), np.diff(A.indptr))
    keep = ~(np.isin(row_of, rows["mass"][:2]) & np.isin(A.indices, columns["contact"]))
    assert not keep.all()
    B = CSR(np.concatenate([[0], np.cumsum(keep)])[A.indptr], A.indices[keep], A.data[keep])
    second = Scene.from_matrix(B, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    changed = {rc for rc, b in second.blocks.items() if b.indices is not first.blocks[rc].indices}
    assert changed == {("mass", "contact")}
    assert_same_blocks(second, Scene.from_matrix(B, rhs, rows, columns=columns, dimension=2))


def test_an_entry_given_twice_is_refused_and_does_no_harm():
    cutter = Cutter()
    A, rows, columns = scrambled(5)
    rhs = np.zeros(A.indptr.size - 1)
    column = A.indices[0]
    B = CSR(A.indptr + (np.arange(A.indptr.size) > 0), np.insert(A.indices, 0, column), np.insert(A.data, 0, 1.0))
    for _ in range(2):
        with pytest.raises(LayoutError, match="columns of a row must increase, without duplicates"):
            Scene.from_matrix(B, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    found = Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    assert_same_blocks(found, Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_from_memory_are_looked_at_as_any_others(value):
    cutter = Cutter()
    A, rows, columns = scrambled(5)
    rhs = np.zeros(A.indptr.size - 1)
    Scene.from_matrix(A, rhs, rows, columns=columns, dimension=2, cutter=cutter)
    data = A.data.copy()
    data[A.indptr[rows["momentum"][3]]] = value
    with pytest.raises(SceneError, match=r"block \(momentum, \w+\): row 3 has an entry that is not finite"):
        Scene.from_matrix(A._replace(data=data), rhs, rows, columns=columns, dimension=2, cutter=cutter)
    assert cutter.hits == len(rows)


def test_only_the_very_arrays_that_passed_are_taken_for_valid():
    scene = full_scene()
    valid = {rc: (b.indptr, b.indices) for rc, b in scene.blocks.items()}
    block = scene.blocks["mass", "mass"]
    falling = block.indices[::-1].copy()
    scene.blocks["mass", "mass"] = block._replace(indices=falling)
    for known in (None, {}, valid):
        with pytest.raises(LayoutError, match=r"block \(mass, mass\): columns of a row must increase"):
            scene.validate(known)
    scene.validate(valid | {("mass", "mass"): (block.indptr, falling)})
