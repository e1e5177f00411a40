"""Old measurements, to first order: what a feedback that is tau old differs by is -tau rho e, up to `lateness`.

e = x - x*, phi = K e, and rho(s) e, of the certificate, stands for the rate of phi under the unsaturated loop. In e,

    phi' = G + g v,    G = K' e + K ((a + b u_k) / D - x*'),    g = K b / D,

where the input is u_k + v with |v| <= `strength`, and w on top. The feedback of a time r <= t is phi(t) minus the
integral of phi' over [r, t]. There G differs from G(t) by at most |t - r| times its own rate, and jumps at the knots;
g v from its value without delay, g(t) (clip(u_lin) - u_k), by at most g (w + late + |t - r| speed + F+ - F-), where
`late` bounds the error of the input that was asked for then, and by |t - r| |g'| |v|. Where u_lin is within the limits
up to `late`, what it is clipped by is at most `late`; where it is beyond, the motor gives F, and so do the law and
`lateness` together as long as age g <= 1. So with

    jerk >= |G'| + |g'| strength,    reaction >= g,    misfit >= |G - g phi - rho e|,

    lateness = noise + age (misfit + jumps + reaction (w + 2 late + F+ - F-)) + age^2 / 2 (jerk + reaction speed).

The robot's numbers are constant in time here.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import Q, require, rounded
from rtcd_jax.certificate.check.matrix import dot
from rtcd_jax.certificate.check.robot import HINGE
from rtcd_jax.certificate.check.taylor import Taylor


class Moving:
    """A value and its rate along a direction."""

    __slots__ = ("rate", "value")

    def __init__(self, value: Any, rate: Any):
        self.value, self.rate = value, rate

    def __add__(self, other: Any) -> "Moving":
        if not isinstance(other, Moving):
            return Moving(self.value + other, self.rate)
        return Moving(self.value + other.value, self.rate + other.rate)

    __radd__ = __add__

    def __mul__(self, other: Any) -> "Moving":
        if not isinstance(other, Moving):
            return Moving(self.value * other, self.rate * other)
        return Moving(self.value * other.value, self.rate * other.value + other.rate * self.value)

    __rmul__ = __mul__


class Along(NamedTuple):
    """What a bound of delays needs on an ellipsoid, Taylor models: the field D, a, b at x* + e, and the loop's data."""

    d: Taylor
    a: list[Taylor]
    b: list[Taylor]
    x: list[Taylor]
    waves: Mapping[tuple[int, ...], tuple[Taylor, Taylor]]
    error: list[Taylor]
    gain: list[Taylor]
    gain_rate: list[Taylor]
    nominal_rate: list[Taylor]
    nominal_bend: list[Taylor]
    input: Any
    scale: Any


class Bounds(NamedTuple):
    """Of the theorem above, on one ellipsoid; `late` is the largest error of the input that is asked for."""

    jerk: Any
    reaction: Any
    misfit: Any


def delay_bounds(claim: Claim, along: Along, late: Any, row: Sequence[Taylor], place: str) -> Bounds:
    """The bounds on an ellipsoid, `row` is rho."""
    d, least = along.d, along.d.least
    require(least > 0, place, "the mass matrix' determinant is not shown to be positive here")
    moving = [a + b * along.input for a, b in zip(along.a, along.b, strict=True)]
    off = [m - d * rate for m, rate in zip(moving, along.nominal_rate, strict=True)]  # D e' of the free input
    asked = dot(along.gain, along.error)
    beyond = max(Q(0), abs(along.input) - claim.limits[0])
    forced = min(claim.limits[1] + abs(along.input), asked.largest + late + beyond) + claim.disturbance
    strength = claim.limits[1] + max(abs(u) for u in claim.u)
    nu, kappa = dot(along.gain, moving), dot(along.gain, along.b)
    main, side = (_rates(claim, along, direction) for direction in (moving, along.b))
    turn = dot(along.gain_rate, along.b) * (d * d)

    def slope(rates: _Rates, value: Taylor, by_input: bool) -> Taylor:
        """(value / D)' D^3 along a direction."""
        forcing = dot(along.gain, rates.b)
        whole = forcing if by_input else dot(along.gain, rates.a) + forcing * along.input
        return whole * d - value * rates.d

    bent = dot(along.gain_rate, off) * (d * d) * Q(2) - dot(along.gain, along.nominal_bend) * (d * d * d)
    cube = least * least * least
    free = (bent + slope(main, nu, False)).largest + forced * (turn + slope(side, nu, False)).largest
    pull = (turn + slope(main, kappa, True)).largest + forced * slope(side, kappa, True).largest
    reaction = kappa.largest / least
    misfit = dot(along.gain_rate, along.error) * d + dot(along.gain, off) - kappa * asked - dot(row, along.error) * d
    return Bounds((free + strength * pull) / cube, reaction, misfit.largest / least)


class _Rates(NamedTuple):
    """Of D, a and b along a direction of the states."""

    d: Taylor
    a: list[Taylor]
    b: list[Taylor]


def _rates(claim: Claim, along: Along, direction: Sequence[Taylor]) -> _Rates:
    """The derivatives, exact, by the rules of sums and products."""
    space, robot = along.d.space, claim.robot
    x = [Moving(value, rate) for value, rate in zip(along.x, direction, strict=True)]
    waves = {}
    for k, (sine, cosine) in along.waves.items():
        turning = [direction[i] * Q(a) for i, a in enumerate(k) if a and robot.joints[i] == HINGE]
        spin = dot(turning, [1] * len(turning))
        waves[k] = Moving(sine, cosine * spin), Moving(cosine, sine * spin * Q(-1))
    numbers = {
        name: Moving(value, value * Q(0)) if isinstance(value, Taylor) else value
        for name, value in claim.numbers(space).items()
    }
    d, a, b = claim.equations.field(numbers, x, waves)

    def rate(value: Any) -> Taylor:
        return space.enclose(value.rate if isinstance(value, Moving) else 0) * along.scale

    return _Rates(rate(d), [rate(each) for each in a], [rate(each) for each in b])


def scaled_along(field: Any, error, gain, gain_rate, nominal_rate, nominal_bend, feedforward) -> Along:
    """With D, a and b times a power of two that makes D about one: cubes of D must not be lost in rounding."""
    center = field.d.constant
    power = int(center.denominator).bit_length() - int(center.numerator).bit_length()
    scale = Q(1 << power) if power >= 0 else Q(1, 1 << -power)
    return Along(
        field.d * scale, [a * scale for a in field.a], [b * scale for b in field.b], field.x, field.waves, error, gain,
        gain_rate, nominal_rate, nominal_bend, feedforward, scale,
    )  # fmt: skip


def jump_bound(claim: Claim, along: Along, knot: int, place: str) -> Any:
    """By how much G + g v without its delay may jump at a knot; `along` is its ellipsoid's, just behind it."""
    step = claim.u[knot] - claim.u[knot - 1]
    rates = [after - before for after, before in zip(claim.rates[knot][0], claim.rates[knot - 1][1], strict=True)]
    bent = [
        (after - 2 * here + before) / claim.dt
        for after, here, before in zip(claim.K[knot + 1], claim.K[knot], claim.K[knot - 1], strict=True)
    ]
    moved = dot(along.gain, [b * step - along.d * rate for b, rate in zip(along.b, rates, strict=True)])
    turned = dot([error * k for error, k in zip(along.error, bent, strict=True)], [1] * claim.n)
    least = along.d.least
    require(least > 0, place, "the mass matrix' determinant is not shown to be positive here")
    return moved.largest / least + turned.largest + claim.reaction * abs(step)


def jumps_within_reach(claim: Claim, knot: int, start: Any) -> Any:
    """The sum of those between the oldest measurement and an interval's present, which begins `start` behind a knot."""
    if start * claim.dt >= claim.age:
        return Q(0)
    oldest = max(0, knot - math.ceil(claim.age / claim.dt))
    return sum(claim.jumps[oldest + 1 : knot + 1], Q(0))


def lateness(claim: Claim, late: Any, misfit: Any, jumps: Any) -> Any:
    """A bound of what the first order leaves; `late` is what the zeroth does, `jumps` are those within reach."""
    noise = late - claim.age * claim.speed
    spread = claim.limits[1] - claim.limits[0]
    first = misfit + jumps + claim.reaction * (claim.disturbance + 2 * late + spread)
    return noise + claim.age * first + claim.age * claim.age / 2 * (claim.jerk + claim.reaction * claim.speed)


def require_delay(claim: Claim, bounds: Bounds, place: str) -> None:
    """The bounds are those of the claim, and small enough for the theorem."""
    unit = claim.robot.input_unit
    for name, value, claimed in (("jerk", bounds.jerk, claim.jerk), ("reaction", bounds.reaction, claim.reaction)):
        reason = f"the feedback's {name} may be {rounded(value):.6g} {unit}, more than claim.{name}"
        require(value <= claimed, place, reason)
    require(claim.age * claim.reaction <= 1, place, "the age times claim.reaction must be at most 1")
