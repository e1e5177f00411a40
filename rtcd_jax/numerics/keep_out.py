"""Sets of states to keep out of: open half spaces, and open ellipsoids with axes along the states.

    {x : normal . x > offset},      {x : sum_i ((x_i - center_i) / semi_axis_i)^2 < 1}

An infinite semi axis bounds nothing in that state. The boundaries are allowed. States have their components first and
any further axes; numpy's arrays and JAX's serve alike, and JAX is imported where it is needed: stored elites are read
without it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    from jaxtyping import Array

    from rtcd_jax.numerics.ellipsoid import Ellipsoids

HALVINGS = 60
"""Of the logarithm of a multiplier between its bounds."""


@final
@dataclass(frozen=True)
class HalfSpace:
    """{x : normal . x > offset}; the `room` is offset - normal . x at that end of the motions which is nearest."""

    normal: tuple[float, ...]
    offset: float
    room: float

    def shrunk(self, share: float) -> "HalfSpace":
        """The half space that leaves a motion a `share` of the room."""
        return replace(self, offset=self.offset - (1 - share) * self.room, room=share * self.room)

    def clearance(self, x: Any) -> Any:
        """A smooth number [...] without unit, negative exactly inside: the distance over the room."""
        return (self.offset - _dot(self.normal, x)) / self.room

    def slopes(self, x: Any) -> list[Any]:
        """The clearance's derivatives by every state."""
        return [-a / self.room for a in self.normal]

    def curvatures(self) -> list[float]:
        """The diagonal of its second derivatives; there are no others."""
        return [0.0] * len(self.normal)

    def entered(self, x: Any) -> Any:
        """Whether the states [...] are inside; what is no number is not."""
        return _dot(self.normal, x) > self.offset

    def fill(self, x: Any) -> "Array":
        """The used share of the room, above 1 exactly inside; not a number for one."""
        return 1 + (_dot(self.normal, x) - self.offset) / self.room

    def radii_clear(self, sets: "Ellipsoids") -> "Float[Array, ' K']":
        """The largest sqrt(rho) for which the ellipsoids do not meet the half space; 0 where the center is inside."""
        import jax.numpy as jnp

        from rtcd_jax.numerics.batched import solve_lower

        centers = sets.centers
        row = jnp.asarray(self.normal, centers.dtype)[:, None, None]
        support = jnp.sqrt(jnp.sum(solve_lower(sets.factors, row) ** 2, (0, 1)))
        return jnp.maximum((self.offset - _dot(self.normal, centers)) / support, 0.0)

    def reach(self, x: Any, step: Any) -> np.ndarray:
        """The smallest |s| [...] for which x + s step, of an x outside, is on the boundary."""
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.abs((self.offset - _dot(self.normal, x)) / _dot(self.normal, step))
        return np.nan_to_num(reach, nan=inf, posinf=inf)


@final
@dataclass(frozen=True)
class Ellipsoid:
    """{x : sum_i ((x_i - center_i) / semi_axis_i)^2 < 1}."""

    center: tuple[float, ...]
    semi_axes: tuple[float, ...]

    def shrunk(self, share: float) -> "Ellipsoid":
        """The ellipsoid grown by 1 / share, which a motion is to keep out of."""
        return replace(self, semi_axes=tuple(axis / share for axis in self.semi_axes))

    def clearance(self, x: Any) -> Any:
        """A smooth number [...] without unit, negative exactly inside: the quadratic form less one."""
        return self._form(x) - 1

    def slopes(self, x: Any) -> list[Any]:
        """The clearance's derivatives by every state."""
        parts = zip(x, self.center, self.semi_axes, strict=True)
        return [2 / axis**2 * (a - c) if isfinite(axis) else 0.0 for a, c, axis in parts]

    def curvatures(self) -> list[float]:
        """The diagonal of its second derivatives; there are no others."""
        return [2 / axis**2 for axis in self.semi_axes]

    def entered(self, x: Any) -> Any:
        """Whether the states [...] are inside; what is no number is not."""
        return self._form(x) < 1

    def fill(self, x: Any) -> "Array":
        """The inverse distance from the center in semi axes, above 1 exactly inside; not a number for one."""
        import jax.numpy as jnp

        return 1 / jnp.sqrt(self._form(x))

    def radii_clear(self, sets: "Ellipsoids") -> "Float[Array, ' K']":
        """The largest sqrt(rho) for which the ellipsoids do not meet this one; 0 where the center is inside.

        With W = diag(1 / semi_axis^2), M = W^1/2 S^-1 W^1/2 and a = W^1/2 (c - x), the least V on this ellipsoid is
        the largest l (a'(1 + l M)^-1 a - 1) over l >= 0, of which each is a bound from below. At the largest one
        |(1 + l M)^-1 a| = 1, and |a| - 1 lies between l times the least and l times the largest eigenvalue of M.
        """
        import jax
        import jax.numpy as jnp

        from rtcd_jax.numerics.batched import mtm, solve_lower, spd_solve
        from rtcd_jax.numerics.loops import repeat

        x, dtype = sets.centers, sets.centers.dtype
        bounded = np.flatnonzero(np.isfinite(self.semi_axes))
        scales = 1 / np.array(self.semi_axes)[bounded]
        rows = np.zeros((len(self.center), len(bounded), 1))
        rows[bounded, np.arange(len(bounded)), 0] = scales
        half = solve_lower(sets.factors, jnp.asarray(rows, dtype))
        shape, apart = (
            mtm(half, half),
            jnp.stack([s * (self.center[i] - x[i]) for i, s in zip(bounded, scales, strict=True)]),
        )
        eye = jnp.asarray(np.eye(len(bounded))[..., None], dtype)
        distance = jnp.sqrt(jnp.sum(apart**2, 0))
        outside = distance > 1

        def solve(multiplier):
            return spd_solve(eye + multiplier * shape, apart[:, None])[0][:, 0]

        def halve(bracket):
            low, high = bracket
            middle = jnp.sqrt(low * high)
            below = jnp.sum(solve(middle) ** 2, 0) > 1
            return jnp.where(below, middle, low), jnp.where(below, high, middle)

        beyond = jnp.where(outside, distance - 1, 1.0)
        bracket = beyond / jnp.trace(shape), beyond * jnp.trace(spd_solve(shape, eye)[0])
        multiplier = jax.lax.stop_gradient(repeat(HALVINGS, halve, bracket)[0])
        least = multiplier * (jnp.sum(apart * solve(multiplier), 0) - 1)
        return jnp.where(outside, jnp.sqrt(jnp.maximum(least, jnp.finfo(dtype).tiny)), 0.0)

    def reach(self, x: Any, step: Any) -> np.ndarray:
        """The smallest |s| [...] for which x + s step, of an x outside, is on the boundary; infinite if none is."""
        parts = [
            ((a - c) / axis, b / axis)
            for a, b, c, axis in zip(x, step, self.center, self.semi_axes, strict=True)
            if isfinite(axis)
        ]
        form, along, square = (sum(part) for part in zip(*((e**2, e * d, d**2) for e, d in parts), strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            root = np.sqrt(along**2 - square * (form - 1))  # not a number where the line passes by
            reach = (np.abs(along) - root) / square
        return np.nan_to_num(reach, nan=inf, posinf=inf)

    def _form(self, x: Any) -> Any:
        parts = zip(x, self.center, self.semi_axes, strict=True)
        terms = [((a - c) / axis) ** 2 for a, c, axis in parts if isfinite(axis)]
        return sum(terms[1:], terms[0])


Set = HalfSpace | Ellipsoid


def sets_of(stated: Sequence[Mapping[str, Any]], ends: Float[np.ndarray, "E n"]) -> tuple[Set, ...]:
    """The sets that a task states, in its words; `ends` are starts and goals, outside of all sets.

    A semi axis of None is infinite.
    """
    sets: list[Set] = []
    for each in stated:
        if "normal" in each:
            normal, offset = tuple(map(float, each["normal"])), float(each["offset"])
            sets.append(HalfSpace(normal, offset, offset - float(np.max(ends @ np.array(normal)))))
        else:
            axes = tuple(inf if axis is None else float(axis) for axis in each["semi_axes"])
            sets.append(Ellipsoid(tuple(map(float, each["center"])), axes))
    return tuple(sets)


def _dot(normal: Sequence[float], x: Any) -> Any:
    terms = [a * b for a, b in zip(normal, x, strict=True) if a]
    return sum(terms[1:], terms[0])
