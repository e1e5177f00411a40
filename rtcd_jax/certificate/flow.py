"""The ellipsoids that grow fastest backward in time: the value function optimized with the funnel.

With L' = L W, W symmetric and constant on an interval, |y| falls on the boundary if

    y'W y > y'L^-1 (f(x* + L y, u) - x*') =: g(t, y)   for all |y| = 1,

and the volume grows backward at the rate -tr W. So W solves a linear program: minimize tr(M W) + evenness max y'W y
such that the inequality holds at sampled t and y with a spare rate, and the limits on the states are kept; g is taken
along the ellipsoids of the previous W, a fixed point in a few rounds. The TVLQR's shape is one feasible choice at every
instant; here the shape is free (Tobenkin, Manchester, Tedrake 2011, alternate between multipliers and V to that end).

What is largest at once may end thin: M = G^-attraction, G = L'S L, looks ahead by the value function. Without it
the volume grows fastest, with much of it the largest level set of TVLQR inside the ellipsoid, and between
them a power mean of the half axes measured by S.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.optimize import linprog

from rtcd_jax.certificate.loop import Loop


class Aim(NamedTuple):
    """What an ellipsoid of free shape aims at beside its volume."""

    evenness: float
    attraction: float


class Plan(NamedTuple):
    """Free shapes with this aim from the knot `until` to the goal, TVLQR's level sets before it."""

    aim: Aim
    until: int


AIMS = (Aim(0.1, 0.0), Aim(0.3, 0.0), Aim(1.0, 0.0), Aim(0.0, 1.0), Aim(0.0, 2.0))
"""To choose from: none is best for all elites."""
ROUNDS = 6
TIMES = 5
"""Instants of an interval at which the inequality is asked for."""
FASTEST = 100.0
"""Largest |entry of W| [1/s]."""
SETTLING = 0.02
"""Time [s] in which an ellipsoid may use up what is left to a limit on the states."""
SHARE_OF_LIMIT = 0.99
WIDEST = 2.0
"""Largest half width [rad] along the angle: beyond it polynomials follow the sine badly."""
LONGEST = 0.05
"""Longest interval [s]: one W for a longer one gives volume away."""
PREDICTED_SPARE = 0.02
"""Spare rate [1/s] of predictions."""
KEPT_INLET = 0.9
"""Share of the TVLQR's inlet that a plan must keep to be preferred."""


def fastest_growth(
    loop: Loop, k: int, start: float, end: float, axes: np.ndarray, spare: float, aim: Aim, y: np.ndarray
) -> np.ndarray | None:
    """W [n n] for the interval that ends with the ellipsoid `axes`; None if there is none."""
    pairs = [(i, j) for i in range(loop.n) for j in range(i + 1)]
    weight = _importance(axes.T @ loop.value(k, end)[0] @ axes, aim.attraction)
    cost = np.array([*(weight[i, j] * (1 if i == j else 2) for i, j in pairs), aim.evenness])
    products = _products(y, pairs)
    below = np.column_stack([-products, np.ones(len(products))])  # the last unknown is max y'W y
    w = path = np.zeros((loop.n, loop.n))
    for _ in range(ROUNDS):
        path = (path + w) / 2  # without the average the rounds alternate about their limit
        rows, levels = [], []
        for share in np.linspace(start, end, TIMES):
            here = axes @ expm(-path * (end - share) * loop.dt)
            rows.append(products)
            levels.append(loop.drift(k, share, here, y) + spare)
            narrow, least = _limits(loop, k, share, here, pairs)
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


def _products(y: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
    """Coefficients [D, pairs] of y'W y in the entries of W."""
    return np.stack([y[i] * y[j] * (1 if i == j else 2) for i, j in pairs], axis=1)


def _limits(loop: Loop, k: int, share: float, axes: np.ndarray, pairs: list) -> tuple[np.ndarray, np.ndarray]:
    """Rows and least values: half widths |row of L| grow backward no faster than what is left to their limits."""
    rooms = SHARE_OF_LIMIT * loop.rooms(k, share)
    rooms[loop.plant.angle] = min(rooms[loop.plant.angle], WIDEST)
    bounded = np.isfinite(rooms)
    widths = np.linalg.norm(axes, axis=1)[bounded]
    return _products((axes[bounded] / widths[:, None]).T, pairs), -np.log(rooms[bounded] / widths) / SETTLING


def predicted(loop: Loop, axes: np.ndarray, aim: Aim, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At the last M knots, down to where an interval has no W: volumes up to the unit ball's, and the levels of TVLQR's
    largest level sets inside the ellipsoids."""
    found = [_measures(loop, len(loop.u), axes)]
    for k in range(len(loop.u) - 1, -1, -1):
        for start, end in reversed(shares(loop)):
            w = fastest_growth(loop, k, start, end, axes, PREDICTED_SPARE, aim, y)
            if w is None:
                return tuple(np.array(found[::-1]).T)
            axes = axes @ expm(-w * (end - start) * loop.dt)
        found.append(_measures(loop, k, axes))
    return tuple(np.array(found[::-1]).T)


def _measures(loop: Loop, k: int, axes: np.ndarray) -> tuple[float, float]:
    return float(np.linalg.det(axes)), held_level(loop.values[k], axes)


def held_level(s: np.ndarray, axes: np.ndarray) -> float:
    """The largest rho with {x'S x <= rho} in {L y : |y| <= 1}."""
    return float(np.linalg.eigvalsh(axes.T @ s @ axes)[0])


def shares(loop: Loop) -> list[tuple[float, float]]:
    """The parts of a knots' interval that get a W each."""
    parts = 2 ** max(math.ceil(math.log2(loop.dt / LONGEST)), 0)
    return [(i / parts, (i + 1) / parts) for i in range(parts)]


def best_plan(loop: Loop, axes: np.ndarray, rhos: np.ndarray, y: np.ndarray) -> Plan | None:
    """The plan with the largest sum of volumes that about keeps the inlet; None: keep S throughout.

    Before a plan's knot TVLQR's levels `rhos` [N+1] are taken to shrink by the share that the free shape holds of them.
    """
    usual = rhos ** (loop.n / 2) / np.sqrt(np.linalg.det(loop.values))
    best, most = None, float(usual.sum())
    for aim in AIMS:
        volumes, levels = predicted(loop, axes, aim, y)
        first = len(usual) - len(volumes)
        for i, level in enumerate(levels):
            k = first + i
            kept = np.minimum(level / rhos[k], 1) ** (loop.n / 2) if k else volumes[0] / usual[0]
            total = float(kept * usual[:k].sum() + volumes[i:].sum())
            if kept >= KEPT_INLET and total > most:
                best, most = Plan(aim, k), total
    return best
