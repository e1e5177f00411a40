"""The goal region: the largest level of V about the goal that can be proved under its saturated LQR, for all time."""

from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, Refused, Shell
from rtcd_jax.certificate.prove.backward import Effort, Tier, prove
from rtcd_jax.certificate.prove.closed_loop import Loop
from rtcd_jax.certificate.prove.field import floats
from rtcd_jax.certificate.prove.levels import goal_level, unit_directions
from rtcd_jax.certificate.prove.sdp import SOLVER

LEVEL_FRACTIONS = (1.0, 0.995, 0.985, 0.97, 0.95, 0.92, 0.88, 0.83, 0.77, 0.7, 0.6, 0.5, 0.35, 0.2, 0.1)
"""Fractions of the level that the samples allow, in the order of trial."""
OUTLET_CLEARANCE = 1e-3
"""Fraction of the level by which the funnel's outlet is smaller than the goal region."""
TIERS = {2: (Tier(10, 9, 5),), 4: (Tier(6, 5, 3), Tier(12, 11, 3, True))}
"""By the number of states: in the place of the order in s, the degree of the Bernstein polynomials in l."""
ENOUGH = 0.1
"""Margin [1/s] of a case beyond which it needs no further monomials."""
SMALL_ERROR = 0.1
"""Error [1/s] of the models up to which richer ones do not help."""
NARROWEST = 1 / 64
"""Narrowest shell of levels."""


class GoalRegion(NamedTuple):
    """{V <= rho} as proved, shell by shell from |y| = `rest` on; the funnel's outlet has the level `outlet`.

    `off` is the largest |y| of a center at t_N.
    """

    rho: float
    outlet: float
    off: float
    axes: list
    order: int
    rest: float
    shells: list[Shell]
    margin: float
    late: list
    sides: list


def goal_region(
    claim: Claim, loop: Loop, exact: bool, rest: float = 0.0, solver: str = SOLVER, pool: Executor | None = None
) -> GoalRegion | None:
    """The region of the first level that can be proved; None if none can.

    Where something moves the goal, motions may stay below |y| = `rest`; the least such |y| is looked for.
    """
    directions = unit_directions(claim.n)
    try:
        most = goal_level(loop, directions)
    except Refused:
        return None
    for fraction in LEVEL_FRACTIONS:
        for tier in TIERS[claim.n]:
            region, error = _at_level(claim, loop, fraction * most, tier, exact, directions, rest, solver, pool)
            if region is not None:
                return region
            if error <= SMALL_ERROR:
                break
    return None


def _at_level(
    claim: Claim,
    loop: Loop,
    rho: float,
    tier: Tier,
    exact: bool,
    directions: np.ndarray,
    most_rest: float,
    solver: str,
    pool: Executor | None,
) -> tuple[GoalRegion | None, float]:
    """The region of a level, and the error [1/s] of its models."""
    axes = loop.outlet_axes(rho)
    waiting, shells, least, rest, error = [(0.0, 1.0)], [], np.inf, 0.0, np.inf
    try:
        late = loop.goal_late_row() if claim.first_order else []
        field = check.goal_field(claim, axes, tier.order, "goal", late)
        while waiting:  # from the outside in
            start, end = waiting.pop()
            ends = check.rational(start), check.rational(end)
            proof = None
            if start or not claim.moves_the_goal:
                todo = check.goal_obligations(claim, field, *ends)
                error = max(float(each.error) for each in todo.values())
                shapes = tier.shapes(todo, claim, tier.degree, tier.time_order)
                proof = prove(todo, shapes, ENOUGH, exact, Effort(directions, solver), pool)
            if proof is not None:
                shells.append(Shell(*ends, proof[0]))
                least = min(least, proof[1])
            elif end - start > NARROWEST:
                middle = (start + end) / 2
                waiting += [(start, middle), (middle, end)]
            elif claim.moves_the_goal and end <= most_rest:
                rest = end
                break
            else:
                return None, error
    except Refused:
        return None, error
    off = largest_offset(claim, axes, claim.x_goal) if claim.shifts else 0.0
    if off >= 1:
        return None, error
    outlet, sides = (1 - off) ** 2 * (1 - OUTLET_CLEARANCE) * rho, loop.goal_sides()
    return GoalRegion(rho, outlet, off, axes, tier.order, rest, shells[::-1], least, late, sides), error


def largest_offset(claim: Claim, axes: list, center: list) -> float:
    """The largest |y| of a funnel's center at t_N in the ellipsoid {center + axes y}."""
    centers = floats(check.last_centers(claim)) - floats(center)
    return float(np.max(np.linalg.norm(np.linalg.solve(floats(axes), centers.T), axis=0)))
