"""The ellipsoids that grow fastest backward in time, interval by interval, for more than two states.

There the boundaries have too many directions for one program over all knots. With L' = L W, W symmetric and constant
on an interval, |y| falls on the boundary if

    y'W y > y'L^-1 (f(x* + L y, u) - x*') =: g(t, y)   for all |y| = 1,

and the volume grows backward at the rate -tr W. So W solves a linear program: minimize tr(M W) + evenness max y'W y
such that the inequality holds at sampled t and y with a decay margin, and the limits on the states hold; g is taken
along the ellipsoids of the previous W, a fixed point in a few rounds.

What is largest at once may end thin: M = G^-attraction, G = L'S L, looks ahead by TVLQR's value function. Without it
the volume grows fastest, with much of it the largest level set of TVLQR inside the ellipsoid. And at some knot TVLQR's
level sets may take over again: the largest one inside the ellipsoid, and the interval between grows from the one into
the other.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.optimize import linprog

from rtcd_jax.certificate.check import Refused
from rtcd_jax.certificate.prove.closed_loop import Loop
from rtcd_jax.certificate.prove.levels import (
    DECAY_MARGIN,
    FRACTION_OF_LIMIT,
    FRACTIONS,
    leveled,
    lower_pairs,
    merit,
    products,
    unit_directions,
)


class ShapeObjective(NamedTuple):
    """Weights beside the volume: of a round shape, and of the largest level set of TVLQR inside."""

    evenness: float
    attraction: float


SHAPE_OBJECTIVES = (ShapeObjective(0.3, 0.0), ShapeObjective(0.0, 1.0))
"""The largest funnel of all of them is taken."""
TAKEOVERS = 8
"""Knots, evenly spread, at which TVLQR's level sets may take over."""
DIRECTION_STRIDE = 4
"""Stride of the directions in the linear programs."""
ROUNDS = 6
FASTEST = 100.0
"""Largest |entry of W| [1/s]."""
SETTLING = 0.02
"""Time [s] in which an ellipsoid may use up its clearance to a limit on the states."""
WIDEST = 0.5
"""Half width [rad] along the angle up to which ellipsoids grow: polynomials of order 5 follow no wider sine well."""


def grown(best: Loop, directions: np.ndarray) -> Loop:
    """The largest funnel over all objectives and takeover knots, or the given one if none is larger.

    Levels are carried back along the `directions` [n D].
    """
    usual = best
    for objective in SHAPE_OBJECTIVES:
        first, free = fastest(usual, objective)
        for until in np.unique(np.linspace(first, len(usual.u), TAKEOVERS, endpoint=False).astype(int)):
            try:
                tried = leveled(taken_over(usual, free, int(until)), directions)
            except (Refused, np.linalg.LinAlgError):
                continue
            best = max(best, tried, key=merit)
    return best


def fastest(usual: Loop, objective: ShapeObjective) -> tuple[int, Loop]:
    """Free shapes from the goal back to the first knot before which an interval has no W."""
    y = unit_directions(usual.n)[:, ::DIRECTION_STRIDE]
    axes = np.linalg.cholesky(np.linalg.inv(usual.values[-1]))
    values, slopes = usual.values.copy(), usual.slopes.copy()
    for k in range(len(usual.u) - 1, -1, -1):
        w = fastest_growth(usual, k, axes, objective, y)
        if w is None:
            return k + 1, usual.shaped(values, slopes)
        before = axes @ expm(-w * usual.dt)
        for end, each in enumerate((before, axes)):
            inverse = np.linalg.inv(each)
            slopes[k, end] = -2 * inverse.T @ w @ inverse
        axes, values[k] = before, np.linalg.inv(before @ before.T)
    return 0, usual.shaped(values, slopes)


def taken_over(usual: Loop, free: Loop, until: int) -> Loop:
    """Free shapes from the knot `until` on; before it level sets of V, at the largest level inside the free shape."""
    if until == 0:
        return free
    values, slopes = free.values.copy(), free.slopes.copy()
    axes = np.linalg.cholesky(np.linalg.inv(values[until]))
    level = float(np.linalg.eigvalsh(axes.T @ usual.values[until] @ axes)[0])  # the largest rho with {V <= rho} inside
    values[:until], slopes[:until] = usual.values[:until] / level, usual.slopes[:until] / level
    slopes[until - 1] = (values[until] - values[until - 1]) / usual.dt
    return usual.shaped(values, slopes)


def fastest_growth(loop: Loop, k: int, axes: np.ndarray, objective: ShapeObjective, y: np.ndarray) -> np.ndarray | None:
    """W [n n] for the interval k, which ends with the ellipsoid `axes`; None if there is none."""
    pairs = lower_pairs(loop.n)
    weight = importance(axes.T @ loop.values[k + 1] @ axes, objective.attraction)
    cost = np.array([*(weight[i, j] * (1 if i == j else 2) for i, j in pairs), objective.evenness])
    along = products(y, y)
    below = np.column_stack([-along, np.ones(len(along))])  # the last unknown is max y'W y
    w = path = np.zeros((loop.n, loop.n))
    for _ in range(ROUNDS):
        path = (path + w) / 2  # without the average the rounds alternate about their limit
        rows, levels = [], []
        for fraction in FRACTIONS:
            here = axes @ expm(-path * (1 - fraction) * loop.dt)
            rows.append(along)
            levels.append(loop.drift(k, fraction, here, y) + DECAY_MARGIN)
            narrow, least = _limits(loop, k, fraction, here)
            rows.append(narrow)
            levels.append(least)
        table = np.concatenate(rows)
        table = np.concatenate([np.column_stack([table, np.zeros(len(table))]), below])
        solution = linprog(cost, -table, -np.concatenate([*levels, np.zeros(len(below))]), bounds=(-FASTEST, FASTEST))
        if solution.status != 0:
            return None
        w = np.zeros((loop.n, loop.n))
        for (i, j), value in zip(pairs, solution.x[:-1], strict=True):
            w[i, j] = w[j, i] = value
    return w


def importance(g: np.ndarray, attraction: float) -> np.ndarray:
    """G^-attraction, its trace n."""
    values, vectors = np.linalg.eigh(g)
    weights = values**-attraction
    return (vectors * (len(g) * weights / weights.sum())) @ vectors.T


def _limits(loop: Loop, k: int, fraction: float, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and least values: half widths |row of L| grow backward no faster than their clearance allows."""
    clearance = FRACTION_OF_LIMIT * loop.clearance(k, fraction)
    widths, angles = np.linalg.norm(axes, axis=1), loop.hinges
    clearance[angles] = np.minimum(clearance[angles], np.maximum(WIDEST, widths[angles]))
    bounded = np.isfinite(clearance)
    widths = widths[bounded]
    rows = (axes[bounded] / widths[:, None]).T
    return products(rows, rows), -np.log(clearance[bounded] / widths) / SETTLING
