"""The obligations of one interval of the funnel: d/dt |y|^2 < 0 on |y| = 1, for every robot and case of the input."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.delay import (
    Along,
    delay_bounds,
    jump_bound,
    jumps_within_reach,
    lateness,
    require_delay,
    scaled_along,
)
from rtcd_jax.certificate.check.delay import Bounds as DelayBounds
from rtcd_jax.certificate.check.exact import Q, alternating, near, require, rounded
from rtcd_jax.certificate.check.keep_out import half_spaces
from rtcd_jax.certificate.check.matrix import cofactors, dot
from rtcd_jax.certificate.check.saturation import Case, Feedback, are_joined, cases_of, input_error
from rtcd_jax.certificate.check.squares import Obligation, Squares, control_points, economized, is_positive
from rtcd_jax.certificate.check.taylor import Space, Taylor, polynomial, sine_and_cosine, terms_of

WHOLE = {0: (Q(-1), Q(1))}
"""s on an interval."""


class Motion(NamedTuple):
    """One interval's data as polynomials in s: x*, x*' [1/s], K, K' [1/s], u, L and L' [1/s]; c_p - x* and its rate
    [1/s], in the robot's numbers too.
    """

    state: list
    rate: list
    gain: list
    gain_rate: list
    input: Any
    axes: list
    axes_rate: list
    shift: list
    shift_rate: list
    duration: Any

    @property
    def center(self) -> list:
        return [a + b for a, b in zip(self.state, self.shift, strict=True)]

    def apart(self, error: list) -> list:
        """x - x* at the states c_p + error."""
        return [a + b for a, b in zip(self.shift, error, strict=True)]


class Interval(NamedTuple):
    """One interval of the funnel: L(s) between its ends is linear plus (1 - s^2) (bend_0 + bend_1 s).

    `orders` are those of its Taylor models in s and y; about own motions also how many powers of y one of a robot's
    numbers counts as, and by number the degree that stays in the end.
    """

    knot: int
    start: Any
    end: Any
    first: list
    last: list
    bend: list
    orders: tuple[int, ...]
    cases: dict[str, Squares]
    late: list
    """rho of delay.py at both ends, linear in between, where old measurements count to first order."""
    sides: list = []  # noqa: RUF012 (of a tuple's field)
    """Of every ellipsoid to keep out of, the side of keep_out.py at both ends."""

    def space(self, claim: Claim) -> Space:
        return claim.space(*self.orders[:3])


def motion(claim: Claim, interval: Interval) -> Motion:
    """The closed loop's and the funnel's data on one interval."""
    k, dt, space = interval.knot, claim.dt, interval.space(claim)
    half = (interval.end - interval.start) / 2
    fraction = space.s * half + space.poly((interval.start + interval.end) / 2)  # of the knots' interval, at s
    speed = 1 / (dt * half)  # ds/dt

    def cubics(x: list, rates: list) -> list:
        parts = []
        for a, va, b, vb in zip(x[k], rates[k][0], x[k + 1], rates[k][1], strict=True):
            hermite = [a, dt * va, 3 * (b - a) - dt * (2 * va + vb), 2 * (a - b) + dt * (va + vb)]
            parts.append(space.compose(hermite, fraction))
        return parts

    state, shift = cubics(claim.x, claim.rates), [space.poly(0)] * claim.n
    for powers, x, rates in claim.shifts:
        product = space.of_the_robot(powers)
        shift = [a + b * product for a, b in zip(shift, cubics(x, rates), strict=True)]
    gain = [space.compose([a, b - a], fraction) for a, b in zip(claim.K[k], claim.K[k + 1], strict=True)]
    axes = []
    for first, last, bend0, bend1 in zip(interval.first, interval.last, *interval.bend, strict=True):
        row = []
        for a, b, c, d in zip(first, last, bend0, bend1, strict=True):
            row.append(space.compose([(a + b) / 2 + c, (b - a) / 2 + d, -c, -d], space.s))
        axes.append(row)
    rate, gain_rate, shift_rate = ([space.derivative(a) * speed for a in each] for each in (state, gain, shift))
    axes_rate = [[space.derivative(a) * speed for a in row] for row in axes]
    return Motion(state, rate, gain, gain_rate, claim.u[k], axes, axes_rate, shift, shift_rate, 2 / speed)


def funnel_obligations(claim: Claim, interval: Interval, place: str) -> dict[str, Obligation]:
    """By case of the input and, behind a slash, control point of the robots."""
    return obligations_of(claim, funnel_models(claim, interval, place), interval.orders[3:])


def obligations_of(
    claim: Claim, models: Mapping[str, tuple[Case, Taylor]], degrees: Sequence[int]
) -> dict[str, Obligation]:
    """As `funnel_obligations`; polynomials are of at most these degrees in the robot's numbers, if there are any."""
    obligations = {}
    for name, (case, q) in models.items():
        p, changed = economized(q.p, claim.n, degrees) if degrees else (q.p, Q(0))
        obligations |= for_all_robots(name, case, p, q.r + q.d + changed, Q(0), WHOLE[0], claim)
    return obligations


def funnel_models(claim: Claim, interval: Interval, place: str) -> dict[str, tuple[Case, Taylor]]:
    """By case of the input, what must be positive there."""
    data, space = motion(claim, interval), interval.space(claim)
    adjugate, determinant = cofactors(data.axes)
    require(is_positive(determinant, WHOLE), place, "an ellipsoid is degenerate: det L must be > 0")
    if claim.age != 0:
        require_speed(claim, funnel_speed(claim, interval, place), place)
    y = [space.y(i) for i in range(claim.n)]
    error, field = field_around(claim, space, data.center, data.axes, place)
    scaled = [dot(column, y) for column in zip(*adjugate, strict=True)]
    push = pushes(field, scaled, Taylor(space, determinant).constant, place)
    drag = [
        Taylor(space, a + b + dot(row, y)).tidy()
        for a, b, row in zip(data.rate, data.shift_rate, data.axes_rate, strict=True)
    ]
    relative = [a - field.d * slow for a, slow in zip(field.a, drag, strict=True)]
    free, forced = pushed(push, relative), pushed(push, field.b)

    def feedback(gain: list) -> Feedback:
        by_axis = [dot(gain, column) for column in zip(*data.axes, strict=True)]
        return Feedback(dot(gain, error) * Q(-1), dot(by_axis, by_axis), dot(gain, data.shift) * Q(-1))

    late, oldest = input_error(claim, interval.knot), None
    if claim.first_order:
        row = late_row(space, interval)
        bounds = delay_bounds(claim, along(claim, data, field, error), late, _models(space, row), place)
        require_delay(claim, bounds, place)
        late = lateness(claim, late, bounds.misfit, jumps_within_reach(claim, interval.knot, interval.start))
        oldest = feedback([gain - row_i * claim.age for row_i, gain in zip(row, data.gain, strict=True)])
    cases = cases_of(
        space, claim, late, data.input, feedback(data.gain), Q(-1), Q(1), oldest, are_joined(interval.cases)
    )
    return {name: (case, (free + forced * Taylor(free.space, case.input)) * Q(-1)) for name, case in cases.items()}


def for_all_robots(
    name: str, case: Case, p, error, drift, span: tuple[Any, Any], claim: Claim
) -> dict[str, Obligation]:
    """The obligations of a case, that of every control point of the robots; p may be a polynomial in their numbers."""
    where = [_without_robot(condition, claim.n) for condition in case.where]
    return {
        f"{name}/{point}" if point else name: Obligation(part, error, drift, where, *span)
        for point, part in control_points(p, claim.n).items()
    }


def _without_robot(p, n: int) -> Any:
    return polynomial(n, {e[: n + 1]: c for e, c in terms_of(p)})


class Field(NamedTuple):
    """D, a and b of the robots on an ellipsoid, Taylor models; the states x, and sine and cosine of k.q by k."""

    d: Taylor
    a: list[Taylor]
    b: list[Taylor]
    x: list[Taylor]
    waves: dict[tuple[int, ...], tuple[Taylor, Taylor]]


def field_of(claim: Claim, x: list[Taylor], values: Mapping[tuple[int, ...], tuple[Any, tuple]], place: str) -> Field:
    """At the states x.

    `values` has for every wave k an angle near k.q, and its sine and cosine with the bound of their errors.
    """
    space = x[0].space
    waves = waves_of(x, values, place)
    d, a, b = claim.equations.field(claim.numbers(space), x, waves)
    return Field(space.enclose(d), [space.enclose(each) for each in a], [space.enclose(each) for each in b], x, waves)


def waves_of(x: list[Taylor], values: Mapping[tuple[int, ...], tuple[Any, tuple]], place: str) -> dict:
    """Sine and cosine of k.q by k, at the states x; `values` as `field_of` has them."""
    return {k: sine_and_cosine(angle_of(k, x), center, known, place) for k, (center, known) in values.items()}


def field_around(claim: Claim, space: Any, center: Iterable, axes: list, place: str) -> tuple[list, Field]:
    """e = L y, and the field at the states center + e."""
    y = [space.y(i) for i in range(claim.n)]
    error = [dot(row, y) for row in axes]
    x = [Taylor(space, c + e).tidy() for c, e in zip(center, error, strict=True)]
    return error, field_of(claim, x, waves_near(claim.equations.waves, x, place), place)


def angle_of(k: tuple[int, ...], x: list) -> Any:
    """k.q."""
    return dot([x[i] for i, a in enumerate(k) if a], [Q(a) for a in k if a])


def waves_near(waves: Iterable[tuple[int, ...]], x: list[Taylor], place: str) -> dict:
    """The values of these waves for `field_of`, about the middle of the states x."""
    values = {}
    for k in waves:
        center, _ = near(angle_of(k, x).constant, 20)
        require(abs(center) <= 64, place, "the nominal angle is beyond 64 rad")
        sine, cosine = alternating(center, 1), alternating(center, 0)
        values[k] = center, (sine[0], cosine[0], sine[1])
    return values


def pushes(field: Field, scaled: list, determinant, place: str) -> list[Taylor]:
    """The vector c adj(L)'y, of which `scaled` lacks the constant c > 0."""
    middle = field.d.constant * determinant
    require(middle > 0, place, "the mass matrix' determinant is not shown to be positive here")
    scale, _ = near(2 / middle, 30)
    wide = field.d.space._replace(y_order=field.d.space.y_order + 1)
    return [Taylor(wide, each) * scale for each in scaled]


def pushed(push: list[Taylor], field: list[Taylor]) -> Taylor:
    """Its product with a vector."""
    return dot(push, [Taylor(push[0].space, f.p, f.r, f.d) for f in field])


def funnel_speed(claim: Claim, interval: Interval, place: str) -> Any:
    """An upper bound of |d/dt (K e)| in the ellipsoids of an interval, e = x - x*."""
    data, space = motion(claim, interval), interval.space(claim)
    error, field = field_around(claim, space, data.center, data.axes, place)
    rate = [a - field.d * Taylor(space, slow) for a, slow in zip(field.a, data.rate, strict=True)]
    turning = dot([Taylor(space, gain) for gain in data.gain_rate], [Taylor(space, e) for e in data.apart(error)])
    return turning.largest + speed_of(claim, field, [Taylor(space, gain) for gain in data.gain], rate, place)


def late_row(space: Any, interval: Interval) -> list:
    """rho of delay.py as polynomials in s."""
    return [space.compose([(a + b) / 2, (b - a) / 2], space.s) for a, b in zip(*interval.late, strict=True)]


def funnel_delay(claim: Claim, interval: Interval, place: str) -> DelayBounds:
    """The bounds of delay.py on the ellipsoids of an interval."""
    data, space = motion(claim, interval), interval.space(claim)
    error, field = field_around(claim, space, data.center, data.axes, place)
    late, row = input_error(claim, interval.knot), _models(space, late_row(space, interval))
    return delay_bounds(claim, along(claim, data, field, error), late, row, place)


def along(claim: Claim, data: Motion, field: Field, error: list) -> Along:
    """The loop on the ellipsoids of an interval, as delay.py needs it."""
    space = field.d.space
    speed = 2 / data.duration
    bend = [space.derivative(rate) * speed for rate in data.rate]
    e, gain, gain_rate, rate, bent = (
        _models(space, part) for part in (data.apart(error), data.gain, data.gain_rate, data.rate, bend)
    )
    return scaled_along(field, e, gain, gain_rate, rate, bent, data.input)


def _models(space: Any, polynomials: list) -> list[Taylor]:
    return [Taylor(space, each).tidy() for each in polynomials]


def require_jump(claim: Claim, interval: Interval, place: str) -> None:
    """The jump of the feedback's rate at the knot where an interval begins is not more than the claim's."""
    if interval.start != 0 or interval.knot == 0:
        return
    found, claimed = funnel_jump(claim, interval, place), claim.jumps[interval.knot]
    unit = claim.robot.input_unit
    reason = f"the feedback's rate may jump by {rounded(found):.6g} {unit}/s, by more than claim.jumps[{interval.knot}]"
    require(found <= claimed, place, reason)


def funnel_jump(claim: Claim, interval: Interval, place: str) -> Any:
    """The bound of the jump at the knot where an interval begins."""
    space, k = interval.space(claim), interval.knot
    shift = [space.poly(0)] * claim.n
    for powers, x, _ in claim.shifts:
        shift = [a + space.of_the_robot(powers) * b for a, b in zip(shift, x[k], strict=True)]
    center = [space.poly(a) + b for a, b in zip(claim.x[k], shift, strict=True)]
    error, field = field_around(claim, space, center, interval.first, place)
    apart = [a + b for a, b in zip(shift, error, strict=True)]
    gain = [Taylor(space, space.poly(each)) for each in claim.K[k]]
    here = scaled_along(field, _models(space, apart), gain, gain, gain, gain, claim.u[k])
    return jump_bound(claim, here, k, place)


def speed_of(claim: Claim, field: Field, gain: list[Taylor], rate: list[Taylor], place: str) -> Any:
    """An upper bound of |K e'|, where `rate` is D e' without the input's part."""
    least, largest_input = field.d.least, claim.limits[1] + claim.disturbance
    require(least > 0, place, "the mass matrix' determinant is not shown to be positive here")
    return (dot(gain, rate).largest + dot(gain, field.b).largest * largest_input) / least


def require_speed(claim: Claim, fastest: Any, place: str) -> None:
    reason = f"the feedback may change by {rounded(fastest):.6g} {claim.robot.input_unit}/s, by more than claim.speed"
    require(fastest <= claim.speed, place, reason)


def require_bounds(claim: Claim, data: Motion, place: str) -> None:
    """|x_i| <= bound: (bound -+ c_i)^2 > |row i of L|^2 and bound -+ c_i > 0, c the center."""
    center, space = data.center, claim.space(0, 0)
    for i, bound in enumerate(claim.bounds):
        if bound is None:
            continue
        for sign in (1, -1):
            left = center[i] * Q(sign) + space.poly(bound)
            clearance = left * left - dot(data.axes[i], data.axes[i])
            inside = is_positive(left, claim.cube) and is_positive(clearance, claim.cube)
            name = claim.robot.states[i]
            require(inside, place, f"the limit |{name}| <= {rounded(bound):.6g} {claim.robot.units[i]} is not kept")


def require_kept_out(claim: Claim, interval: Interval, data: Motion, place: str) -> None:
    """The ellipsoids meet no half space w'(x - c) > offset that holds a set to keep out of:
    (offset - w'(c_p - c))^2 > |L'w|^2 and offset - w'(c_p - c) > 0.
    """
    space = interval.space(claim)
    sides = [
        ([space.compose([(a + b) / 2, (b - a) / 2], space.s) for a, b in zip(*ends, strict=True)], ends)
        for ends in interval.sides
    ]
    for i, (normal, center, offset) in enumerate(half_spaces(claim.keep_out, sides)):
        apart = [space.poly(c) - x for c, x in zip(center, data.center, strict=True)]
        left = dot(apart, normal) + space.poly(offset)
        turned = [dot(column, normal) for column in zip(*data.axes, strict=True)]
        outside = is_positive(left, claim.cube) and is_positive(left * left - dot(turned, turned), claim.cube)
        require(outside, place, f"the set claim.keep_out[{i}] is not kept out of")
