"""Ellipsoids {x : x' S x <= rho} through the Cholesky factor of S; matrices first, elementwise over further axes."""

from math import lgamma, log, pi
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rtcd_jax.numerics.batched import cholesky, mtv, mv, solve_lower, solve_lower_transposed


def from_ball(factor: Float[Array, "n n *#batch"], y: Float[Array, "n *#batch"]) -> Float[Array, "n *#batch"]:
    """The point x with x' S x = |y|^2, for S = L L' with `factor` L."""
    return solve_lower_transposed(factor, y[:, None])[:, 0]


def log_volume(factor: Float[Array, "n n *#batch"], level: Float[Array, "*#batch"]) -> Float[Array, "*#batch"]:
    """log of pi^(n/2) / Gamma(n/2 + 1) rho^(n/2) / sqrt(det S); -inf for rho = 0."""
    n = factor.shape[0]
    unit_ball = 0.5 * n * log(pi) - lgamma(0.5 * n + 1)
    log_root = sum(jnp.log(factor[i, i]) for i in range(n))
    return unit_ball + 0.5 * n * jnp.log(level) - log_root


def half_widths(factor: Float[Array, "n n *batch"]) -> Float[Array, "n *batch"]:
    """Largest |x_i| on x' S x = 1: the roots of the diagonal of S^-1."""
    n = factor.shape[0]
    eye = jnp.broadcast_to(jnp.eye(n, dtype=factor.dtype).reshape(n, n, *(1,) * (factor.ndim - 2)), factor.shape)
    return jnp.sqrt(jnp.sum(solve_lower(factor, eye) ** 2, 0))


class Ellipsoids(NamedTuple):
    """K sets {x : (x - center)' S (x - center) <= rho} on the last axis; `values` are S, `factors` L with S = L L'."""

    centers: Float[Array, "n K"]
    values: Float[Array, "n n K"]
    factors: Float[Array, "n n K"]

    @classmethod
    def about(cls, centers: Float[Array, "n K"], values: Float[Array, "n n K"]) -> "Ellipsoids":
        return cls(centers, values, cholesky(values)[0])

    def part(self, which: slice | Int[Array | np.ndarray, " chosen"]) -> "Ellipsoids":
        """The chosen ones."""
        return Ellipsoids(*(leaf[..., which] for leaf in self))

    def points(self, radii: Float[Array, "K *batch"], y: Float[Array, "n *rest"]) -> Float[Array, "n K *batch"]:
        """x with V(x) = (radii |y|)^2, for y that broadcasts to [n K *batch]."""
        y = jnp.broadcast_to(y, (y.shape[0], *radii.shape))
        return _behind(self.centers, radii.ndim - 1) + from_ball(_behind(self.factors, radii.ndim - 1), radii * y)

    def to_ball(self, x: Float[Array, "n K *batch"]) -> Float[Array, "n K *batch"]:
        """y with |y|^2 = V(x): L' (x - center)."""
        return mtv(_behind(self.factors, x.ndim - 2), x - _behind(self.centers, x.ndim - 2))

    def level(self, x: Float[Array, "n K *batch"]) -> Float[Array, "K *batch"]:
        """V(x)."""
        return self.value_of_error(x - _behind(self.centers, x.ndim - 2))

    def value_of_error(self, error: Float[Array, "n K *batch"]) -> Float[Array, "K *batch"]:
        """V(center + error)."""
        return jnp.sum(error * mv(_behind(self.values, error.ndim - 2), error), 0)

    def radii_inside(self, limits: Float[Array, " n"]) -> Float[Array, " K"]:
        """The largest sqrt(rho) for which |x_i| <= limits_i everywhere in the set; 0 if not even the center is."""
        room = limits[:, None] - jnp.abs(self.centers)
        return jnp.maximum(jnp.min(room / half_widths(self.factors), 0), 0.0)


def _behind(a, count: int):
    return a.reshape(*a.shape, *(1,) * count)
