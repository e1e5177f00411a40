"""Ellipsoids {x : x' S x <= rho} through the Cholesky factor of S; matrices first, elementwise over further axes."""

from math import lgamma, log, pi

import jax.numpy as jnp

from rtcd_jax.numerics.batched import solve_lower, solve_lower_transposed


def from_ball(factor, y):
    """The point x [n ...] with x' S x = |y|^2, for S = L L' with `factor` L [n n ...] and y [n ...]."""
    return solve_lower_transposed(factor, y[:, None])[:, 0]


def log_volume(factor, level):
    """log of pi^(n/2) / Gamma(n/2 + 1) rho^(n/2) / sqrt(det S); -inf for rho = 0."""
    n = factor.shape[0]
    unit_ball = 0.5 * n * log(pi) - lgamma(0.5 * n + 1)
    log_root = sum(jnp.log(factor[i, i]) for i in range(n))
    return unit_ball + 0.5 * n * jnp.log(level) - log_root


def half_widths(factor):
    """Largest |x_i| [n ...] on x' S x = 1: the roots of the diagonal of S^-1."""
    n = factor.shape[0]
    eye = jnp.broadcast_to(jnp.eye(n, dtype=factor.dtype).reshape(n, n, *(1,) * (factor.ndim - 2)), factor.shape)
    return jnp.sqrt(jnp.sum(solve_lower(factor, eye) ** 2, 0))
