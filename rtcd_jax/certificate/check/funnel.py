"""What has to be shown on one interval of the funnel: d/dt |y|^2 < 0 on |y| = 1, for every case of the saturation."""

from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import Q, alternating, insist, near
from rtcd_jax.certificate.check.scalar import (
    cofactors,
    derivative,
    norm_squared,
    plus,
    product_entry,
    substitute,
    times,
)
from rtcd_jax.certificate.check.squares import Obligation, Witness, is_positive
from rtcd_jax.certificate.check.taylor import Space, Taylor, sine_and_cosine, size

SINGULAR = "the mass matrix' determinant is not shown to be positive"


class Motion(NamedTuple):
    """One interval's data as polynomials in s: x*, x*' [1/s], K, u, L and L' [1/s]."""

    state: list
    rate: list
    gain: list
    input: Any
    axes: list
    axes_rate: list
    duration: Any


class Stretch(NamedTuple):
    """One interval of the funnel: L(s) between its ends is linear plus (1 - s^2) (bend_0 + bend_1 s)."""

    knot: int
    start: Any
    end: Any
    first: list
    last: list
    bend: list
    orders: tuple[int, int]
    cases: dict[str, Witness]


def motion(claim: Claim, piece: Stretch) -> Motion:
    """The closed loop's and the funnel's data on one interval."""
    k, dt = piece.knot, claim.dt
    share = [(piece.start + piece.end) / 2, (piece.end - piece.start) / 2]  # of the knots' interval, at s
    speed = 1 / (dt * share[1])  # ds/dt
    state = []
    for a, va, b, vb in zip(claim.x[k], claim.rates[k][0], claim.x[k + 1], claim.rates[k][1], strict=True):
        hermite = [a, dt * va, 3 * (b - a) - dt * (2 * va + vb), 2 * (a - b) + dt * (va + vb)]
        state.append(substitute(hermite, share))
    gain = [substitute([a, b - a], share) for a, b in zip(claim.K[k], claim.K[k + 1], strict=True)]
    axes = []
    for first, last, bend0, bend1 in zip(piece.first, piece.last, *piece.bend, strict=True):
        row = []
        for a, b, c, d in zip(first, last, bend0, bend1, strict=True):
            row.append([(a + b) / 2 + c, (b - a) / 2 + d, -c, -d])
        axes.append(row)
    rate = [[c * speed for c in derivative(a)] for a in state]
    axes_rate = [[[c * speed for c in derivative(a)] for a in row] for row in axes]
    return Motion(state, rate, gain, claim.u[k], axes, axes_rate, 2 / speed)


def funnel_obligations(claim: Claim, piece: Stretch, place: str) -> dict[str, Obligation]:
    """By case of the saturation: "free", "high" (u = F), "low" (u = -F); those that cannot occur are left out."""
    data, space, every = motion(claim, piece), Space(claim.n, *piece.orders), range(claim.n)
    adjugate, determinant = cofactors(data.axes)
    insist(is_positive(determinant, Q(-1), Q(1)), place, "an ellipsoid is degenerate: det L must be > 0")
    y = [space.y(i) for i in every]
    error = [space.sum(space.poly(data.axes[i][j]) * y[j] for j in every) for i in every]
    drag = [space.sum(space.poly(data.axes_rate[i][j]) * y[j] for j in every) for i in every]
    x = [Taylor(space, space.poly(data.state[i]) + error[i]).tidy() for i in every]
    angle = x[claim.plant.angle]
    center, _ = near(angle.constant, 20)
    insist(abs(center) <= 64, place, "the nominal angle is beyond 64 rad")
    values = alternating(center, 1), alternating(center, 0)
    sine, cosine = sine_and_cosine(angle, center, (values[0][0], values[1][0], values[0][1]), place)
    d, a, b = claim.plant.field(claim.parameters, x, sine, cosine)
    d0 = d.constant
    insist(2 * d0 - size(d.p) - d.r - d.d > 0, place, SINGULAR)
    wide = space._replace(y_order=space.y_order + 1)
    scale, _ = near(2 / (d0 * determinant[0]), 30)
    push = [Taylor(wide, space.sum(space.poly(adjugate[i][j]) * y[i] for i in every)) * scale for j in every]
    free, forced = wide.enclose(0), wide.enclose(0)
    for j in every:
        fall = a[j] - d * Taylor(space, space.poly(data.rate[j]) + drag[j]).tidy()
        free += push[j] * Taylor(wide, fall.p, fall.r, fall.d)
        forced += push[j] * Taylor(wide, b[j].p, b[j].r, b[j].d)
    linear = space.sum(space.poly(data.gain[i]) * error[i] * Q(-1) for i in every)
    reach = norm_squared([product_entry(data.gain, data.axes, j) for j in every])
    where = cases_of(space, claim.limit, data.input, linear, reach, Q(-1), Q(1))
    inputs = {"free": space.poly(data.input) + linear, "high": claim.limit, "low": -claim.limit}
    found = {}
    for case, conditions in where.items():
        u = inputs[case]
        total = (free + forced * (Taylor(wide, u) if case == "free" else u)) * Q(-1)
        found[case] = Obligation(total.p, total.r + total.d, Q(0), conditions, Q(-1), Q(1))
    return found


def cases_of(space: Space, limit, feedforward, linear, reach, low, high) -> dict[str, list]:
    """What is >= 0 where u = feedforward + linear is free, too high, too low; |linear|^2 <= reach(s) on the sphere."""
    room = {"high": space.poly(limit - feedforward) - linear, "low": space.poly(limit + feedforward) + linear}
    occurs = []
    for case, left in (("high", limit - feedforward), ("low", limit + feedforward)):
        square = plus([left * left], [-c for c in reach])
        if not (left > 0 and is_positive(square, low, high, depth=4)):
            occurs.append(case)
    return {"free": [room[case] for case in occurs], **{case: [room[case] * Q(-1)] for case in occurs}}


def insist_bounds(claim: Claim, data: Motion, place: str) -> None:
    """|x_i| <= bound: (bound -+ x*_i)^2 > |row i of L|^2 and bound -+ x*_i > 0."""
    for i, bound in enumerate(claim.bounds):
        if bound is None:
            continue
        row = norm_squared(data.axes[i])
        for sign in (1, -1):
            left = plus([bound], [c * sign for c in data.state[i]])
            inside = is_positive(left, Q(-1), Q(1)) and is_positive(
                plus(times(left, left), [-c for c in row]), Q(-1), Q(1)
            )
            name = claim.plant.states[i]
            insist(inside, place, f"the limit |{name}| <= {float(bound):.6g} {claim.plant.units[i]} is not kept")
