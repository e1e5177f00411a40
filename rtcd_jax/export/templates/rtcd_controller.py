"""The exported controller and its funnel monitor. Needs numpy alone, and `rtcd_controller.npz` beside it.

    controller = Controller()
    des_pos, des_vel, des_tau = controller.get_control_output(meas_pos, meas_vel, meas_tau, meas_time)
    watch = controller.monitor(meas_time, [meas_pos, meas_vel])

Time counts from the start of the motion. Angles are not wrapped, unless `Controller(wrapped=True)` says that the
measured ones are. `rtcd_controller.json` has units, signs and limits. `python rtcd_controller.py` compares the
controller with `test_vectors.csv`; with `--demo` it swings up MuJoCo's model of the robot.

On [t_k, t_k+1], with s = (t - t_k) / dt:  u = clip(u_k - K(t) (x - x*(t))), x* the cubic Hermite interpolant of x_k and
its rates, K linear between K_k and K_k+1. Before t_0 the first instant is held; from t_N on u = clip(-K_goal (x -
x_goal)).

The proved funnel, if there is a certificate, is {x* + L(t) y : |y| <= 1} with the certificate's L, from its first time
on; after t_N its region of the goal. The sampled one is {x : V = (x - x*)'S(t)(x - x*) <= rho(t)}, S the cubic Hermite
interpolant of S_k and its rates, log rho linear.

A motion that ends in a catch set (`caught`) is over at t_N, where the sampled funnel is that set: afterwards the input
is zero, and every state counts as outside.

Where the state, the time or what follows from them is not finite, the input is zero and the state counts as outside.
"""

from __future__ import annotations  # robots run old Pythons

import math
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

TOLERANCE = 1e-6
"""Of the self-test."""
CLAIM = ""
"""SHA-256 of the claim that the certificate proves about this controller; empty without one."""
LARGEST = sys.float_info.max

_JOINTS = ("meas_pos", "meas_vel", "meas_tau", "meas_time")
_STATE = ("x", "t")
_CART_POLE = ("mea_cart_pos", "mea_pend_pos", "mea_cart_vel", "mea_pend_vel", "mea_force", "mea_time")
_CART_POLE_FORCE = ("mea_time", "mea_cart_pos", "mea_pend_pos", "mea_cart_vel", "mea_pend_vel")
_NEEDED = {
    _JOINTS: set(_JOINTS[:2]),
    _STATE: {"x"},
    _CART_POLE: set(_CART_POLE),
    _CART_POLE_FORCE: set(_CART_POLE_FORCE),
}


class Monitor(NamedTuple):
    """Where a state is in the funnel now.

    `ratio` is |y|^2 in the proved funnel, V/rho in the sampled one: 0 on the nominal motion, 1 on the funnel's
    boundary. `margin` = 1 - ratio is negative outside. `abort` advises to stop. `proved` says which funnel it is.
    """

    ratio: float
    margin: float
    inside: bool
    abort: bool
    proved: bool


class Controller:
    """The closed loop of one design, with the interfaces of the DFKI controllers.

    `abort_ratio` is the ratio above which the monitor advises to abort; it always does beyond the limits of the states.
    4 is twice as far from the nominal motion as the funnel reaches: outside it nothing is promised, but much may work.
    `wrapped` is for encoders that lose whole turns: every measured angle is taken in the turn nearest to the nominal.
    """

    def __init__(self, folder: Path | str = Path(__file__).parent, abort_ratio: float = 4.0, wrapped: bool = False):
        with np.load(Path(folder) / "rtcd_controller.npz") as stored:
            time, x, rates, self.u, gains = (stored[key] for key in ("time", "x", "x_rates", "u", "K"))
            values, value_rates, levels = stored["S"], stored["S_rates"], stored["rho"]
            self.x_goal, self.goal_gain = stored["x_goal"], stored["K_goal"]
            self.u_max, self.limits, self.joints = stored["u_max"], stored["state_limits"], stored["input_joints"]
            self._begins, self._axes = stored["proof_begins"], stored["proof_axes"]
            self.angles, self.caught = stored["angles"], bool(stored["caught"])
        self.abort_ratio, self.wrapped = abort_ratio, wrapped
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

    def reset(self) -> None:
        """Nothing to do: the controller has no memory."""

    def set_goal(self, x=None) -> None:
        """Nothing to do: the goal belongs to the funnel."""

    def get_control_output(self, *measured, **named):
        """What the DFKI toolkits ask for, in each one's own form, arguments by place or by name:

            (meas_pos, meas_vel, meas_tau=None, meas_time=0.0)      torque-limited simple pendulum
                -> positions, velocities and torques or forces of all joints; floats for a float `meas_pos`
            (x, t)                                                  double pendulum
                -> torques or forces of all joints [n/2]
            (mea_cart_pos, mea_pend_pos, mea_cart_vel, mea_pend_vel, mea_force, mea_time)       cart-pole
                -> cart position, pendulum position, cart velocity, pendulum velocity, force: floats
            (mea_time, mea_cart_pos, mea_pend_pos, mea_cart_vel, mea_pend_vel)       cart-pole, as its TVLQR
                -> force: a float

        A joint without a motor gets zero. Raises TypeError for arguments of no form.
        """
        form, given = self._form(measured, named)
        if form is _JOINTS:
            return self._joints_output(given["meas_pos"], given["meas_vel"], given.get("meas_time", 0.0))
        if form is _STATE:
            return self.get_control_output_(given["x"], given.get("t"))
        t = _number(given["mea_time"])
        x = np.array([_number(given[name]) for name in _CART_POLE[:4]])
        nominal, u = self._nominal_and_input(t, x)
        return float(u[0]) if form is _CART_POLE_FORCE else (*nominal.tolist(), float(u[0]))

    def get_control_output_(self, x, t=None) -> np.ndarray:
        """Torques or forces of all joints [n/2] at the state x and the time t, as the double pendulum's toolkit asks.

        Raises TypeError without a time: the controller follows a motion.
        """
        if t is None:
            raise TypeError("the time t is needed: this controller follows a motion")
        return self._by_joint(self.control(t, x))

    def _form(self, measured, named):
        """The toolkit's form in which the arguments come, and the arguments by its names."""
        states, count = len(self.x_goal), len(measured) + len(named)
        if named:
            forms = _JOINTS, _STATE, _CART_POLE_FORCE, _CART_POLE
        elif count and np.size(measured[0]) == states:
            forms = (_STATE,)
        else:
            forms = ({5: _CART_POLE_FORCE, 6: _CART_POLE}.get(count, _JOINTS),)
        for form in forms:
            given = {**dict(zip(form, measured)), **named}  # noqa: B905 (old Pythons have no strict=)
            fits = len(given) == count and _NEEDED[form] <= given.keys() <= set(form)
            sizes = {np.size(given[name]) for name in _NEEDED[form]} if fits else set()
            if sizes == {{_JOINTS: states // 2, _STATE: states}.get(form, states // 4)}:
                return form, given
        raise TypeError(
            "get_control_output takes (meas_pos, meas_vel, meas_tau, meas_time), (x, t), or of a cart-pole "
            "(mea_cart_pos, mea_pend_pos, mea_cart_vel, mea_pend_vel, mea_force, mea_time) or "
            "(mea_time, mea_cart_pos, mea_pend_pos, mea_cart_vel, mea_pend_vel)"
        )

    def _joints_output(self, pos, vel, t):
        x = np.array([pos, vel], float).reshape(-1)
        nominal, u = self._nominal_and_input(t, x)
        if len(x) == 2:
            output = float(nominal[0]), float(nominal[1]), float(u[0])
            return output if np.ndim(pos) == 0 else tuple(np.array([a]) for a in output)
        half = len(x) // 2
        return nominal[:half], nominal[half:], self._by_joint(u)

    def _by_joint(self, u: np.ndarray) -> np.ndarray:
        tau = np.zeros(len(self.x_goal) // 2)
        tau[self.joints] = u
        return tau

    def control(self, t: float, x) -> np.ndarray:
        """u [inputs] of the state x as in `monitor`; zero if x or t is not finite."""
        return self._nominal_and_input(t, np.asarray(x, float).reshape(-1))[1]

    def unwrap(self, t: float, x) -> np.ndarray:
        """x with every angle in the turn that is nearest to x*(t): half a turn at most between them."""
        x = np.array(x, float).reshape(-1)
        if np.isfinite(x).all() and np.isfinite(t):
            error = (x - self.nominal(t))[self.angles]
            x[self.angles] -= 2 * np.pi * np.round(error / (2 * np.pi))
        return x

    def over(self, t: float) -> bool:
        """Whether the motion has ended in its catch set before t."""
        return self.caught and t > self.duration

    def nominal(self, t: float) -> np.ndarray:
        """x*(t) [n] at a finite time; after the motion the goal."""
        return self._nominal(*self._place(t))

    def monitor(self, t: float, x) -> Monitor:
        """Whether x = (positions, velocities), flat or [positions, velocities], is inside the funnel at time t."""
        x = self.unwrap(t, x) if self.wrapped else np.asarray(x, float).reshape(-1)
        proved = bool(len(self._begins) > 0 and np.isfinite(t) and t >= self._begins[0] * self.dt)
        if not (np.isfinite(x).all() and np.isfinite(t)) or self.over(t):
            return Monitor(LARGEST, -LARGEST, False, True, proved)
        with np.errstate(over="ignore", invalid="ignore"):  # of absurd states
            k, s = self._place(t)
            error = x - self._nominal(k, s)
            ratio = self._proved_ratio(k, s, error) if proved else self._sampled_ratio(k, s, error)
        if not np.isfinite(ratio):
            return Monitor(LARGEST, -LARGEST, False, True, proved)
        outside = bool((np.abs(x) > self.limits).any())
        ratio = max(ratio, 0.0)  # the rounding of a state on the nominal motion
        return Monitor(ratio, 1 - ratio, ratio <= 1 and not outside, ratio > self.abort_ratio or outside, proved)

    def _proved_ratio(self, k, s: float, error: np.ndarray) -> float:
        """|y|^2 where x = x* + L(t) y; L is cubic between two of `_begins`, the last one is the goal's."""
        at = len(self.u) if k is None else k + s
        piece = int(np.searchsorted(self._begins, at, side="right")) - 1
        local = 0.0
        if piece + 1 < len(self._begins):
            begin, end = self._begins[piece : piece + 2]
            local = (2 * at - begin - end) / (end - begin)
        axes = np.array([1.0, local, local * local, local**3]) @ self._axes[piece].reshape(4, -1)
        y = np.linalg.solve(axes.reshape(len(error), -1), error)
        return float(y @ y)

    def _sampled_ratio(self, k, s: float, error: np.ndarray) -> float:
        """V/rho."""
        if k is None:
            return float(error @ self._last_value @ error)
        value = (np.array([1.0, s, s * s, s**3]) @ self._values[k]).reshape(len(error), len(error))
        log_level = (1 - s) * self._log_levels[k] + s * self._log_levels[k + 1]
        return float(error @ value @ error) * math.exp(-log_level)

    def _place(self, t: float):
        """The interval and the fraction of it; None behind the last one."""
        if t >= self.duration:
            return None, 0.0
        k = min(int(max(t, 0.0) / self.dt), len(self.u) - 1)
        return k, max(t, 0.0) / self.dt - k

    def _nominal(self, k, s: float) -> np.ndarray:
        """x*."""
        if k is None:
            return self.x_goal.copy()
        return np.array([1.0, s, s * s, s**3]) @ self._table[k, :, : len(self.x_goal)]

    def _nominal_and_input(self, t: float, x: np.ndarray):
        """x*(t) and u."""
        x = self.unwrap(t, x) if self.wrapped else x
        finite = bool(np.isfinite(x).all() and np.isfinite(t))
        k, s = self._place(t) if np.isfinite(t) else (None, 0.0)
        if k is None:
            nominal, feedforward, gain = self.x_goal.copy(), np.zeros_like(self.u_max), self.goal_gain
        else:
            row = np.array([1.0, s, s * s, s**3]) @ self._table[k]
            nominal, feedforward, gain = row[: len(x)], self.u[k], row[len(x) :].reshape(-1, len(x))
        if not finite or self.over(t):
            return nominal, np.zeros_like(self.u_max)
        with np.errstate(over="ignore", invalid="ignore"):  # of absurd states
            u = feedforward - gain @ (x - nominal)
        if not np.isfinite(u).all():
            return nominal, np.zeros_like(self.u_max)
        return nominal, np.minimum(np.maximum(u, -self.u_max), self.u_max)


def _number(value) -> float:
    return float(np.asarray(value, float).reshape(()))


def self_test(folder: Path | str = Path(__file__).parent, tolerance: float = TOLERANCE) -> float:
    """The largest deviation from `test_vectors.csv`, as a share of the input limits and of 1 + ratio.

    Infinite where an input is not finite, or the monitor says inside, abort or proved where the table does not.
    """
    controller = Controller(folder)
    n, m = len(controller.x_goal), len(controller.u_max)
    worst = 0.0
    for row in np.loadtxt(Path(folder) / "test_vectors.csv", delimiter=",", skiprows=1):
        t, x, u, (ratio, *flags) = row[0], row[1 : 1 + n], row[1 + n : 1 + n + m], row[1 + n + m :]
        off = np.abs(controller.control(t, x) - u) / controller.u_max
        watch = controller.monitor(t, x)
        off = max(float(off.max()), abs(watch.ratio - ratio) / (1 + ratio))
        right = [watch.inside, watch.abort, watch.proved] == [bool(flag) for flag in flags] and off == off
        worst = max(worst, off if right else math.inf)
    print(f"{'ok' if worst <= tolerance else 'FAILED'}: largest deviation {worst:.2g}, allowed {tolerance:g}")
    return worst


if __name__ == "__main__":
    if "--demo" in sys.argv[1:]:
        from rtcd_demo import main

        sys.exit(main([word for word in sys.argv[1:] if word != "--demo"]))
    sys.exit(0 if self_test() <= TOLERANCE else 1)
