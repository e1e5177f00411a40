"""A stored funnel at every instant, not only at its knots: is a state inside, and how far?

On [t_k, t_k+1], s = (t - t_k) / (t_k+1 - t_k):

    x*(t)    the cubic Hermite interpolant of x_k, f(x_k, u_k) and x_k+1, f(x_k+1, u_k)
    S(t)     that of S_k and S_k+1 with the slopes of the policy's Riccati equation there, or a refinement's
    rho(t)   rho_k^(1 - s) rho_k+1^s

After t_N the goal, its LQR's S_N, and rho_N; with a catch set nothing is said there. Errors x - x*(t) of angles are not
wrapped. What was sampled is promised at the knots; between them this is the interpolation that proofs begin from.
"""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from rtcd_jax.elite.closed_loop import ClosedLoop, Dynamics
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.simulators import dynamics_of
from rtcd_jax.numerics.hermite import cubic_hermite

STEP = 1e-5
"""Of the central differences, in SI units."""


@final
@dataclass(frozen=True, eq=False)
class FunnelInterpolant:
    """The funnel of `loop`'s elite; `value_rates` are S' at both ends of every interval."""

    loop: ClosedLoop
    value_rates: Float[np.ndarray, "intervals 2 n n"]

    @classmethod
    def of(cls, elite: Elite) -> "FunnelInterpolant":
        """The funnel of an elite, by the plant's closed form where there is one."""
        f = dynamics_of(elite)
        ends = np.stack([elite.x[:-1], elite.x[1:]], axis=1)
        inputs = np.stack([elite.u, elite.u], axis=1)
        a, b = linearized(f, ends.reshape(-1, ends.shape[2]), inputs.reshape(-1, inputs.shape[2]))
        shape = ends.shape[:2]
        rates = value_rates(elite, a.reshape(*shape, *a.shape[1:]), b.reshape(*shape, *b.shape[1:]))
        return cls(ClosedLoop.of(elite, f), rates)

    @property
    def elite(self) -> Elite:
        return self.loop.elite

    def nominal(self, time: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T n"]:
        """x*(t)."""
        k, s, after = self._interval(time)
        return np.where(after[:, None], self.elite.x_goal, self.loop.nominal(k, s))

    def value(self, time: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T n n"]:
        """S(t)."""
        k, s, after = self._interval(time)
        S, rates = self.elite.S, self.value_rates
        fraction, duration = s[:, None, None], self.loop.duration(k)[:, None, None]
        between = cubic_hermite(fraction, duration, S[k], rates[k, 0], S[k + 1], rates[k, 1])
        return np.where(after[:, None, None], S[-1], between)

    def level(self, time: Float[np.ndarray, " T"]) -> Float[np.ndarray, " T"]:
        """rho(t)."""
        k, s, _ = self._interval(time)
        logs = np.log(self.elite.rho)
        return np.exp((1 - s) * logs[k] + s * logs[k + 1])

    def ratio(self, time: Float[np.ndarray, " T"], x: Float[np.ndarray, "T n"]) -> Float[np.ndarray, " T"]:
        """V(t, x) / rho(t): at most 1 inside the funnel, 0 on the nominal motion."""
        error = x - self.nominal(time)
        return np.einsum("ti,tij,tj->t", error, self.value(time), error) / self.level(time)

    def _interval(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The interval, the fraction of it, and whether the motion is over; then the fraction is 1."""
        knots = self.elite.time
        k = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 2)
        return k, np.clip((time - knots[k]) / self.loop.duration(k), 0, 1), time >= knots[-1]


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


def value_rates(
    elite: Elite, a: Float[np.ndarray, "intervals 2 n n"], b: Float[np.ndarray, "intervals 2 n m"]
) -> Float[np.ndarray, "intervals 2 n n"]:
    """S' at both ends of every interval: the elite's, or by the policy's own Riccati equation, from A and B there.

    The options are those of `rtcd_jax.policy`: A is A + discount I, and R is R input_weight / max(1 - |u*| / u_max,
    authority)^2.
    """
    if elite.S_rates is not None:
        return elite.S_rates
    options = elite.policy
    left = np.maximum(1 - np.abs(elite.u) / elite.u_max, options.get("authority", 1.0))
    weights = options.get("input_weight", 1.0) * np.diag(elite.R) / left**2
    a = a + options.get("discount", 0.0) * np.eye(a.shape[-1])
    return riccati_rate(np.stack([elite.S[:-1], elite.S[1:]], axis=1), a, b, elite.Q, weights[:, None])


def riccati_rate(S: np.ndarray, a: np.ndarray, b: np.ndarray, q: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """S' = -(A'S + S A - S B R^-1 B'S + Q) [... n n]; `weights` [... m] is the diagonal of R."""
    gain = S @ b
    return -(np.swapaxes(a, -2, -1) @ S + S @ a - (gain / weights[..., None, :]) @ np.swapaxes(gain, -2, -1) + q)
