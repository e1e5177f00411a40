"""The sets of states that no motion enters: open half spaces, and open ellipsoids with axes along the states.

An ellipsoid {x : sum_i ((x_i - c_i) / a_i)^2 < 1} lies in the half space {x : w'(x - c) > -|(a_i w_i)_i|} for every w
that is zero where a_i is infinite. A certificate has such a w, the `side`, at both ends of every interval, linear in
between, where the norm is not more than the larger one of the ends, and one at the goal.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.exact import root_up


class HalfSpace(NamedTuple):
    """{x : normal'x > offset}."""

    normal: list
    offset: Any


class Ellipsoid(NamedTuple):
    """{x : sum_i ((x_i - center_i) / semi_axis_i)^2 < 1}; a semi axis of None is infinite."""

    center: list
    semi_axes: list


def half_spaces(keep_out: list, sides: list[tuple[list, list]]) -> Iterator[tuple[list, list, Any]]:
    """Of every set a half space w'(x - c) > offset that holds it, as (w [n], c [n], offset).

    `sides` has for every ellipsoid w [n], numbers or polynomials, and numbers [.][n] of which it is a mean.
    """
    rest = iter(sides)
    for each in keep_out:
        if isinstance(each, HalfSpace):
            yield each.normal, [0 * a for a in each.normal], each.offset
        else:
            normal, among = next(rest)
            yield normal, each.center, -max(_support(each, w) for w in among)


def _support(ellipsoid: Ellipsoid, w: list) -> Any:
    """An upper bound of the largest w'(x - c) in the ellipsoid."""
    pairs = zip(ellipsoid.semi_axes, w, strict=True)
    return root_up(sum((axis * axis * a * a for axis, a in pairs if axis is not None), start=0 * w[0]))
