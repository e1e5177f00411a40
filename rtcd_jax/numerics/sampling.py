"""Directions and points of the unit ball."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, PRNGKeyArray


def quasi_uniform(key: PRNGKeyArray, count: int, dimensions: int, dtype: DTypeLike) -> Float[Array, "dimensions count"]:
    """`count` points of the unit cube: an additive recurrence, shifted at random.

    The generators are powers of the root of g^(d+1) = g + 1 (Roberts 2018), the golden ratio for d = 1.
    """
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    points = np.outer(steps, np.arange(count)) % 1.0
    return (jnp.asarray(points, dtype) + jax.random.uniform(key, (dimensions, 1), dtype)) % 1.0


def directions(key: PRNGKeyArray, count: int, n: int, dtype: DTypeLike) -> Float[Array, "n count"]:
    """`count` well spread unit vectors; evenly spaced for n = 2; for n = 1 three of them point both ways."""
    if n == 2:
        turn = 2 * np.pi * (jnp.arange(count, dtype=dtype) + jax.random.uniform(key, (), dtype)) / count
        return jnp.stack([jnp.cos(turn), jnp.sin(turn)])
    tiny = float(jnp.finfo(dtype).eps)
    normal = jax.scipy.special.ndtri(jnp.clip(quasi_uniform(key, count, n, dtype), tiny, 1 - tiny))
    return normal / jnp.linalg.norm(normal, axis=0)


def ball(key: PRNGKeyArray, shape: tuple[int, ...], n: int, dtype: DTypeLike) -> Float[Array, "n *shape"]:
    """Independent points, uniform in the unit ball."""
    aim, reach = jax.random.split(key)
    normal = jax.random.normal(aim, (n, *shape), dtype)
    radius = jax.random.uniform(reach, shape, dtype) ** (1 / n)
    return normal * (radius / jnp.sqrt(jnp.sum(normal**2, 0)))
