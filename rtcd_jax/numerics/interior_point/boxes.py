"""Bounded variables: their slacks and duals, and reductions over everything but the batch, which is last."""

from typing import NamedTuple, cast

import jax.numpy as jnp
from jaxtyping import Array, Float


class Boxed(NamedTuple):
    """One value for each bounded variable: interior states with a finite limit, inputs, the step if it is free."""

    xs: Float[Array, "N-1 b P"]
    us: Float[Array, "N m P"]
    h: Float[Array, "s P"]


def total(a: Float[Array, "*rest P"]) -> Float[Array, " P"]:
    """The sum over all but the batch."""
    return jnp.sum(a, tuple(range(a.ndim - 1)))


def largest(a: Float[Array, "*rest P"]) -> Float[Array, " P"]:
    """The largest absolute value; 0 of none."""
    return jnp.max(jnp.abs(a), tuple(range(a.ndim - 1)), initial=0.0)


def least(a: Float[Array, "*rest P"]) -> Float[Array, " P"]:
    """The smallest value; infinity of none."""
    return jnp.min(a, tuple(range(a.ndim - 1)), initial=jnp.inf)


def sum_over(boxed: Boxed) -> Float[Array, " P"]:
    """The sum over all bounded variables."""
    return cast(Array, sum(total(leaf) for leaf in boxed))


def log_sum(slacks: Boxed) -> Float[Array, " P"]:
    """The sum of the logarithms of all slacks, lower and upper."""
    return cast(Array, sum(total(jnp.log(slack[0] * slack[1])) for slack in slacks))


def complementarity(duals: Boxed, slacks: Boxed, barrier: Float[Array, " P"] | float) -> Float[Array, " P"]:
    """The largest |dual slack - barrier|."""
    errors = [largest(dual * slack - barrier) for dual, slack in zip(duals, slacks, strict=True)]
    return jnp.maximum(jnp.maximum(errors[0], errors[1]), errors[2])


def push_inside(
    value: Float[Array, "*rest P"], low: Float[Array, "*#rest 1"], high: Float[Array, "*#rest 1"], share: float = 1e-2
) -> Float[Array, "*rest P"]:
    """Section 3.6: strictly inside the box, by a share of the bound's size or of the box."""
    below = jnp.minimum(share * jnp.maximum(1.0, jnp.abs(low)), share * (high - low))
    above = jnp.minimum(share * jnp.maximum(1.0, jnp.abs(high)), share * (high - low))
    return jnp.clip(value, low + below, high - above)


def boundary_step(values: Boxed, steps: Boxed, fraction: Float[Array, " P"]) -> Float[Array, " P"]:
    """Largest step <= 1 that keeps values + step above (1 - fraction) values: (15)."""
    rooms = [room(v, d, fraction) for v, d in zip(values, steps, strict=True)]
    return jnp.minimum(1.0, jnp.minimum(jnp.minimum(rooms[0], rooms[1]), rooms[2]))


def room(
    value: Float[Array, "*rest P"], step: Float[Array, "*rest P"], fraction: Float[Array, " P"]
) -> Float[Array, " P"]:
    """The largest length that keeps value + length step above (1 - fraction) value."""
    return least(jnp.where(step < 0, -fraction * value / jnp.where(step < 0, step, -1.0), jnp.inf))
