"""The input: what the motor gives lies between two saturated laws, and which of their cases occur.

The feedback acts on a measurement, up to `age` old, with errors up to `noise`: it is u_lin + e with |e| <= error. The
motor's limit F lies in [F-, F+], and |w| <= `disturbance` comes on top. So

    clip(u_lin - error, -F+, F-) - w  <=  u  <=  clip(u_lin + error, -F-, F+) + w,

and what is affine in u and positive at both ends is positive at u. Where the limit alone is uncertain, both laws are
free only where |u_lin| <= F+: one case "free" is enough for both.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.matrix import dot
from rtcd_jax.certificate.check.squares import is_positive
from rtcd_jax.certificate.check.taylor import Space


class Feedback(NamedTuple):
    """What u_lin is beside the feed-forward: `linear` in y, with |linear|^2 <= `squared` on the sphere, and an `offset`
    that is the robot's own.
    """

    linear: Any
    squared: Any
    offset: Any


class Case(NamedTuple):
    """A case of a saturated law: the `input` where all of `where` are >= 0; `saturated` if it is a number."""

    where: list
    input: Any
    saturated: bool


def input_error(claim: Claim, k: int) -> Any:
    """A bound of the error of the feedback on interval k: its gains lie between those of the knots around it."""
    oldest = max(0, k - math.ceil(claim.age / claim.dt))
    return error_under(claim, claim.K[oldest : k + 2])


def error_under(claim: Claim, gains: Sequence[Sequence]) -> Any:
    """A bound of the error of the feedback whose gains lie between those of the rows."""
    largest = [max(abs(gain) for gain in column) for column in zip(*gains, strict=True)]
    return dot(largest, claim.noise) + claim.age * claim.speed


def cases_of(
    space: Space,
    claim: Claim,
    error,
    feedforward,
    feedback: Feedback,
    low,
    high,
    oldest: Feedback | None = None,
    joined: bool = True,
) -> dict[str, Case]:
    """By name: "free", "high" and "low", each with "-" and "+" where the laws differ; s in [low, high].

    What cannot occur is left out. The conditions are those of all robots together: each holds where it does for one.
    `oldest` is the feedback of the oldest measurement, where these count to first order: the cases "late" are those of
    its laws. `joined`: laws that differ in the limit alone have one case "free".
    """
    if oldest is not None:
        now, then = (
            cases_of(space, claim, error, feedforward, each, low, high, joined=joined) for each in (feedback, oldest)
        )
        return now | {f"{name}late": case for name, case in then.items()}
    weak, strong = claim.limits
    w, linear, apart = claim.disturbance, feedback.linear, space.size(feedback.offset)
    free = limited = {"-": (-error, strong, weak, -w), "+": (error, weak, strong, w)}
    if error == 0 and w == 0:
        widest = {"": (error, strong, strong, w)}
        free = widest if joined or weak == strong else free
        limited = widest if weak == strong else limited
    cases = {}
    for sign, (shift, lower, upper, on_top) in (free | limited).items():
        middle = feedforward + shift
        clearance = {
            "high": space.poly(upper - middle + apart) - linear,
            "low": space.poly(lower + middle + apart) + linear,
        }
        occurs = [
            case
            for case, left in (("high", upper - middle - apart), ("low", lower + middle - apart))
            if not (left > 0 and is_positive(space.poly(left * left) - feedback.squared, {0: (low, high)}, depth=4))
        ]
        if sign in free:
            law = space.poly(middle + on_top) + linear + feedback.offset
            cases[f"free{sign}"] = Case([clearance[case] for case in occurs], law, False)
        if sign in limited:
            ends = {"high": upper + on_top, "low": on_top - lower}
            for case in occurs:
                reached = space.poly(2 * apart) - clearance[case]
                cases[case + sign] = Case([reached], space.poly(ends[case]), True)
    return cases


def are_joined(cases: Iterable[str]) -> bool:
    """Whether laws that differ in the limit alone have one case "free" among these; older files have two."""
    return not any(name.startswith("free-") for name in cases)
