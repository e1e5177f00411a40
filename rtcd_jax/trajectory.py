"""Candidate -> Trajectory: batched multiple shooting.

    min over h, x, u   h sum_k 1/2 [(x_k - x_g)' Q (x_k - x_g) + u_k' R u_k] + w_t h N
    s.t.  x_{k+1} = Phi(x_k, u_k, h),  x_0 = start,  x_N = goal,  h_min <= h <= h_max,  |x| <= x_max,  |u| <= u_max

and, where the task states sets to keep out of, no x_k in one of them. A `cost_center` stands for x_g in the cost.
Phi integrates the dynamics over one interval with the input held (paper, section II-B, whose DIRTRAN takes one explicit
midpoint step instead). This verb plans for a whole population at once rather than for one candidate under vmap: the
solver refills its lanes as candidates finish, so that slow ones do not hold up their neighbors.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float

from rtcd_jax.genome import decode, initial_genome
from rtcd_jax.numerics import interior_point
from rtcd_jax.numerics.derivatives import jacobian
from rtcd_jax.numerics.integrate import componentwise, join, rk4, split
from rtcd_jax.numerics.loops import packed_scan
from rtcd_jax.plants.base import Components
from rtcd_jax.problem import Problem, initial_design
from rtcd_jax.types import Candidate, Status, Trajectory

SWING = 0.4
"""Amplitude of the starting guesses' swings over the distance from start to goal."""

SHARES = (0.5, 0.25, 0.95, 0.75)
"""Steps of the starting guesses, as shares of their box; the one that more often ends better comes first.

The longest solve most of what the first two leave.
"""

PATIENCE = 2
"""Iterations that a further start may take, over those that solved the candidate before."""

RESOLVED_RATE = 1e-3
"""Oscillations below this [rad/s] are roundings of eigenvalues that are real."""


def plan(problem: Problem, candidates: Candidate) -> Trajectory:
    """The cheapest trajectory found from the first `starts` of a small family of starts, for every candidate [P].

    Where these fail, the others follow until one is solved. A candidate's result does not depend on its neighbors'.
    Its status is TRAJECTORY_NOT_SOLVED if no start ended within 1e-9 of the interval map and inside the boxes.
    Nothing is optimized where the search is for the goal's region alone: the robot rests there.
    """
    settings = problem.config.trajectory
    if problem.config.at_rest:
        return _rest(problem, candidates)
    parameters = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), candidates)
    control = interior_point.ControlProblem(
        interval=lambda x, u, h, candidate: interval_map(
            problem.of(candidate), candidate, x, _inputs(problem, candidate, u), h, settings.substeps
        ),
        rate=lambda x, u, candidate: problem.of(candidate).plant.dynamics(
            candidate.design, x, _inputs(problem, candidate, u)
        ),
        running=lambda x, u, candidate: _running(problem.of(candidate), x, _inputs(problem, candidate, u), candidate),
        ends=lambda candidate: (problem.of(candidate).start, problem.of(candidate).goal),
        travel=np.max([np.abs(each.start - each.goal) for each in problem.tasks or (problem,)], 0),
        state_limits=settings.limit_share * problem.state_limits,
        input_limits=settings.input_share * np.asarray(problem.input_limits(initial_design(problem))),
        step_limits=(settings.step.min, settings.step.max),
        keep_out=tuple(each.shrunk(settings.limit_share) for each in problem.keep_out),
    )
    most = settings.max_iterations

    def attempt(best, start):
        index, guess = start
        # A start that takes much longer than the one before it seldom ends better.
        allowance = jnp.where(best.solved, jnp.minimum(PATIENCE * best.iterations, most), most)
        allowance = jnp.where((index < settings.starts) | ~best.solved, allowance, 0)
        found = interior_point.solve(control, parameters, own(guess), allowance)
        return _better(best, found, allowance > 0), None

    def own(guess):
        """Of several tasks, each candidate's."""
        return jax.tree.map(lambda leaf: leaf[..., candidates.task], guess) if problem.tasks else guess

    family = starts(problem, parameters.q.dtype)
    none = _nothing(own(jax.tree.map(lambda leaf: leaf[0], family)), candidates.q.shape[0])
    best, _ = packed_scan(attempt, none, (np.arange(len(SHARES)), family), carry=False)
    us = _inputs(problem, parameters, jnp.moveaxis(best.us, 1, 0)).T
    xs, h = (jnp.moveaxis(leaf, -1, 0) for leaf in (best.xs, best.h))
    status = jnp.where(best.solved, Status.OK, Status.TRAJECTORY_NOT_SOLVED).astype(jnp.int32)
    return Trajectory(us, xs, h, best.cost, best.defect, best.iterations, status)


def _rest(problem: Problem, candidates: Candidate) -> Trajectory:
    """At the goal, in the shortest intervals."""
    like, knots = candidates.q, problem.intervals + 1
    count, n = like.shape
    goals = jnp.asarray(problem.of(candidates).goal, like.dtype).T.reshape(-1, 1, n)
    zero = jnp.zeros(count, like.dtype)
    none = jnp.zeros(count, jnp.int32)
    return Trajectory(
        us=jnp.zeros((count, knots - 1, problem.plant.m), like.dtype),
        xs=jnp.broadcast_to(goals, (count, knots, n)),
        dt=zero + problem.config.trajectory.step.min,
        cost=zero,
        defect=zero,
        iterations=none,
        status=none,
    )


def _inputs(problem: Problem, candidate: Candidate, us: Array | Components) -> Any:
    """The inputs' components that the optimizer's `us` stand for.

    Its box is one for all candidates: where a motor's limit is a design's or a task's, its inputs are those of the
    initial design's motor, of which the candidate's gives the same share.
    """
    limits = problem.of(candidate).input_limits(candidate.design)
    if isinstance(limits, np.ndarray):
        return us
    known = problem.input_limits(initial_design(problem))
    given = tuple(limit / first * u for limit, first, u in zip(limits, known, us, strict=True))
    return given if isinstance(us, tuple) else jnp.stack(given)


def interval_map(
    problem: Problem,
    candidate: Candidate,
    x: Float[Array, "n *batch"],
    u: Float[Array, "m *batch"],
    h: Float[Array, "*#batch"] | float,
    substeps: int,
) -> Float[Array, "n *batch"]:
    """Phi(x, u, h), elementwise over the trailing axes."""
    dynamics = componentwise(partial(problem.plant.dynamics, candidate.design))
    return join(rk4(dynamics, split(x), u, h, substeps))


def _running(problem: Problem, x, u, candidate: Candidate):
    """Cost per time of the components x (n arrays) and u (m arrays)."""
    center = problem.goal if problem.cost_center is None else problem.cost_center
    states = sum(q * (x - c) ** 2 for q, x, c in zip(candidate.q, x, center, strict=True))
    inputs = sum(r * u**2 for r, u in zip(candidate.r, u, strict=True))
    return 0.5 * (states + inputs) + problem.config.trajectory.time_weight


def _nothing(guess: interior_point.Guess, count: int) -> interior_point.Solution:
    """What is known before the first start."""
    if not guess.h.ndim:
        guess = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[..., None], (*leaf.shape, count)), guess)
    xs, us, h = guess
    zero = jnp.zeros(count, jnp.int32)
    return interior_point.Solution(us, xs, h, cost=0 * h, defect=jnp.inf + h, iterations=zero, solved=zero > 0)


def _better(best: interior_point.Solution, found: interior_point.Solution, tried) -> interior_point.Solution:
    """The cheaper one of two that are solved; of two that are not, the one closer to the dynamics."""
    cheaper = found.solved & ~(best.solved & (best.cost <= found.cost))
    closer = ~found.solved & ~best.solved & ~(found.defect >= best.defect)
    return jax.tree.map(lambda new, old: jnp.where(tried & (cheaper | closer), new, old), found, best)


def starts(problem: Problem, dtype: DTypeLike) -> interior_point.Guess:
    """The family [G ...] of guesses: swing to and fro about the start, then into the goal, in longer and shorter times;
    [G ... T] of several tasks.

    Which one ends best depends on how many swings the candidate needs. They are motions, no solutions of the dynamics:
    rolling the dynamics out under a sinusoidal input and bending the end into the goal needs four times the iterations,
    and the straight line of the paper's code often fails.
    """
    if problem.tasks:
        return jax.tree.map(lambda *leaves: jnp.stack(leaves, -1), *(starts(each, dtype) for each in problem.tasks))
    step = problem.config.trajectory.step
    pace = slowest_oscillation(problem) / (2 * np.pi)
    family = []
    for share in SHARES:
        h = step.min + share * (step.max - step.min)
        family.append(_swing(problem, max(2, int(problem.intervals * h * pace)), h))
    return interior_point.Guess(*(jnp.asarray(np.stack(leaves), dtype) for leaves in zip(*family, strict=True)))


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
