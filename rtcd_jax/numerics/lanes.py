"""Many independent iterative problems on a fixed number of lanes, refilled as problems finish.

A vmapped while_loop makes every problem wait for its slowest neighbor. Here a finished lane hands over
its result and takes the next problem, so that slow problems do not delay the others. A lane's arithmetic never
looks at another lane: the result of a problem does not depend on which problems it ran beside.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree


def solve_in_lanes(
    load: Callable,
    advance: Callable,
    finished: Callable,
    extract: Callable,
    count: int,
    width: int,
    wanted: Int[Array, ""] | int | None = None,
) -> PyTree:
    """Results of problems 0 .. count-1, batch on the last axis of every leaf; of the first `wanted`, else zeros.

    `load(indices [W]) -> state`, `advance(state) -> state` (must leave finished lanes unchanged),
    `finished(state) -> [W] bool`, `extract(state) -> result`. Every problem must finish after a bounded number
    of advances. Lanes are refilled when a quarter of them is free, or nothing else is left to do.
    """
    wanted = count if wanted is None else wanted
    share = max(1, width // 4)
    lanes = jnp.arange(width)
    state = load(jnp.minimum(lanes, count - 1))
    shapes = jax.eval_shape(extract, state)
    results = jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape[:-1], count), leaf.dtype), shapes)

    def refill(carry):
        state, results, problem, upcoming = carry
        free = finished(state) | (problem == count)
        target = jnp.where(free, problem, count)
        results = jax.tree.map(lambda all_, new: all_.at[..., target].set(new, mode="drop"), results, extract(state))
        candidate = upcoming + jnp.cumsum(free) - 1
        loaded = free & (candidate < wanted)
        problem = jnp.where(free, jnp.where(loaded, candidate, count), problem)
        fresh = load(jnp.minimum(problem, count - 1))
        state = jax.tree.map(lambda old, new: jnp.where(loaded, new, old), state, fresh)
        return state, results, problem, upcoming + jnp.sum(loaded)

    def step(carry):
        state, results, problem, upcoming = carry
        state = advance(state)
        idle = problem == count
        done = finished(state)
        due = (jnp.sum(done & ~idle) >= share) & (upcoming < wanted)
        due = due | jnp.all(done | idle)
        return jax.lax.cond(due, refill, lambda carry: carry, (state, results, problem, upcoming))

    def unfinished(carry):
        return jnp.any(carry[2] < count)

    carry = (state, results, jnp.where(lanes < wanted, lanes, count), jnp.asarray(width))
    return jax.lax.while_loop(unfinished, step, carry)[1]
