"""A matrix cut from memory is what it is without."""

import numpy as np
import pytest
from sample import csr, dense, full_scene

from petsc_fs.cutting import Cutter
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
