"""A cycle of tasks: each motion ends where a reset carries it into the start of the next one, the last into the first.

    S_N = DR' S_0 DR,   S_0 of the next task,   all around the cycle: to first order V does not rise at a reset

The reset R acts on the whole last ellipsoid, and it is not linear: a cycle is closed if held-out samples of every last
ellipsoid, and as many on its rim, lie in the next task's first one. Then a state of any funnel stays in the funnels
from swing to swing.
"""

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from rtcd_jax.adversary import Scales
from rtcd_jax.numerics import riccati, sampling
from rtcd_jax.numerics.batched import mm, mtm
from rtcd_jax.numerics.derivatives import jacobian
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.policy import riccati_intervals
from rtcd_jax.problem import RESETS, Problem
from rtcd_jax.types import Candidate, Evaluation, Status, TaskEvaluations, Trajectory, first_failure


def values_at_resets(problem: Problem, candidates: Candidate, trajectories: Trajectory) -> Float[Array, "tasks n n"]:
    """S_N of one genome's candidates and trajectories [T] on every task; no numbers where the periodic Riccati equation
    has no stabilizing solution.
    """

    def swing(candidate: Candidate, trajectory: Trajectory):
        own = problem.of(candidate)
        stages = riccati_intervals(own, candidate, trajectory)
        last, others = jax.tree.map(lambda leaf: leaf[-1], stages), jax.tree.map(lambda leaf: leaf[:-1], stages)
        whole, _ = jax.lax.scan(lambda late, early: (riccati.compose(early, late), None), last, others, reverse=True)
        return whole, jacobian(partial(_reset, problem, candidate, {}), trajectory.xs[-1])

    swings, jumps = jax.vmap(swing)(candidates, trajectories)
    jumped = jax.vmap(riccati.mapped)(swings, jumps)
    first, later = jax.tree.map(lambda leaf: leaf[0], jumped), jax.tree.map(lambda leaf: leaf[1:], jumped)
    period, _ = jax.lax.scan(lambda early, late: (riccati.compose(early, late), None), first, later)
    start, reached = riccati.periodic(period)

    def backward(start, at):
        swing, jump = at
        last = mtm(jump, mm(start, jump))
        return riccati.propagate(swing, last)[0], last

    _, lasts = jax.lax.scan(backward, start, (swings, jumps), reverse=True)
    return jnp.where(reached, lasts, jnp.nan)


def closed(
    problem: Problem, evaluations: TaskEvaluations, key: PRNGKeyArray, samples: int, share: float = 1.0
) -> TaskEvaluations:
    """One genome's evaluations with what their resets do; FUNNEL_EMPTY where one of them leads out of the next task's
    first ellipsoid, or out of this `share` of its level.
    """
    after, worst = worst_after_reset(problem, evaluations.tasks, key, samples)
    leaves = jnp.where(jnp.all(after <= share), Status.OK, Status.FUNNEL_EMPTY)
    status = first_failure(evaluations.status, leaves)
    return dataclasses.replace(evaluations, status=status, after_reset=after, worst_at_resets=worst)


def worst_after_reset(
    problem: Problem, tasks: Evaluation, key: PRNGKeyArray, samples: int
) -> tuple[Float[Array, " tasks"], Float[Array, "tasks 2 n"]]:
    """Of one genome's evaluations [T]: the largest V / rho_0 in the next task's first ellipsoid, at most 1 if the cycle
    is closed there, of `samples` states that are uniform in each last one, and as many on its rim, after the reset; and
    the states before and after the reset that have it. Under uncertainty of the worst robot at a corner of the box.
    """
    policies = tasks.funnel.policy
    count, _, n = policies.trajectory.xs.shape

    def sets(knot: int) -> Ellipsoids:
        return Ellipsoids.about(policies.trajectory.xs[:, knot].T, jnp.moveaxis(policies.values[:, knot], 0, -1))

    y = sampling.ball(key, (count, samples), n, tasks.funnel.levels.dtype)
    y = jnp.concatenate([y, y / jnp.sqrt(jnp.sum(y**2, 0))], -1)
    radii = jnp.sqrt(tasks.funnel.levels[:, -1])[:, None]
    ends = sets(-1).points(jnp.broadcast_to(radii, y.shape[1:]), y)

    def of_the_robot(scales: Scales):
        after = jax.vmap(lambda candidate, x: _reset(problem, candidate, scales, x), (0, 1), 1)(tasks.candidate, ends)
        levels = sets(0).level(jnp.roll(after, 1, 1)) / tasks.funnel.levels[:, 0][:, None]
        levels = jnp.roll(jnp.where(jnp.isnan(levels), jnp.inf, levels), -1, 0)
        states = jnp.moveaxis(jnp.stack([ends, after]), (2, 3), (0, 1))  # [tasks samples 2 n]
        return jnp.max(levels, -1), states[np.arange(count), jnp.argmax(levels, -1)]

    robots = _corners(problem)
    if not robots:
        return of_the_robot({})
    levels, states = jax.vmap(of_the_robot)(robots)
    worst = jnp.argmax(levels, 0)
    return jnp.max(levels, 0), states[worst, np.arange(count)]


def _corners(problem: Problem) -> Scales:
    """Of the box of robots by the numbers that the reset needs, and the nominal one [R]; empty without such a box."""
    box = problem.uncertainty
    if box is None:
        return {}
    fields = RESETS[problem.config.task.catch.reset].fields[problem.plant.n // 2]
    widths = {name: width for name, width in box.parameters.items() if name in fields}
    signs = np.array([*itertools.product((-1.0, 1.0), repeat=len(widths)), np.zeros(len(widths))])
    return {name: 1 + width * side for (name, width), side in zip(widths.items(), signs.T, strict=True)}


def _reset(
    problem: Problem, candidate: Candidate, scales: Scales, x: Float[Array, "n *batch"]
) -> Float[Array, "n *batch"]:
    """R of states at the end of the candidate's task, with its robot's numbers, some of them scaled."""
    assert problem.reset is not None
    numbers = problem.numbers(candidate)
    return problem.reset(numbers | {name: numbers[name] * scale for name, scale in scales.items()}, x)
