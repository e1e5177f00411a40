"""The window of a catch: how far a point of the robot, a brachiator's free hook, may be from its place at the goal.

    C = J' J / window^2 + diag(0, 1 / speed^2)        the catch set of a single motion, J of the point's place

In a last ellipsoid {V <= rho} the point is farthest from its place on the rim of the ellipsoid's shadow on the two
angles that its place is a function of. That function is not linear: the rim is followed through the kinematics
themselves.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtcd_jax.numerics.derivatives import jacobian
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate

RIM = 360
"""Points on the rim of the shadow; between them the distance is larger by less than 4e-5 of itself."""
SMALL, ROUNDS = 1e-3, 10
"""Radii along a ray, the first one of this angle [rad], each corrected by the distance found at the one before."""
MARGIN = 1e-3
"""Share of the radius that is given away for both."""


def catch_shape(problem: Problem, candidate: Candidate) -> Float[Array, "n n"]:
    """C of the catch set {x : (x - goal)' C (x - goal) <= 1}: the task's own, or that of its window and speed."""
    dtype = candidate.q.dtype
    if problem.catch is not None:
        return jnp.asarray(problem.catch, dtype)
    assert problem.window is not None
    turn = jacobian(partial(problem.window.place, problem.numbers(candidate)), jnp.asarray(problem.goal, dtype))
    n = problem.plant.n
    speeds = np.diag(np.repeat([0.0, problem.window.speed**-2], n // 2))
    return turn.T @ turn / problem.window.size**2 + speeds


def window_radius(problem: Problem, candidate: Candidate, last: Ellipsoids) -> Float[Array, ""]:
    """The largest radius sqrt(rho) of the `last` ellipsoid (K = 1) in which the point is within the window."""
    assert problem.window is not None
    size, rim = problem.window.size, _rim(problem, last)

    def corrected(_, radii: Float[Array, " rim"]) -> Float[Array, " rim"]:
        return radii * size / _distances(problem, candidate, radii * rim)

    first = jnp.full(RIM, SMALL / jnp.sqrt(jnp.max(rim**2)))
    return (1 - MARGIN) * jnp.min(jax.lax.fori_loop(0, ROUNDS, corrected, first))


def farthest(problem: Problem, candidate: Candidate, last: Ellipsoids, level: Float[Array, ""]) -> Float[Array, ""]:
    """The point's largest distance [m] from its place at the goal in the `last` ellipsoid (K = 1) of this level."""
    return jnp.max(_distances(problem, candidate, jnp.sqrt(level) * _rim(problem, last)))


def _rim(problem: Problem, last: Ellipsoids) -> Float[Array, "joints rim"]:
    """Of the shadow of {V <= 1} on the two angles, from its middle, in the joints: where the set has that shadow."""
    assert problem.window is not None
    seen = problem.window.angles
    joints = seen.shape[1]
    turns = np.linspace(0, 2 * np.pi, RIM, endpoint=False)
    spread = jnp.linalg.inv(last.values[..., 0])[:joints, :joints] @ seen.T
    factor = jnp.linalg.cholesky(seen @ spread)
    return spread @ jnp.linalg.solve(factor.T, np.stack([np.cos(turns), np.sin(turns)]))


def _distances(problem: Problem, candidate: Candidate, offsets: Float[Array, "joints rim"]) -> Float[Array, " rim"]:
    """From the place at the goal, of the point where the joints are off the goal by these."""
    assert problem.window is not None
    place = partial(problem.window.place, problem.numbers(candidate))
    goal = jnp.asarray(problem.goal, offsets.dtype)[:, None]
    x = jnp.broadcast_to(goal, (len(goal), offsets.shape[1])).at[: len(offsets)].add(offsets)
    return jnp.sqrt(jnp.sum((place(x) - place(goal)) ** 2, 0))
