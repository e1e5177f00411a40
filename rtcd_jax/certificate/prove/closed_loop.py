"""The claim of an elite's closed loop, and the same loop in float64 for the search."""

from collections.abc import Callable, Mapping
from copy import copy
from typing import Any, final

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import value_rates
from rtcd_jax.numerics.hermite import cubic_hermite, cubic_hermite_rate
from rtcd_jax.system.errors import UserError

ADVERSARIAL_DIRECTIONS, TRIES = 8, 40
SEARCH_RADII = (0.2, 0.1, 0.05, 0.02)
"""The most adversarial directions of a sphere are improved by random steps: `TRIES` for each standard deviation."""


def double(value: float) -> str:
    """A double as certificates write it."""
    return float(value).hex()


def doubles(values: Any) -> Any:
    """Nested lists of doubles."""
    return [doubles(v) for v in values] if np.ndim(values) else double(values)


def with_digests(record: Mapping[str, Any]) -> dict[str, Any]:
    """The record and the digests of its values."""
    return {**record, "sha256": {name: check.digest(value) for name, value in record.items()}}


def claim_of(elite: Elite) -> dict[str, Any]:
    """The claim about an elite, without `start`: what is to be proved is fixed before the proof.

    The rates of the cubic Hermite interpolant are f(x_k, u_k) and f(x_{k+1}, u_k), rounded to doubles.

    Raises:
        UserError: a plant that the checker does not know, more than one input, knots that are not evenly spaced, or a
            number that no claim can hold.
    """
    name = elite.plant
    if name not in check.PLANTS:
        raise UserError(f"no certificate for the plant {name!r}: the checker knows {', '.join(check.PLANTS)}")
    plant, x, u = check.PLANTS[name], elite.x, elite.u
    if u.shape[1] != 1:
        raise UserError(f"no certificate for {u.shape[1]} inputs: the checker knows loops with one")
    missing = [key for key in plant.parameters if key not in elite.parameters]
    if missing:
        raise UserError(f"no certificate without the {name}'s {', '.join(missing)}: its parameters lack them")
    parameters = {key: np.float64(elite.parameters[key]) for key in plant.parameters}
    if float(elite.u_max[0]) != parameters[plant.limit]:
        raise UserError(f"u_max = {elite.u_max[0]}: must be {plant.limit} = {parameters[plant.limit]}")
    dt = elite.time[1] - elite.time[0]
    if not np.allclose(np.diff(elite.time), dt, rtol=1e-9, atol=0):
        raise UserError("no certificate for knots that are not evenly spaced")
    ends = np.stack([x[:-1], x[1:]])
    with np.errstate(all="ignore"):  # the checker's reader refuses what is not finite
        rates = np.moveaxis(rate(plant, parameters, np.moveaxis(ends, 2, 0), u[:, 0]), 0, 2)
    claim = {
        "plant": name,
        "parameters": {key: double(value) for key, value in parameters.items()},
        "state_limits": [double(limit) if np.isfinite(limit) else None for limit in elite.state_limits],
        "dt": double(dt),
        "x": doubles(x),
        "rates": doubles(np.swapaxes(rates, 0, 1)),
        "u": doubles(u[:, 0]),
        "K": doubles(elite.K[:, 0]),
        "x_goal": doubles(elite.x_goal),
        "K_goal": doubles(elite.K_goal[0]),
    }
    try:
        check.read_claim(check.Node("the elite's claim", with_digests({**claim, "start": [0, double(0.0)]})))
    except check.Refused as refused:
        raise UserError(str(refused)) from None
    return claim


def rate(plant: check.Plant, parameters: Mapping[str, float], x: np.ndarray, u: Any) -> np.ndarray:
    """x' [n ...] of states [n ...], real or complex."""
    angle = x[plant.angle]
    determinant, drift, push = plant.field(parameters, x, np.sin(angle), np.cos(angle))
    return np.stack([(a + b * u) / determinant for a, b in zip(drift, push, strict=True)])


def linear(
    plant: check.Plant, parameters: Mapping[str, float], x: np.ndarray, u: float
) -> tuple[np.ndarray, np.ndarray]:
    """A [n n] and B [n] at x [n], by complex steps."""
    step = 1e-30
    a = np.imag(rate(plant, parameters, x[:, None] + 1j * step * np.eye(len(x)), u)) / step
    return a, np.imag(rate(plant, parameters, x.astype(complex), u + 1j * step)) / step


@final
class Loop:
    """The claimed loop in float64, and the value function that shapes its funnel.

    Between knots S is the cubic Hermite interpolant of S_k with the slopes of the policy's Riccati equation, unless
    it is `shaped` anew.
    """

    def __init__(self, claim: check.Claim, elite: Elite):
        self.claim = claim
        self.plant, self.n = claim.plant, claim.n
        self.parameters = {key: float(value) for key, value in claim.parameters.items()}
        self.limit, self.dt = float(claim.limit), float(claim.dt)
        self.x, self.rates, self.u = floats(claim.x), floats(claim.rates), floats(claim.u)
        self.gains, self.goal, self.goal_gain = floats(claim.K), floats(claim.x_goal), floats(claim.K_goal)
        self.bounds = np.array([np.inf if b is None else float(b) for b in claim.bounds])
        self.values = elite.S
        a, b = np.zeros((len(self.u), 2, self.n, self.n)), np.zeros((len(self.u), 2, self.n, 1))
        for k, u in enumerate(self.u):
            for end in (0, 1):
                a[k, end], b[k, end, :, 0] = linear(self.plant, self.parameters, self.x[k + end], u)
        self.slopes = value_rates(elite, a, b)

    def rate(self, x: np.ndarray, u: Any) -> np.ndarray:
        return rate(self.plant, self.parameters, x, u)

    def shaped(self, values: np.ndarray, slopes: np.ndarray) -> "Loop":
        """The same loop with another V: S at the knots [N+1 n n] and S' at both ends of the intervals [N 2 n n]."""
        other = copy(self)
        other.values, other.slopes = values, slopes
        return other

    def nominal(self, k: int, fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """x* and x*' at a fraction of the interval k."""
        return hermite(fraction, self.dt, self.x[k], self.rates[k, 0], self.x[k + 1], self.rates[k, 1])

    def error_rate(self, k: int, fraction: float) -> Callable[[np.ndarray], np.ndarray]:
        """Errors e [n D] from the nominal motion -> e' = f(x* + e, u) - x*' [n D], at a fraction of the interval k."""
        center, center_rate = self.nominal(k, fraction)
        gain = (1 - fraction) * self.gains[k] + fraction * self.gains[k + 1]

        def rate(error: np.ndarray) -> np.ndarray:
            u = np.clip(self.u[k] - gain @ error, -self.limit, self.limit)
            return self.rate(center[:, None] + error, u) - center_rate[:, None]

        return rate

    def value(self, k: int, fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """S and S'."""
        return hermite(fraction, self.dt, self.values[k], self.slopes[k, 0], self.values[k + 1], self.slopes[k, 1])

    def axes(self, k: int, fraction: float, rho: float, growth: float) -> tuple[np.ndarray, np.ndarray]:
        """L with L L' = rho S^-1 and its rate, where rho' = growth rho; the angle's row has its first entry alone.

        Raises:
            Refused: between knots, S is not positive definite.
        """
        s, slope = self.value(k, fraction)
        check.require(float(np.linalg.eigvalsh(s)[0]) > 0, f"interval {k}", "S is not positive definite between knots")
        p = np.linalg.inv(s) * rho
        p_rate = growth * p - p @ slope @ p / rho
        order = [self.plant.angle, *(i for i in range(self.n) if i != self.plant.angle)]
        c = np.linalg.cholesky(p[np.ix_(order, order)])
        inner = np.linalg.solve(c, np.linalg.solve(c, p_rate[np.ix_(order, order)]).T)
        c_rate = c @ (np.tril(inner, -1) + np.diag(np.diag(inner)) / 2)
        back, sign = np.argsort(order), np.ones(self.n)
        sign[-1] = np.linalg.det(np.eye(self.n)[order])  # of the permutation: det L > 0
        return c[back] * sign, c_rate[back] * sign

    def growth(self, k: int, fraction: float, rho: float, directions: np.ndarray) -> float:
        """The largest V' / V over the surface V = rho, searched from the sampled directions [n D]."""
        s, slope = self.value(k, fraction)
        axes, _ = self.axes(k, fraction, rho, 0.0)
        error_rate = self.error_rate(k, fraction)

        def rises(y: np.ndarray) -> np.ndarray:
            error = axes @ y
            return np.sum((s @ error) * (2 * error_rate(error)) + error * (slope @ error), axis=0) / rho

        return _highest(rises, directions)

    def drift(self, k: int, fraction: float, axes: np.ndarray, y: np.ndarray) -> np.ndarray:
        """y'L^-1 (f(x* + L y, u) - x*') [D] for directions y [n D] of an ellipsoid L."""
        return np.sum(y * np.linalg.solve(axes, self.error_rate(k, fraction)(axes @ y)), axis=0)

    def clearance(self, k: int, fraction: float) -> np.ndarray:
        """The half widths [n] that the limits on the states allow an ellipsoid."""
        center, _ = self.nominal(k, fraction)
        return self.bounds - np.abs(center)

    def box_level(self, k: int, fraction: float) -> float:
        """The level of the ellipsoid that touches a limit on the states."""
        return _touching(self.clearance(k, fraction), self.value(k, fraction)[0])

    def goal_box_level(self) -> float:
        """As `box_level`; half a turn away is another equilibrium, which no goal region has in it."""
        clearance = self.bounds - np.abs(self.goal)
        clearance[self.plant.angle] = min(clearance[self.plant.angle], np.pi)
        return _touching(clearance, self.values[-1])

    def goal_growth(self, rho: float, directions: np.ndarray) -> float:
        """As `growth`, about the goal."""
        s = self.values[-1]
        axes = np.linalg.cholesky(np.linalg.inv(s) * rho)

        def rises(y: np.ndarray) -> np.ndarray:
            error = axes @ y
            u = np.clip(-self.goal_gain @ error, -self.limit, self.limit)
            return 2 * np.sum((s @ error) * self.rate(self.goal[:, None] + error, u), axis=0) / rho

        return _highest(rises, directions)


def _touching(clearance: np.ndarray, s: np.ndarray) -> float:
    """The level of V = x'S x whose ellipsoid touches the first of the half widths [n]."""
    return float(np.min(clearance**2 / np.diag(np.linalg.inv(s))))


def _highest(f: Callable[[np.ndarray], np.ndarray], directions: np.ndarray) -> float:
    """The largest f over the sphere: the best directions [n D], then random steps around them, ever shorter."""
    values = f(directions)
    if len(directions) == 2:  # a circle is covered densely
        return float(values.max())
    random, best = np.random.default_rng(0), directions[:, np.argsort(values)[-ADVERSARIAL_DIRECTIONS:]]
    for radius in SEARCH_RADII:
        tries = best[:, :, None] + radius * random.normal(size=(*best.shape, TRIES))
        tries = np.concatenate([best[:, :, None], tries], axis=2)
        tries /= np.linalg.norm(tries, axis=0)
        values = f(tries.reshape(len(best), -1)).reshape(best.shape[1], -1)
        best = np.take_along_axis(tries, values.argmax(axis=1)[None, :, None], axis=2)[:, :, 0]
    return float(values.max())


def floats(values: Any) -> np.ndarray:
    """Nested lists of exact numbers as doubles."""
    return np.array(values, dtype=object).astype(float)


def hermite(fraction: Any, dt: float, a: Any, a_rate: Any, b: Any, b_rate: Any) -> tuple[Any, Any]:
    """Value and rate of the cubic with these values and rates at the ends of an interval of `dt`."""
    ends = fraction, dt, a, a_rate, b, b_rate
    return cubic_hermite(*ends), cubic_hermite_rate(*ends)
