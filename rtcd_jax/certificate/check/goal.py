"""The obligations of the goal region, level by level, and of the funnel's end inside it."""

import itertools
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.delay import Bounds as DelayBounds
from rtcd_jax.certificate.check.delay import delay_bounds, lateness, require_delay, scaled_along
from rtcd_jax.certificate.check.exact import MAX_ORDER, PI, PI_ERROR, Q, require, rounded
from rtcd_jax.certificate.check.funnel import (
    Field,
    angle_of,
    field_of,
    for_all_robots,
    pushed,
    pushes,
    require_speed,
    speed_of,
)
from rtcd_jax.certificate.check.matrix import cofactors, dot
from rtcd_jax.certificate.check.saturation import Feedback, are_joined, cases_of, error_under
from rtcd_jax.certificate.check.squares import Obligation, Squares, basis_change, is_positive_definite
from rtcd_jax.certificate.check.taylor import Taylor, terms_of

MOST_TURNS = 10**6
"""Largest angle [rad] of a goal."""


class Shell(NamedTuple):
    """The part of the goal region with |y| between two levels."""

    start: Any
    end: Any
    cases: dict[str, Squares]


class GoalField(NamedTuple):
    """2 y' adj(L) a / l and 2 y' adj(L) b / l as Taylor models in (l, z) after y = l z, K L, and the input's error.

    `older` is the feedback of the oldest measurement as a row, where these count to first order.
    """

    free: Taylor
    forced: Taylor
    gain: list
    late: Any
    older: list | None


def goal_field(claim: Claim, axes: list, y_order: int, place: str, row: list) -> GoalField:
    """The goal region's, which is {x_g + axes y : |y| <= 1}; `row` is rho of delay.py, if it is needed."""
    adjugate, determinant = cofactors(axes)
    require(determinant > 0, place, "the ellipsoid is degenerate: det L must be > 0")
    if claim.age != 0:
        require_speed(claim, goal_speed(claim, axes, y_order, place), place)
    field = _field_at_goal(claim, axes, y_order, place)
    z = [field.d.space.y(i) for i in range(claim.n)]
    still = all(any(e[: claim.n + 1]) for f in field.a for e, _ in terms_of(f.p))
    require(still, place, "the goal is no equilibrium")
    push = pushes(field, [dot(z, column) for column in zip(*adjugate, strict=True)], determinant, place)
    gain = [dot(claim.K_goal, column) for column in zip(*axes, strict=True)]
    late, older = error_under(claim, [claim.K_goal]), None
    if claim.first_order:
        bounds = goal_delay(claim, axes, y_order, place, row)
        require_delay(claim, bounds, place)
        late = lateness(claim, late, bounds.misfit, Q(0))
        older = [g - claim.age * dot(row, column) for g, column in zip(gain, zip(*axes, strict=True), strict=True)]
    return GoalField(pushed(push, field.a), pushed(push, field.b), gain, late, older)


def goal_delay(claim: Claim, axes: list, y_order: int, place: str, row: list) -> DelayBounds:
    """The bounds of delay.py in the goal region."""
    field = _field_at_goal(claim, axes, y_order, place)
    space = field.d.space
    error = [Taylor(space, (x.p - space.poly(c))) for x, c in zip(field.x, claim.x_goal, strict=True)]
    gain, rates, still = ([space.enclose(each) for each in row_] for row_ in (claim.K_goal, row, [Q(0)] * claim.n))
    here = scaled_along(field, error, gain, still, still, still, Q(0))
    return delay_bounds(claim, here, error_under(claim, [claim.K_goal]), rates, place)


def _field_at_goal(claim: Claim, axes: list, y_order: int, place: str) -> Field:
    """In (l, z)."""
    space = claim.space(MAX_ORDER, y_order)
    z = [space.y(i) for i in range(claim.n)]
    x = [Taylor(space, space.poly(c) + dot(z, row) * space.s) for c, row in zip(claim.x_goal, axes, strict=True)]
    return field_of(claim, x, waves_at_goal(claim, place), place)


def goal_speed(claim: Claim, axes: list, y_order: int, place: str) -> Any:
    """An upper bound of |K x'| in the goal region."""
    field = _field_at_goal(claim, axes, y_order, place)
    return speed_of(claim, field, [field.d.space.enclose(gain) for gain in claim.K_goal], field.a, place)


def waves_at_goal(claim: Claim, place: str) -> dict[tuple[int, ...], tuple[Any, tuple]]:
    """For `field_of`: angles at the goal are multiples of pi, rounded to doubles."""
    values = {}
    for k in claim.equations.waves:
        center = angle_of(k, claim.x_goal)
        turns = round(rounded(center) / math.pi) if abs(center) < MOST_TURNS else 0
        off = abs(center - PI * turns) + PI_ERROR * abs(turns)
        require(off < Q(1, 10**9), place, "the goal's angle is no multiple of pi")
        values[k] = center, (Q(0), Q(-1 if turns % 2 else 1), off / 3)
    return values


def goal_obligations(claim: Claim, field: GoalField, low, high, proved: Iterable[str] = ()) -> dict[str, Obligation]:
    """As `funnel_obligations`, in l on [low, high]: q / l where u is saturated or the goal is moved, else q / l^2.

    `proved` are the names of the cases that a file has.
    """
    free, forced, gain, late, older = field
    space = free.space

    def by_level(row: list) -> Any:
        return dot([space.y(j) for j in range(claim.n)], row) * Q(-1)

    def asked(row: list) -> Feedback:
        return Feedback(by_level(row) * space.s, space.s * space.s * dot(row, row), space.poly(0))

    oldest = None if older is None else asked(older)
    linear, obligations = by_level(gain), {}
    cases = cases_of(space, claim, late, Q(0), asked(gain), low, high, oldest, are_joined(proved))
    for name, case in cases.items():
        if case.saturated or claim.moves_the_goal:
            held = free + forced * Taylor(space, case.input)
            p, error, drift = held.p * Q(-1), held.r * high + held.d, Q(0)
        else:
            lowered = space.polynomial({(e[0] - 1, *e[1:]): c for e, c in terms_of(free.p)})
            held = forced * Taylor(space, linear)
            p, error, drift = (lowered + held.p) * Q(-1), free.r + held.r + held.d, free.d
        obligations |= for_all_robots(name, case, p, error, drift, (low, high), claim)
    return obligations


def require_arrival(claim: Claim, outlet: list, axes: list, weight, place: str) -> None:
    """E(t_N) in G: |adj(L_g) (c - x_g + L_N y)| < det L_g for |y| <= 1, by the S-lemma with the given weight.

    The centers c for which that holds are convex: it is enough to look at the control points of c_p over the robots.
    """
    adjugate, determinant = cofactors(axes)
    for center in last_centers(claim):
        offset = [a - b for a, b in zip(center, claim.x_goal, strict=True)]
        columns = [[dot(row, column) for row in adjugate] for column in (*zip(*outlet, strict=True), offset)]
        form = [[-dot(p, q) for q in columns] for p in columns]
        for i in range(claim.n):
            form[i][i] += weight
        form[-1][-1] += determinant * determinant - weight
        require(is_positive_definite(form), place, "the funnel's outlet is not shown to lie in the goal region")


def last_centers(claim: Claim) -> list[list]:
    """The Bernstein control points of c_p(t_N) over the robots."""
    degrees = [max(each) for each in zip(*(shift.powers for shift in claim.shifts), strict=True)]
    changes = [basis_change(degree, degree, Q(-1), Q(1)) for degree in degrees]
    centers = []
    for place in itertools.product(*(range(degree + 1) for degree in degrees)):
        center = claim.x[-1]
        for powers, x, _ in claim.shifts:
            weight = math.prod((rows[k][j] for rows, k, j in zip(changes, powers, place, strict=True)), start=Q(1))
            center = [a + weight * b for a, b in zip(center, x[-1], strict=True)]
        centers.append(center)
    return centers
