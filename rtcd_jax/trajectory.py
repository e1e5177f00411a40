"""Candidate -> Trajectory: batched multiple shooting.

    min over h, x, u   h sum_k 1/2 [(x_k - x_g)' Q (x_k - x_g) + u_k' R u_k] + w_t h N
    s.t.  x_{k+1} = Phi(x_k, u_k, h),  x_0 = start,  x_N = goal,  h_min <= h <= h_max,  |x| <= x_max,  |u| <= u_max

Phi integrates the dynamics over one interval with the input held (paper, section II-B, whose DIRTRAN takes one explicit
midpoint step instead). This verb plans for a whole population at once rather than for one candidate under vmap: the
solver refills its lanes as candidates finish, so that slow ones do not hold up their neighbours.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax.numerics import interior_point
from rtcd_jax.numerics.derivatives import jacobian
from rtcd_jax.numerics.integrate import componentwise, rk4, split
from rtcd_jax.population import decode, initial_genome
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Status, Trajectory

SWING = 0.4
"""Amplitude of the starting guesses' swings over the distance from start to goal."""

RESOLVED_RATE = 1e-3
"""Oscillations below this [rad/s] are roundings of eigenvalues that are real."""


def plan(problem: Problem, candidates: Candidate) -> Trajectory:
    """The cheapest trajectory found from a small family of starts, for every candidate [P].

    A candidate's result does not depend on the others. Its status is TRAJECTORY_NOT_SOLVED if no start ended within
    1e-9 of the interval map and inside the boxes.
    """
    settings = problem.config.trajectory
    parameters = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), candidates)
    control = interior_point.ControlProblem(
        interval=lambda x, u, h, candidate: interval_map(problem, candidate, x, u, h, settings.substeps),
        rate=lambda x, u, candidate: problem.plant.dynamics(candidate.design, x, u),
        running=partial(_running, problem),
        start=problem.start,
        goal=problem.goal,
        state_limits=problem.state_limits,
        input_limits=problem.input_limits,
        step_limits=(settings.step.min, settings.step.max),
    )
    guesses = starts(problem, parameters.q.dtype)
    solution = interior_point.solve(
        control, parameters, guesses, interior_point.Settings(max_iterations=settings.max_iterations)
    )
    return _cheapest(solution, guesses.h.shape[-1])


def interval_map(problem: Problem, candidate: Candidate, x, u, h, substeps: int):
    """Phi(x, u, h), elementwise over the axes behind the first."""
    dynamics = componentwise(partial(problem.plant.dynamics, candidate.design))
    return jnp.stack(rk4(dynamics, split(x), u, h, substeps))


def _running(problem: Problem, x, u, candidate: Candidate):
    """Cost per time of the components x (n arrays) and u (m arrays)."""
    states = sum(q * (x - goal) ** 2 for q, x, goal in zip(candidate.q, x, problem.goal, strict=True))
    inputs = sum(r * u**2 for r, u in zip(candidate.r, u, strict=True))
    return 0.5 * (states + inputs) + problem.config.trajectory.time_weight


def _cheapest(solution: interior_point.Solution, family: int) -> Trajectory:
    solved, cost, defect = (leaf.reshape(-1, family) for leaf in (solution.solved, solution.cost, solution.defect))
    cheapest = jnp.argmin(jnp.where(solved, cost, jnp.inf), 1)
    closest = jnp.argmin(jnp.where(jnp.isnan(defect), jnp.inf, defect), 1)  # what an unsolved candidate shows
    best = jnp.where(jnp.any(solved, 1), cheapest, closest) + family * jnp.arange(solved.shape[0])
    chosen = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[..., best], -1, 0), solution)
    return Trajectory(
        us=chosen.us,
        xs=chosen.xs,
        dt=chosen.h,
        cost=chosen.cost,
        defect=chosen.defect,
        iterations=chosen.iterations,
        status=jnp.where(chosen.solved, Status.OK, Status.TRAJECTORY_NOT_SOLVED).astype(jnp.int32),
    )


def starts(problem: Problem, dtype) -> interior_point.Guess:
    """The family of starting guesses: swing to and fro about the start, then into the goal, in a short and a long time.

    Which one ends best depends on how many swings the candidate needs. They are motions, no solutions of the dynamics:
    rolling the dynamics out under a sinusoidal input and bending the end into the goal needs four times the iterations,
    and the straight line of the paper's code often fails.
    """
    step = problem.config.trajectory.step
    pace = slowest_oscillation(problem) / (2 * np.pi)
    family = []
    for share in (0.25, 0.5):
        h = step.min + share * (step.max - step.min)
        family.append(_swing(problem, max(2, int(problem.intervals * h * pace)), h))
    return interior_point.Guess(*(jnp.asarray(np.stack(leaves, -1), dtype) for leaves in zip(*family, strict=True)))


def slowest_oscillation(problem: Problem) -> float:
    """Of the initial design about the start, without input [rad/s]; 0 if it does not oscillate."""
    plant = problem.plant
    with jax.ensure_compile_time_eval():  # the starts are constants of the compiled program
        design = decode(problem, jnp.asarray(initial_genome(problem))).design
        slopes = jacobian(lambda x: plant.dynamics(design, x, jnp.zeros(plant.m)), jnp.asarray(problem.start))
        rates = np.abs(np.linalg.eigvals(np.asarray(slopes)).imag)
    return float(min(rates[rates > RESOLVED_RATE], default=0.0))


def _swing(problem: Problem, swings: int, h: float):
    """Positions swing `swings` half periods under one arch and, in the second half of the time, move to the goal."""
    n, count = problem.plant.n, problem.intervals
    s = np.linspace(0, 1, count + 1)[:, None]
    late = np.clip(2 * s - 1, 0, 1)
    ease = late**2 * (3 - 2 * late)
    swing = np.sin(np.pi * s) * np.sin(swings * np.pi * s)
    travel = problem.goal[: n // 2] - problem.start[: n // 2]
    positions = problem.start[: n // 2] + travel * (ease - SWING * swing)
    xs = np.concatenate([positions, np.gradient(positions, h * count * s[:, 0], axis=0)], 1)
    return xs, np.zeros((count, problem.plant.m)), h
