"""The claim of an elite's closed loop, and the same loop in float64 for the search."""

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any, cast, final

import numpy as np
from scipy.linalg import expm
from scipy.optimize import brentq

from rtcd_jax.certificate import check
from rtcd_jax.certificate.prove.centers import Nodes, fitted, shifts_at
from rtcd_jax.certificate.prove.field import ControlPoints, floats, linear, rate
from rtcd_jax.certificate.prove.robot import ClaimedRobot, claimed_robot
from rtcd_jax.certificate.prove.uncertainty import Bounds, bounds_of
from rtcd_jax.config.schema import UncertaintyConfig
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import value_rates
from rtcd_jax.numerics.hermite import cubic_hermite, cubic_hermite_rate
from rtcd_jax.numerics.keep_out import Ellipsoid, HalfSpace
from rtcd_jax.system.errors import UserError

GRID = 34
"""Ellipsoids are rounded to multiples of 2^-34."""
PIECES = 32
"""Of the last interval of a motion that ends in a catch, in which V is carried."""
NARROWEST = 16.0
"""Times the sum of S at its knots, by which S may grow there."""
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


def claim_of(elite: Elite, bounds: Bounds | None = None) -> dict[str, Any]:
    """The claim about an elite, without `start` and `push`: what is to be proved is fixed before the proof.

    `bounds`: of what is uncertain; None: nothing is. `speed` is 0, to be set where measurements may be old. The rates
    of the cubic Hermite interpolant are f(x_k, u_k) and f(x_{k+1}, u_k), rounded to doubles.

    Raises:
        UserError: a robot of which there is no claim, knots that are not evenly spaced, or a number that no claim can
            hold.
    """
    robot = claimed_robot(elite)
    bounds = bounds or bounds_of(elite, UncertaintyConfig())
    loop = _loop_record(elite, robot)
    claim = {
        "robot": robot_record(robot.description),
        "parameters": {name: doubles(bounds.parameters[name]) for name in robot.numbers},
        "limit": doubles(bounds.limit),
        "disturbance": double(bounds.disturbance),
        "noise": doubles(bounds.noise),
        "age": double(bounds.age),
        "speed": double(0.0),
        **loop,
        **({"catch": _catch_record(elite)} if elite.caught else {}),
        **({"shifts": _shifts_record(robot, bounds, loop)} if bounds.moving else {}),
        **({"keep_out": [_set_record(each) for each in elite.keep_out]} if elite.keep_out else {}),
    }
    rest = {"start": [0, double(0.0)], "push": double(0.0)}
    try:
        check.read_claim(check.Node("the elite's claim", with_digests({**claim, **rest})))
    except check.Refused as refused:
        raise UserError(str(refused)) from None
    return claim


def _set_record(each: HalfSpace | Ellipsoid) -> dict[str, Any]:
    if isinstance(each, HalfSpace):
        return {"normal": doubles(each.normal), "offset": double(each.offset)}
    axes = [double(axis) if np.isfinite(axis) else None for axis in each.semi_axes]
    return {"center": doubles(each.center), "semi_axes": axes}


def _loop_record(elite: Elite, robot: ClaimedRobot) -> dict[str, Any]:
    x, u = elite.x, elite.u
    dt = elite.time[1] - elite.time[0]
    if not np.allclose(np.diff(elite.time), dt, rtol=1e-9, atol=0):
        raise UserError("no certificate for knots that are not evenly spaced")
    ends = np.stack([x[:-1], x[1:]])
    with np.errstate(all="ignore"):  # the checker's reader refuses what is not finite
        numbers = {name: np.float64(value) for name, value in robot.numbers.items()}
        rates = np.moveaxis(rate(robot.description, numbers, np.moveaxis(ends, 2, 0), u[:, 0]), 0, 2)
    return {
        "state_limits": [double(limit) if np.isfinite(limit) else None for limit in elite.state_limits],
        "dt": double(dt),
        "x": doubles(x),
        "rates": doubles(np.swapaxes(rates, 0, 1)),
        "u": doubles(u[:, 0]),
        "K": doubles(elite.K[:, 0]),
        **({} if elite.caught else {"x_goal": doubles(elite.x_goal), "K_goal": doubles(elite.K_goal[0])}),
    }


def _catch_record(elite: Elite) -> dict[str, Any]:
    """The set in which the elite's motion ends, without a reset."""
    axes = on_grid(np.linalg.cholesky(np.linalg.inv(elite.S[-1]) * elite.rho[-1]))
    return catch_record(doubles(elite.x_goal), matrix_record(axes))


def catch_record(center: Any, axes: Any, **reset: Any) -> dict[str, Any]:
    return with_digests({"center": center, "axes": axes, **reset})


def matrix_record(matrix: list[list]) -> Any:
    return doubles([[float(c) for c in row] for row in matrix])


def _shifts_record(robot: ClaimedRobot, bounds: Bounds, loop: dict[str, Any]) -> list[dict[str, Any]]:
    def numbers(key: str) -> np.ndarray:
        return np.vectorize(float.fromhex)(loop[key])

    parameters = {name: bounds.parameters[name] for name in robot.numbers}
    motion = numbers("x"), numbers("rates"), numbers("u"), numbers("K")
    parts = fitted(robot.description, parameters, float.fromhex(loop["dt"]), motion, sum(bounds.limit) / 2)
    return [with_digests({**part, "x": doubles(part["x"]), "rates": doubles(part["rates"])}) for part in parts]


def robot_record(robot: check.Robot) -> dict[str, Any]:
    """A robot as certificates write it."""
    functions = {
        "mass": [[function_record(entry) for entry in row] for row in robot.mass],
        "potential": function_record(robot.potential),
        "damping": [function_record(each) for each in robot.damping],
        "motor": [function_record(each) for each in robot.motor],
    }
    names = {"name": robot.name, "states": list(robot.states), "units": list(robot.units)}
    return with_digests({**names, "input_unit": robot.input_unit, "joints": list(robot.joints), **functions})


def function_record(terms: check.Function) -> list[dict[str, Any]]:
    """A function of the positions as certificates write it."""
    return [
        {
            "joints": list(each.joints),
            "powers": dict(each.powers),
            "cos": double(each.cosine),
            "sin": double(each.sine),
        }
        for each in terms
    ]


@final
class Loop:
    """The claimed loop in float64, and the value function that shapes its funnel.

    Between knots S is the cubic Hermite interpolant of S_k with the slopes of the policy's Riccati equation, unless
    it is `shaped` anew; before a catch it is `_carried`. No level is above this `share` of the sampled ones, if it is
    below 1.
    """

    def __init__(
        self,
        claim: check.Claim,
        elite: Elite,
        misfits: Sequence[float] = (),
        misfit_at_goal: float = 0.0,
        share: float = 1.0,
    ):
        self.claim, self.age = claim, float(claim.age)
        self.robot, self.n, self.hinges = claim.robot, claim.n, list(claim.robot.hinges)
        self.parameters = {name: float(low + high) / 2 for name, (low, high) in claim.parameters.items()}
        self.limits, self.disturbance = floats(claim.limits), float(claim.disturbance)
        self.limit, self.dt = float(self.limits.mean()), float(claim.dt)
        late = [check.input_error(claim, k) for k in range(len(claim.u))]
        late_at_goal = check.error_under(claim, [claim.K_goal]) if claim.catch is None else check.Q(0)
        if claim.first_order:
            late = [
                check.lateness(claim, error, check.rational(misfit), check.jumps_within_reach(claim, k, 0))
                for k, (error, misfit) in enumerate(zip(late, misfits, strict=True))
            ]
            late_at_goal = check.lateness(claim, late_at_goal, check.rational(misfit_at_goal), check.Q(0))
        self.late, self.late_at_goal = [float(each) for each in late], float(late_at_goal)
        self._points = self._robots = ControlPoints.of(claim)
        self._shifts = np.zeros((len(claim.x), self.n, 1)), np.zeros((len(claim.u), 2, self.n, 1))
        if claim.shifts:
            nodes = Nodes.of({name: (float(low), float(high)) for name, (low, high) in claim.parameters.items()})
            self._robots = ControlPoints(nodes.numbers, np.eye(len(nodes.points)))
            self._shifts = shifts_at(claim.shifts, nodes.points)
        self.x, self.rates, self.u = floats(claim.x), floats(claim.rates), floats(claim.u)
        self.gains, self.goal, self.goal_gain = floats(claim.K), floats(claim.x_goal), floats(claim.K_goal)
        self.bounds = np.array([np.inf if b is None else float(b) for b in claim.bounds])
        self.keep_out = elite.keep_out
        self._largest = share * elite.rho if share < 1 else None
        self.values = elite.S
        a, b = np.zeros((len(self.u), 2, self.n, self.n)), np.zeros((len(self.u), 2, self.n, 1))
        for k, u in enumerate(self.u):
            for end in (0, 1):
                a[k, end], b[k, end, :, 0] = linear(self.robot, self.parameters, self.x[k + end], u)
        self.slopes, self._linear = value_rates(elite, a, b), (a, b)
        self._last = None if claim.catch is None else self._carried()

    def _carried(self) -> tuple[list[np.ndarray | None], np.ndarray]:
        """On the last interval of a motion that ends in a catch, S [PIECES + 1 n n] at the ends of its pieces: carried
        from the first knot on so that V stays the same in the linear loop, as long as it is not too narrow. By piece
        that loop's A - B K in its middle, or None where V falls instead.

        The policy's S has a boundary layer there, since S_N is the catch's, and its gains are not between their knots
        what those of that layer are.
        """
        k, s = len(self.u) - 1, self.values[-2]
        narrowest = np.linalg.cholesky(NARROWEST * (self.values[-2] + self.values[-1]))
        loops, values = [], [s]
        for middle in (np.arange(PIECES) + 0.5) / PIECES:
            a, b = linear(self.robot, self.parameters, self.nominal(k, middle)[0], self.u[k])
            loop = a - np.outer(b, (1 - middle) * self.gains[k] + middle * self.gains[k + 1])
            back = expm(-loop * self.dt / PIECES)
            s = back.T @ s @ back
            inner = np.linalg.solve(narrowest, np.linalg.solve(narrowest, s).T)
            widths, turned = np.linalg.eigh((inner + inner.T) / 2)
            if narrow := bool(widths[-1] > 1):
                axes = narrowest @ turned
                s = (axes * np.minimum(widths, 1)) @ axes.T
            loops.append(None if narrow else loop)
            values.append(s)
        return loops, np.array(values)

    def late_row(self, k: int, fraction: float) -> np.ndarray:
        """rho [n]: how fast K e changes in the unsaturated loop is about rho e."""
        gain = (1 - fraction) * self.gains[k] + fraction * self.gains[k + 1]
        a, b = ((1 - fraction) * each[k, 0] + fraction * each[k, 1] for each in self._linear)
        return (self.gains[k + 1] - self.gains[k]) / self.dt + gain @ (a - b @ gain[None])

    def late_rows(self, k: int, start: float, end: float) -> list[list]:
        """As certificates have them, at both ends of a part of an interval."""
        return on_grid(np.array([self.late_row(k, start), self.late_row(k, end)]))

    def goal_late_row(self) -> list:
        """As `late_rows`, at the goal."""
        a, b = linear(self.robot, self.parameters, self.goal, 0.0)
        return on_grid((self.goal_gain @ (a - np.outer(b, self.goal_gain)))[None])[0]

    def rate(self, x: np.ndarray, u: Any) -> np.ndarray:
        return rate(self.robot, self.parameters, x, u)

    def shaped(self, values: np.ndarray, slopes: np.ndarray) -> "Loop":
        """The same loop with another V: S at the knots [N+1 n n] and S' at both ends of the intervals [N 2 n n]."""
        other = copy(self)
        other.values, other.slopes = values, slopes
        return other

    def nominal(self, k: int, fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """x* and x*' at a fraction of the interval k."""
        return hermite(fraction, self.dt, self.x[k], self.rates[k, 0], self.x[k + 1], self.rates[k, 1])

    def shift(self, k: int, fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """c_p - x* and its rate [n J] of the robots at the `Nodes`, the first of which is the nominal one."""
        x, rates = self._shifts
        return hermite(fraction, self.dt, x[k], rates[k, 0], x[k + 1], rates[k, 1])

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
        if self._last is not None and k == len(self.u) - 1:
            piece = min(int(fraction * PIECES), PIECES - 1)
            (loops, values), part = self._last, fraction * PIECES - piece
            loop, first, last = loops[piece], values[piece], values[piece + 1]
            if loop is None:
                return (1 - part) * first + part * last, (last - first) * PIECES / self.dt
            back = expm(-loop * part * self.dt / PIECES)
            carried = back.T @ first @ back
            falls = carried @ loop
            return carried, -(falls + falls.T)
        return hermite(fraction, self.dt, self.values[k], self.slopes[k, 0], self.values[k + 1], self.slopes[k, 1])

    def axes(self, k: int, fraction: float, rho: float, growth: float) -> tuple[np.ndarray, np.ndarray]:
        """L with L L' = rho S^-1 and its rate, where rho' = growth rho; the first angle's row has one entry.

        Raises:
            Refused: between knots, S is not positive definite.
        """
        s, slope = self.value(k, fraction)
        check.require(float(np.linalg.eigvalsh(s)[0]) > 0, f"interval {k}", "S is not positive definite between knots")
        p = np.linalg.inv(s) * rho
        p_rate = growth * p - p @ slope @ p / rho
        order = [*self.hinges, *(i for i in range(self.n) if i not in self.hinges)]
        c = np.linalg.cholesky(p[np.ix_(order, order)])
        inner = np.linalg.solve(c, np.linalg.solve(c, p_rate[np.ix_(order, order)]).T)
        c_rate = c @ (np.tril(inner, -1) + np.diag(np.diag(inner)) / 2)
        back, sign = np.argsort(order), np.ones(self.n)
        sign[-1] = np.linalg.det(np.eye(self.n)[order])  # of the permutation: det L > 0
        return c[back] * sign, c_rate[back] * sign

    def outlet_axes(self, rho: float) -> list[list]:
        """The exact L at t_N of this level."""
        return on_grid(self.axes(len(self.u) - 1, 1.0, rho, 0.0)[0])

    def growth(self, k: int, fraction: float, rho: float, directions: np.ndarray) -> float:
        """The largest V' / V over the surface V = rho, searched from the sampled directions [n D]."""
        return 2 * self.rise(k, fraction, *self.axes(k, fraction, rho, 0.0), directions)

    def rise(self, k: int, fraction: float, axes: np.ndarray, axes_rate: np.ndarray, directions: np.ndarray) -> float:
        """The largest |y|' over |y| = 1, where x = c_p + L y, of all robots and inputs; searched from the sampled
        directions [n D].
        """
        (center, center_rate), (shift, shift_rate) = self.nominal(k, fraction), self.shift(k, fraction)
        gain = (1 - fraction) * self.gains[k] + fraction * self.gains[k + 1]
        inverse = np.linalg.inv(axes)

        def rises(y: np.ndarray) -> np.ndarray:
            weight = inverse.T @ y
            error = shift[:, :, None] + (axes @ y)[:, None]
            asked = self.u[k] - np.tensordot(gain, error, 1)
            late = self.age * np.tensordot(self.late_row(k, fraction), error, 1) if self.claim.first_order else 0
            x = center[:, None, None] + error
            rises = self._fastest(self._robots, x, weight, (asked, asked + late), self.late[k]) - shift_rate.T @ weight
            return np.max(rises, axis=0) - center_rate @ weight - np.sum(weight * (axes_rate @ y), axis=0)

        return _highest(rises, directions)

    def _fastest(
        self,
        points: ControlPoints,
        x: np.ndarray,
        weight: np.ndarray,
        asked: tuple[np.ndarray, np.ndarray],
        late: float,
    ) -> np.ndarray:
        """The largest weight'x' [J D] of the robots, of inputs from one asked to another; x [n D] or [n J D]."""
        determinant, a, b = points.field(self.robot, x)
        free, forced = (np.einsum("nd,njd->jd", weight, each) / determinant for each in (a, b))
        (weak, strong), w = self.limits, self.disturbance
        least, most = np.minimum(*asked) - late, np.maximum(*asked) + late
        low, high = np.clip(least, -strong, weak) - w, np.clip(most, -weak, strong) + w
        return free + np.maximum(forced * low, forced * high)

    def drift(self, k: int, fraction: float, axes: np.ndarray, y: np.ndarray) -> np.ndarray:
        """y'L^-1 (f(x* + L y, u) - x*') [D] for directions y [n D] of an ellipsoid L."""
        return np.sum(y * np.linalg.solve(axes, self.error_rate(k, fraction)(axes @ y)), axis=0)

    def clearance(self, k: int, fraction: float) -> np.ndarray:
        """The half widths [n] that the limits on the states allow an ellipsoid about any of the centers."""
        center, shift = self.nominal(k, fraction)[0], self.shift(k, fraction)[0]
        return self.bounds - np.max(np.abs(center[:, None] + shift), axis=1)

    def box_level(self, k: int, fraction: float) -> float:
        """The level of the ellipsoid that touches a limit on the states or a set to keep out of, or the largest one
        that is wanted.

        Raises:
            Refused: x* is in such a set.
        """
        s, _ = self.value(k, fraction)
        level = min(_touching(self.clearance(k, fraction), s), self._most(k, fraction))
        return self._clear(level, self.nominal(k, fraction)[0], s, self.shift(k, fraction)[0])

    def sides(self, k: int, start: float, end: float) -> list[list]:
        """Of every ellipsoid to keep out of, the normals [2 n] of half spaces that hold it, at both ends of a part of
        an interval: those between it and the ellipsoids that touch it.
        """
        ends = [(self.nominal(k, fraction)[0], self.value(k, fraction)[0]) for fraction in (start, end)]
        return [on_grid(np.array([_touched(each, *end)[1] for end in ends])) for each in self._ellipsoids]

    def goal_sides(self) -> list[list]:
        """As `sides`, at the goal."""
        return [on_grid(_touched(each, self.goal, self.values[-1])[1][None]) for each in self._ellipsoids]

    @property
    def _ellipsoids(self) -> list[Ellipsoid]:
        return [each for each in self.keep_out if isinstance(each, Ellipsoid)]

    def _clear(self, level: float, center: np.ndarray, s: np.ndarray, shift: np.ndarray | None = None) -> float:
        for each in self.keep_out:
            touching, normal = _touched(each, center, s)
            if shift is not None and self.claim.shifts:  # the sets' sides are those of the nominal motion
                reach = np.sqrt(normal @ np.linalg.solve(s, normal))
                room = np.sqrt(touching) * reach - np.max(normal @ shift)
                check.require(bool(room > 0), "the motion", "of a robot enters a set to keep out of")
                touching = float((room / reach) ** 2)
            level = min(level, touching)
        return level

    def caught_level(self) -> float:
        """The largest level at t_N whose ellipsoid about the catch's center is in its set."""
        assert self.claim.catch is not None
        axes = floats(self.claim.catch.axes)
        return float(np.linalg.eigvalsh(axes.T @ self.value(len(self.u) - 1, 1.0)[0] @ axes)[0])

    def goal_box_level(self) -> float:
        """As `box_level`; half a turn away is another equilibrium, which no goal region has in it."""
        clearance = self.bounds - np.abs(self.goal)
        clearance[self.hinges] = np.minimum(clearance[self.hinges], np.pi)
        level = min(_touching(clearance, self.values[-1]), self._most(len(self.u) - 1, 1.0))
        return self._clear(level, self.goal, self.values[-1])

    def _most(self, k: int, fraction: float) -> float:
        """The largest level that is wanted: between the knots' geometrically."""
        if self._largest is None:
            return np.inf
        return float(self._largest[k] ** (1 - fraction) * self._largest[k + 1] ** fraction)

    def goal_growth(self, rho: float, directions: np.ndarray) -> float:
        """As `growth`, about the goal."""
        s = self.values[-1]
        axes = np.linalg.cholesky(np.linalg.inv(s) * rho)
        row = floats(self.goal_late_row())

        def rises(y: np.ndarray) -> np.ndarray:
            error = axes @ y
            asked = -self.goal_gain @ error
            oldest = asked + self.age * row @ error if self.claim.first_order else asked
            x = self.goal[:, None] + error
            rises = self._fastest(self._points, x, s @ error, (asked, oldest), self.late_at_goal)
            return 2 * np.max(rises, axis=0) / rho

        return _highest(rises, directions)


def on_grid(matrix: np.ndarray) -> list[list]:
    """The exact matrix nearest to `matrix` on the grid."""
    return [[check.Q(int(c), 1 << GRID) for c in row] for row in np.rint(matrix * 2.0**GRID)]


def _touching(clearance: np.ndarray, s: np.ndarray) -> float:
    """The level of V = x'S x whose ellipsoid touches the first of the half widths [n]."""
    return float(np.min(clearance**2 / np.diag(np.linalg.inv(s))))


def _touched(each: HalfSpace | Ellipsoid, center: np.ndarray, s: np.ndarray) -> tuple[float, np.ndarray]:
    """The level of V = e'S e at which its ellipsoid about `center` touches the set, and the normal [n] of the plane
    between both, into the set; of an ellipsoid scaled so that it is one over the semi axes, of which it is a mean.

    With W = diag(1 / semi_axis^2), M = W^1/2 S^-1 W^1/2 and a = W^1/2 (c - center), the normal is W^1/2 v with
    v = (1 + l M)^-1 a and the l for which |v| = 1.

    Raises:
        Refused: the center is in the set.
    """
    inverse = np.linalg.inv(s)
    if isinstance(each, HalfSpace):
        normal = np.array(each.normal)
        left = each.offset - normal @ center
        check.require(bool(left > 0), "the motion", "enters a set to keep out of")
        return float(left**2 / (normal @ inverse @ normal)), normal
    scale = 1 / np.array(each.semi_axes)
    values, vectors = np.linalg.eigh(scale[:, None] * inverse * scale)
    apart = vectors.T @ np.where(scale > 0, scale * (np.array(each.center) - center), 0)
    distance = float(np.linalg.norm(apart))
    check.require(distance > 1, "the motion", "enters a set to keep out of")
    values = np.maximum(values, 0)

    def excess(multiplier: float) -> float:
        return float(np.linalg.norm(apart / (1 + multiplier * values))) - 1

    highest = 2 * (distance - 1) / values[apart != 0].max()
    while excess(highest) > 0:
        highest *= 2
    multiplier = cast(float, brentq(excess, 0, highest, xtol=1e-15 * highest))
    normal = scale * (vectors @ (apart / (1 + multiplier * values)))
    step = inverse @ normal * multiplier
    return float(step @ s @ step), normal


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


def hermite(fraction: Any, dt: float, a: Any, a_rate: Any, b: Any, b_rate: Any) -> tuple[Any, Any]:
    """Value and rate of the cubic with these values and rates at the ends of an interval of `dt`."""
    ends = fraction, dt, a, a_rate, b, b_rate
    return cubic_hermite(*ends), cubic_hermite_rate(*ends)
