"""The exported controller and its funnel monitor. Needs numpy alone, and `controller.npz` beside it.

    controller = Controller()
    des_pos, des_vel, des_tau = controller.get_control_output(meas_pos, meas_vel, meas_tau, meas_time)
    watch = controller.monitor(meas_time, [meas_pos, meas_vel])

Time counts from the start of the motion. Angles are not wrapped. `controller.json` has units, signs and limits.
`python controller.py` compares the controller with `test_vectors.csv`.

On [t_k, t_k+1], with s = (t - t_k) / dt:  u = clip(u_k - K(t) (x - x*(t))), x* the cubic Hermite interpolant of x_k and
its rates, K linear between K_k and K_k+1. Before t_0 the first instant is held; from t_N on u = clip(-K_goal (x -
x_goal)). The funnel is {x : V = (x - x*)'S(t)(x - x*) <= rho(t)}, S the cubic Hermite interpolant of S_k and its rates,
log rho linear.
"""

from __future__ import annotations  # robots run old Pythons

import math
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

TOLERANCE = 1e-6
"""Of the self-test."""


class Monitor(NamedTuple):
    """Where a state is in the funnel now.

    `ratio` is V/rho: 0 on the nominal motion, 1 on the funnel's boundary. `margin` = 1 - ratio is negative outside.
    `abort` advises to stop.
    """

    ratio: float
    margin: float
    inside: bool
    abort: bool


class Controller:
    """The closed loop of one design, with the interface of the DFKI controllers.

    `abort_ratio` is the V/rho above which the monitor advises to abort; it always does beyond the limits of the states.
    4 is twice as far from the nominal motion as the funnel reaches: outside it nothing is promised, but much may work.
    """

    def __init__(self, folder: Path | str = Path(__file__).parent, abort_ratio: float = 4.0):
        with np.load(Path(folder) / "controller.npz") as stored:
            time, x, rates, self.u, gains = (stored[key] for key in ("time", "x", "x_rates", "u", "K"))
            values, value_rates, levels = stored["S"], stored["S_rates"], stored["rho"]
            self.x_goal, self.goal_gain = stored["x_goal"], stored["K_goal"]
            self.u_max, self.limits, self.joints = stored["u_max"], stored["state_limits"], stored["input_joints"]
        self.abort_ratio = abort_ratio
        self.dt, self.duration = float(time[1]), float(time[-1])
        self._log_levels, self._last_value = np.log(levels).tolist(), values[-1] / levels[-1]
        # Coefficients of 1, s, s^2, s^3, one row an interval: of x*(t) with K(t) behind it, and of S(t).
        flat = gains.reshape(len(gains), -1)
        linear = np.stack([flat[:-1], np.diff(flat, axis=0), 0 * flat[1:], 0 * flat[1:]], axis=1)
        self._table = np.concatenate([self._cubics(x, rates), linear], axis=2)
        self._values = self._cubics(values.reshape(len(values), -1), value_rates.reshape(*value_rates.shape[:2], -1))

    def _cubics(self, knots, rates) -> np.ndarray:
        """Hermite's cubics [N 4 columns] through rows of `knots`, with `rates` at both ends of every interval."""
        start, end, first, last = knots[:-1], knots[1:], self.dt * rates[:, 0], self.dt * rates[:, 1]
        cubic = [start, first, 3 * (end - start) - 2 * first - last, 2 * (start - end) + first + last]
        return np.stack(cubic, axis=1)

    def init(self, x0=None) -> None:
        """Nothing to do: the controller has no memory."""

    def set_goal(self, x=None) -> None:
        """Nothing to do: the goal belongs to the funnel."""

    def get_control_output(self, meas_pos, meas_vel, meas_tau=None, meas_time=0.0):
        """Desired positions, velocities and torques or forces of all joints; floats for a float `meas_pos`.

        A joint without a motor gets zero.
        """
        x = np.array([meas_pos, meas_vel], float).reshape(-1)
        nominal, u = self._nominal_and_input(meas_time, x)
        if len(x) == 2:
            pos, vel, tau = float(nominal[0]), float(nominal[1]), float(u[0])
            return (pos, vel, tau) if np.ndim(meas_pos) == 0 else tuple(np.array([a]) for a in (pos, vel, tau))
        half = len(x) // 2
        tau = np.zeros(half)
        tau[self.joints] = u
        return nominal[:half], nominal[half:], tau

    def control(self, t: float, x) -> np.ndarray:
        """u [inputs] of the state x as in `monitor`; zero if x or t is not finite."""
        return self._nominal_and_input(t, np.asarray(x, float).reshape(-1))[1]

    def monitor(self, t: float, x) -> Monitor:
        """Whether x = (positions, velocities), flat or [positions, velocities], is inside the funnel at time t."""
        x = np.asarray(x, float).reshape(-1)
        if not (np.isfinite(x).all() and np.isfinite(t)):
            return Monitor(np.inf, -np.inf, False, True)
        k, s = self._place(t)
        if k is None:
            error = x - self.x_goal
            ratio = float(error @ self._last_value @ error)
        else:
            powers = np.array([1.0, s, s * s, s * s * s])
            error = x - powers @ self._table[k, :, : len(x)]
            value = (powers @ self._values[k]).reshape(len(x), len(x))
            log_level = (1 - s) * self._log_levels[k] + s * self._log_levels[k + 1]
            ratio = float(error @ value @ error) * math.exp(-log_level)
        outside = bool((np.abs(x) > self.limits).any())
        ratio = max(ratio, 0.0)  # the rounding of a state on the nominal motion
        return Monitor(ratio, 1 - ratio, ratio <= 1 and not outside, ratio > self.abort_ratio or outside)

    def _place(self, t: float):
        """The interval and the fraction of it; None behind the last one."""
        if t >= self.duration:
            return None, 0.0
        k = min(int(max(t, 0.0) / self.dt), len(self.u) - 1)
        return k, max(t, 0.0) / self.dt - k

    def _nominal_and_input(self, t: float, x: np.ndarray):
        """x*(t) and u."""
        k, s = self._place(t) if np.isfinite(t) else (None, 0.0)
        if k is None:
            nominal, u = self.x_goal.copy(), -(self.goal_gain @ (x - self.x_goal))
        else:
            row = np.array([1.0, s, s * s, s * s * s]) @ self._table[k]
            nominal = row[: len(x)]
            u = self.u[k] - row[len(x) :].reshape(-1, len(x)) @ (x - nominal)
        if not (np.isfinite(x).all() and np.isfinite(t)):
            return nominal, np.zeros_like(self.u_max)
        return nominal, np.minimum(np.maximum(u, -self.u_max), self.u_max)


def self_test(folder: Path | str = Path(__file__).parent, tolerance: float = TOLERANCE) -> float:
    """The largest deviation from `test_vectors.csv`, as a share of the input limits and of 1 + V/rho."""
    controller = Controller(folder)
    n, m = len(controller.x_goal), len(controller.u_max)
    worst = 0.0
    for row in np.loadtxt(Path(folder) / "test_vectors.csv", delimiter=",", skiprows=1):
        t, x, u, ratio = row[0], row[1 : 1 + n], row[1 + n : 1 + n + m], row[-1]
        off = np.abs(controller.control(t, x) - u) / controller.u_max
        worst = max(worst, float(off.max()), abs(controller.monitor(t, x).ratio - ratio) / (1 + ratio))
    print(f"{'ok' if worst <= tolerance else 'FAILED'}: largest deviation {worst:.2g}, allowed {tolerance:g}")
    return worst


if __name__ == "__main__":
    sys.exit(0 if self_test() <= TOLERANCE else 1)
