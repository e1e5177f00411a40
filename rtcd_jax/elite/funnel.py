"""A stored funnel at every instant, not only at its knots: is a state inside, and how far?

On [t_k, t_k+1], s = (t - t_k) / (t_k+1 - t_k):

    x*(t)    the cubic Hermite interpolant of x_k, f(x_k, u_k) and x_k+1, f(x_k+1, u_k)
    S(t)     that of S_k and S_k+1 with the slopes of the policy's Riccati equation there
    rho(t)   rho_k^(1 - s) rho_k+1^s

After t_N the goal, its LQR's S_N, and rho_N. Errors x - x*(t) of angles are not wrapped. What was sampled is promised
at the knots; between them this is the interpolation that proofs begin from.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from rtcd_jax.elite.closed_loop import Dynamics
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.simulators import CLOSED_FORMS
from rtcd_jax.numerics.hermite import cubic_hermite
from rtcd_jax.system.errors import UserError

STEP = 1e-5
"""Of the central differences, in SI units."""


@final
@dataclass(frozen=True)
class Tube:
    """`elite` with the rates of x* and of S at both ends of every interval."""

    elite: Elite
    rates: Float[np.ndarray, "intervals 2 n"]
    slopes: Float[np.ndarray, "intervals 2 n n"]

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> "Tube":
        """The funnel of a stored candidate. Raises UserError if it has none, or its record is incomplete."""
        elite = Elite.of(arrays, record)
        missing = [name for name in ("Q", "R") if name not in arrays]
        if missing:
            raise UserError(f"the elite lacks {', '.join(missing)}")
        f = dynamics_of(elite)
        ends = np.stack([elite.x[:-1], elite.x[1:]], axis=1)
        inputs = np.stack([elite.u, elite.u], axis=1)
        flat = ends.reshape(-1, ends.shape[2]), inputs.reshape(-1, inputs.shape[2])
        a, b = linearized(f, *flat)
        S = np.stack([elite.S[:-1], elite.S[1:]], axis=1).reshape(a.shape)
        weights = _input_weights(elite, np.diag(arrays["R"]), record.get("policy", {}), flat[1])
        a = a + record.get("policy", {}).get("discount", 0.0) * np.eye(a.shape[1])
        gain = S @ b
        falls = np.swapaxes(a, 1, 2) @ S + S @ a - (gain / weights[:, None]) @ np.swapaxes(gain, 1, 2) + arrays["Q"]
        return cls(elite, f(*flat).reshape(ends.shape), -falls.reshape(*ends.shape, -1))

    def nominal(self, time: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T n"]:
        """x*(t)."""
        k, share, after = self._place(time)
        x, rates = self.elite.x, self.rates
        found = cubic_hermite(share[:, None], self._duration(k)[:, None], x[k], rates[k, 0], x[k + 1], rates[k, 1])
        return np.where(after[:, None], self.elite.x_goal, found)

    def value(self, time: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T n n"]:
        """S(t)."""
        k, share, after = self._place(time)
        S, slopes = self.elite.S, self.slopes
        at = share[:, None, None], self._duration(k)[:, None, None]
        return np.where(after[:, None, None], S[-1], cubic_hermite(*at, S[k], slopes[k, 0], S[k + 1], slopes[k, 1]))

    def level(self, time: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
        """rho(t)."""
        k, share, _ = self._place(time)
        logs = np.log(self.elite.rho)
        return np.exp((1 - share) * logs[k] + share * logs[k + 1])

    def fill(self, time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T n"]) -> Float[np.ndarray, " T"]:
        """V(t, x) / rho(t): at most 1 inside the funnel, 0 on the nominal motion."""
        error = x - self.nominal(time)
        return np.einsum("ti,tij,tj->t", error, self.value(time), error) / self.level(time)

    def _place(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The interval, the share of it, and whether the motion is over, at which share is 1."""
        knots = self.elite.time
        k = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 2)
        share = np.clip((time - knots[k]) / self._duration(k), 0, 1)
        return k, share, time >= knots[-1]

    def _duration(self, k: np.ndarray) -> np.ndarray:
        return self.elite.time[k + 1] - self.elite.time[k]


def dynamics_of(elite: Elite) -> Dynamics:
    """The plant's closed form, or C MuJoCo where there is none."""
    if elite.plant in CLOSED_FORMS:
        return CLOSED_FORMS[elite.plant](elite.parameters)
    from rtcd_jax.plants.mjx import CpuDynamics, model_of

    columns = elite.x_goal.size + elite.u_max.size
    return CpuDynamics(model_of(elite.plant, elite.parameters), 2 * columns * len(elite.time))


def linearized(
    f: Dynamics, x: Float[np.ndarray, "K n"], u: Float[np.ndarray, "K m"]
) -> tuple[Float[np.ndarray, "K n n"], Float[np.ndarray, "K n m"]]:
    """A and B of the dynamics at K points, by central differences."""
    n, point = x.shape[1], np.concatenate([x, u], axis=1)
    columns = []
    for direction in STEP * np.eye(point.shape[1]):
        ahead, behind = point + direction, point - direction
        columns.append((f(ahead[:, :n], ahead[:, n:]) - f(behind[:, :n], behind[:, n:])) / (2 * STEP))
    both = np.stack(columns, axis=2)
    return both[:, :, :n], both[:, :, n:]


def _input_weights(elite: Elite, r: np.ndarray, policy: Mapping[str, float], u: np.ndarray) -> np.ndarray:
    """The diagonal of the controller's R [K m] at feed-forwards [K m], as the policy defines it."""
    left = np.maximum(1 - np.abs(u) / elite.u_max, policy.get("authority", 1.0))
    return policy.get("input_weight", 1.0) * r / left**2
