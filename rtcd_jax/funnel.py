"""Policy -> Funnel: levels rho_k such that the closed loop carries B_k into B_{k+1}, found by rollouts.

    rho_k = sup {rho : every sampled x with V_k(x) <= rho stays inside the boxes and ends with V_{k+1} <= rho_{k+1}}

(paper, section II-D.2, by simulation). Where a state ends after one interval does not depend on any level: all knots and
samples are rolled out at once, and one cheap backward scan then sets every level. Two such passes, a coarse one over
the whole box and a fine one about its result, are followed by fresh independent states, uniform in each ellipsoid; a
failure among them shrinks and repeats. rho_N is the region of attraction of the goal's LQR, by long rollouts.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtcd_jax import rollout
from rtcd_jax.config import FunnelConfig
from rtcd_jax.numerics import ellipsoid, sampling
from rtcd_jax.numerics.batched import cholesky, mv, solve_lower
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Funnel, Policy, Status, first_failure

COARSE_DIRECTIONS = 16
COARSE_DECADES = 3.0
"""The first pass looks at radii from the box's down to a thousandth of it: a millionth of its level."""

FINE_WINDOW = (0.7, 1.3)
"""Radii of the second pass over those that the first one found."""

NEAR_GOAL = 0.05
"""A state has arrived at the goal at this share of the largest level without saturation and inside the boxes."""

SAFETY = 0.99
"""Level over that of the lowest fresh state that failed."""


class Dynamics(NamedTuple):
    """Whose physics the directions, the long rollouts at the goal and the fresh states feel."""

    directions: rollout.Dynamics
    goal: rollout.Dynamics
    fresh: rollout.Dynamics
    share: rollout.Dynamics | None = None  # of a share of the fresh states


class _Knots(NamedTuple):
    """The candidate's ellipsoids: knots on the last axis."""

    centers: Float[Array, "n K"]
    values: Float[Array, "n n K"]
    factors: Float[Array, "n n K"]
    radii: Float[Array, " K"]  # of the largest ellipsoid inside the boxes, |L'(x - x*)|

    def points(self, radii, y):
        """x [n K ...] at `radii` [K ...] times y [n ...] or [n K ...] of the unit ball."""
        y = jnp.broadcast_to(y, (y.shape[0], *radii.shape))
        factors = self.factors.reshape(*self.factors.shape, *(1,) * (radii.ndim - 1))
        centers = self.centers.reshape(*self.centers.shape, *(1,) * (radii.ndim - 1))
        return centers + ellipsoid.from_ball(factors, radii * y)

    def level(self, x):
        """V_k(x) [K ...] of x [n K ...]."""
        behind = (1,) * (x.ndim - 2)
        error = x - self.centers.reshape(*self.centers.shape, *behind)
        return jnp.sum(error * mv(self.values.reshape(*self.values.shape, *behind), error), 0)

    def part(self, which: slice) -> "_Knots":
        return _Knots(*(leaf[..., which] for leaf in self))


def estimate_funnel(
    problem: Problem, candidate: Candidate, policy: Policy, key, settings: FunnelConfig, dynamics: Dynamics, rounds: int
) -> Funnel:
    """The funnel of a policy (*sampled* rung); `key` fixes all directions, radii and fresh states.

    `trials[k]` fresh states, independent and uniform in the final B_k, were rolled out over their interval without a
    failure in the last of at most `rounds` passes; it is zero where that pass still had to shrink the level. Status:
    FUNNEL_EMPTY if some level is below the smallest sampled one.
    """
    keys = jax.random.split(key, 4)
    knots = _knots(problem, policy)
    last, goal_found = _goal_level(problem, candidate, policy, knots, keys[0], settings, dynamics.goal)
    tracked = rollout.reference(problem, candidate, policy, settings.steps)
    dtype = knots.centers.dtype

    def pass_over(radii, directions):
        """Levels from the rays through `directions` [n D] with ascending `radii` [N J]."""
        grid = jnp.broadcast_to(radii[:, None, :], (radii.shape[0], directions.shape[1], radii.shape[1]))
        x = knots.part(slice(0, -1)).points(grid, directions[:, None, :, None])
        ends, inside = rollout.roll_intervals(problem, candidate, tracked, x, dynamics.directions)
        return _scan_rays(grid, knots.part(slice(1, None)).level(ends), inside, last)

    n = problem.plant.n
    boxes = knots.radii[:-1]
    coarse = np.logspace(-COARSE_DECADES, 0, settings.radii)
    found = pass_over(boxes[:, None] * coarse, sampling.directions(keys[1], COARSE_DIRECTIONS, n, dtype))
    window = np.geomspace(*FINE_WINDOW, 4)
    fine = jnp.minimum(jnp.sqrt(found)[:, None] * window, boxes[:, None])
    levels = pass_over(fine, sampling.directions(keys[2], settings.directions, n, dtype))
    levels = jnp.concatenate([levels, last[None]])

    confirmed = _confirm(problem, candidate, knots, tracked, levels, keys[3], settings, dynamics, rounds)
    smallest = (knots.radii * 10**-COARSE_DECADES) ** 2
    full = goal_found & jnp.all(confirmed.levels >= smallest)
    finite = jnp.all(jnp.isfinite(confirmed.levels)) & jnp.all(jnp.isfinite(policy.values))
    status = first_failure(
        policy.status,
        jnp.where(finite, Status.OK, Status.NOT_FINITE),
        jnp.where(full, Status.OK, Status.FUNNEL_EMPTY),
    )
    return Funnel(policy, confirmed.levels, confirmed.trials, status)


def _knots(problem: Problem, policy: Policy) -> _Knots:
    values = jnp.moveaxis(policy.values, 0, -1)
    factors, _ = cholesky(values)
    centers = policy.trajectory.xs.T
    room = jnp.asarray(problem.state_limits, centers.dtype)[:, None] - jnp.abs(centers)
    radii = jnp.min(room / ellipsoid.half_widths(factors), 0)
    return _Knots(centers, values, factors, jnp.maximum(radii, 0.0))


def _scan_rays(radii, ends, inside, last):
    """Levels [N] from radii [N D J] ascending in J, the next knot's V there, and the last level.

    Along each ray the level is where V at the interval's end reaches the next level: interpolated between the last
    good radius and the first bad one, on logarithmic scales, where V ~ r^2 is exact.
    """

    def backward(target, knot):
        radii, ends, inside = knot
        good = inside & (ends <= target)
        held = jnp.cumprod(good, 1).astype(bool)
        count = jnp.sum(held, 1)
        take = lambda a, index: jnp.take_along_axis(a, index[:, None], 1)[:, 0]  # noqa: E731
        below = jnp.maximum(count - 1, 0)
        above = jnp.minimum(count, radii.shape[1] - 1)
        r0, v0 = take(radii, below), take(ends, below)
        r1, v1 = take(radii, above), take(ends, above)
        share = jnp.log(target / v0) / jnp.log(v1 / v0)
        crossing = r0 * (r1 / r0) ** jnp.clip(share, 0.0, 1.0)
        crossing = jnp.where(take(inside, above) & (above > below), crossing, r0)
        # No radius of this ray is good: V ~ r^2 from the lowest one, if the boxes at least held there.
        scaled = jnp.where(inside[:, 0], radii[:, 0] * jnp.sqrt(jnp.minimum(target / ends[:, 0], 1.0)), 0.0)
        level = jnp.min(jnp.where(count == 0, scaled, crossing)) ** 2
        return level, level

    _, levels = jax.lax.scan(backward, last, (radii, ends, inside), reverse=True)
    return levels


class _Confirmed(NamedTuple):
    levels: Float[Array, " K"]
    trials: Int[Array, " K"]
    clean: Bool[Array, ""]
    round: Int[Array, ""]


def _confirm(problem, candidate, knots, tracked, levels, key, settings, dynamics, rounds) -> _Confirmed:
    """Fresh states, uniform in each ellipsoid, until a whole pass has no failure."""
    dtype = levels.dtype
    shape = (problem.intervals, settings.trials)
    starts, nexts = knots.part(slice(0, -1)), knots.part(slice(1, None))

    def one_pass(state: _Confirmed) -> _Confirmed:
        y = sampling.ball(jax.random.fold_in(key, state.round), shape, problem.plant.n, dtype)
        radii = jnp.broadcast_to(jnp.sqrt(state.levels[:-1])[:, None], shape)
        x = starts.points(radii, y)
        ends, inside = rollout.roll_intervals(problem, candidate, tracked, x, dynamics.fresh)
        if dynamics.share is not None:
            ends, inside = _reroll(problem, candidate, tracked, x, ends, inside, key, state.round, settings, dynamics)
        levels, failures = _shrink(state.levels, starts.level(x), nexts.level(ends), inside)
        trials = jnp.where(failures == 0, settings.trials, 0)
        # What holds at the goal is found by long rollouts, not by trials over one interval.
        return _Confirmed(levels, jnp.append(trials, 0).astype(jnp.int32), jnp.sum(failures) == 0, state.round + 1)

    state = _Confirmed(levels, jnp.zeros(levels.shape, jnp.int32), jnp.asarray(False), jnp.asarray(0))
    return jax.lax.while_loop(lambda state: ~state.clean & (state.round < rounds), one_pass, state)


def _shrink(levels, starts, ends, inside):
    """Backward over the knots: below the lowest fresh state that failed, and how many did [N]."""

    def backward(target, knot):
        level, starts, ends, inside = knot
        failed = ~(inside & (ends <= target)) & (starts <= level)
        lowest = jnp.min(jnp.where(failed, starts, jnp.inf))
        shrunk = jnp.minimum(level, SAFETY * lowest)
        return shrunk, (shrunk, jnp.sum(failed))

    _, (shrunk, failures) = jax.lax.scan(backward, levels[-1], (levels[:-1], starts, ends, inside), reverse=True)
    return jnp.append(shrunk, levels[-1]), failures


def _reroll(problem, candidate, tracked, x, ends, inside, key, round_, settings, dynamics):
    """Replace a random share of the fresh rollouts by those of the other dynamics; the same ones for all candidates.

    The states of one knot are exchangeable, so that the first ones of randomly chosen knots are as good as any.
    """
    count = x.shape[1]
    per_knot = settings.mjx_share * settings.trials
    width = max(1, round(per_knot))
    chosen = max(1, round(count * min(1.0, per_knot / width)))
    which = jax.random.permutation(jax.random.fold_in(key, 1_000_000 + round_), count)[:chosen]
    part = tracked._replace(
        states=tracked.states[..., which], gains=tracked.gains[..., which], inputs=tracked.inputs[..., which]
    )
    new_ends, new_inside = rollout.roll_intervals(problem, candidate, part, x[:, which, :width], dynamics.share)
    return ends.at[:, which, :width].set(new_ends), inside.at[which, :width].set(new_inside)


def _goal_level(problem, candidate, policy, knots: _Knots, key, settings: FunnelConfig, dynamics):
    """rho_N: below the smallest radius from which a long rollout under the goal's LQR does not arrive.

    Radii between the largest good and the smallest bad one are refined in rounds, from the whole box down. Returns
    the level and whether any radius was good.
    """
    goal, gain, value = settings.goal, policy.gains[-1], policy.values[-1]
    end = knots.part(slice(-1, None))
    box = end.radii[0]
    steepness = jnp.sqrt(jnp.sum(solve_lower(end.factors[..., 0], gain.T) ** 2, 0))  # of K x on the unit ellipsoid
    unsaturated = jnp.min(jnp.asarray(problem.input_limits, box.dtype) / steepness)
    near = NEAR_GOAL * jnp.minimum(box, unsaturated) ** 2
    smallest = box * 10**-COARSE_DECADES
    shares = np.arange(1, goal.radii + 1) / (goal.radii + 1)

    def refine(bracket, key):
        low, high = bracket
        y = sampling.directions(key, goal.directions, problem.plant.n, box.dtype)
        radii = low * (high / low) ** shares
        grid = jnp.broadcast_to(radii, (1, goal.directions, goal.radii))
        x = end.points(grid, y[:, None, :, None])[:, 0]
        result = rollout.roll_to_goal(problem, candidate, gain, value, near, x, dynamics, goal.horizon, goal.step)
        good = jnp.cumprod(jnp.all(result.arrived, 0))
        ladder = jnp.concatenate([low[None], radii, high[None]])
        count = jnp.sum(good)
        return (ladder[count], ladder[count + 1]), None

    (low, _), _ = jax.lax.scan(refine, (smallest, box), jax.random.split(key, goal.rounds))
    return low**2, low > smallest
