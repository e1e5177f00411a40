"""Derivatives of a step against automatic differentiation of the whole step, and the numbers known beforehand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics.entries import dot, known, plus, times, unstacked
from rtcd_jax.numerics.expansion import expander
from rtcd_jax.numerics.integrate import rk4

n, m, P = 3, 2, 5
w = n + 1 + m
PARAMETERS = {"a": np.linspace(0.5, 1.5, P), "q": np.linspace(1, 2, 2 * P).reshape(2, P)}


def rate(x, u, p):
    """x_0 appears nowhere; x_1' is known to be x_2; both inputs appear, one of them under a sine."""
    return jnp.stack([x[1] * x[2] + u[0], x[2], -p["a"] * jnp.sin(x[1]) * u[1] + jnp.exp(-(x[2] ** 2)) * u[0]])


def running(x, u, p):
    return p["q"][0] * x[1] ** 2 + p["q"][1] * u[1] ** 2 * x[2] + 0.3


def step(z, p):
    x, h, u = z[:n], z[n], z[n + 1 :]
    return rk4(lambda x, u: rate(x, u, p), x, u, h, 1), h * running(x, u, p)


def dense(entries):
    return jnp.stack([dense(e) for e in entries]) if isinstance(entries, list) else jnp.broadcast_to(entries, (P,))


@pytest.fixture(scope="module")
def point():
    random = np.random.default_rng(0)
    return (
        jnp.asarray(random.normal(size=(n, P))),
        jnp.asarray(random.normal(size=(m, P))),
        jnp.asarray(random.uniform(0.1, 0.5, P)),
        jnp.asarray(random.normal(size=(n, P))),
    )


@pytest.fixture(scope="module")
def expansion(point):
    x, u, h, lam = point
    return expander(rate, running, n, m, PARAMETERS)(tuple(x), tuple(u), h, tuple(lam), PARAMETERS)


def autodiff(point, index):
    x, u, h, lam = (leaf[..., index] for leaf in point)
    p = jax.tree.map(lambda leaf: leaf[..., index], PARAMETERS)
    z = jnp.concatenate([x, h[None], u])
    slopes, gradient = jax.jacfwd(step)(z, p)

    def lagrangian(z):
        after, cost = step(z, p)
        return cost + lam @ after

    return slopes, gradient, jax.hessian(lagrangian)(z)


@pytest.mark.thorough
@pytest.mark.parametrize("index", range(P))
def test_the_step_is_differentiated_exactly(point, expansion, index):
    slopes, gradient, hessian = autodiff(point, index)
    np.testing.assert_allclose(dense(expansion.jacobian)[..., index], slopes, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(dense(expansion.gradient)[..., index], gradient, rtol=1e-12, atol=1e-12)
    for i, row in enumerate(expansion.hessian):
        np.testing.assert_allclose(dense(row)[..., index], hessian[i, : i + 1], rtol=1e-11, atol=1e-11)


@pytest.mark.thorough
def test_what_a_robot_does_not_depend_on_is_known(expansion):
    """Translations: the first column of the slopes is the identity's, that of the Hessian zero."""
    assert [row[0] for row in expansion.jacobian] == [1.0, 0.0, 0.0]
    assert [row[0] for row in expansion.hessian] == [0.0] * w


def test_known_outputs_are_those_that_no_argument_reaches():
    def f(x, y):
        return x * y, jnp.ones(()) * 3, jnp.where(x > 0, 0.0, 0.0), y - y

    one = jax.ShapeDtypeStruct((), jnp.float64)
    assert known(f, one, one) == [None, 3.0, None, None]


def test_arithmetic_with_known_numbers():
    x = jnp.arange(3.0)
    assert times(0.0, x) == 0.0
    assert times(x, 1.0) is x
    assert plus(0.0, x, 0.0) is x
    assert plus(0.0, 0.0) == 0.0
    np.testing.assert_array_equal(dot([x, 2.0, 0.0], [x, x, x]), x * x + 2 * x)


@pytest.mark.parametrize("f", [lambda x: jnp.stack([x[0], 2 * x[1]]), lambda x: jnp.concatenate([x[:1], 2 * x[1:]])])
def test_components_are_those_of_the_array_however_it_was_made(f):
    x = jnp.array([[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(jnp.stack(unstacked(f)(x)), f(x))
