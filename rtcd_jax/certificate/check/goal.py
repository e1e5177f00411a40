"""The obligations of the goal region, level by level, and of the funnel's end inside it."""

import math
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import MAX_ORDER, PI, PI_ERROR, Q, require
from rtcd_jax.certificate.check.funnel import cases_of, field_of, pushed, pushes
from rtcd_jax.certificate.check.matrix import cofactors, dot
from rtcd_jax.certificate.check.squares import GramCertificate, Obligation, is_positive_definite
from rtcd_jax.certificate.check.taylor import Space, Taylor, polynomial, terms_of


class Shell(NamedTuple):
    """The part of the goal region with |y| between two levels."""

    start: Any
    end: Any
    cases: dict[str, GramCertificate]


def goal_field(claim: Claim, axes: list, y_order: int, place: str) -> tuple[Taylor, Taylor, list]:
    """2 y' adj(L) a / l and 2 y' adj(L) b / l as Taylor models in (l, z) after y = l z, and K L."""
    space = Space(claim.n, MAX_ORDER, y_order)
    adjugate, determinant = cofactors(axes)
    require(determinant > 0, place, "the ellipsoid is degenerate: det L must be > 0")
    z = [space.y(i) for i in range(claim.n)]
    center = claim.x_goal[claim.plant.angle]
    turns = round(float(center) / math.pi)
    off = abs(center - PI * turns) + PI_ERROR * abs(turns)
    require(off < Q(1, 10**9), place, "the goal's angle is no multiple of pi")
    x = [Taylor(space, space.poly(c) + dot(z, row) * space.s) for c, row in zip(claim.x_goal, axes, strict=True)]
    field = field_of(claim, x, center, (Q(0), Q(-1 if turns % 2 else 1), off / 3), place)
    require(all(f.constant == 0 for f in field.a), place, "the goal is no equilibrium")
    push = pushes(field, [dot(z, column) for column in zip(*adjugate, strict=True)], determinant)
    gain = [dot(claim.K_goal, column) for column in zip(*axes, strict=True)]
    return pushed(push, field.a), pushed(push, field.b), gain


def goal_obligations(claim: Claim, field: tuple[Taylor, Taylor, list], low, high) -> dict[str, Obligation]:
    """As `funnel_obligations`, in l on [low, high]: q / l^2 where u is free, q / l where it is saturated."""
    free, forced, gain = field
    space = free.space
    linear = dot([space.y(j) for j in range(claim.n)], gain) * Q(-1)
    bound_squared = space.s * space.s * dot(gain, gain)
    obligations = {}
    for case, conditions in cases_of(space, claim.limit, Q(0), linear * space.s, bound_squared, low, high).items():
        if case == "free":
            lowered = polynomial(claim.n, {(e[0] - 1, *e[1:]): c for e, c in terms_of(free.p)})
            held = forced * Taylor(space, linear)
            p, error, drift = (lowered + held.p) * Q(-1), free.r + held.r + held.d, free.d
        else:
            held = free + forced * (claim.limit if case == "high" else -claim.limit)
            p, error, drift = held.p * Q(-1), held.r + held.d, Q(0)
        obligations[case] = Obligation(p, error, drift, conditions, low, high)
    return obligations


def require_arrival(claim: Claim, outlet: list, axes: list, weight, place: str) -> None:
    """E(t_N) in G: |adj(L_g) (x_N - x_g + L_N y)| < det L_g for |y| <= 1, by the S-lemma with the given weight."""
    adjugate, determinant = cofactors(axes)
    offset = [a - b for a, b in zip(claim.x[-1], claim.x_goal, strict=True)]
    columns = [[dot(row, column) for row in adjugate] for column in (*zip(*outlet, strict=True), offset)]
    form = [[-dot(p, q) for q in columns] for p in columns]
    for i in range(claim.n):
        form[i][i] += weight
    form[-1][-1] += determinant * determinant - weight
    require(is_positive_definite(form), place, "the funnel's outlet is not shown to lie in the goal region")
