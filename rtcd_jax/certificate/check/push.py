"""The push margin: an impulse on the motor moves a state on x* at most to the funnel's boundary, at every instant."""

from collections.abc import Callable
from typing import Any

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import require, rounded
from rtcd_jax.certificate.check.funnel import Interval, field_of, motion, waves_near
from rtcd_jax.certificate.check.matrix import cofactors, dot
from rtcd_jax.certificate.check.squares import is_positive
from rtcd_jax.certificate.check.taylor import Taylor


def require_push(claim: Claim, interval: Interval, place: str) -> None:
    """x* + (b / D) J in E, or c_p for x*, for all |J| <= push, robots and instants: (D det L)^2 > |push adj(L) b|^2."""
    holds = is_positive(push_clearance(claim, interval, place)(claim.push), claim.cube)
    require(holds, place, f"an impulse of {rounded(claim.push):.6g} {claim.robot.input_unit} s may leave the funnel")


def push_clearance(claim: Claim, interval: Interval, place: str) -> Callable[[Any], Any]:
    """An impulse -> the polynomial in s and the robots that must be positive."""
    data, space = motion(claim, interval), interval.space(claim)
    x = [Taylor(space, center).tidy() for center in data.center]
    field = field_of(claim, x, waves_near(claim.equations.waves, x, place), place)
    adjugate, determinant = cofactors(data.axes)
    moved = [dot([Taylor(space, entry) for entry in row], field.b) for row in adjugate]
    room = field.d * Taylor(space, determinant)
    allowed, needed = room * room, dot(moved, moved)

    def clearance(push: Any) -> Any:
        left = allowed - needed * (push * push)
        return left.p - space.poly(left.r + left.d)

    return clearance
