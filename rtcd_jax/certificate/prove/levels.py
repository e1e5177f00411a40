"""The levels of V that the loop allows: at the goal, and carried backward in time; and the size of their funnel."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog

from rtcd_jax.certificate.check import Refused, require
from rtcd_jax.certificate.prove.closed_loop import Loop, hermite

LADDER = np.geomspace(1e-10, 1, 241)
"""Levels at which the fastest growth of V at the goal is sampled, as fractions of the largest one."""
BISECTIONS = 12
"""Of the two levels of the ladder between which V ceases to fall."""
HEUN_STEPS = 4
COLLAPSE = 1e-3
"""Fraction of its level that a funnel must keep within an interval."""
BOX_FRACTION = 0.999
"""Fraction of the level at which an ellipsoid would touch a limit."""
FRACTION_OF_LIMIT = 0.99
"""Fraction of the clearance to a limit that ellipsoids of free shape may fill."""
DIRECTION_COUNTS = {2: 720, 4: 4000}
ROUNDS = 3
"""Linear programs by which the level of an interval that is proved follows the growth of V."""
SPARE = 0.1
"""Weight of how much faster |y| falls, beside the level."""
INSTANTS = np.linspace(0, 1, 7)
"""Fractions of such an interval at which the growth is sampled."""
DECAY_MARGIN = 0.02
"""Decay margin [1/s] of funnels that are not proved yet."""
FRACTIONS = np.linspace(0, 1, 5)
"""Fractions of an interval at which such a funnel is sampled."""
INLET = 0.1
"""Weight of the logarithm of the inlet's volume beside that of the integral."""


class Carried(NamedTuple):
    """A level at the start of an interval, and its rates of growth [1/s] at the start and the end."""

    rho: float
    first: float
    last: float


class Course(NamedTuple):
    """The ellipsoids of an interval: L and L' [n n] at its start and end. In between L is the cubic of these."""

    first: np.ndarray
    first_rate: np.ndarray
    last: np.ndarray
    last_rate: np.ndarray

    def at(self, fraction: float, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """L and L'."""
        return hermite(fraction, duration, self.first, self.first_rate, self.last, self.last_rate)

    def scaled(self, by: float, first_growth: float, last_growth: float) -> "Course":
        """With `by` times the first ellipsoid, and both ends growing faster by rates [1/s]."""
        first_rate = by * (self.first_rate + first_growth * self.first)
        return Course(by * self.first, first_rate, self.last, self.last_rate + last_growth * self.last)


def unit_directions(n: int) -> np.ndarray:
    """Unit vectors [n D] that cover the sphere."""
    if n == 2:
        angle = np.linspace(0, 2 * np.pi, DIRECTION_COUNTS[2], endpoint=False)
        return np.stack([np.cos(angle), np.sin(angle)])
    vectors = np.random.default_rng(0).normal(size=(n, DIRECTION_COUNTS[n]))
    return vectors / np.linalg.norm(vectors, axis=0)


def lower_pairs(n: int) -> list[tuple[int, int]]:
    """The entries (i, j) of a symmetric matrix's lower half, in the order in which programs have them."""
    return [(i, j) for i in range(n) for j in range(i + 1)]


def products(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Coefficients [... D m] of p'X q in the `lower_pairs` of a symmetric X; p, q [... n D]."""
    return np.stack(
        [p[..., i, :] * q[..., j, :] + (i != j) * p[..., j, :] * q[..., i, :] for i, j in lower_pairs(p.shape[-2])],
        axis=-1,
    )


def goal_level(loop: Loop, directions: np.ndarray) -> float:
    """The largest level up to which V falls in the sampled directions [n D], under the limits on the states.

    Where something moves the goal, V need not fall on the lowest levels.

    Raises:
        Refused: V falls at no level.
    """

    def falls(level: float) -> bool:
        return loop.goal_growth(level, directions) < 0

    levels = BOX_FRACTION * loop.goal_box_level() * LADDER
    fall = [falls(level) for level in levels]
    first = fall.index(True) if loop.claim.moves_the_goal and True in fall else 0
    last = fall.index(False, first) if False in fall[first:] else len(levels)
    require(last > first, "goal", "V does not fall")
    if last == len(levels):
        return float(levels[-1])
    low, high = levels[last - 1], levels[last]
    for _ in range(BISECTIONS):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if falls(middle) else (low, middle)
    return float(low)


def last_level(loop: Loop, directions: np.ndarray) -> float:
    """The level at t_N from which levels are carried back: the goal's, or that of the catch set, under the limits.

    Raises:
        Refused: V falls at no level about the goal.
    """
    if loop.claim.catch is None:
        return goal_level(loop, directions)
    return min(loop.caught_level(), BOX_FRACTION * loop.box_level(len(loop.u) - 1, 1.0))


def carried_back(
    loop: Loop, k: int, start: float, end: float, rho: float, decay_margin: float, directions: np.ndarray
) -> Carried:
    """The level that the loop carries into rho at the end, by Heun's method on its logarithm, under the limits.

    Raises:
        Refused: the level vanishes.
    """

    def growth(fraction: float, level: float) -> float:
        return loop.growth(k, fraction, level, directions) + decay_margin

    step, held = (end - start) / HEUN_STEPS, rho
    last = slope = growth(end, rho)
    for i in range(HEUN_STEPS):
        fraction = end - (i + 1) * step
        guess = rho * np.exp(-step * loop.dt * slope)
        rho *= np.exp(-step * loop.dt * (slope + growth(fraction, guess)) / 2)
        if rho < COLLAPSE * held:
            raise Refused("interval", "the level vanishes")
        slope = growth(fraction, rho)
    cap = BOX_FRACTION * loop.box_level(k, start)
    if rho > cap:
        both = float(np.log(held / cap) / ((end - start) * loop.dt))
        return Carried(cap, both, both)
    return Carried(float(rho), slope, last)


def followed(
    loop: Loop, k: int, start: float, end: float, rho: float, decay_margin: float, directions: np.ndarray
) -> tuple[float, Course]:
    """The largest level at the start from which a cubic L leads to rho at the end, and that L: |y| falls by half the
    decay margin or faster at all sampled instants.

    The cubic of `carried_back` follows V's growth at both ends alone. It is scaled by exp(c(t)), c(end) = 0, with a
    quadratic c' no smaller than what is missing, of which a linear program finds the one with the least integral. The
    limits on the states hold at the instants, too; where only they bind, c' exceeds what is missing by all it can.

    Raises:
        Refused: the level vanishes.
    """
    duration = (end - start) * loop.dt
    carried = carried_back(loop, k, start, end, rho, decay_margin, directions)
    first, last = loop.axes(k, start, carried.rho, carried.first), loop.axes(k, end, rho, carried.last)
    level, course = carried.rho, Course(*first, *last)
    fractions = start + INSTANTS * (end - start)
    caps = np.log([BOX_FRACTION * loop.box_level(k, fraction) for fraction in fractions[:-1]])
    shapes = [np.linalg.slogdet(loop.value(k, fraction)[0])[1] for fraction in fractions[:-1]]
    for _ in range(ROUNDS):
        ellipsoids = [course.at(t, duration) for t in INSTANTS]
        rises = [loop.rise(k, f, *each, directions) for f, each in zip(fractions, ellipsoids, strict=True)]
        sizes = [2 * np.linalg.slogdet(axes)[1] for axes, _ in ellipsoids[:-1]]
        room = (caps - np.add(sizes, shapes) / loop.n) / 2  # of the logarithm of L
        by, first_growth, last_growth = _least_scale(np.array(rises) + decay_margin / 2, room, duration)
        level *= by**2
        course = course.scaled(by, first_growth, last_growth)
    return float(level), course


def _least_scale(missing: np.ndarray, room: np.ndarray, duration: float) -> tuple[float, float, float]:
    """exp(c) at the start, and c' at the start and at the end, of `followed`: c' [1/s] is at least `missing` at the
    `INSTANTS`, and c at most `room` at all but the last.

    Raises:
        Refused: there is none.
    """
    powers = np.stack([np.ones_like(INSTANTS), INSTANTS, INSTANTS**2], axis=1)
    integrals = (1 - INSTANTS[:-1, None] ** [1, 2, 3]) / [1, 2, 3] * duration  # -c at an instant, of the powers
    bounded = np.isfinite(room)
    rows, excess = -np.vstack([powers, integrals[bounded]]), np.append(np.ones(len(powers)), np.zeros(bounded.sum()))
    solution = linprog(
        np.append(integrals[0], -SPARE * duration),
        np.column_stack([rows, excess]),
        np.append(-missing, room[bounded]),
        bounds=[(None, None)] * 3 + [(0, None)],
    )
    require(solution.status == 0, "interval", "no cubic level follows the growth of V")
    rate = solution.x[:3]
    by = float(np.exp(-integrals[0] @ rate))
    require(by**2 > COLLAPSE, "interval", "the level vanishes")
    return by, float(rate[0]), float(rate.sum())


def leveled(loop: Loop, directions: np.ndarray) -> Loop:
    """The same shapes at the levels of a funnel, which become 1.

    Raises:
        Refused: the level vanishes, or V is not positive definite.
    """
    rho, n = last_level(loop, directions), len(loop.u)
    values, slopes = loop.values.copy(), loop.slopes.copy()
    values[n] /= rho
    for k in range(n - 1, -1, -1):
        slopes[k, 1] /= rho
        carried = carried_back(loop, k, 0.0, 1.0, rho, DECAY_MARGIN, directions)
        slopes[k, 1] -= carried.last * values[k + 1]
        rho = carried.rho
        values[k] /= rho
        slopes[k, 0] = slopes[k, 0] / rho - carried.first * values[k]
    other = loop.shaped(values, slopes)
    require(np.linalg.eigvalsh(values_at(other)[0]).min() > 0, "funnel", "S is not positive definite between knots")
    return other


def merit(loop: Loop) -> float:
    """The logarithm of the funnel's integral over time, and a share of that of its inlet's volume."""
    return float(np.log(integral(loop)) - INLET / 2 * np.linalg.slogdet(loop.values[0])[1])


def integral(loop: Loop) -> float:
    """Over time, of the volumes of {V <= 1}, up to the unit ball's."""
    value, _ = values_at(loop)
    return float(np.trapezoid(np.linalg.det(value) ** -0.5, FRACTIONS).sum() * loop.dt)


def values_at(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """P and P' [N T n n] at the instants of all N intervals."""
    first, last = loop.slopes[:, None, 0], loop.slopes[:, None, 1]
    return hermite(FRACTIONS[:, None, None], loop.dt, loop.values[:-1, None], first, loop.values[1:, None], last)
