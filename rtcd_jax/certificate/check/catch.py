"""The obligation of a motion's end: its last ellipsoid lies in the catch set, or the reset leads it there."""

from collections.abc import Sequence
from typing import Any

from rtcd_jax.certificate.check.claim import Claim, Reset
from rtcd_jax.certificate.check.exact import MAX_ORDER, PI, PI_ERROR, Q, near, require
from rtcd_jax.certificate.check.funnel import waves_near, waves_of
from rtcd_jax.certificate.check.matrix import cofactors, dot
from rtcd_jax.certificate.check.robot import Function, value_of
from rtcd_jax.certificate.check.squares import Obligation, control_points
from rtcd_jax.certificate.check.taylor import Taylor

CAUGHT = "caught"
"""The one case of a catch."""


def catch_obligations(claim: Claim, outlet: list, order: int, place: str) -> dict[str, Obligation]:
    """|adj(L_c) D (x+ - c)| < D det L_c at all states c_p(t_N) + l L_N z before the reset, l in [0, 1], |z| = 1, where
    D x+ is what the reset leads to; without one it is D = 1 and x. By control point of the robots.
    """
    assert claim.catch is not None
    center, axes, reset = claim.catch
    space = claim.space(MAX_ORDER, order)
    z = [space.y(i) for i in range(claim.n)]
    x = []
    for i, row in enumerate(outlet):
        shifts = (space.of_the_robot(powers) * values[-1][i] for powers, values, _ in claim.shifts)
        x.append(Taylor(space, sum(shifts, space.poly(claim.x[-1][i]) + dot(z, row) * space.s)).tidy())
    factor, landed = (space.enclose(1), x) if reset is None else _after(claim, reset, x, place)
    adjugate, determinant = cofactors(axes)
    require(determinant > 0, place, "the catch set is degenerate: det L must be > 0")
    middle = factor.constant * determinant
    require(middle > 0, place, "the mass matrix' determinant after the reset is not shown to be positive here")
    scale, _ = near(1 / middle, 30)
    offset = [(there - factor * c) * scale for there, c in zip(landed, center, strict=True)]
    apart = [dot(offset, row) for row in adjugate]
    room = factor * (determinant * scale)
    q = room * room - dot(apart, apart)
    points = control_points(q.p, claim.n)
    return {
        f"{CAUGHT}/{point}" if point else CAUGHT: Obligation(part, q.r + q.d, Q(0), [], Q(0), Q(1))
        for point, part in points.items()
    }


def _after(claim: Claim, reset: Reset, x: Sequence[Taylor], place: str) -> tuple[Taylor, list[Taylor]]:
    """D and D x+, D the determinant of the mass matrix after the reset."""
    robot, space = claim.robot, x[0].space
    joints = range(len(robot.joints))
    q, v = x[: len(joints)], x[len(joints) :]
    mass = [[_turned(entry, reset) for entry in row] for row in robot.mass]
    terms = [term for row in (*mass, *reset.momentum) for entry in row for term in entry]
    waves = sorted({term.joints for term in terms if any(term.joints)})
    known = waves_of([*x], waves_near(waves, [*x], place), place)
    before = claim.numbers(space)
    after = {name: before[a] if isinstance(a, str) else a for name, a in reset.numbers.items()}

    def value(function: Function, numbers: dict[str, Any]) -> Taylor:
        return space.enclose(value_of(robot, function, numbers, q, known))

    lower = [[value(entry, after) for entry in row] for row in mass]
    adjugate, determinant = cofactors([[lower[max(i, j)][min(i, j)] for j in joints] for i in joints])
    momenta = [dot(v, [value(entry, before) for entry in row]) for row in reset.momentum]
    positions = [
        dot(q, map(Q, row)) + Taylor(space, space.poly(PI * turns), d=PI_ERROR * abs(turns))
        for row, turns in zip(reset.positions, reset.turns, strict=True)
    ]
    return determinant, [determinant * at for at in positions] + [dot(momenta, row) for row in adjugate]


def _turned(function: Function, reset: Reset) -> Function:
    """A function of q+ as one of q: cos(k.q+) = cos(k.P q + k.turns pi)."""
    turned = []
    for term in function:
        sign = -1 if sum(k * turns for k, turns in zip(term.joints, reset.turns, strict=True)) % 2 else 1
        joints = tuple(sum(k * row[j] for k, row in zip(term.joints, reset.positions, strict=True))
                       for j in range(len(term.joints)))  # fmt: skip
        turned.append(term._replace(joints=joints, cosine=term.cosine * sign, sine=term.sine * sign))
    return tuple(turned)
