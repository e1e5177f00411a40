"""Centers that move with a robot's constant numbers: polynomials in these, fitted to the robots' own motions."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rtcd_jax.certificate import check
from rtcd_jax.certificate.prove.field import floats, rate
from rtcd_jax.elite.closed_loop import runge_kutta_step
from rtcd_jax.numerics.hermite import cubic_hermite

STEPS = 8
"""Of Runge-Kutta, an interval, for own motions."""
DEGREE = 2
"""Of the centers in the robots' numbers."""


class Nodes(NamedTuple):
    """Robots of a box: the names of its m uncertain numbers, points p [J m] of {-1, 0, 1}^m, the first 0, and the
    robots' numbers [J 1].
    """

    uncertain: list[str]
    points: Float[np.ndarray, "J m"]
    numbers: dict[str, Float[np.ndarray, "J 1"]]

    @classmethod
    def of(cls, parameters: dict[str, tuple[float, float]]) -> "Nodes":
        """Of least and largest values by name; those that differ are uncertain."""
        uncertain = sorted(name for name, (low, high) in parameters.items() if low < high)
        points = np.array(sorted(itertools.product((-1.0, 0.0, 1.0), repeat=len(uncertain)), key=np.any))
        numbers = {}
        for name, (low, high) in parameters.items():
            place = points[:, uncertain.index(name)] if name in uncertain else np.zeros(len(points))
            numbers[name] = ((low + high) / 2 + (high - low) / 2 * place)[:, None]
        return cls(uncertain, points, numbers)


def fitted(
    robot: check.Robot,
    parameters: dict[str, tuple[float, float]],
    dt: float,
    motion: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    limit: float,
) -> list[dict[str, Any]]:
    """`powers` by name, `x` [N+1 n] and `rates` [N 2 n] of every part of the centers, by least squares.

    Robots of the box make their own motions from x*(0) by u = clip(u*_k - K(t) (x - x*(t)), +-limit); `motion` has x*
    and its rates as a claim has them, u* and K.
    """
    x, rates, u, gains = motion
    nodes = Nodes.of(parameters)
    away, slopes = np.zeros((len(nodes.points), *x.shape)), np.zeros((len(nodes.points), *rates.shape))
    now = np.repeat(x[0][:, None], len(nodes.points), axis=1)
    for k in range(len(u)):
        ends = dt, x[k], rates[k, 0], x[k + 1], rates[k, 1]

        def moving(fraction: float, state: np.ndarray, k: int = k, ends: tuple = ends) -> np.ndarray:
            gain = (1 - fraction) * gains[k] + fraction * gains[k + 1]
            error = state - cubic_hermite(fraction, *ends)[:, None]
            asked = np.clip(u[k] - gain @ error, -limit, limit)
            return rate(robot, nodes.numbers, state[:, :, None], asked[:, None])[:, :, 0]

        slopes[:, k, 0] = (moving(0.0, now) - rates[k, 0][:, None]).T
        for i in range(STEPS):
            now = runge_kutta_step(lambda part, state, i=i: moving((i + part) / STEPS, state), now, dt / STEPS)
        slopes[:, k, 1] = (moving(1.0, now) - rates[k, 1][:, None]).T
        away[:, k + 1] = (now - x[k + 1][:, None]).T
    powers = [e for e in itertools.product(range(DEGREE + 1), repeat=len(nodes.uncertain)) if 0 < sum(e) <= DEGREE]
    terms = np.stack([np.prod(nodes.points ** np.array(e), axis=1) for e in powers], axis=1)
    inverse = np.linalg.pinv(terms)
    parts = zip(powers, *(np.tensordot(inverse, each, 1) for each in (away, slopes)), strict=True)
    return [
        {"powers": {name: e for name, e in zip(nodes.uncertain, each, strict=True) if e}, "x": values, "rates": turns}
        for each, values, turns in parts
    ]


def shifts_at(shifts: Sequence[check.Shift], points: Float[np.ndarray, "J m"]) -> tuple[np.ndarray, np.ndarray]:
    """c_p - x* at the knots [N+1 n J] and its rates at both ends of the intervals [N 2 n J], of points p."""
    x = rates = np.zeros(1)
    for powers, values, turns in shifts:
        factor = np.prod(points ** np.array(powers), axis=1)
        x, rates = x + floats(values)[..., None] * factor, rates + floats(turns)[..., None] * factor
    return x, rates
