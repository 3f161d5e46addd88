"""Forcing terms of inexact Newton on residuals chosen by hand."""

import pytest

from petsc_fs.errors import UsageError
from petsc_fs.porepy.forcing import EisenstatWalker, EisenstatWalkerParameters


def terms(residuals, tolerance=None, **parameters):
    forcing = EisenstatWalker(EisenstatWalkerParameters(**parameters))
    return [forcing.term(r, tolerance) for r in residuals]


def test_choice_2():
    """Of the second kind: gamma (r_k / r_{k-1})^alpha, after the first term."""
    found = terms([1.0, 0.1, 1e-3], rtol0=0.3, rtolmax=0.9, gamma=0.9, alpha=2.0)
    assert found == pytest.approx([0.3, 0.9 * 0.1**2, 0.9 * 0.01**2])


def test_safeguard_keeps_a_term_from_falling_at_once():
    found = terms([1.0, 0.01], rtol0=0.8, rtolmax=0.9, gamma=0.9, alpha=2.0)
    assert found == pytest.approx([0.8, 0.9 * 0.8**2])


def test_no_term_above_the_largest():
    found = terms([1.0, 50.0, 20.0, 0.0, 1.0], rtol0=0.3, rtolmax=0.5, alpha=2.0)
    assert found == [0.3, 0.5, 0.5**2, 0.0, 0.5]


def test_the_end_is_neither_missed_nor_overdone():
    """Where the expected residual is near the tolerance, the term is what leaves half of it."""
    tolerance = 1e-7
    for r in (1e-3, 1e-5, 2e-6, 1e-7, 1e-9):
        forcing = EisenstatWalker(EisenstatWalkerParameters(rtol0=0.01, rtolmax=0.5))
        eta = forcing.term(r, tolerance)
        assert eta == pytest.approx(0.01 if 0.01 * r >= 10 * tolerance else min(0.5, 0.5 * tolerance / r))
        assert eta * r >= 0.5 * tolerance * 0.999 or eta == 0.5


def test_a_new_time_step_starts_anew():
    forcing = EisenstatWalker(EisenstatWalkerParameters(rtol0=0.3, rtolmax=0.5))
    forcing.term(1.0)
    forcing.restart()
    assert forcing.term(1e-6) == 0.3


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"gamma": 0.0}, "gamma must be positive, found 0.0"),
        ({"rtolmax": 1.0}, "rtolmax < 1"),
        ({"alpha": 3.0}, "alpha <= 2"),
    ],
)
def test_impossible_parameters(parameters, message):
    with pytest.raises(UsageError, match=message):
        EisenstatWalkerParameters(**parameters)
