"""Rows that changed are found, and rows put in their place stand where a whole new pattern has them."""

import numpy as np
import pytest
from sample import csr

from petsc_fs.splice import Splice, changed_rows

PATTERNS = [(seed, rate) for seed in range(5) for rate in (0.0, 0.02, 0.3, 1.0)]


def two_patterns(seed: int, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Dense patterns, some rows of them empty, of which about this share of the entries differ."""
    rng = np.random.default_rng(seed)
    first = rng.random((30, 12)) < rng.random((30, 1)) * (rng.random((30, 1)) < 0.8)
    return first, first ^ (rng.random(first.shape) < rate)


@pytest.mark.parametrize(("seed", "rate"), PATTERNS)
def test_changed_rows_are_those_that_differ(seed, rate):
    first, second = two_patterns(seed, rate)
    a, b = csr(first), csr(second)
    np.testing.assert_array_equal(changed_rows(*a[:2], *b[:2]), (first != second).any(axis=1))
    assert not changed_rows(*a[:2], *a[:2]).any()


def test_rows_with_the_same_columns_in_another_order_differ():
    indptr = np.array([0, 2, 4])
    assert changed_rows(indptr, np.array([0, 1, 3, 5]), indptr, np.array([0, 1, 5, 3])).tolist() == [False, True]


@pytest.mark.parametrize(("seed", "rate"), PATTERNS)
def test_spliced_rows_make_the_later_matrix(seed, rate):
    first, second = two_patterns(seed, rate)
    changed = (first != second).any(axis=1)
    numbers = np.arange(1.0, first.size + 1).reshape(first.shape)
    a, b, rows = csr(first * numbers), csr(second * numbers), csr((second * numbers)[changed])
    splice = Splice(a.indptr, changed, np.diff(rows.indptr))
    np.testing.assert_array_equal(splice.indptr, b.indptr)
    np.testing.assert_array_equal(splice.merge(a.indices, rows.indices), b.indices)
    np.testing.assert_array_equal(splice.merge(a.data, rows.data), b.data)
    np.testing.assert_array_equal(splice.replaced(a.data), csr((first * numbers)[changed]).data)
