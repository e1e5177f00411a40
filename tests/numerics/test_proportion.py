"""The exact bounds on a probability after independent trials."""

import numpy as np
import pytest
import scipy.stats

from rtcd_jax.numerics.proportion import clopper_pearson, failure_bound


@pytest.mark.parametrize(("failures", "trials"), [(0, 100), (3, 1000), (100, 100)])
def test_clopper_pearson_bounds_are_where_the_binomial_tails_are(failures, trials):
    lower, upper = clopper_pearson(failures, trials, 0.99)
    if failures > 0:
        assert scipy.stats.binom.sf(failures - 1, trials, lower) == pytest.approx(0.01)
    else:
        assert lower == 0
    if failures < trials:
        assert scipy.stats.binom.cdf(failures, trials, upper) == pytest.approx(0.01)
    else:
        assert upper == 1


@pytest.mark.parametrize("doubt", [0.3, 0.01, 2e-4])
def test_without_failures_the_bound_is_clopper_and_pearsons(doubt):
    for trials in (1, 7, 64, 2000):
        exact = scipy.stats.binomtest(0, trials, alternative="less").proportion_ci(1 - doubt, method="exact")
        assert failure_bound(trials, doubt) == pytest.approx(exact.high, rel=1e-10)
        assert failure_bound(trials, doubt) == pytest.approx(clopper_pearson(0, trials, 1 - doubt)[1], rel=1e-10)


def test_at_the_bound_no_failure_is_just_as_likely_as_the_doubt():
    for trials in (1, 10, 1000, 10**9):
        assert trials * np.log1p(-failure_bound(trials, 0.01)) == pytest.approx(np.log(0.01), rel=1e-9)


def test_without_trials_nothing_is_excluded():
    assert failure_bound(0, 0.01) == 1


def test_more_trials_and_more_doubt_lower_it():
    assert np.all(np.diff([failure_bound(trials, 0.01) for trials in range(100)]) < 0)
    assert np.all(np.diff([failure_bound(64, doubt) for doubt in np.linspace(0.01, 0.99, 50)]) < 0)
