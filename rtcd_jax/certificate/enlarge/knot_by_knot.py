"""The ellipsoids that grow fastest backward in time, interval by interval: for more states than two.

There the boundaries have too many directions for one program over all knots. With L' = L W, W symmetric and constant
on an interval, |y| falls on the boundary if

    y'W y > y'L^-1 (f(x* + L y, u) - x*') =: g(t, y)   for all |y| = 1,

and the volume grows backward at the rate -tr W. So W solves a linear program: minimize tr(M W) + evenness max y'W y
such that the inequality holds at sampled t and y with a spare rate, and the limits on the states are kept; g is taken
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
    SHARE_OF_LIMIT,
    SHARES,
    SPARED,
    directions,
    leveled,
    lower_pairs,
    merit,
    products,
)


class Aim(NamedTuple):
    """What an ellipsoid of free shape aims at beside its volume."""

    evenness: float
    attraction: float


AIMS = (Aim(0.3, 0.0), Aim(0.0, 1.0))
"""To choose from."""
TAKEOVERS = 8
"""Knots, evenly spread, at which TVLQR's level sets may take over."""
THINNED = 4
"""The linear programs get one of so many directions."""
ROUNDS = 6
FASTEST = 100.0
"""Largest |entry of W| [1/s]."""
SETTLING = 0.02
"""Time [s] in which an ellipsoid may use up what is left to a limit on the states."""
WIDEST = 0.5
"""Half width [rad] along the angle up to which ellipsoids grow: polynomials of order 5 follow no wider sine well."""


def grown(best: Loop, aims: np.ndarray) -> Loop:
    """The largest funnel of all aims and knots to take over at, the given one among them; `aims` carry levels back."""
    usual = best
    for aim in AIMS:
        first, free = fastest(usual, aim)
        for until in np.unique(np.linspace(first, len(usual.u), TAKEOVERS, endpoint=False).astype(int)):
            try:
                tried = leveled(taken_over(usual, free, int(until)), aims)
            except (Refused, np.linalg.LinAlgError):
                continue
            best = max(best, tried, key=merit)
    return best


def fastest(usual: Loop, aim: Aim) -> tuple[int, Loop]:
    """Free shapes from the goal back to the first knot before which an interval has no W."""
    y = directions(usual.n)[:, ::THINNED]
    axes = np.linalg.cholesky(np.linalg.inv(usual.values[-1]))
    values, slopes = usual.values.copy(), usual.slopes.copy()
    for k in range(len(usual.u) - 1, -1, -1):
        w = fastest_growth(usual, k, axes, aim, y)
        if w is None:
            return k + 1, usual.shaped(values, slopes)
        before = axes @ expm(-w * usual.dt)
        for end, each in enumerate((before, axes)):
            inverse = np.linalg.inv(each)
            slopes[k, end] = -2 * inverse.T @ w @ inverse
        axes, values[k] = before, np.linalg.inv(before @ before.T)
    return 0, usual.shaped(values, slopes)


def taken_over(usual: Loop, free: Loop, until: int) -> Loop:
    """Free shapes from the knot `until` on; before it the level sets the last of which is the largest one inside."""
    if until == 0:
        return free
    values, slopes = free.values.copy(), free.slopes.copy()
    held = held_level(usual.values[until], np.linalg.cholesky(np.linalg.inv(values[until])))
    values[:until], slopes[:until] = usual.values[:until] / held, usual.slopes[:until] / held
    slopes[until - 1] = (values[until] - values[until - 1]) / usual.dt
    return usual.shaped(values, slopes)


def held_level(s: np.ndarray, axes: np.ndarray) -> float:
    """The largest rho with {x'S x <= rho} in {L y : |y| <= 1}."""
    return float(np.linalg.eigvalsh(axes.T @ s @ axes)[0])


def fastest_growth(loop: Loop, k: int, axes: np.ndarray, aim: Aim, y: np.ndarray) -> np.ndarray | None:
    """W [n n] for the interval k, which ends with the ellipsoid `axes`; None if there is none."""
    pairs = lower_pairs(loop.n)
    weight = _importance(axes.T @ loop.values[k + 1] @ axes, aim.attraction)
    cost = np.array([*(weight[i, j] * (1 if i == j else 2) for i, j in pairs), aim.evenness])
    along = products(y, y)
    below = np.column_stack([-along, np.ones(len(along))])  # the last unknown is max y'W y
    w = path = np.zeros((loop.n, loop.n))
    for _ in range(ROUNDS):
        path = (path + w) / 2  # without the average the rounds alternate about their limit
        rows, levels = [], []
        for share in SHARES:
            here = axes @ expm(-path * (1 - share) * loop.dt)
            rows.append(along)
            levels.append(loop.drift(k, share, here, y) + SPARED)
            narrow, least = _limits(loop, k, share, here)
            rows.append(narrow)
            levels.append(least)
        table = np.concatenate(rows)
        table = np.concatenate([np.column_stack([table, np.zeros(len(table))]), below])
        found = linprog(cost, -table, -np.concatenate([*levels, np.zeros(len(below))]), bounds=(-FASTEST, FASTEST))
        if found.status != 0:
            return None
        w = np.zeros((loop.n, loop.n))
        for (i, j), value in zip(pairs, found.x[:-1], strict=True):
            w[i, j] = w[j, i] = value
    return w


def _importance(g: np.ndarray, attraction: float) -> np.ndarray:
    """G^-attraction, its trace n."""
    values, vectors = np.linalg.eigh(g)
    weights = values**-attraction
    return (vectors * (len(g) * weights / weights.sum())) @ vectors.T


def _limits(loop: Loop, k: int, share: float, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and least values: half widths |row of L| grow backward no faster than what is left to their limits."""
    rooms = SHARE_OF_LIMIT * loop.rooms(k, share)
    widths, angle = np.linalg.norm(axes, axis=1), loop.plant.angle
    rooms[angle] = min(rooms[angle], max(WIDEST, widths[angle]))
    bounded = np.isfinite(rooms)
    widths = widths[bounded]
    rows = (axes[bounded] / widths[:, None]).T
    return products(rows, rows), -np.log(rooms[bounded] / widths) / SETTLING
