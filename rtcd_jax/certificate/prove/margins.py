"""The largest impulse that a funnel survives, and how fast its feedback may change, by the checker's bounds."""

from collections.abc import Sequence

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, Interval, Q
from rtcd_jax.certificate.prove.backward import TIERS, TIME_ORDER, on_grid
from rtcd_jax.certificate.prove.closed_loop import Loop
from rtcd_jax.certificate.prove.levels import leveled, unit_directions
from rtcd_jax.elite.elite import Elite

BISECTIONS = 14
"""Of the push margin."""
SPEED_CLEARANCE = 1.05
"""By which the claimed speed exceeds that of the sampled levels."""


def push_margin(claim: Claim, intervals: Sequence[Interval]) -> float:
    """The largest impulse J [input s] with which a state on x* stays in every interval's funnel, by bisection."""
    clearances = [check.push_clearance(claim, interval, "push") for interval in intervals]
    box = check.cube(claim)

    def holds(push: float) -> bool:
        return all(check.is_positive(clearance(Q(*push.as_integer_ratio())), box) for clearance in clearances)

    low, high = 0.0, 1.0
    while holds(high):
        low, high = high, 2 * high
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def feedback_speed(claim: Claim, elite: Elite) -> float:
    """How fast K (x - x*) may change [input/s], in ellipsoids of the levels that samples allow without delay.

    Raises:
        Refused: there are no such levels.
    """
    claim = claim._replace(age=Q(0))
    loop = leveled(Loop(claim, elite), unit_directions(claim.n))
    orders, zero = (TIME_ORDER, TIERS[claim.n][0][0]), np.zeros((claim.n, claim.n))
    speeds = []
    for k in range(len(claim.u)):
        first, last = (on_grid(loop.axes(k, end, 1.0, 0.0)[0]) for end in (0.0, 1.0))
        bend = [on_grid(zero), on_grid(zero)]
        speeds.append(check.funnel_speed(claim, Interval(k, Q(0), Q(1), first, last, bend, orders, {}), "speed"))
    goal = on_grid(loop.axes(len(claim.u) - 1, 1.0, 1.0, 0.0)[0])
    speeds.append(check.goal_speed(claim, goal, TIERS[claim.n][0][0], "speed"))
    return SPEED_CLEARANCE * float(max(speeds))
