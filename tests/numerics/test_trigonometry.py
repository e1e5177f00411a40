"""Sine and cosine against the C library's in extended precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics import trigonometry

PAIRS = [
    pytest.param(trigonometry.sin, np.sin, id="sin"),
    pytest.param(trigonometry.cos, np.cos, id="cos"),
]


def angles(largest):
    """Random angles, and the floating-point numbers nearest to multiples of a quarter turn, where reduction is hard."""
    random = np.random.default_rng(0)
    quarters = np.unique(np.round(random.uniform(-largest, largest, 20_000) / (np.pi / 2))) * (np.pi / 2)
    return np.concatenate([random.uniform(-largest, largest, 50_000), quarters])


@pytest.mark.parametrize(("ours", "exact"), PAIRS)
@pytest.mark.parametrize("largest", [4.0, 1e3, 1e5])
def test_error_is_below_two_units_in_the_last_place_of_one(ours, exact, largest):
    x = angles(largest)
    error = np.asarray(jax.jit(ours)(x)) - exact(x.astype(np.longdouble))
    assert np.max(np.abs(error)) < 2 * np.finfo(np.float64).eps


@pytest.mark.parametrize(("ours", "exact"), PAIRS)
def test_single_precision_stays_single_and_as_accurate_up_to_a_thousand(ours, exact):
    x = angles(1e3).astype(np.float32)
    result = jax.jit(ours)(x)
    assert result.dtype == jnp.float32
    assert np.max(np.abs(np.asarray(result) - exact(x.astype(np.float64)))) < 2 * np.finfo(np.float32).eps


def test_sine_is_odd_to_the_last_bit_and_keeps_small_angles():
    x = angles(1e5)
    np.testing.assert_array_equal(trigonometry.sin(-x), -trigonometry.sin(x))
    tiny = np.array([0.0, 1e-300, 1e-9, -1e-9])
    np.testing.assert_array_equal(trigonometry.sin(tiny), tiny)


@pytest.mark.parametrize("ours", [trigonometry.sin, trigonometry.cos])
def test_what_is_not_finite_gives_nan(ours):
    assert np.all(np.isnan(ours(jnp.array([jnp.nan, jnp.inf, -jnp.inf]))))


@pytest.mark.parametrize("differentiate", [jax.grad, jax.jacrev, jax.jacfwd])
def test_derivatives_are_the_functions_themselves(differentiate):
    """Not those of the polynomial: four derivatives return the sine to the last bit."""
    x = angles(10.0)[::500]
    derivative = jax.vmap(differentiate(trigonometry.sin))
    np.testing.assert_array_equal(derivative(x), trigonometry.cos(x))
    fourth = trigonometry.sin
    for _ in range(4):
        fourth = differentiate(fourth)
    np.testing.assert_array_equal(jax.vmap(fourth)(x), trigonometry.sin(x))


@pytest.mark.parametrize("ours", [trigonometry.sin, trigonometry.cos])
def test_no_routine_of_the_library_is_called(ours):
    def operations(f):
        return jax.jit(f).lower(jnp.ones(8)).as_text()

    assert "cosine" in operations(jnp.cos), "the test no longer sees what it looks for"
    assert "sine" in operations(jnp.sin)
    assert "sine" not in operations(jax.grad(lambda x: jnp.sum(ours(x))))
