"""Directions and points of the ball: exact norms, even spread, the right distribution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rtcd_jax.numerics.sampling import ball, directions, quasi_uniform


def draws(draw, keys=3):
    """The draws of several keys by one compiled program, as numpy arrays."""
    return np.asarray(jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), keys)))


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_directions_have_unit_length(n):
    aims = draws(lambda key: directions(key, 48, n, jnp.float64))
    np.testing.assert_allclose(np.sum(aims**2, 1), 1, rtol=1e-14)


def test_directions_of_the_plane_are_evenly_spaced():
    (turned,) = draws(lambda key: directions(key, 12, 2, jnp.float64), 1)
    gaps = np.sum(turned * np.roll(turned, 1, axis=1), 0)
    np.testing.assert_allclose(gaps, np.cos(2 * np.pi / 12), rtol=1e-12)


@pytest.mark.parametrize("n", [3, 4, 6])
def test_directions_cover_every_side_and_balance_better_than_random_ones(n):
    """Every axis has one within 60 degrees; the second moment is nearer to the sphere's, 1/n of the identity."""

    def imbalance(aims):
        return np.mean(np.max(np.abs(aims @ np.swapaxes(aims, 1, 2) / aims.shape[2] - np.eye(n) / n), (1, 2)))

    aims = draws(lambda key: directions(key, 512, n, jnp.float64), 20)
    assert np.all(np.max(aims, 2) > 0.5)
    assert np.all(np.min(aims, 2) < -0.5)
    independent = np.random.default_rng(0).normal(size=aims.shape)
    assert imbalance(aims) < 0.75 * imbalance(independent / np.linalg.norm(independent, axis=1, keepdims=True))


@pytest.mark.parametrize("count", [3, 8])
def test_both_directions_of_the_line(count):
    signs = draws(lambda key: directions(key, count, 1, jnp.float64), 200)
    assert np.all(np.min(signs, (1, 2)) == -1)
    assert np.all(np.max(signs, (1, 2)) == 1)


@pytest.mark.parametrize("dimensions", [1, 2, 3, 4])
def test_quasi_random_points_fill_the_cube_more_evenly_than_random_ones(dimensions):
    """Their discrepancy is at most half that of independent points, whatever the shift."""
    random = stats.qmc.discrepancy(np.random.default_rng(0).random((256, dimensions)))
    for points in draws(lambda key: quasi_uniform(key, 256, dimensions, jnp.float64)):
        assert np.all((points >= 0) & (points < 1))
        assert stats.qmc.discrepancy(points.T) < random / 2


def test_the_generator_of_one_dimension_is_the_golden_ratio():
    """A Fibonacci number of points on the circle leaves gaps of two lengths alone, in the golden ratio."""
    ((points,),) = np.sort(draws(lambda key: quasi_uniform(key, 89, 1, jnp.float64), 1))
    gaps = np.diff(points, append=points[0] + 1)
    short, long = np.unique(np.round(gaps, 12))
    assert long / short == pytest.approx((1 + np.sqrt(5)) / 2, abs=1e-9)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_points_of_the_ball_are_uniform(n):
    """|y|^n and, from n = 2 on, the angle in the first plane are uniform: Kolmogorov and Smirnov at 1 in 10,000."""
    (points,) = draws(lambda key: ball(key, (5000,), n, jnp.float64), 1)
    radii = np.linalg.norm(points, axis=0)
    assert np.all(radii <= 1)
    assert stats.kstest(radii**n, "uniform").pvalue > 1e-4
    if n > 1:
        turns = np.arctan2(points[1], points[0]) / (2 * np.pi) % 1
        assert stats.kstest(turns, "uniform").pvalue > 1e-4


DRAWS = [
    pytest.param(lambda key, dtype: quasi_uniform(key, 5, 3, dtype), (3, 5), id="quasi_uniform"),
    pytest.param(lambda key, dtype: directions(key, 5, 3, dtype), (3, 5), id="directions"),
    pytest.param(lambda key, dtype: directions(key, 5, 2, dtype), (2, 5), id="directions of the plane"),
    pytest.param(lambda key, dtype: ball(key, (4, 5), 3, dtype), (3, 4, 5), id="ball"),
]


@pytest.mark.parametrize(("draw", "shape"), DRAWS)
def test_every_key_draws_other_points(draw, shape):
    first, other = draws(lambda key: draw(key, jnp.float64), 2)
    assert first.shape == shape
    assert np.all(first != other)


@pytest.mark.parametrize(("draw", "shape"), DRAWS)
def test_single_precision_stays_single(draw, shape):
    drawn = jax.eval_shape(lambda key: draw(key, jnp.float32), jax.random.key(0))
    assert drawn == jax.ShapeDtypeStruct(shape, jnp.float32)
