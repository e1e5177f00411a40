"""The exact bound on a failure probability after trials without a failure."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rtcd_jax.numerics.proportion import failure_bound


@pytest.mark.parametrize("doubt", [0.3, 0.01, 2e-4])
def test_the_bound_is_clopper_and_pearsons(doubt):
    for trials in (1, 7, 64, 2000):
        interval = stats.binomtest(0, trials, alternative="less").proportion_ci(1 - doubt, method="exact")
        assert float(failure_bound(trials, doubt)) == pytest.approx(interval.high, rel=1e-10)


def test_at_the_bound_no_failure_is_just_as_likely_as_the_doubt():
    trials = np.array([1, 10, 1000, 10**9])
    np.testing.assert_allclose(trials * np.log1p(-failure_bound(trials, 0.01)), np.log(0.01), rtol=1e-9)


def test_without_trials_nothing_is_excluded():
    np.testing.assert_array_equal(failure_bound(jnp.array([0, 0]), 0.01), 1)
    assert failure_bound(jnp.float32(0), jnp.float32(0.01)) == 1


def test_more_trials_and_more_doubt_lower_it():
    assert np.all(np.diff(failure_bound(jnp.arange(100), 0.01)) < 0)
    assert np.all(np.diff(failure_bound(64, jnp.linspace(0.01, 0.99, 50))) < 0)
