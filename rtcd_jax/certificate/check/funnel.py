"""The obligations of one interval of the funnel: d/dt |y|^2 < 0 on |y| = 1, for every case of the saturation."""

from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import Q, alternating, near, require, rounded
from rtcd_jax.certificate.check.matrix import cofactors, dot
from rtcd_jax.certificate.check.squares import GramCertificate, Obligation, is_positive
from rtcd_jax.certificate.check.taylor import Space, Taylor, derivative, sine_and_cosine, size


class Motion(NamedTuple):
    """One interval's data as polynomials in s: x*, x*' [1/s], K, u, L and L' [1/s]."""

    state: list
    rate: list
    gain: list
    input: Any
    axes: list
    axes_rate: list
    duration: Any


class Interval(NamedTuple):
    """One interval of the funnel: L(s) between its ends is linear plus (1 - s^2) (bend_0 + bend_1 s)."""

    knot: int
    start: Any
    end: Any
    first: list
    last: list
    bend: list
    orders: tuple[int, int]
    cases: dict[str, GramCertificate]


def motion(claim: Claim, interval: Interval) -> Motion:
    """The closed loop's and the funnel's data on one interval."""
    k, dt, n, space = interval.knot, claim.dt, claim.n, Space(claim.n, *interval.orders)
    half = (interval.end - interval.start) / 2
    fraction = space.s * half + space.poly((interval.start + interval.end) / 2)  # of the knots' interval, at s
    speed = 1 / (dt * half)  # ds/dt
    state = []
    for a, va, b, vb in zip(claim.x[k], claim.rates[k][0], claim.x[k + 1], claim.rates[k][1], strict=True):
        hermite = [a, dt * va, 3 * (b - a) - dt * (2 * va + vb), 2 * (a - b) + dt * (va + vb)]
        state.append(space.compose(hermite, fraction))
    gain = [space.compose([a, b - a], fraction) for a, b in zip(claim.K[k], claim.K[k + 1], strict=True)]
    axes = []
    for first, last, bend0, bend1 in zip(interval.first, interval.last, *interval.bend, strict=True):
        row = []
        for a, b, c, d in zip(first, last, bend0, bend1, strict=True):
            row.append(space.compose([(a + b) / 2 + c, (b - a) / 2 + d, -c, -d], space.s))
        axes.append(row)
    rate = [derivative(n, a) * speed for a in state]
    axes_rate = [[derivative(n, a) * speed for a in row] for row in axes]
    return Motion(state, rate, gain, claim.u[k], axes, axes_rate, 2 / speed)


def funnel_obligations(claim: Claim, interval: Interval, place: str) -> dict[str, Obligation]:
    """By case of the saturation: "free", "high" (u = F), "low" (u = -F); those that cannot occur are left out."""
    data, space = motion(claim, interval), Space(claim.n, *interval.orders)
    adjugate, determinant = cofactors(data.axes)
    require(is_positive(determinant, Q(-1), Q(1)), place, "an ellipsoid is degenerate: det L must be > 0")
    y = [space.y(i) for i in range(claim.n)]
    error = [dot(row, y) for row in data.axes]
    x = [Taylor(space, center + e).tidy() for center, e in zip(data.state, error, strict=True)]
    center, _ = near(x[claim.plant.angle].constant, 20)
    require(abs(center) <= 64, place, "the nominal angle is beyond 64 rad")
    values = alternating(center, 1), alternating(center, 0)
    field = field_of(claim, x, center, (values[0][0], values[1][0], values[0][1]), place)
    scaled = [dot(column, y) for column in zip(*adjugate, strict=True)]
    push = pushes(field, scaled, Taylor(space, determinant).constant)
    drag = [Taylor(space, a + dot(row, y)).tidy() for a, row in zip(data.rate, data.axes_rate, strict=True)]
    free = pushed(push, [a - field.d * slow for a, slow in zip(field.a, drag, strict=True)])
    forced = pushed(push, field.b)
    linear = dot(data.gain, error) * Q(-1)
    by_axis = [dot(data.gain, column) for column in zip(*data.axes, strict=True)]
    where = cases_of(space, claim.limit, data.input, linear, dot(by_axis, by_axis), Q(-1), Q(1))
    inputs = {"free": space.poly(data.input) + linear, "high": claim.limit, "low": -claim.limit}
    obligations = {}
    for case, conditions in where.items():
        u = inputs[case]
        total = (free + forced * (Taylor(free.space, u) if case == "free" else u)) * Q(-1)
        obligations[case] = Obligation(total.p, total.r + total.d, Q(0), conditions, Q(-1), Q(1))
    return obligations


class Field(NamedTuple):
    """D, a and b of the robot on an ellipsoid, Taylor models."""

    d: Taylor
    a: list[Taylor]
    b: list[Taylor]


def field_of(claim: Claim, x: list[Taylor], center, values: tuple, place: str) -> Field:
    """At the states x, whose angle is near `center`, with the sine and cosine and the bound of their errors there."""
    sine, cosine = sine_and_cosine(x[claim.plant.angle], center, values, place)
    d, a, b = claim.plant.field(claim.parameters, x, sine, cosine)
    require(
        2 * d.constant - size(d.p) - d.r - d.d > 0, place, "the mass matrix' determinant is not shown to be positive"
    )
    return Field(d, a, b)


def pushes(field: Field, scaled: list, determinant) -> list[Taylor]:
    """The vector c adj(L)'y, of which `scaled` lacks the constant c."""
    scale, _ = near(2 / (field.d.constant * determinant), 30)
    wide = field.d.space._replace(y_order=field.d.space.y_order + 1)
    return [Taylor(wide, each) * scale for each in scaled]


def pushed(push: list[Taylor], field: list[Taylor]) -> Taylor:
    """Its product with a vector."""
    return dot(push, [Taylor(push[0].space, f.p, f.r, f.d) for f in field])


def cases_of(space: Space, limit, feedforward, linear, bound_squared, low, high) -> dict[str, list]:
    """What is >= 0 where u = feedforward + linear is free, too high, too low.

    |linear|^2 <= bound_squared on the sphere.
    """
    clearance = {"high": space.poly(limit - feedforward) - linear, "low": space.poly(limit + feedforward) + linear}
    occurs = []
    for case, left in (("high", limit - feedforward), ("low", limit + feedforward)):
        if not (left > 0 and is_positive(space.poly(left * left) - bound_squared, low, high, depth=4)):
            occurs.append(case)
    return {"free": [clearance[case] for case in occurs], **{case: [clearance[case] * Q(-1)] for case in occurs}}


def require_bounds(claim: Claim, data: Motion, place: str) -> None:
    """|x_i| <= bound: (bound -+ x*_i)^2 > |row i of L|^2 and bound -+ x*_i > 0."""
    for i, bound in enumerate(claim.bounds):
        if bound is None:
            continue
        for sign in (1, -1):
            left = data.state[i] * Q(sign) + Space(claim.n, 0, 0).poly(bound)
            clearance = left * left - dot(data.axes[i], data.axes[i])
            inside = is_positive(left, Q(-1), Q(1)) and is_positive(clearance, Q(-1), Q(1))
            name = claim.plant.states[i]
            require(inside, place, f"the limit |{name}| <= {rounded(bound):.6g} {claim.plant.units[i]} is not kept")
