"""Derivatives of functions that act on the first axis and are elementwise on all others."""

import jax
import jax.numpy as jnp


def basis(z):
    """The unit vectors of the first axis [w w ...], for z [w ...]."""
    eye = jnp.eye(z.shape[0], dtype=z.dtype)
    return jnp.broadcast_to(eye.reshape(*eye.shape, *(1,) * (z.ndim - 1)), (z.shape[0], *z.shape))


def value_and_jacobian(f, z):
    """f(z) [o ...] and df/dz [o w ...] of f: [w ...] -> [o ...], by one forward pass that all w columns share."""
    value, push = jax.linearize(f, z)
    return value, jnp.swapaxes(jax.vmap(push)(basis(z)), 0, 1)


def jacobian(f, z):
    """df/dz [o w ...] of f: [w ...] -> [o ...]."""
    return value_and_jacobian(f, z)[1]
