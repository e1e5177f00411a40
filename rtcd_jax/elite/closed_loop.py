"""The closed loop of a stored elite, simulated in numpy for many states at once.

On [t_k, t_k+1] with s = (t - t_k) / (t_k+1 - t_k)

    u = clip(u_k - K(t) (x - x*(t))),  K(t) = (1 - s) K_k + s K_k+1,
    x*(t) the cubic Hermite interpolant of x_k, f(x_k, u_k) and x_k+1, f(x_k+1, u_k);

after the last knot u = clip(-K_goal (x - x_goal)); a motion that ends in a catch set is over there. The input is
evaluated wherever the integrator asks for a slope: held over a step, it would lag the loop by half of it, and that is
another loop than the promised one.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.integrate import RK45

from rtcd_jax.elite.elite import Elite
from rtcd_jax.numerics.hermite import cubic_hermite
from rtcd_jax.system.errors import UserError

LEVEL_TOLERANCE = 1e-6
"""Share of a level by which a state may exceed it: numerical room, no allowance for failures."""
ARRIVED = 1e-3
"""Share of the last level below which a state counts as arrived at the end of the settling time."""
FORGOTTEN = 0.1
"""Share of that below which a settling state is not simulated any more."""
SETTLING = 15.0
"""Settling time in time constants of the slowest mode about the goal."""

SETTLING_INTERVALS = 4
"""Intervals between two looks at who has settled."""

Dynamics = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""x [states n], u [states m] -> x' [states n]."""
Policy = Callable[[float, np.ndarray], np.ndarray]
"""t, x [states n] -> u [states m]."""
March = Callable[[Policy, float, float, np.ndarray], Iterator[np.ndarray]]
"""A policy, t0, t1 and x at t0 -> x after every step, the last time at t1."""


@final
@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """The policy of an elite; `rates` are x*' at both ends of every interval: f(x_k, u_k) and f(x_k+1, u_k)."""

    elite: Elite
    rates: Float[np.ndarray, "intervals 2 n"]

    @classmethod
    def of(cls, elite: Elite, f: Dynamics) -> "ClosedLoop":
        """The policy about the motion that the dynamics `f` interpolate; they are asked for two states at a time."""
        pairs = zip(elite.x[:-1], elite.x[1:], elite.u, strict=True)
        return cls(elite, np.stack([f(np.stack([start, end]), np.stack([u, u])) for start, end, u in pairs]))

    def duration(self, k: Any) -> Any:
        """t_k+1 - t_k [s]."""
        return self.elite.time[k + 1] - self.elite.time[k]

    def nominal(self, k: Any, s: Any) -> Float[np.ndarray, "*T n"]:
        """x* at the fractions s of the intervals k, one or [T]."""
        x, h = self.elite.x, self.duration(k)
        if np.ndim(s):
            s, h = s[:, None], h[:, None]
        return cubic_hermite(s, h, x[k], self.rates[k, 0], x[k + 1], self.rates[k, 1])

    def gain(self, k: int, s: float) -> Float[np.ndarray, "m n"]:
        """K at the fraction s of the interval k."""
        return (1 - s) * self.elite.K[k] + s * self.elite.K[k + 1]

    def tracking(self, k: int) -> Policy:
        """The policy on [t_k, t_k+1]."""
        elite, start, h = self.elite, self.elite.time[k], self.duration(k)

        def policy(t: float, x: np.ndarray) -> np.ndarray:
            s = (t - start) / h
            return np.clip(elite.u[k] - (x - self.nominal(k, s)) @ self.gain(k, s).T, -elite.u_max, elite.u_max)

        return policy

    def holding(self) -> Policy:
        """The goal's LQR."""
        elite = self.elite
        return lambda _, x: np.clip((elite.x_goal - x) @ elite.K_goal.T, -elite.u_max, elite.u_max)


@final
@dataclass(frozen=True)
class Outcome:
    """Of every state: did it leave the funnel at a later knot, leave the limits at any step, miss the goal or the catch
    set?

    Who enters a set to keep out of leaves the limits too.
    A state that left the limits is followed no further and has missed the goal too.
    """

    left_funnel: Bool[np.ndarray, " states"]
    left_limits: Bool[np.ndarray, " states"]
    missed_goal: Bool[np.ndarray, " states"]

    @property
    def failed(self) -> Bool[np.ndarray, " states"]:
        return self.left_funnel | self.left_limits | self.missed_goal


def simulate(
    elite: Elite,
    f: Dynamics,
    march: March,
    knots: Int[np.ndarray, " states"],
    states: Float[np.ndarray, "states n"],
    settle: March | None = None,
) -> Outcome:
    """Follows every state from its knot's time to the last knot by `march`, then for the settling time by `settle`, or
    by `march`, too; from a catch set no further.

    `f` are the dynamics that both integrate; here they give the slopes of x*(t) and the settling time.
    """
    loop, x = ClosedLoop.of(elite, f), states.copy()
    left_funnel = np.zeros(len(x), bool)
    left_limits = outside_limits(elite, x)

    def advance(march: March, moving: np.ndarray, policy: Policy, start: float, end: float) -> None:
        if not moving.size:
            return
        outside = np.zeros(moving.size, bool)
        for now in march(policy, start, end, x[moving]):
            outside |= outside_limits(elite, now)
            x[moving] = now
        left_limits[moving] |= outside

    for k in range(len(elite.u)):
        moving = np.flatnonzero((knots <= k) & ~left_limits)
        advance(march, moving, loop.tracking(k), elite.time[k], elite.time[k + 1])
        level = elite.rho[k + 1] * (1 + LEVEL_TOLERANCE)
        left_funnel[moving] |= ~(elite.value(k + 1, x[moving]) <= level)

    if elite.caught:
        caught = elite.value_of_goal(x) <= elite.rho[-1] * (1 + LEVEL_TOLERANCE)
        return Outcome(left_funnel, left_limits, left_limits | ~caught)
    arrived = ARRIVED * elite.rho[-1]
    interval = SETTLING_INTERVALS * (elite.time[-1] - elite.time[-2])
    for _ in range(math.ceil(settling_time(elite, f) / interval)):
        moving = np.flatnonzero(~left_limits & ~(elite.value_of_goal(x) <= FORGOTTEN * arrived))
        advance(settle or march, moving, loop.holding(), 0.0, interval)
    return Outcome(left_funnel, left_limits, left_limits | ~(elite.value_of_goal(x) <= arrived))


def settling_time(elite: Elite, f: Dynamics) -> float:
    """`SETTLING` time constants of the slowest mode of the goal's unsaturated loop [s].

    Raises:
        UserError: that loop is not stable.
    """
    slowest = -np.max(np.real(_modes(f, elite.x_goal, np.zeros_like(elite.u_max), elite.K_goal)))
    if not slowest > 0:
        raise UserError(f"K_goal does not hold the goal: a mode of its loop grows at {-slowest:g} 1/s")
    return SETTLING / slowest


def fastest_rate(elite: Elite, f: Dynamics) -> float:
    """Largest |eigenvalue| of the unsaturated loop at the knots and the goal [1/s]."""
    tracked = zip(elite.x[:-1], elite.u, elite.K[:-1], strict=True)
    return max(fastest_rate_of_goal(elite, f), *(float(np.abs(_modes(f, *point)).max()) for point in tracked))


def fastest_rate_of_goal(elite: Elite, f: Dynamics) -> float:
    """Largest |eigenvalue| of the goal's unsaturated loop [1/s]."""
    return float(np.abs(_modes(f, elite.x_goal, np.zeros_like(elite.u_max), elite.K_goal)).max())


def runge_kutta(f: Dynamics, longest_step: float) -> March:
    """Classical steps of equal length: of fourth order, but of second where the input enters or leaves its limit."""

    def march(policy: Policy, start: float, end: float, x: np.ndarray) -> Iterator[np.ndarray]:
        steps = math.ceil((end - start) / longest_step * (1 - 1e-12))
        dt = (end - start) / steps
        for step in range(steps):
            x = runge_kutta_step(lambda part, x, step=step: f(x, policy(start + (step + part) * dt, x)), x, dt)
            yield x

    return march


def runge_kutta_step(slope: Callable[[float, np.ndarray], np.ndarray], x: np.ndarray, dt: float) -> np.ndarray:
    """x after one classical step of `dt`; `slope` has the fraction of the step and the state there."""
    k1 = slope(0, x)
    k2 = slope(0.5, x + dt / 2 * k1)
    k3 = slope(0.5, x + dt / 2 * k2)
    k4 = slope(1, x + dt * k3)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def dormand_prince(f: Dynamics, longest_step: float, relative: float, absolute: float) -> March:
    """scipy's adaptive RK45 on all states stacked to one.

    RK45 controls the root mean square of the error; to bound every single state's, the tolerances are divided by
    the square root of the states' number.
    """

    def march(policy: Policy, start: float, end: float, x: np.ndarray) -> Iterator[np.ndarray]:
        share = 1 / math.sqrt(len(x))

        def slope(t: float, flat: np.ndarray) -> np.ndarray:
            now = flat.reshape(x.shape)
            return f(now, policy(t, now)).ravel()

        solver = RK45(slope, start, x.ravel(), end, longest_step, rtol=relative * share, atol=absolute * share)
        while solver.status == "running":
            failure = solver.step()
            if failure:
                raise RuntimeError(f"RK45 stopped at t = {solver.t:g} s: {failure}")
            yield solver.y.reshape(x.shape)

    return march


def outside_limits(elite: Elite, x: Float[np.ndarray, "states n"]) -> Bool[np.ndarray, " states"]:
    """Beyond the limits, in a set to keep out of, or no longer finite."""
    outside = ~np.all(np.abs(x) <= np.minimum(elite.state_limits, np.finfo(float).max), axis=1)
    for each in elite.keep_out:
        outside |= each.entered(x.T)
    return outside


def _modes(f: Dynamics, x: np.ndarray, u: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Eigenvalues [1/s] of A - B K, A and B by central differences."""
    n = x.size
    step = 1e-6 * np.eye(n + u.size)
    ahead, behind = ((np.concatenate([x, u]) + sign * step) for sign in (1, -1))
    slopes = (f(ahead[:, :n], ahead[:, n:]) - f(behind[:, :n], behind[:, n:])) / 2e-6
    return np.linalg.eigvals(slopes[:n].T - slopes[n:].T @ gain)
