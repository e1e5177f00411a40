"""Derivatives of functions that act on the first axis and are elementwise on all others."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def basis(z: Float[Array, "w *batch"]) -> Float[Array, "w w *batch"]:
    """The unit vectors of the first axis."""
    eye = jnp.eye(z.shape[0], dtype=z.dtype)
    return jnp.broadcast_to(eye.reshape(*eye.shape, *(1,) * (z.ndim - 1)), (z.shape[0], *z.shape))


def value_and_jacobian(
    f: Callable, z: Float[Array, "w *batch"]
) -> tuple[Float[Array, "o *batch"], Float[Array, "o w *batch"]]:
    """f(z) and df/dz of f: [w ...] -> [o ...], by one forward pass that all w columns share."""
    value, push = jax.linearize(f, z)
    return value, jnp.swapaxes(jax.vmap(push)(basis(z)), 0, 1)


def jacobian(f: Callable, z: Float[Array, "w *batch"]) -> Float[Array, "o w *batch"]:
    """df/dz of f: [w ...] -> [o ...]."""
    return value_and_jacobian(f, z)[1]
