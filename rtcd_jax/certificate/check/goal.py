"""What has to be shown at the goal, level by level, and that the funnel ends in there."""

import math
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import MAX_ORDER, PI, PI_ERROR, Q, insist, near
from rtcd_jax.certificate.check.funnel import SINGULAR, cases_of
from rtcd_jax.certificate.check.scalar import cofactors, constants, norm_squared, product_entry
from rtcd_jax.certificate.check.squares import Obligation, Witness, is_positive_definite
from rtcd_jax.certificate.check.taylor import Space, Taylor, polynomial, sine_and_cosine, size, terms_of


class Shell(NamedTuple):
    """The part of the goal region with |y| between two levels."""

    start: Any
    end: Any
    cases: dict[str, Witness]


def goal_field(claim: Claim, axes: list, y_order: int, place: str) -> tuple[Taylor, Taylor, list]:
    """2 y' adj(L) a / l and 2 y' adj(L) b / l as Taylor models in (l, z) after y = l z, and K L."""
    space, every = Space(claim.n, MAX_ORDER, y_order), range(claim.n)
    adjugate, determinant = cofactors(constants(axes))
    insist(determinant[0] > 0, place, "the ellipsoid is degenerate: det L must be > 0")
    level = polynomial(claim.n, {(1, *(0,) * claim.n): Q(1)})
    z = [space.y(i) for i in every]
    error = [space.sum(z[j] * axes[i][j] for j in every) * level for i in every]
    center = claim.x_goal[claim.plant.angle]
    turns = round(float(center) / math.pi)
    off = abs(center - PI * turns) + PI_ERROR * abs(turns)
    insist(off < Q(1, 10**9), place, "the goal's angle is no multiple of pi")
    x = [Taylor(space, space.poly(c) + e) for c, e in zip(claim.x_goal, error, strict=True)]
    values = (Q(0), Q(-1 if turns % 2 else 1), off / 3)
    sine, cosine = sine_and_cosine(x[claim.plant.angle], center, values, place)
    d, a, b = claim.plant.field(claim.parameters, x, sine, cosine)
    insist(2 * d.constant - size(d.p) - d.r - d.d > 0, place, SINGULAR)
    scale, _ = near(2 / (d.constant * determinant[0]), 30)
    wide = space._replace(y_order=y_order + 1)
    push = [Taylor(wide, space.sum(z[i] * adjugate[i][j][0] for i in every) * scale) for j in every]
    insist(all(f.constant == 0 for f in a), place, "the goal is no equilibrium")
    fields = []
    for f in (a, b):
        total = wide.enclose(0)
        for j in every:
            total += push[j] * Taylor(wide, f[j].p, f[j].r, f[j].d)
        fields.append(total)
    return fields[0], fields[1], [product_entry([[k] for k in claim.K_goal], constants(axes), j)[0]
                                  for j in every]  # fmt: skip


def goal_obligations(claim: Claim, field: tuple[Taylor, Taylor, list], low, high) -> dict[str, Obligation]:
    """As `funnel_obligations`, in l on [low, high]: q / l^2 where u is free, q / l where it is saturated."""
    free, forced, gain = field
    space, zero = free.space, (0,) * (claim.n + 1)
    linear = space.sum((space.y(j) * -k for j, k in enumerate(gain)))
    level = polynomial(claim.n, {(1, *zero[1:]): Q(1)})
    reach = [Q(0), Q(0), norm_squared([[k] for k in gain])[0]]
    where = cases_of(space, claim.limit, Q(0), linear * level, reach, low, high)
    found = {}
    for case, conditions in where.items():
        if case == "free":
            lowered = polynomial(claim.n, {(e[0] - 1, *e[1:]): c for e, c in terms_of(free.p)})
            held = forced * Taylor(space, linear)
            p, error, drift = (lowered + held.p) * Q(-1), free.r + held.r + held.d, free.d
        else:
            held = free + forced * (claim.limit if case == "high" else -claim.limit)
            p, error, drift = held.p * Q(-1), held.r + held.d, Q(0)
        found[case] = Obligation(p, error, drift, conditions, low, high)
    return found


def insist_arrival(claim: Claim, outlet: list, axes: list, weight, place: str) -> None:
    """E(t_N) in G: |adj(L_g) (x_N - x_g + L_N y)| < det L_g for |y| <= 1, by the S-lemma with the given weight."""
    every = range(claim.n)
    adjugate, determinant = cofactors(constants(axes))
    offset = [a - b for a, b in zip(claim.x[-1], claim.x_goal, strict=True)]
    b = [[sum((adjugate[i][k][0] * outlet[k][j] for k in every), Q(0)) for j in every] for i in every]
    w = [sum((adjugate[i][k][0] * offset[k] for k in every), Q(0)) for i in every]
    columns = [[b[i][j] for i in every] for j in every] + [w]
    form = [[-sum((c * d for c, d in zip(p, q, strict=True)), Q(0)) for q in columns] for p in columns]
    for i in every:
        form[i][i] += weight
    form[-1][-1] += determinant[0] * determinant[0] - weight
    insist(is_positive_definite(form), place, "the funnel's outlet is not shown to lie in the goal region")
