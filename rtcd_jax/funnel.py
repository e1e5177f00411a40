"""Policy -> Funnel: levels rho_k such that the closed loop carries B_k into B_{k+1}, found by rollouts.

    rho_k = sup {rho : every sampled x with V_k(x) <= rho stays inside the boxes and ends with V_{k+1} <= rho_{k+1}}

(paper, section II-D.2, by simulation), knot by knot backward from rho_N, which comes from long rollouts under the
goal's LQR or, where the motion ends in a catch set, is that set's own level. At every knot states are rolled out along
rays through the set, on a ladder of radii about the next level's. Few random directions come near the worst one, and
what each knot misses multiplies along the motion: the worst one is climbed to, from where it was at knot k+1. Held-out
samples validate the whole (validation.py). Where every robot of an uncertainty has its own center (centers.py), all
this is for each of its corners, and the smallest radius counts.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from rtcd_jax import rollout
from rtcd_jax.adversary import Opponent, Worst
from rtcd_jax.centers import facing, for_each
from rtcd_jax.numerics import sampling
from rtcd_jax.numerics.batched import solve_lower
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.numerics.loops import packed_scan, short_scan
from rtcd_jax.numerics.sphere import climb
from rtcd_jax.policy import catch_weight
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Funnel, Policy, Status, first_failure
from rtcd_jax.validation import Rollouts, SamplingBudget, validate_intervals, validate_paths
from rtcd_jax.window import window_radius

SMALLEST = 1e-3
"""Radius below which a set counts as empty, over the box's, that at which the last gain saturates, or a catch set's."""

REACH = 1e3
"""Radius up to which sets are looked for, over that at which the goal's LQR saturates: states may have no limits."""

WINDOWS = (2.0, 1.1)
RADII = 3
"""A ray is looked at so often, at so many radii from the one expected over the window to it times that."""

BRACKET_OVERLAP = 1.05
"""Radii at the goal: a round starts below the last one's by this, since its other directions may find less."""

MARGIN = 1e-3
"""Share of every level that is given away for the directions between the sampled ones."""


def estimate_funnel(
    problem: Problem,
    candidate: Candidate,
    policy: Policy,
    key: PRNGKeyArray,
    budget: SamplingBudget,
    samples_per_knot: Int[Array, ""] | int | None = None,
) -> Funnel:
    """The funnel of a policy (guarantee *sampled*); `key` fixes all directions, radii and held-out samples.

    `trials[k]` held-out samples, independent and uniform in the final B_k, were rolled out without a failure: over
    their interval or, with `budget.samples_per_knot`, to the goal. It is zero where the last round had failures.
    `samples_per_knot`, a number or a tracer, stands in for the budget's unless that is 0.
    Status: FUNNEL_EMPTY if some level is below the smallest one that counts; TOO_STIFF where the rollouts' steps are
    unstable for the closed loop, so that nothing can be said.
    """
    keys = jax.random.split(key, 4)
    rollouts = Rollouts.of(problem, candidate, policy, budget.funnel)
    goal_set = rollouts.sets.part(slice(-1, None))
    saturated = saturating_radius(problem.input_limits(candidate.design), policy, goal_set)
    boxes = for_each(rollouts.robots, lambda robot: _clear_radii(problem, rollouts.about(robot).sets))
    boxes = boxes if rollouts.robots is None else jnp.min(boxes, 0)
    boxes = jnp.minimum(boxes, REACH * saturated)
    scales = jnp.minimum(boxes, saturated)
    if not problem.caught:
        last = goal_level(rollouts, boxes[-1], saturated, keys[0], budget)
    else:
        if problem.window is not None:
            boxes = boxes.at[-1].min(window_radius(problem, candidate, goal_set))
        caught = catch_weight(problem, candidate)
        last, scales = jnp.minimum(caught, boxes[-1] ** 2), jnp.minimum(scales, jnp.sqrt(caught))
    offsets = rollouts.offsets()
    if offsets is not None:
        last = jnp.maximum(jnp.sqrt(last) - offsets[-1], 0) ** 2

    levels = knot_levels(rollouts, boxes, last, keys[1], budget)
    levels, samples = validate_intervals(rollouts, levels, keys[2], budget)
    if budget.samples_per_knot:
        levels, samples = validate_paths(rollouts, levels, keys[3], budget, samples_per_knot)
    filled = (levels >= (scales * SMALLEST) ** 2) & (boxes > 0)
    full = jnp.all(filled)
    finite = jnp.all(jnp.isfinite(levels)) & jnp.all(jnp.isfinite(policy.values))
    empty = jnp.where(rollouts.stiffness.too_stiff, Status.TOO_STIFF, Status.FUNNEL_EMPTY)
    status = first_failure(
        policy.status,
        jnp.where(finite, Status.OK, Status.NOT_FINITE),
        jnp.where(full, Status.OK, empty),
    )
    uncertain = budget.dynamics.directions.opponent is not None
    borne = jnp.mean(jnp.cumprod(filled[::-1]).astype(levels.dtype)) if uncertain else None
    return Funnel(policy, levels, samples, status, borne, offsets)


def _clear_radii(problem: Problem, sets: Ellipsoids) -> Float[Array, " knots"]:
    """The largest radii with which the sets are inside the limits on the states and clear of what is kept out."""
    boxes = sets.radii_inside(jnp.asarray(problem.state_limits, sets.centers.dtype))
    for each in problem.keep_out:
        boxes = jnp.minimum(boxes, each.radii_clear(sets))
    return boxes


def knot_levels(
    rollouts: Rollouts,
    boxes: Float[Array, " knots"],
    last: Float[Array, ""],
    key: PRNGKeyArray,
    budget: SamplingBudget,
) -> Float[Array, " knots"]:
    """Levels [N+1] backward from the `last` one."""
    n, dtype, funnel = rollouts.problem.plant.n, boxes.dtype, budget.funnel

    def backward(carry, knot):
        target, shrinkage, adversarial = carry
        index, box, drawn = knot
        expected = jnp.minimum(jnp.sqrt(target) * shrinkage, box)

        def climbed(robot, adversarial):
            opponent = facing(budget.dynamics.directions, robot).opponent
            alone = partial(_Step.at(rollouts.about(robot), index).ends_alone, expected, opponent=opponent)
            return climb(alone, adversarial, funnel.climbs)

        adversarial = for_each(rollouts.robots, climbed, adversarial)

        def look(radius, window):
            """The smallest radius at which a state leaves the boxes or misses the next set, seen from near `radius`."""
            ladder = jnp.minimum(radius * window ** np.linspace(-1, 1, RADII), box)
            radii = jnp.broadcast_to(ladder, (funnel.directions + funnel.climbers, RADII))

            def along(robot, adversarial):
                directions = jnp.concatenate([drawn, adversarial], 1)[..., None]
                step = _Step.at(rollouts.about(robot), index)
                reached, peaks = step.ends(radii, directions, facing(budget.dynamics.directions, robot))
                # Each for itself: between V and a peak that is near one all the way nothing can be interpolated.
                shares = jnp.sum(reached**2, 0) / target, peaks**2
                value, peak = (jnp.where(jnp.isnan(share), jnp.inf, share) for share in shares)
                crossings = jnp.minimum(_crossings(radii, value), _crossings(radii, peak))
                return crossings, jnp.maximum(value, peak)[:, -1]

            crossings, bad = for_each(rollouts.robots, along, adversarial)
            return jnp.min(crossings), bad

        def remembered(robot, adversarial, bad):
            # The worst of the drawn ones replaces the least bad adversarial one: there may be several maxima.
            newcomer = _worst(drawn, bad[: funnel.directions], 1)
            survivors = _worst(adversarial, bad[funnel.directions :], funnel.climbers - 1)
            return jnp.concatenate([newcomer, survivors], 1)

        radius, bad = short_scan(look, jnp.sqrt(target), jnp.asarray(WINDOWS, dtype))
        level = (1 - MARGIN) * radius**2
        adversarial = for_each(rollouts.robots, remembered, adversarial, bad[-1])
        return (level, jnp.sqrt(level / target), adversarial), level

    keys = jax.random.split(key, boxes.shape[0])
    climbers = sampling.directions(keys[-1], funnel.climbers, n, dtype)
    if rollouts.robots is not None:
        climbers = jnp.broadcast_to(climbers, (rollouts.robots.centers.shape[0], *climbers.shape))
    start = last, jnp.ones((), dtype), climbers
    drawn = jax.vmap(lambda key: sampling.directions(key, funnel.directions, n, dtype))(keys[:-1])
    knots = jnp.arange(boxes.shape[0] - 1), boxes[:-1], drawn
    _, levels = packed_scan(backward, start, knots, reverse=True)
    return jnp.append(levels, last)


def _worst(directions, bad, count: int):
    """Those `count` of the directions [n D] that are worst."""
    return directions[:, jnp.argsort(-bad)[:count]]


class _Step(NamedTuple):
    """One interval: the sets at both its ends, and what carries a state from one to the other."""

    rollouts: Rollouts
    here: Ellipsoids
    there: Ellipsoids
    tracking: rollout.TrackingData

    @classmethod
    def at(cls, rollouts: Rollouts, index) -> "_Step":
        one = index + np.arange(1)
        return cls(rollouts, rollouts.sets.part(one), rollouts.sets.part(one + 1), rollouts.tracking.part(one))

    def ends(self, radii, y, dynamics):
        """Ends [n ...] of the states `radii` times `y` [n ...], as points of the next set's ball, and peaks [...]."""
        shape = jnp.broadcast_shapes(jnp.shape(radii), y.shape[1:])
        x = self.here.points(jnp.broadcast_to(radii, shape)[None], y[:, None])
        ends, peaks = self.rollouts.roll(self.tracking, x, dynamics)
        return self.there.to_ball(ends)[:, 0], peaks[0]

    def ends_alone(self, radii, y, opponent: Opponent | None):
        """The ends under the plant's own equations."""
        return self.ends(radii, y, rollout.closed_form(self.rollouts.problem.plant, opponent))[0]


def saturating_radius(
    limits: Float[Array | np.ndarray, " m"], policy: Policy, goal_set: Ellipsoids
) -> Float[Array, ""]:
    """The radius of the goal's set at which an input of the goal's LQR reaches one of the `limits`."""
    rows = solve_lower(goal_set.factors, policy.gains[-1].T[..., None])  # u = -K L'^-1 y
    largest = jnp.sqrt(jnp.sum(rows**2, 0))[:, 0]
    return jnp.min(jnp.asarray(limits, largest.dtype) / largest)


def goal_level(
    rollouts: Rollouts,
    box: Float[Array, ""],
    saturated: Float[Array, ""],
    key: PRNGKeyArray,
    budget: SamplingBudget,
) -> Float[Array, ""]:
    """rho_N: V decreases over `horizon` from every sampled state below it, inside the boxes.

    V then decreases at all multiples of the horizon, so that every state arrives: a Lyapunov function of the map over
    the horizon, which for a long one reaches out to the ellipsoid's whole region of attraction.
    """
    goal, dynamics = rollouts.goal, budget.dynamics.directions
    goal_set = rollouts.sets.part(slice(-1, None))

    def growth(radii, key):
        """The `radii` along directions [D J], and what becomes of V and the boxes there: bad if > 1."""
        directions = sampling.directions(key, goal.directions, rollouts.problem.plant.n, box.dtype)
        grid = jnp.broadcast_to(radii, (goal.directions, len(radii)))
        x = goal_set.points(grid[None], directions[:, None, :, None])

        def growing(robot):
            ends, peaks = rollouts.at_goal(x, facing(dynamics, robot))
            return jnp.maximum(goal_set.level(ends) / grid**2, peaks**2)[0]

        bad = for_each(rollouts.robots, growing)
        return grid, bad if rollouts.robots is None else jnp.max(bad, 0)

    def narrow(bracket, turn):
        """Of a ladder of radii over the bracket, the last good one and the one above it, and the crossing between."""
        (low, high, _), (key, first) = bracket, turn
        ladder = low * (high / low) ** np.linspace(0, 1, goal.radii)
        if dynamics.opponent is not None:
            ladder = jnp.minimum(ladder, high)  # the highest may be the only good one, and the box just there
        grid, bad = growth(ladder, key)
        if dynamics.opponent is not None:
            # Below the first radius from which V falls lies what the disturbance keeps away from the goal.
            good = bad <= 1
            bad = jnp.where((jnp.cumsum(good, 1) > 0) | ~jnp.any(good, 1, keepdims=True), bad, 0.5)
        crossing = jnp.min(_crossings(grid, bad))
        index = jnp.clip(jnp.searchsorted(ladder, crossing, side="right") - 1, 0, goal.radii - 2)
        low, high = ladder[index] / BRACKET_OVERLAP, ladder[index + 1]
        if dynamics.opponent is None:
            # A region far smaller than the box lies below the first ladder; under a disturbance none does.
            deeper = first & (crossing < ladder[0]) & (smallest < ladder[0])
            low, high = jnp.where(deeper, smallest, low), jnp.where(deeper, ladder[0], high)
        return (low, high, crossing), None

    smallest = jnp.minimum(box, saturated) * SMALLEST
    # Far out the rollouts diverge so steeply that no crossing can be interpolated before the bracket is narrow.
    start = (box * SMALLEST, box, box)
    rounds = jax.random.split(key, goal.rounds), np.arange(goal.rounds) == 0
    (_, _, radius), _ = jax.lax.scan(narrow, start, rounds)
    if isinstance(dynamics.opponent, Worst):
        # The residual set must be one: from its rim, and from there outward, V falls.
        residual = dynamics.opponent.uncertainty.residual
        ladder = radius * residual ** np.linspace(1, 0, goal.radii)[:-1]
        _, bad = growth(ladder, jax.random.fold_in(key, goal.rounds))
        radius = jnp.where(jnp.all(bad <= 1), radius, 0.0)
    return (1 - MARGIN) * radius**2


def _crossings(radii, bad):
    """Radius [D] below which `bad` <= 1 at all ascending radii [D J] of a ray.

    Interpolated between the last good radius and the first bad one on logarithmic scales, where V ~ r^2 is exact; where
    no radius is good, continued from the lowest one in the same way.
    """
    good = jnp.cumprod(bad <= 1, 1).astype(bool)
    count = jnp.sum(good, 1)
    below = jnp.maximum(count - 1, 0)
    above = jnp.minimum(count, radii.shape[1] - 1)

    def take(a, index):
        return jnp.take_along_axis(a, index[:, None], 1)[:, 0]

    r0, v0, r1, v1 = take(radii, below), take(bad, below), take(radii, above), take(bad, above)
    share = jnp.clip(-jnp.log(v0) / jnp.log(v1 / v0), 0.0, 1.0)
    between = jnp.where(jnp.isfinite(v1) & (r1 > r0), r0 * (r1 / r0) ** share, r0)
    lowest = jnp.where(jnp.isfinite(v0), r0 / jnp.sqrt(v0), 0.0)
    return jnp.where(count == 0, lowest, between)
