"""The largest impulse that a funnel survives, what of it all robots share, and how its feedback may change, by the
checker's bounds.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, Interval, Q
from rtcd_jax.certificate.check.matrix import dot
from rtcd_jax.certificate.prove.backward import degrees_of, moving, tiers_of
from rtcd_jax.certificate.prove.closed_loop import Loop, doubles, on_grid
from rtcd_jax.certificate.prove.levels import leveled, unit_directions
from rtcd_jax.elite.elite import Elite

BISECTIONS = 14
"""Of the push margin."""
BISECTIONS_OF_OFFSET = 8
SPEED_CLEARANCE = 1.05
"""By which the claimed speed exceeds that of the sampled levels."""


def push_margin(claim: Claim, intervals: Sequence[Interval]) -> float:
    """The largest impulse J [input s] with which a state on x* stays in every interval's funnel, by bisection."""
    clearances = [check.push_clearance(claim, interval, "push") for interval in intervals]

    def holds(push: float) -> bool:
        return all(check.is_positive(clearance(check.rational(push)), claim.cube) for clearance in clearances)

    low, high = 0.0, 1.0
    while holds(high):
        low, high = high, 2 * high
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def center_offset(claim: Claim, interval: Interval) -> float:
    """A bound of |L^-1 (c_p - x*)| on an interval, of all robots, by bisection; 1 where it is not less."""
    data = check.motion(claim, interval)
    adjugate, determinant = check.cofactors(data.axes)
    moved = [dot(row, data.shift) for row in adjugate]
    needed = dot(moved, moved)

    def holds(offset: float) -> bool:
        return check.is_positive(determinant * determinant * check.rational(offset) ** 2 - needed, claim.cube)

    low, high = 0.0, 1.0
    for _ in range(BISECTIONS_OF_OFFSET if holds(high) else 0):
        middle = (low + high) / 2
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


class Delay(NamedTuple):
    """What a claim says of old measurements: bounds of the feedback's rates; beside it the misfit of each interval and
    of the goal [input/s], which the search for levels counts with.
    """

    speed: float
    jerk: float
    reaction: float
    jumps: list[float]
    misfits: list[float]
    misfit_at_goal: float

    def record(self) -> dict[str, Any]:
        """As a claim has it."""
        numbers = {"speed": self.speed, "jerk": self.jerk, "reaction": self.reaction, "jumps": self.jumps}
        return {name: doubles(value) for name, value in numbers.items()}


def feedback_delay(claim: Claim, elite: Elite) -> Delay:
    """How fast K (x - x*) and its rate may change, in ellipsoids of the levels that samples allow without delay.

    Raises:
        Refused: there are no such levels.
    """
    loop = leveled(Loop(claim._replace(age=Q(0), jerk=None), elite), unit_directions(claim.n))
    tier = tiers_of(claim.n, moving(claim))[0]
    orders, zero = tier.orders(claim, degrees_of(claim)[0]), np.zeros((claim.n, claim.n))
    bend = [on_grid(zero), on_grid(zero)]
    intervals = []
    for k in range(len(claim.u)):
        first, last = (on_grid(loop.axes(k, end, 1.0, 0.0)[0]) for end in (0.0, 1.0))
        intervals.append(Interval(k, Q(0), Q(1), first, last, bend, orders, {}, loop.late_rows(k, 0.0, 1.0)))
    axes, order = on_grid(loop.axes(len(claim.u) - 1, 1.0, 1.0, 0.0)[0]), tier.order
    speeds = [check.funnel_speed(claim, interval, "speed") for interval in intervals]
    speed = SPEED_CLEARANCE * float(max(*speeds, check.goal_speed(claim, axes, order, "speed")))
    claim = claim._replace(speed=check.rational(speed))
    bounds = [check.funnel_delay(claim, interval, "delay") for interval in intervals]
    bounds.append(check.goal_delay(claim, axes, order, "delay", loop.goal_late_row()))
    jerk, reaction = (SPEED_CLEARANCE * float(max(each)) for each in list(zip(*bounds, strict=True))[:2])
    claim = claim._replace(reaction=check.rational(reaction))
    jumps = [0.0] + [SPEED_CLEARANCE * float(check.funnel_jump(claim, each, "jump")) for each in intervals[1:]]
    *misfits, at_goal = (float(each.misfit) for each in bounds)
    return Delay(speed, jerk, reaction, jumps, misfits, at_goal)
