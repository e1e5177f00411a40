"""Climbing to the largest |f|^2 on the unit sphere, against eigenvalues, the secular equation and dense searches."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from rtcd_jax.numerics.sphere import climb


def _unit(n, *batch, seed=0):
    y = np.random.default_rng(seed).normal(size=(n, *batch))
    return jnp.asarray(y / np.linalg.norm(y, axis=0))


def _affine(j, c):
    """y [n ...] -> J y + c [o ...]."""
    return lambda y: jnp.einsum("ij,j...->i...", jnp.asarray(j), y) + jnp.asarray(c).reshape(-1, *(1,) * (y.ndim - 1))


def _linear(j):
    return _affine(j, np.zeros(len(j)))


def _climbed(f, y, steps):
    climbed = jax.jit(partial(climb, f), static_argnums=1)(y, steps)
    np.testing.assert_allclose(np.linalg.norm(climbed, axis=0), 1, rtol=1e-14)
    return climbed


def _height(f, y):
    return np.sum(np.asarray(f(y)) ** 2, 0)


def _with_singular_values(values, seed=0):
    """A square matrix with these and random singular vectors; the right ones are the columns of the second."""
    random = np.random.default_rng(seed)
    left, right = (np.linalg.qr(random.normal(size=(len(values), len(values))))[0] for _ in range(2))
    return left @ np.diag(values) @ right.T, right


SPECTRA = {
    "apart": [3.0, 2.0, 1.0, 0.5],
    "two near the top": [1.0, 0.9999, 0.5, 0.1],
    "all equal": [2.0, 2.0, 2.0, 2.0],
    "one of many orders": [1e3, 1.0, 1e-3, 1e-6],
    "singular": [1.0, 0.0, 0.0, 0.0],
    "plane": [1.0, 0.7],
    "line": [0.3],
}


@pytest.mark.thorough
@pytest.mark.parametrize("spectrum", SPECTRA)
def test_the_largest_value_of_a_quadratic_is_the_largest_eigenvalue(spectrum):
    """From everywhere: a linear map has no other maximum. Ten steps, as eigenvalues may be near each other."""
    j, _ = _with_singular_values(SPECTRA[spectrum])
    y = _climbed(_linear(j), _unit(len(j), 200), 10)
    largest = np.linalg.eigh(j.T @ j)[0][-1]
    np.testing.assert_allclose(_height(_linear(j), y), largest, rtol=3e-4)


def test_three_steps_reach_the_largest_eigenvalue_where_it_stands_apart():
    """A tenth of a thousandth below at most, whereas the starts are half a decade below."""
    j, _ = _with_singular_values(SPECTRA["apart"])
    start = _unit(4, 200)
    heights = _height(_linear(j), _climbed(_linear(j), start, 3))
    assert np.median(_height(_linear(j), start)) < 0.5 * 9
    assert heights.min() > (1 - 1e-4) * 9
    assert heights.max() < (1 + 1e-14) * 9


def _largest_of_affine(j, c):
    """max |J y + c|^2 on the sphere by the secular equation |(s I - H)^-1 p| = 1 right of the largest eigenvalue."""
    eigenvalues, vectors = np.linalg.eigh(j.T @ j)
    p = vectors.T @ (j.T @ c)

    def secular(s):
        return np.sum((p / (s - eigenvalues)) ** 2) - 1

    low = eigenvalues[-1] + 1e-3 * abs(p[-1])
    s = scipy.optimize.brentq(secular, low, eigenvalues[-1] + 2 * np.linalg.norm(p), xtol=1e-15, rtol=1e-14)
    return np.sum((j @ (vectors @ (p / (s - eigenvalues))) + c) ** 2)


@pytest.mark.parametrize("offset", [0.01, 0.3, 5.0])
@pytest.mark.parametrize("n", [2, 4])
def test_the_largest_value_of_an_affine_map_solves_the_secular_equation(n, offset):
    """From all starts but those on the far side of a small offset, where there is a maximum of its own."""
    random = np.random.default_rng(n)
    j, c = random.normal(size=(n + 1, n)), offset * random.normal(size=n + 1)
    f = _affine(j, c)
    largest = _largest_of_affine(j, c)
    dense = _height(f, _unit(n, 300_000, seed=1)).max()
    assert (1 - 1e-2) * largest < dense < (1 + 1e-10) * largest
    heights = _height(f, _climbed(f, _unit(n, 200), 10))
    assert heights.max() < (1 + 1e-10) * largest
    reached = heights > (1 - 1e-5) * largest
    assert reached.mean() > 0.4
    # The far side's maximum: |J y + c| is less there by about twice the offset.
    assert np.all(heights > (1 - 1e-5) * (np.sqrt(largest) - 2 * np.linalg.norm(c)) ** 2)
    if offset == 5.0:
        assert reached.all()


def test_the_hard_case_is_climbed_too():
    """p orthogonal to the top eigenvector and short: the secular equation has no root right of it, and the maximum
    takes from that vector what is missing to a unit length, on either side."""
    values = np.array([2.0, 1.0, 0.5, 0.2])
    j, right = _with_singular_values(values)
    share = np.array([0.0, 0.3, 0.2, -0.1])
    p = right @ ((values[0] ** 2 - values**2) * share)
    c = np.linalg.solve(j.T, p)
    f = _affine(j, c)
    best = right @ (share + np.array([np.sqrt(1 - share @ share), 0, 0, 0]))
    largest = _height(f, jnp.asarray(best))
    assert largest > _height(f, _unit(4, 300_000)).max()
    heights = _height(f, _climbed(f, _unit(4, 200), 10))
    np.testing.assert_allclose(heights, largest, rtol=1e-4)


def _clipped(y):
    """A plant whose motor saturates: V of its end is no quadratic, and steep where the motor is at its limit."""
    y = 3 * y
    u = jnp.clip(-4 * y[0] - 2 * y[1], -1, 1)
    return jnp.stack([y[0] + 0.5 * y[1] + 0.2 * u, 0.7 * y[1] + y[0] + 0.9 * u, 0.5 * y[2], 0.4 * y[3] + 0.1 * u])


@pytest.mark.thorough
@pytest.mark.parametrize("f", [_clipped, lambda y: jnp.tanh(3 * y) + 0.2 * y, lambda y: jnp.sin(4 * y)])
def test_no_step_goes_down(f):
    y = _unit(4, 300)
    heights = [_height(f, y)]
    for _ in range(6):
        y = _climbed(f, y, 1)
        heights.append(_height(f, y))
    assert np.all(np.diff(heights, axis=0) >= 0)
    assert np.mean(heights[-1] > heights[0]) > 0.9


def test_where_the_map_saturates_the_plain_model_overshoots_and_the_climb_does_not():
    """|f|^2 = |clip(y, +-a)|^2 + |y / 10|^2 with a = 0.45: largest where every component is at its limit. The model
    at a point with one free component makes that one 1, and loses all others."""

    def f(y):
        return jnp.concatenate([jnp.clip(y, -0.45, 0.45), 0.1 * y])

    start = _unit(4, 300)
    largest = 4 * 0.45**2 + 0.01
    free = np.abs(start) < 0.45
    plain = np.where(np.cumsum(free, 0) * free == 1, np.sign(start), 0)
    plain = jnp.asarray(plain[:, free.any(0)])
    assert np.all(_height(f, plain) < 0.3 * largest)
    heights = _height(f, _climbed(f, start, 10))
    assert heights.max() <= (1 + 1e-14) * largest
    assert np.median(heights) > 0.9 * largest
    assert np.all(heights > 0.7 * largest)


@pytest.mark.thorough
def test_of_a_saturated_plant_the_best_of_a_few_climbers_is_that_of_a_dense_search():
    """Twelve are always enough; a random direction in twelve is 5 % below."""
    dense = _height(_clipped, _unit(4, 300_000, seed=1)).max()
    starts = _unit(4, 12, 100)
    heights = _height(_clipped, _climbed(_clipped, starts, 5)).max(0)
    assert np.all(heights > (1 - 1e-3) * dense)
    assert np.median(_height(_clipped, starts).max(0)) < 0.95 * dense


@pytest.mark.parametrize("bad", [jnp.nan, jnp.inf, -jnp.inf])
def test_values_that_are_not_finite_attract_nobody(bad):
    """Beyond a wall f is `bad`: climbers stay before it, and are as good as without it if they need not cross."""
    j, _ = _with_singular_values([2.0, 1.0, 0.5, 0.2])
    walled = lambda y: jnp.where(y[0] > 0.1, bad, _linear(j)(y))  # noqa: E731
    start = _unit(4, 300)
    before = np.asarray(start[0]) <= 0.1
    y = np.asarray(_climbed(walled, start, 6))
    assert np.all(y[0, before] <= 0.1)
    heights = _height(_linear(j), jnp.asarray(y))
    assert np.all(heights[before] >= _height(_linear(j), start)[before])
    np.testing.assert_allclose(heights[before].max(), 4, rtol=1e-4)
    # Who starts behind it stays a unit vector.
    assert np.all(np.isfinite(y))


def test_everywhere_not_finite_leaves_all_where_they_are():
    y = _unit(3, 20)
    np.testing.assert_array_equal(_climbed(lambda y: jnp.nan * y, y, 3), y)


@pytest.mark.thorough
def test_neighbors_do_not_matter_and_no_step_leaves_y():
    j, _ = _with_singular_values(SPECTRA["apart"])
    y = _unit(4, 5, 6)
    np.testing.assert_array_equal(_climbed(_linear(j), y, 0), y)
    together = _climbed(_linear(j), y, 3)
    alone = _climbed(_linear(j), y[:, 2, 3], 3)
    np.testing.assert_allclose(together[:, 2, 3], alone, rtol=1e-12, atol=1e-12)


@pytest.mark.thorough
def test_single_precision_stays_single_and_climbs_as_high():
    j, _ = _with_singular_values(SPECTRA["apart"])
    j = j.astype(np.float32)
    f = lambda y: jnp.einsum("ij,j...->i...", jnp.asarray(j), y)  # noqa: E731
    y = jax.jit(lambda y: climb(f, y, 5))(_unit(4, 100).astype(jnp.float32))
    assert y.dtype == jnp.float32
    np.testing.assert_allclose(np.linalg.norm(y, axis=0), 1, rtol=1e-6)
    np.testing.assert_allclose(_height(f, y), 9, rtol=1e-4)
