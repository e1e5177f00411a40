"""The state of a solve."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from rtcd_jax.numerics.interior_point.boxes import Boxed
from rtcd_jax.numerics.interior_point.inequalities import Inequalities


class Iterate(NamedTuple):
    """A point with its multipliers, and what the barrier, the regularization and the filter remember."""

    xs: Float[Array, "N+1 n P"]
    us: Float[Array, "N m P"]
    h: Float[Array, " P"]
    multipliers: Float[Array, "N n P"]
    duals: Boxed  # each with a leading axis (lower, upper)
    barrier: Float[Array, " P"]
    regularization: Float[Array, " P"]
    last_regularization: Float[Array, " P"]
    filter: Float[Array, "F 2 P"]
    filtered: Int[Array, " P"]
    violation_start: Float[Array, " P"]
    rejections: Int[Array, " P"]
    iterations: Int[Array, " P"]
    cost: Float[Array, " P"]
    defects: Float[Array, "N n P"]
    solved: Bool[Array, " P"]
    inequalities: Inequalities | None = None  # where there are sets to keep out of


def where(condition: Bool[Array, " P"], yes: PyTree, no: PyTree) -> PyTree:
    """`jnp.where` on every leaf of two trees."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
