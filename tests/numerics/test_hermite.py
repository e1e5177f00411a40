"""The cubic that is fixed by both ends' values and rates."""

import numpy as np
import pytest

from rtcd_jax.numerics.hermite import cubic_hermite, cubic_hermite_rate


@pytest.mark.parametrize("duration", [0.05, 1.0, 3.0])
def test_every_cubic_is_reproduced(duration):
    cubic = np.polynomial.Polynomial([0.3, -1.0, 2.0, 0.7])
    rate = cubic.deriv()
    shares = np.linspace(0, 1, 9)
    ends = cubic(0), rate(0), cubic(duration), rate(duration)
    np.testing.assert_allclose(cubic_hermite(shares, duration, *ends), cubic(shares * duration), rtol=1e-13, atol=1e-13)
    rates = cubic_hermite_rate(shares, duration, *ends)
    np.testing.assert_allclose(rates, rate(shares * duration), rtol=1e-12, atol=1e-12)


def test_ends_are_met_exactly_and_rates_by_differences():
    start, start_rate, end, end_rate = 0.1, 3.0, -0.7, -2.0
    duration, step = 0.4, 1e-6

    def curve(s):
        return cubic_hermite(s, duration, start, start_rate, end, end_rate)

    assert curve(0.0) == start
    assert curve(1.0) == end
    assert (curve(step) - start) / (step * duration) == pytest.approx(start_rate, rel=1e-5)
    assert (end - curve(1 - step)) / (step * duration) == pytest.approx(end_rate, rel=1e-5)


def test_a_smooth_curve_is_met_to_fourth_order():
    """The error of the interpolant is at most duration^4 / 384 max |x''''|."""
    shares = np.linspace(0, 1, 101)
    for duration in (0.5, 0.25):
        curve = cubic_hermite(shares, duration, np.sin(1.0), np.cos(1.0), np.sin(1 + duration), np.cos(1 + duration))
        error = np.max(np.abs(curve - np.sin(1 + shares * duration)))
        assert 0.5 < error / (duration**4 / 384) <= 1
