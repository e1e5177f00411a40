"""Inequalities c(x_k) >= 0 at the interior knots, by slacks s > 0 and duals z: c(x) = s, s z = barrier.

Of their Newton equations, with the slopes J of c and r = c(x) - s,

    ds = J dx + r,      dz = barrier / s - z - (z / s) ds

are eliminated, which leaves in the quadratic model of every knot

    1/2 dx' (J' (z / s) J - sum z c_xx) dx + (J' ((z / s) r - barrier / s))' dx.

A start may be anywhere: r is a part of the violation that the filter brings to zero.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rtcd_jax.numerics.entries import Entry, Matrix, Row, plus, times
from rtcd_jax.numerics.interior_point.boxes import largest, room, total
from rtcd_jax.numerics.keep_out import Set

SMALLEST_SLACK = 1e-2
"""At the start."""


class Inequalities(NamedTuple):
    """Slacks and duals; c of the sets are their clearances."""

    slacks: Float[Array, "inner c P"]
    duals: Float[Array, "inner c P"]


class Linearized(NamedTuple):
    """The inequalities at a point, with the misfits r; entries of the slopes are numbers or [N-1 P]."""

    at: Inequalities
    misfits: Float[Array, "inner c P"]
    slopes: Matrix
    curvatures: list[list[float]]
    barrier: Float[Array, " P"]

    @classmethod
    def of(
        cls, sets: tuple[Set, ...], at: Inequalities, xs: Float[Array, "knots n P"], barrier: Float[Array, " P"]
    ) -> "Linearized":
        """At the knots xs, with the weight of the barrier."""
        slopes = [each.slopes(_inner(xs)) for each in sets]
        curvatures = [each.curvatures() for each in sets]
        return cls(at, misfits(sets, at.slacks, xs), slopes, curvatures, barrier)

    def pulled(self, weights: Float[Array, "inner c P"]) -> Row:
        """J' weights: entries [N-1 P], or zeros."""
        rows = [[times(slope, weights[:, j]) for slope in row] for j, row in enumerate(self.slopes)]
        return [plus(*column) for column in zip(*rows, strict=True)]

    def hessian(self) -> Matrix:
        """The lower half of J' (z / s) J - sum z c_xx."""
        stiffness, n = self.at.duals / self.at.slacks, len(self.slopes[0])
        lower: Matrix = [[0.0] * (i + 1) for i in range(n)]
        for c, row in enumerate(self.slopes):
            for i in range(n):
                for j in range(i + 1):
                    lower[i][j] = plus(lower[i][j], times(times(row[i], row[j]), stiffness[:, c]))
                lower[i][i] = plus(lower[i][i], times(-self.curvatures[c][i], self.at.duals[:, c]))
        return lower

    def gradient(self) -> Row:
        """J' ((z / s) r - barrier / s)."""
        return self.pulled((self.at.duals * self.misfits - self.barrier) / self.at.slacks)

    def steps(self, dxs: Float[Array, "knots n P"]) -> Inequalities:
        """ds and dz."""
        slacks, duals = self.at
        inner = _inner(dxs)
        moved = [plus(*(times(slope, dx) for slope, dx in zip(row, inner, strict=True))) for row in self.slopes]
        by_slack = jnp.stack(moved, 1) + self.misfits
        return Inequalities(by_slack, self.barrier / slacks - duals - duals / slacks * by_slack)

    def descent(self, steps: Inequalities) -> Float[Array, " P"]:
        """The slope of -barrier sum log s along the steps, without what `gradient` says of it."""
        slacks, duals = self.at
        along = (duals * self.misfits - self.barrier) / slacks * (steps.slacks - self.misfits)
        return -total(along) - self.barrier * total(steps.slacks / slacks)

    def moved(self, steps: Inequalities, length: Float[Array, " P"], fraction: Float[Array, " P"]) -> Inequalities:
        """The slacks at a length, and the duals near barrier / slack there."""
        slacks, duals = self.at.slacks + length * steps.slacks, self.at.duals
        duals = duals + jnp.minimum(1.0, room(duals, steps.duals, fraction)) * steps.duals
        return Inequalities(slacks, jnp.clip(duals, self.barrier / 1e10 / slacks, 1e10 * self.barrier / slacks))


def started(sets: tuple[Set, ...], xs: Float[Array, "knots n P"], barrier: Float[Array, " P"]) -> Inequalities:
    """Slacks that are positive, with duals to them."""
    slacks = jnp.maximum(_clearances(sets, xs), SMALLEST_SLACK)
    return Inequalities(slacks, barrier / slacks)


def misfits(
    sets: tuple[Set, ...], slacks: Float[Array, "inner c P"], xs: Float[Array, "knots n P"]
) -> Float[Array, "inner c P"]:
    """c(x) - s."""
    return _clearances(sets, xs) - slacks


def kept(at: Linearized, tolerance: float) -> Bool[Array, " P"]:
    """Whether every c(x) is positive and agrees with its slack."""
    return (largest(at.misfits) <= tolerance) & (jnp.min(at.misfits + at.at.slacks, (0, 1)) > 0)


def _inner(xs: Float[Array, "knots n P"]) -> list[Entry]:
    return list(jnp.moveaxis(xs[1:-1], 1, 0))


def _clearances(sets: tuple[Set, ...], xs: Float[Array, "knots n P"]) -> Float[Array, "inner c P"]:
    return jnp.stack([each.clearance(_inner(xs)) for each in sets], 1)
