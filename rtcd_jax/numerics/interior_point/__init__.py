"""Batched primal-dual interior-point SQP for trajectory optimization with pinned ends and one free step length.

    minimize over x_1 .. x_{N-1}, u_0 .. u_{N-1}, h     sum_k h running(x_k, u_k)
    subject to   x_{k+1} = next(x_k, u_k, h),  x_0 and x_N given,  boxes on x, u and h

The method is IPOPT's (Waechter and Biegler, Math. Programming 106, 2006; equation numbers are theirs) with the
exact Hessian of the Lagrangian and an O(N) factorization of the KKT system (../kkt.py). The batch is the last axis of
every array, see ../batched.py, and problems go through in lanes, see ../lanes.py.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from rtcd_jax.numerics.interior_point.boxes import largest
from rtcd_jax.numerics.interior_point.iteration import Iteration
from rtcd_jax.numerics.interior_point.model import Model
from rtcd_jax.numerics.interior_point.problem import DEFAULTS, ControlProblem, Guess, Settings, Solution
from rtcd_jax.numerics.lanes import solve_in_lanes
from rtcd_jax.numerics.loops import on_gpu

__all__ = ["ControlProblem", "Guess", "Settings", "Solution", "solve"]

CACHE = 2**20
"""Second-level cache of a CPU's core [bytes]."""
MOST = 32
"""Lanes of a CPU at most: of more, waiting for the slowest costs more than calls."""
VECTOR = 8
"""Lanes come in whole vectors: of the rest of a vector, a compiler may round sines and logarithms differently."""


def _lanes(count: int, intervals: int, w: int) -> int:
    """All problems at once on a GPU; on a CPU as many as have their Hessians in a core's cache."""
    in_cache = max(1, CACHE // (8 * intervals * w * w) // VECTOR) * VECTOR
    whole = -(-count // VECTOR) * VECTOR
    return whole if on_gpu() else min(MOST, in_cache, whole)


def solve(
    problem: ControlProblem,
    parameters: PyTree,
    guess: Guess,
    allowance: Int[Array, " P"],
    settings: Settings = DEFAULTS,
) -> Solution:
    """Solve every problem of the batch, within `allowance` iterations.

    `parameters` is a pytree with P on the last axis of every leaf; so do the solutions come back. The guess has
    one of P, or none. A problem whose allowance is zero costs nothing; all that is said of it is that it is not solved.
    """
    count = allowance.shape[0]
    model = Model(problem, guess.xs.dtype)
    method = Iteration(model, settings)
    order = jnp.argsort(allowance == 0)  # stable: those that are wanted come first
    place = jnp.argsort(order)

    def load(indices):
        rows = order[indices]
        chosen = jax.tree.map(lambda leaf: leaf[..., rows], parameters)
        if guess.h.ndim:
            start = jax.tree.map(lambda leaf: leaf[..., rows], guess)
        else:
            start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[..., None], (*leaf.shape, *rows.shape)), guess)
        return method.initial(start, chosen), chosen, allowance[rows]

    def advance(state):
        iterate, chosen, allowed = state
        return method.advance(iterate, chosen, allowed), chosen, allowed

    def extract(state):
        it = state[0]
        return Solution(it.us, it.xs, it.h, it.cost, largest(it.defects), it.iterations, it.solved)

    def finished(state):
        return method.finished(state[0], state[2])

    wanted = jnp.sum(allowance > 0)
    width = settings.lanes or _lanes(count, guess.us.shape[0], model.n + 1 + model.m)
    solution = solve_in_lanes(load, advance, finished, extract, count, width, wanted)
    return jax.tree.map(lambda leaf: leaf[..., place], solution)
