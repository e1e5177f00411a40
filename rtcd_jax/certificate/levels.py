"""Levels of V as the loop allows them: at the goal, and carried backward in time."""

from typing import NamedTuple

import numpy as np

from rtcd_jax.certificate.check import Refused, insist
from rtcd_jax.certificate.loop import Loop

LEVELS = 400
"""Levels at which the fastest growth of V at the goal is looked at."""
HEUN_STEPS = 4
COLLAPSE = 1e-3
"""Share of its level that a funnel must keep within an interval."""
BOX_SHARE = 0.999
"""Share of the level at which an ellipsoid would touch a limit."""
DIRECTIONS = {2: 720, 4: 4000}


class Carried(NamedTuple):
    """A level at the start of an interval, and its rates of growth [1/s] at the start and the end."""

    rho: float
    first: float
    last: float


def directions(n: int) -> np.ndarray:
    """Unit vectors [n D] that cover the sphere."""
    if n == 2:
        angle = np.linspace(0, 2 * np.pi, DIRECTIONS[2], endpoint=False)
        return np.stack([np.cos(angle), np.sin(angle)])
    found = np.random.default_rng(0).normal(size=(n, DIRECTIONS[n]))
    return found / np.linalg.norm(found, axis=0)


def goal_level(loop: Loop, aims: np.ndarray) -> float:
    """The largest level up to which V falls in the sampled directions [n D], under the limits on the states.

    Raises:
        Refused: V falls at no level.
    """
    levels = BOX_SHARE * loop.goal_box_level() * np.linspace(0, 1, LEVELS + 1)
    falls = [loop.goal_growth(level, aims) < 0 for level in levels[1:]]
    last = falls.index(False) if False in falls else LEVELS
    insist(last > 0, "goal", "V does not fall")
    return float(levels[last])


def carried_back(loop: Loop, k: int, start: float, end: float, rho: float, spare: float, aims: np.ndarray) -> Carried:
    """The level that the loop carries into rho at the end, by Heun's method on its logarithm, under the limits.

    Raises:
        Refused: the level vanishes.
    """

    def growth(share: float, level: float) -> float:
        return loop.growth(k, share, level, aims) + spare

    step, held = (end - start) / HEUN_STEPS, rho
    last = slope = growth(end, rho)
    for i in range(HEUN_STEPS):
        share = end - (i + 1) * step
        guess = rho * np.exp(-step * loop.dt * slope)
        rho *= np.exp(-step * loop.dt * (slope + growth(share, guess)) / 2)
        if rho < COLLAPSE * held:
            raise Refused("interval", "the level vanishes")
        slope = growth(share, rho)
    cap = BOX_SHARE * loop.box_level(k, start)
    if rho > cap:
        both = float(np.log(held / cap) / ((end - start) * loop.dt))
        return Carried(cap, both, both)
    return Carried(float(rho), slope, last)
