"""The Runge-Kutta step against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics.integrate import STABLE, join, rk4, rk4_step, split
from rtcd_jax.numerics.loops import compiled_for


def test_a_step_of_a_linear_system_is_the_exponentials_series_to_fourth_order():
    a = np.array([[0.3, -1.0], [2.0, 0.1]])
    x, u, dt = np.array([1.0, -2.0]), np.array([0.5, 0.7]), 0.3

    def f(x, u):
        return a @ x + u

    # Of x' = A x + u: x(dt) = x + sum_k dt^k/k! A^(k-1) (A x + u).
    series, term = x.copy(), f(x, u)
    for k in range(1, 5):
        series += dt**k / np.prod(np.arange(1.0, k + 1)) * term
        term = a @ term
    np.testing.assert_allclose(rk4_step(f, x, u, dt), series, rtol=1e-14)


def test_the_error_falls_with_the_fourth_power_of_the_step():
    """x' = u x^2 from 1 ends at 1 / (1 - u t)."""
    errors = [float(rk4(lambda x, u: u * x**2, 1.0, 0.5, 1.0, steps)) - 2.0 for steps in (8, 16, 32)]
    orders = np.log2(np.abs(errors[:-1]) / np.abs(errors[1:]))
    np.testing.assert_allclose(orders, 4, atol=0.2)


def test_backwards_undoes_forwards():
    x = np.array([0.3, 0.2])

    def f(x, u):
        return jnp.stack([x[1], u - jnp.sin(x[0])])

    there = rk4(f, x, 0.1, 0.5, 50)
    np.testing.assert_allclose(rk4(f, there, 0.1, -0.5, 50), x, atol=1e-10)


def test_trailing_axes_are_so_many_trajectories():
    durations = np.array([0.1, 0.2, 0.3])
    x = np.random.default_rng(0).normal(size=(2, 4, 3))

    def f(x, u):
        return jnp.stack([x[1], u - x[0] ** 3])

    together = rk4(f, x, 0.1, durations, 3)
    for k, p in np.ndindex(4, 3):
        np.testing.assert_allclose(together[:, k, p], rk4(f, x[:, k, p], 0.1, durations[p], 3), rtol=1e-14)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_is_kept(dtype):
    assert rk4(lambda x, u: x + u, jnp.ones(2, dtype), jnp.ones(2, dtype), 0.1, 3).dtype == dtype


@pytest.mark.parametrize("platform", ["cpu", "cuda"])
def test_components_are_joined_as_they_were_split(platform):
    x = np.arange(24.0).reshape(3, 2, 4)
    with compiled_for(platform):
        joined = jax.jit(lambda x: join(split(x)))(x)
    np.testing.assert_array_equal(joined, x)


def test_steps_are_stable_on_the_left_half_disk_and_not_on_one_much_larger():
    """x' = lambda x, x(dt) = x (1 + z + z^2/2 + z^3/6 + z^4/24) with z = lambda dt."""

    def growth(radius, angles):
        z = radius * np.exp(1j * angles)
        real, imaginary = jnp.asarray(z.real), jnp.asarray(z.imag)
        turn = lambda x, _: jnp.stack([real * x[0] - imaginary * x[1], imaginary * x[0] + real * x[1]])  # noqa: E731
        return np.hypot(*rk4_step(turn, jnp.stack([jnp.ones(z.size), jnp.zeros(z.size)]), 0.0, 1.0))

    left = np.linspace(np.pi / 2, np.pi, 1001)
    assert np.all(growth(STABLE, left) <= 1)
    assert np.max(growth(1.01 * STABLE, left)) > 1
    assert growth(2.785, left[-1:]) < 1 < growth(2.786, left[-1:])
