"""Jacobians of elementwise functions against JAX's own, point by point, and against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics.derivatives import basis, jacobian, value_and_jacobian


def f(z):
    return jnp.stack([z[0] * z[1] ** 2, jnp.exp(z[2]) - z[0], z[1] * z[2] / (1 + z[0] ** 2), z[0]])


def points(*batch):
    return jnp.asarray(np.random.default_rng(0).normal(size=(3, *batch)))


def test_jacobian_is_that_of_every_point():
    z = points(4, 5)
    together = jax.jit(lambda z: jacobian(f, z))(z)
    assert together.shape == (4, 3, 4, 5)
    alone = jax.jit(jax.vmap(jax.vmap(jax.jacfwd(f), -1, -1), -1, -1))(z)
    np.testing.assert_allclose(together, alone, rtol=1e-13)


def test_the_value_comes_with_its_jacobian():
    """Both exactly those that are asked for alone."""
    z = points(4, 5)
    value, slope = jax.jit(lambda z: value_and_jacobian(f, z))(z)
    np.testing.assert_allclose(value, f(z), rtol=1e-15)
    np.testing.assert_array_equal(slope, jax.jit(lambda z: jacobian(f, z))(z))


@pytest.mark.thorough
def test_jacobian_agrees_with_central_differences():
    """Truncation and cancellation of a central difference with step 1e-5 are both about 1e-10."""
    z = points(6)
    steps = 1e-5 * basis(z)
    numerical = jnp.stack([(f(z + step) - f(z - step)) / 2e-5 for step in steps], 1)
    np.testing.assert_allclose(jacobian(f, z), numerical, atol=1e-8)


@pytest.mark.thorough
def test_a_point_without_a_batch():
    np.testing.assert_allclose(jacobian(f, points()), jax.jacrev(f)(points()), rtol=1e-13)


def test_a_jacobian_can_be_differentiated():
    z = points(5)
    second = jax.jit(lambda z: jacobian(lambda z: jacobian(f, z).reshape(12, -1), z))(z)
    expected = jax.jit(jax.vmap(jax.hessian(f), -1, -1))(z)
    np.testing.assert_allclose(second.reshape(4, 3, 3, 5), expected, rtol=1e-12, atol=1e-12)


def test_basis_has_the_shape_and_type_of_its_point():
    z = points(2, 4).astype(jnp.float32)
    vectors = basis(z)
    assert vectors.dtype == jnp.float32
    np.testing.assert_array_equal(jnp.einsum("ijab->abij", vectors), np.broadcast_to(np.eye(3), (2, 4, 3, 3)))
