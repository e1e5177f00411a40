"""The classical fourth-order Runge-Kutta step. States are arrays or pytrees of arrays.

A state as a tuple of its components, `split(x)`, makes the faster program on a CPU: XLA fuses arithmetic on components
into one pass over the batch, but stops at every concatenation of components to one array.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from rtcd_jax.numerics.loops import on_gpu, repeat

START, MIDDLE, END = 0, 1, 2
"""Where in the step a slope is taken."""

STABLE = 2.6
"""Steps of x' = lambda x are stable for Re lambda < 0 and |lambda| dt up to this (2.785 where lambda is real)."""


def split(x: Float[Array, "n *batch"]) -> tuple[Float[Array, "*batch"], ...]:
    """The components of x."""
    return tuple(x[i] for i in range(x.shape[0]))


def join(parts: Sequence[Float[Array, "*batch"]]) -> Float[Array, "n *batch"]:
    """The array of the components: `split` backward, where their computation is long.

    On a CPU they are written one after another: of what XLA fuses into a concatenation it makes scalar code, for some
    robots fifty times slower.
    """
    if on_gpu():
        return jnp.stack(parts)
    whole = jnp.zeros((len(parts), *jnp.shape(parts[0])), parts[0].dtype)
    for i, part in enumerate(parts):
        whole = jax.lax.dynamic_update_index_in_dim(whole, part, i, 0)
    return whole


def componentwise(f: Callable) -> Callable:
    """f(x [n ...], ...) -> x' [n ...] as a function of tuples of components."""
    return lambda parts, *rest: split(f(jnp.stack(parts), *rest))


def rk4_varying_step(slope: Callable, x: PyTree[ArrayLike], dt: ArrayLike) -> PyTree[ArrayLike]:
    """x(t + dt) for x' = slope(x, place), `place` being START, MIDDLE or END of the step."""
    k1 = slope(x, START)
    k2 = slope(_along(x, 0.5 * dt, k1), MIDDLE)
    k3 = slope(_along(x, 0.5 * dt, k2), MIDDLE)
    k4 = slope(_along(x, dt, k3), END)
    return jax.tree.map(lambda x, a, b, c, d: x + dt / 6 * (a + 2 * b + 2 * c + d), x, k1, k2, k3, k4)


def rk4_step(f: Callable, x: PyTree[ArrayLike], u: PyTree[ArrayLike], dt: ArrayLike) -> PyTree[ArrayLike]:
    """x(t + dt) for x' = f(x, u), the input held."""
    return rk4_varying_step(lambda x, _: f(x, u), x, dt)


def rk4(f: Callable, x: PyTree[ArrayLike], u: PyTree[ArrayLike], duration: ArrayLike, steps: int) -> PyTree[ArrayLike]:
    """x(t + duration) by equal Runge-Kutta steps, the input held."""
    return repeat(steps, lambda x: rk4_step(f, x, u, duration / steps), x)


def _along(x, distance, slope):
    return jax.tree.map(lambda x, k: x + distance * k, x, slope)
