"""Policy -> Funnel: levels rho_k such that the closed loop carries B_k into B_{k+1}, found by rollouts.

    rho_k = sup {rho : every sampled x with V_k(x) <= rho stays inside the boxes and ends with V_{k+1} <= rho_{k+1}}

(paper, section II-D.2, by simulation). Where a state ends after one interval does not depend on any level: all knots
and samples are rolled out at once, and one cheap backward scan then sets every level. A coarse pass over the whole box
and finer ones about its result are followed by fresh independent states (confirmation.py). rho_N comes from long
rollouts under the goal's LQR.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax import rollout
from rtcd_jax.confirmation import Effort, confirm, follow
from rtcd_jax.numerics import sampling
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Funnel, Policy, Status, first_failure

COARSE_DIRECTIONS = 12
COARSE_DECADES = 3.0
"""The first pass looks at radii from the box's down to a thousandth of it: a millionth of its level."""

WINDOWS = (1.35, 1.1, 1.02)
WINDOW_RADII = 4
"""`Effort.passes` later passes look at so many radii, from the last pass' radius over its window to it times that."""

BRACKET_OVERLAP = 1.05
"""Radii at the goal: a round starts below the last one's by this, since its other directions may find less."""

MARGIN = 1e-3
"""Share of every level that is given away for the directions between the sampled ones."""


def estimate_funnel(problem: Problem, candidate: Candidate, policy: Policy, key, effort: Effort) -> Funnel:
    """The funnel of a policy (*sampled* rung); `key` fixes all directions, radii and fresh states.

    `trials[k]` fresh states, independent and uniform in the final B_k, were rolled out without a failure: over their
    interval or, with `effort.follow`, to the goal. It is zero where the last pass still had to shrink the level.
    Status: FUNNEL_EMPTY if some level is below the smallest sampled one.
    """
    keys = jax.random.split(key, 5)
    sets = Ellipsoids.about(policy.trajectory.xs.T, jnp.moveaxis(policy.values, 0, -1))
    dtype = sets.centers.dtype
    boxes = sets.radii_inside(jnp.asarray(problem.state_limits, dtype))
    tracked = rollout.reference(problem, candidate, policy, effort.funnel.steps)
    last = _goal_level(problem, candidate, policy, sets.part(slice(-1, None)), boxes[-1], keys[0], effort)

    def pass_over(radii, directions, dynamics):
        """Levels from the rays through `directions` [n D] with ascending `radii` [N J]."""
        grid = jnp.broadcast_to(radii[:, None, :], (radii.shape[0], directions.shape[1], radii.shape[1]))
        x = sets.part(slice(0, -1)).points(grid, directions[:, None, :, None])
        ends, inside = rollout.roll_intervals(problem, candidate, tracked, x, dynamics)
        return _scan_rays(grid, sets.part(slice(1, None)).level(ends), inside, last)

    def closer(levels, pass_):
        window, key = pass_
        near = jnp.sqrt(levels)[:, None] * window ** np.linspace(-1, 1, WINDOW_RADII)
        aims = sampling.directions(key, effort.funnel.directions, n, dtype)
        return pass_over(jnp.minimum(near, boxes[:-1, None]), aims, effort.dynamics.directions), None

    n = problem.plant.n
    coarse = boxes[:-1, None] * np.logspace(-COARSE_DECADES, 0, effort.funnel.radii)
    aims = sampling.directions(keys[1], COARSE_DIRECTIONS, n, dtype)
    levels = pass_over(coarse, aims, rollout.closed_form(problem.plant))
    windows = jnp.asarray(WINDOWS[: effort.passes], dtype)
    levels, _ = jax.lax.scan(closer, levels, (windows, jax.random.split(keys[2], effort.passes)))

    levels, trials = confirm(problem, candidate, sets, tracked, jnp.append(levels, last), keys[3], effort)
    if effort.follow:
        levels, trials = follow(problem, candidate, policy, sets, tracked, levels, keys[4], effort)
    full = jnp.all(levels >= (boxes * 10**-COARSE_DECADES) ** 2) & jnp.all(boxes > 0)
    finite = jnp.all(jnp.isfinite(levels)) & jnp.all(jnp.isfinite(policy.values))
    status = first_failure(
        policy.status,
        jnp.where(finite, Status.OK, Status.NOT_FINITE),
        jnp.where(full, Status.OK, Status.FUNNEL_EMPTY),
    )
    return Funnel(policy, levels, trials, status)


def _goal_level(problem, candidate, policy, goal_set: Ellipsoids, box, key, effort: Effort):
    """rho_N: V decreases over `horizon` from every sampled state below it, inside the boxes.

    V then decreases at all multiples of the horizon, so that every state arrives: a Lyapunov function of the map over
    the horizon, which for a long one reaches out to the ellipsoid's whole region of attraction.
    """
    goal, gain = effort.funnel.goal, policy.gains[-1]

    def narrow(bracket, key):
        """Of a ladder of radii over the bracket, the last good one and the one above it, and the crossing between."""
        low, high, _ = bracket
        ladder = low * (high / low) ** np.linspace(0, 1, goal.radii)
        directions = sampling.directions(key, goal.directions, problem.plant.n, box.dtype)
        grid = jnp.broadcast_to(ladder, (goal.directions, goal.radii))
        x = goal_set.points(grid[None], directions[:, None, :, None])
        dynamics = effort.dynamics.directions
        ends, inside = rollout.roll_at_goal(problem, candidate, gain, x, dynamics, goal.horizon, goal.step)
        crossing = jnp.min(_crossings(grid, goal_set.level(ends)[0] / grid**2, inside[0], 1.0))
        index = jnp.clip(jnp.searchsorted(ladder, crossing, side="right") - 1, 0, goal.radii - 2)
        return (ladder[index] / BRACKET_OVERLAP, ladder[index + 1], crossing), None

    # Far out the rollouts diverge so steeply that no crossing can be interpolated before the bracket is narrow.
    start = (box * 10**-COARSE_DECADES, box, box)
    (_, _, radius), _ = jax.lax.scan(narrow, start, jax.random.split(key, goal.rounds))
    return (1 - MARGIN) * radius**2


def _scan_rays(radii, ends, inside, last):
    """Levels [N] from the last level and V at the next knots, `ends` [N D J], of the rays' ascending radii [N D J]."""

    def backward(target, knot):
        radii, ends, inside = knot
        # Where no radius of a ray is good: V ~ r^2 from the lowest one, if the boxes at least held there.
        lowest = jnp.where(inside[:, 0], radii[:, 0] * jnp.sqrt(jnp.minimum(target / ends[:, 0], 1.0)), 0.0)
        crossings = _crossings(radii, ends, inside, target)
        level = (1 - MARGIN) * jnp.min(jnp.where(crossings > 0, crossings, lowest)) ** 2
        return level, level

    _, levels = jax.lax.scan(backward, last, (radii, ends, inside), reverse=True)
    return levels


def _crossings(radii, ends, inside, target):
    """Radius [D] below which `ends` <= target and `inside` hold at all radii [D J] of a ray; 0 if at none.

    Interpolated between the last good radius and the first bad one on logarithmic scales, where V ~ r^2 is exact.
    """
    good = jnp.cumprod(inside & (ends <= target), 1).astype(bool)
    count = jnp.sum(good, 1)
    below = jnp.maximum(count - 1, 0)
    above = jnp.minimum(count, radii.shape[1] - 1)

    def take(a, index):
        return jnp.take_along_axis(a, index[:, None], 1)[:, 0]

    r0, v0, r1, v1 = take(radii, below), take(ends, below), take(radii, above), take(ends, above)
    share = jnp.clip(jnp.log(target / v0) / jnp.log(v1 / v0), 0.0, 1.0)
    known = take(inside, above) & jnp.isfinite(v1) & (above > below)
    between = jnp.where(known, r0 * (r1 / r0) ** share, r0)
    return jnp.where(count == 0, 0.0, between)
