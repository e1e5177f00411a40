"""The control rate that a funnel asks for: its boundary rolled out with the input held from one call to the next."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import final

import numpy as np
from jaxtyping import Bool, Float

from rtcd_jax.elite.closed_loop import (
    LEVEL_TOLERANCE,
    ClosedLoop,
    Dynamics,
    March,
    Policy,
    fastest_rate,
    runge_kutta,
    simulate,
)
from rtcd_jax.elite.elite import Elite, ellipsoid_axes
from rtcd_jax.elite.simulators import STEP_OF_FASTEST, STEPS, dynamics_of
from rtcd_jax.export.proof import ProvedFunnel

DIVISORS = 1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 25, 32, 40, 50, 64, 80, 100
"""Calls in an interval of the knots that are tried: the input jumps at knots, so that a call must fall there."""
FASTEST = 5000.0
"""Largest control rate that is tried [Hz]."""
STATES = 4000
"""Of the boundary, over all knots."""
RADII = 1.0, 0.999, 0.99
"""Shares of the ellipsoids' radii at which motions start, tried in this order: where the boundary itself is a motion,
as after a refinement for one exact model, a held input leaves it at any rate.
"""
FIRST = 20
"""One in so many is tried first: most rates fail there."""
STEP = 0.005
"""Longest step of the integrator [s]; the input is held over it, so that it is of fourth order."""

Within = Callable[[float, np.ndarray], np.ndarray]
"""Time [s], inf for the goal, x [states n] -> whether they are in the funnel [states]."""


@final
@dataclass(frozen=True)
class ControlRate:
    """The slowest tried rate at which all states stayed, and what was tried.

    `divisor` calls are an interval of the knots; None if no rate sufficed. `states` were rolled out at every rate, from
    `radius` times the ellipsoids' boundaries; `lost` more fail with an input that is continuous in time, too. `failed`
    says by divisor which share failed.
    """

    divisor: int | None
    interval: float
    radius: float
    states: int
    lost: int
    failed: dict[int, float]

    @property
    def rate(self) -> float | None:
        """[Hz]"""
        return None if self.divisor is None else self.divisor / self.interval

    @property
    def period(self) -> float | None:
        """[s]"""
        return None if self.divisor is None else self.interval / self.divisor

    @property
    def sentence(self) -> str:
        """What came out, of how many states."""
        failing = [f"{share:.2g} at {d / self.interval:.4g} Hz" for d, share in self.failed.items() if share]
        start = "on the funnel's boundary" if self.radius == 1 else f"at {self.radius:.1%} of the funnel's radius"
        states = f"{self.states} states {start}, rolled out with the input held between calls"
        if self.lost:
            states += f" ({self.lost} more fail with a continuous input, too)"
        failed = f"; a share of {', '.join(failing)} failed" if failing else ""
        if self.divisor is None:
            return f"no tried rate suffices for {states}{failed}"
        rate = f"{self.rate:.4g} Hz, every {self.period:.6g} s = dt/{self.divisor}, with a call at every knot,"
        return f"{rate} suffices for {states}{failed}"


def control_rate(
    elite: Elite, proof: ProvedFunnel | None, show: Callable[[int, int], None] = lambda done, of: None
) -> ControlRate:
    """The slowest tried rate at which the boundaries of a funnel's ellipsoids at the knots stay inside, or where none
    suffices what starts a little further in: the first of `RADII` for which one does.

    A state stays if it is within the limits at every step, in the funnel at every later knot, in a proved one at every
    call, and arrives at the goal. `show(done, of)` is called after every rate.

    Raises:
        UserError: a goal that its own LQR does not hold.
    """
    f, interval = dynamics_of(elite), float(elite.time[1])
    first, axes, within = 0, ellipsoid_axes(elite.S, elite.rho), None
    if proof:
        shown = [proof.at(k) for k in range(len(axes))]
        first = next(k for k, ellipsoid in enumerate(shown) if ellipsoid is not None)
        axes[first:] = shown[first:]
        within = _within(proof, ClosedLoop.of(elite, f))
    knots = np.sort(first + np.arange(STATES) % (len(axes) - first))
    y = np.random.default_rng(0).normal(size=(STATES, elite.x_goal.size))
    x = elite.x[knots] + np.einsum("sij,sj->si", axes[knots], y / np.linalg.norm(y, axis=1, keepdims=True))
    funnel = replace(elite, S=np.linalg.inv(axes @ np.swapaxes(axes, 1, 2)), rho=np.ones(len(axes)))

    held = np.ones(STATES, bool)
    if proof is None:
        step = min(interval / STEPS, STEP_OF_FASTEST / fastest_rate(elite, f))
        held = ~simulate(funnel, f, runge_kutta(f, step), knots, x).failed
    knots, x = knots[held], x[held]
    tried = [divisor for divisor in DIVISORS if divisor / interval <= FASTEST]
    share = partial(_share_of_failures, funnel, f, within)
    divisor, radius, failed = None, RADII[-1], {}
    for radius in RADII:
        start = elite.x[knots] + radius * (x - elite.x[knots])
        divisor, failed = _slowest(tried, lambda each, start=start: share(interval / each, knots, start), show)
        if divisor is not None:
            break
    return ControlRate(divisor, interval, radius, len(x), int(np.sum(~held)), failed)


def _slowest(
    tried: Sequence[int], share: Callable[[int], float], show: Callable[[int, int], None]
) -> tuple[int | None, dict[int, float]]:
    """The slowest rate of which no share fails, by bisection: what a rate keeps inside, faster ones do. And all shares
    that were found.
    """
    failed: dict[int, float] = {}
    slowest, end = 0, len(tried)
    while slowest < end:
        show(len(failed), len(tried).bit_length())
        middle = (slowest + end) // 2
        failed[tried[middle]] = share(tried[middle])
        slowest, end = (middle + 1, end) if failed[tried[middle]] else (slowest, middle)
    return (tried[slowest] if slowest < len(tried) else None), dict(sorted(failed.items()))


def _share_of_failures(
    elite: Elite, f: Dynamics, within: Within | None, period: float, knots: np.ndarray, x: np.ndarray
) -> float:
    """Of the states of the first round that has any."""
    march = _held(f, period, within)
    settle = _held(f, period, within and (lambda _, x: within(math.inf, x)))
    shares = (
        float(simulate(elite, f, march, knots[part], x[part], settle).failed.mean())
        for part in (slice(None, None, FIRST), slice(None))
    )
    return next(filter(None, shares), 0.0)


def _within(proof: ProvedFunnel, loop: ClosedLoop) -> Within:
    elite = loop.elite

    def within(t: float, x: Float[np.ndarray, "states n"]) -> Bool[np.ndarray, " states"]:
        last = len(elite.u)
        knots = min(t / elite.time[1], last)
        axes, k = proof.at(knots), min(int(knots), last - 1)
        if axes is None:
            return np.ones(len(x), bool)
        nominal = elite.x_goal if knots == last else loop.nominal(k, knots - k)
        return np.sum(np.linalg.solve(axes, (x - nominal).T) ** 2, axis=0) <= 1 + LEVEL_TOLERANCE

    return within


def _held(f: Dynamics, period: float, within: Within | None) -> March:
    """Classical Runge-Kutta steps under a controller that is called every `period`; what is not within becomes nan."""

    def march(policy: Policy, start: float, end: float, x: np.ndarray) -> Iterator[np.ndarray]:
        calls, steps = round((end - start) / period), math.ceil(period / STEP)
        h = (end - start) / calls / steps
        for call in range(calls):
            u = policy(start + call * (end - start) / calls, x)
            for _ in range(steps):
                k1 = f(x, u)
                k2 = f(x + h / 2 * k1, u)
                k3 = f(x + h / 2 * k2, u)
                k4 = f(x + h * k3, u)
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            if within:
                inside = within(start + (call + 1) * (end - start) / calls, x)
                x = np.where(inside[:, None], x, np.nan)
            yield x

    return march
