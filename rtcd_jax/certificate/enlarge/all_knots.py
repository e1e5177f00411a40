"""The value function with the largest funnel: all its ellipsoids at once, the goal region's among them.

V = e'P e with P free at every knot, and its rate free at both ends of every interval: between them P is the cubic
Hermite interpolant, as TVLQR's own is. The program is

    maximize    log (integral of det P^-1/2 over time) + INLET log (det P^-1/2 at t = 0)
    such that   V' <= -decay_margin V  wherever V = 1, and for all V <= 1 at the goal,
                {V <= 1} keeps the limits on the states.

It is solved as a sequence of linear programs. V' is asked for at sampled instants and directions e of the present
ellipsoids, and is linearized in P: where P changes by dP, the boundary point e moves to (1 + r) e with
r = -e'dP e / 2. Levels that are carried back from the goal, as in a proof with a given V, correct the error of
the linearization. So every iterate is a funnel of known volume. A step is taken if the objective grows. (Tobenkin,
Manchester, Tedrake 2011 alternate between multipliers and V to the same end.)
"""

from typing import Any, NamedTuple, final

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog

from rtcd_jax.certificate.check import Refused, require
from rtcd_jax.certificate.prove.closed_loop import Loop, hermite
from rtcd_jax.certificate.prove.levels import (
    DECAY_MARGIN,
    FRACTION_OF_LIMIT,
    FRACTIONS,
    INLET,
    integral,
    leveled,
    lower_pairs,
    merit,
    products,
    unit_directions,
    values_at,
)

LEVELS = np.linspace(0.1, 1, 10)
"""Levels |y| of the goal region at which V must fall."""
TRUST = (0.3, 0.4, 0.01)
"""Largest change of an entry of P in units of the ellipsoid: at first, ever, and where the search ends."""
BENDING = 4.0
"""The rates of P may change by so much more in the time of an interval."""
ROUNDS = 40
WIDEST = 3.0
"""Largest half width [rad] along the angle: beyond it polynomials follow the sine badly."""
DIRECTION_STRIDE = 8
"""Stride of the directions in the linear programs."""
DIRECTIONS_PER_INSTANT = 40
"""Most directions of an instant in a linear program: those in which V falls least."""
WORTH = 1e-3
"""Gain of a step below which the next one is shorter."""
STEP = 0.01
"""Of the differences that give the loop's rate along a direction."""


def enlarged(best: Loop, directions: np.ndarray) -> Loop:
    """The funnel after all steps that gained. Levels are carried back along the `directions` [n D]."""
    trust, most, finest = TRUST
    for _ in range(ROUNDS):
        tried = _step(best, trust, directions)
        gain = -np.inf if tried is None else merit(tried) - merit(best)
        if tried is not None and gain > 0:
            best = tried
        trust = min(1.3 * trust, most) if gain > WORTH else trust / 2
        if trust < finest:
            break
    return best


def _step(loop: Loop, trust: float, directions: np.ndarray) -> Loop | None:
    """The funnel after one linear program; None if there is none."""
    try:
        return leveled(changed(loop, trust), directions)
    except (Refused, np.linalg.LinAlgError):
        return None


def changed(loop: Loop, trust: float) -> Loop:
    """The loop after one linear program: a funnel up to what is of second order in `trust`.

    Raises:
        Refused: the solver has no solution.
    """
    program = Program(loop, trust)
    rows = [program.falling(), program.falling_at_goal(), program.within_limits()]
    table, bound = sp.vstack([each.table for each in rows]), np.concatenate([each.bound for each in rows])
    radius = np.stack([-program.radius, program.radius], axis=1)
    solution = linprog(-program.gain(), table, np.maximum(bound, 0), bounds=radius)  # no change is always a solution
    require(solution.status == 0, "funnel", "the linear program was not solved")
    return program.changed(solution.x)


class Rows(NamedTuple):
    """Inequalities: table [R C] times the unknowns <= bound [R]."""

    table: Any
    bound: np.ndarray


@final
class Program:
    """The linear program about a loop's present ellipsoids {L y}.

    Unknown are the changes of P at the N + 1 knots and of its rates at both ends of the N intervals, all as symmetric
    X: L^-T X L^-1 with the L of that knot, the rates' by the time of an interval. P on an interval is made of four of
    them, `blocks` [N 4], with `weights` [T 4], P' with `rates` [T 4]. `radius` [C] bounds the unknowns' size.
    """

    def __init__(self, loop: Loop, trust: float):
        self.loop, knots, n = loop, np.arange(len(loop.u)), len(loop.u)
        self.value, self.slope = values_at(loop)
        self.axes = np.linalg.cholesky(np.linalg.inv(self.value))
        self.units = np.linalg.inv(np.linalg.cholesky(np.linalg.inv(loop.values)))
        self.blocks = np.stack([knots, n + 1 + 2 * knots, knots + 1, n + 2 + 2 * knots], axis=1)
        basis = [hermite(FRACTIONS, 1.0, *row) for row in np.eye(4)]
        self.weights = np.stack([weight for weight, _ in basis], axis=1)
        self.rates = np.stack([rate for _, rate in basis], axis=1) / loop.dt
        self.pairs = lower_pairs(loop.n)
        self.radius = trust * np.repeat([1.0, BENDING], [(n + 1) * len(self.pairs), 2 * n * len(self.pairs)])

    def falling(self) -> Rows:
        """V' <= -decay margin on the boundaries, in those directions in which it falls least."""
        error = self.axes @ unit_directions(self.loop.n)[:, ::DIRECTION_STRIDE]
        v, e, motion, radial = _decrease(self.value, self.slope, error, self._error_rates)
        worst = np.argsort(-v, axis=-1)[..., :DIRECTIONS_PER_INSTANT]
        v, radial = np.take_along_axis(v, worst, -1), np.take_along_axis(radial, worst, -1)
        e, motion = (np.take_along_axis(each, worst[..., None, :], -1) for each in (e, motion))
        parts = []
        for knot in (self.units[:-1, None], self.units[1:, None]):
            p = knot @ e
            moved = products(p, p)
            parts.append((2 * products(p, knot @ motion) - radial[..., None] / 2 * moved, moved))
        coefficients = [
            self.weights[:, None, None, j] * parts[j // 2][0] + self.rates[:, None, None, j] * parts[j // 2][1]
            for j in range(4)
        ]
        return self._rows(np.stack(coefficients, axis=-2), self.blocks[:, None, None], -DECAY_MARGIN - v)

    def falling_at_goal(self) -> Rows:
        """The same on ellipsoids within the last one, in the loop of the goal."""
        value, unit, y = self.loop.values[-1], self.units[-1], unit_directions(self.loop.n)[:, ::DIRECTION_STRIDE]
        level = LEVELS[:, None, None]
        v, e, motion, radial = _decrease(
            value, np.zeros_like(value), level * np.linalg.solve(unit, y), self._goal_rates
        )
        coefficients = 2 * products(unit @ e, unit @ motion) - radial[..., None] / 2 * products(y, y)
        bound = -DECAY_MARGIN * level[..., 0] ** 2 - v
        return self._rows(coefficients[..., None, :], np.array([len(self.loop.u)]), bound)

    def within_limits(self) -> Rows:
        """Half widths along the states: the diagonal of P^-1 is at most their squares."""
        clearance = FRACTION_OF_LIMIT * (self.loop.bounds - np.abs(self._nominal()[0]))
        angles = self.loop.hinges
        clearance[..., angles] = np.minimum(clearance[..., angles], WIDEST)
        bounded = np.flatnonzero(np.isfinite(clearance[0, 0]))
        spread = np.linalg.inv(self.value)
        widths = np.diagonal(spread, axis1=-2, axis2=-1)[..., bounded]
        p = [knot @ spread[..., bounded] for knot in (self.units[:-1, None], self.units[1:, None])]
        moved = [products(each, each) for each in p]
        coefficients = [-self.weights[:, None, None, j] * moved[j // 2] for j in range(4)]
        bound = clearance[..., bounded] ** 2 - widths
        return self._rows(np.stack(coefficients, axis=-2), self.blocks[:, None, None], bound)

    def gain(self) -> np.ndarray:
        """What the merit gains by the unknowns, to first order."""
        times = np.gradient(FRACTIONS) * self.loop.dt
        times[[0, -1]] /= 2
        density = -times * np.linalg.det(self.axes) / 2
        total = np.zeros((len(self.radius) // len(self.pairs), len(self.pairs)))
        for j in range(4):
            p = self.units[j // 2 : len(self.blocks) + j // 2, None] @ self.axes
            shrinks = products(p, p).sum(axis=-2)
            np.add.at(total, self.blocks[:, j], np.sum((self.weights[:, j] * density)[..., None] * shrinks, axis=1))
        total /= integral(self.loop)
        total[0, [i == j for i, j in self.pairs]] -= INLET / 2
        return total.ravel()

    def changed(self, x: np.ndarray) -> Loop:
        """The loop after the changes that are the program's solution."""
        loop, n = self.loop, len(self.loop.u)
        matrices = np.zeros((3 * n + 1, loop.n, loop.n))
        for (i, j), entries in zip(self.pairs, x.reshape(3 * n + 1, -1).T, strict=True):
            matrices[:, i, j] = matrices[:, j, i] = entries
        ends = np.stack([self.units[:-1], self.units[1:]], axis=1)
        values = np.swapaxes(self.units, -1, -2) @ matrices[: n + 1] @ self.units
        slopes = np.swapaxes(ends, -1, -2) @ matrices[n + 1 :].reshape(loop.slopes.shape) @ ends / loop.dt
        return loop.shaped(loop.values + values, loop.slopes + slopes)

    def _nominal(self) -> tuple[np.ndarray, np.ndarray]:
        """x* and x*' [N T n]."""
        x, rates = self.loop.x[:, None], self.loop.rates
        return hermite(FRACTIONS[:, None], self.loop.dt, x[:-1], rates[:, None, 0], x[1:], rates[:, None, 1])

    def _error_rates(self, error: np.ndarray) -> np.ndarray:
        """e' for errors e [N T n D] from the nominal motion."""
        loop, (center, rate), fraction = self.loop, self._nominal(), FRACTIONS[:, None]
        gain = (1 - fraction) * loop.gains[:-1, None] + fraction * loop.gains[1:, None]
        u = loop.u[:, None, None] - np.sum(gain[..., None] * error, axis=-2)
        motion = loop.rate(np.moveaxis(center[..., None] + error, -2, 0), np.clip(u, -loop.limit, loop.limit))
        return np.moveaxis(motion, 0, -2) - rate[..., None]

    def _goal_rates(self, error: np.ndarray) -> np.ndarray:
        """e' for errors e [... n D] from the goal, in its loop."""
        loop = self.loop
        u = np.clip(-loop.goal_gain @ error, -loop.limit, loop.limit)
        return np.moveaxis(loop.rate(np.moveaxis(loop.goal[:, None] + error, -2, 0), u), 0, -2)

    def _rows(self, coefficients: np.ndarray, blocks: np.ndarray, bound: np.ndarray) -> Rows:
        """Those inequalities, coefficients [... B m] of the unknowns `blocks` [... B], that can become active."""
        m, unknowns = len(self.pairs), len(self.radius)
        columns = np.broadcast_to((blocks[..., None] * m + np.arange(m)), coefficients.shape).reshape(bound.size, -1)
        coefficients, bound = coefficients.reshape(bound.size, -1), bound.ravel()
        near = np.sum(np.abs(coefficients) * self.radius[columns], axis=1) > bound
        count = int(near.sum())
        starts = np.arange(count + 1) * columns.shape[1]
        table = sp.csr_matrix((coefficients[near].ravel(), columns[near].ravel(), starts), shape=(count, unknowns))
        return Rows(table, bound[near])


def _decrease(value: np.ndarray, slope: np.ndarray, error: np.ndarray, rates: Any) -> tuple[np.ndarray, ...]:
    """On a boundary: V' at the errors e, e, their rates, and how V' grows with e: d V' / d r at (1 + r) e."""
    motion = rates(error)
    turned = (rates((1 + STEP) * error) - rates((1 - STEP) * error)) / (2 * STEP)
    gradient, drift = 2 * value @ error, np.sum(error * (slope @ error), axis=-2)
    at, along = np.sum(gradient * motion, axis=-2), np.sum(gradient * turned, axis=-2)
    return at + drift, error, motion, at + along + 2 * drift
