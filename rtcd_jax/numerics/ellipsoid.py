"""Ellipsoids {x : x' S x <= rho} through the Cholesky factor of S; matrices first, elementwise over further axes."""

from math import lgamma, log, pi
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from rtcd_jax.numerics.batched import cholesky, mtv, mv, solve_lower, solve_lower_transposed


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


class Ellipsoids(NamedTuple):
    """K sets {x : (x - center)' S (x - center) <= rho} on the last axis; `values` are S, `factors` L with S = L L'."""

    centers: Float[Array, "n K"]
    values: Float[Array, "n n K"]
    factors: Float[Array, "n n K"]

    @classmethod
    def about(cls, centers, values) -> "Ellipsoids":
        return cls(centers, values, cholesky(values)[0])

    def part(self, which: slice) -> "Ellipsoids":
        """Some of them."""
        return Ellipsoids(*(leaf[..., which] for leaf in self))

    def points(self, radii, y):
        """x [n K ...] with V(x) = (radii |y|)^2, for radii [K ...] and y that broadcasts to [n K ...]."""
        y = jnp.broadcast_to(y, (y.shape[0], *radii.shape))
        return _behind(self.centers, radii.ndim - 1) + from_ball(_behind(self.factors, radii.ndim - 1), radii * y)

    def to_ball(self, x):
        """y [n K ...] with |y|^2 = V(x), for x [n K ...]: L' (x - center)."""
        return mtv(_behind(self.factors, x.ndim - 2), x - _behind(self.centers, x.ndim - 2))

    def level(self, x):
        """V(x) [K ...] of x [n K ...]."""
        return self.value_of_error(x - _behind(self.centers, x.ndim - 2))

    def value_of_error(self, error):
        """V(center + error) [K ...] of errors [n K ...]."""
        return jnp.sum(error * mv(_behind(self.values, error.ndim - 2), error), 0)

    def radii_inside(self, limits):
        """The largest sqrt(rho) [K] for which |x_i| <= limits_i everywhere in the set; 0 if not even the center is."""
        room = limits[:, None] - jnp.abs(self.centers)
        return jnp.maximum(jnp.min(room / half_widths(self.factors), 0), 0.0)


def _behind(a, count: int):
    return a.reshape(*a.shape, *(1,) * count)
