"""Simulated motions of a certificate's closed loops, from its claim and its ellipsoids alone.

Every motion has its own robot of the claim's box, its own motor, and signs of the disturbance and of the feedback's
errors that change at every step: half of the motions take those by which |y| grows fastest, the others random ones. A
measurement acts as long as the claim allows. The equations (`robots.py`) are written apart from the checker's. Every
motion is integrated by classical Runge-Kutta steps; every `REPEATED`-th one a second time with halved steps, and the
largest difference of the two in |y| is the measure of the integrator's error. The loop is Lipschitz, with kinks where
the input meets its limit, so the order is two at least and that difference is 3/4 of the error or more.
"""

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float
from numpy.linalg import LinAlgError

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Node, Refused, Undecided
from rtcd_jax.certificate.falsify.robots import Drawn, after_reset, draw, rate
from rtcd_jax.system.errors import UserError

REPEATED = 16
STEPS = (1e-6, 1e3)
"""Lengths [s] of a knots' interval that are simulated."""
ARRIVED = 0.1
"""|y| in the goal region at which a motion is followed no further: the proof holds all the way down."""
LONGEST = 60.0
"""Time [s] after which a motion has not arrived."""
LOST = 1e3
"""|y| in the goal region from which on a motion is followed no further: it has not arrived. The region ends at 1."""
COARSER = 4
"""Steps in the goal region are so many times longer: there |y| falls fast, and its growth alone is judged."""
TOGETHER = 0.2
"""Time [s] between two searches for motions that have arrived."""
SETTLING = LONGEST / 1e5, TOGETHER / 2
"""Lengths [s] of a step in the goal region, however long a knots' interval is."""

Feedback = Callable[[float, np.ndarray], np.ndarray]
"""Time [s], states [n M] -> K (x - x*) [M]."""


class Ellipsoids(NamedTuple):
    """One interval: its knot, its ends as fractions of the knots' interval, and L at its ends with its bend."""

    knot: int
    start: float
    end: float
    first: np.ndarray
    last: np.ndarray
    bend: np.ndarray

    def axes(self, fraction: float) -> np.ndarray:
        """L [n n] at a fraction of the knots' interval."""
        s = (2 * fraction - self.start - self.end) / (self.end - self.start)
        return (self.first * (1 - s) + self.last * (1 + s)) / 2 + (1 - s * s) * (self.bend[0] + s * self.bend[1])


class Law(NamedTuple):
    """The controller on an interval or at the goal: u = feedforward - feedback, before it is clipped.

    `errors` bounds what the errors of the measured state do to the feedback.
    """

    feedforward: float
    feedback: Feedback
    errors: float


class Acting(NamedTuple):
    """What acts in one step on some motions: their robots, the signs [M] of w and of the errors, and the feedback [M]
    of a former measurement that acts still, or None.
    """

    drawn: Drawn
    signs: np.ndarray
    held: np.ndarray | None

    def part(self, who: Any) -> "Acting":
        return Acting(self.drawn.part(who), self.signs[who], None if self.held is None else self.held[who])


class MotionResults(NamedTuple):
    """Of every motion, after its start: the largest |y| in the funnel, the largest share of a limit, the largest
    growth of |y| in one step in the goal region, whether it arrived; of all, the integrator's error in |y|."""

    level: Float[np.ndarray, " M"]
    share_of_limit: Float[np.ndarray, " M"]
    growth: Float[np.ndarray, " M"]
    arrived: Bool[np.ndarray, " M"]
    error: float


@final
class Motions:
    """What a certificate's file claims, in floats; robots and what acts on them may be `beyond` times as uncertain."""

    def __init__(self, content: Any, beyond: float = 1.0):
        claim = check.read_claim(Node("claim", content["claim"]))
        low, high = STEPS
        check.require(
            low <= float(claim.dt) <= high, "claim.dt", f"cannot be simulated: must be from {low:g} s to {high:g} s"
        )
        intervals = [check.read_interval(Node(f"funnel[{i}]", each), claim) for i, each in enumerate(content["funnel"])]
        check.require(len(intervals) > 0, "funnel", "has no intervals")
        self.claim, self.beyond = claim, beyond
        self.plant, self.n, self.dt = claim.robot.name, claim.n, float(claim.dt)
        self._noise, self._age = _floats(claim.noise), beyond * float(claim.age)
        region = content["goal"] if claim.catch is None else content["claim"]["catch"]
        self.rest = 0.0 if claim.catch else float(check.read_goal(Node("goal", region), claim).rest)
        self._x, self._rates, self._u, self._gains = map(_floats, (claim.x, claim.rates, claim.u, claim.K))
        self._shifts = [(shift.powers, _floats(shift.x), _floats(shift.rates)) for shift in claim.shifts]
        self._goal, self._goal_gain = _floats(claim.x_goal), _floats(claim.K_goal)
        self._bounds = np.array([np.inf if b is None else float(b) for b in claim.bounds])
        self._outward = np.linalg.inv(_floats(Node("axes", region["axes"]).array(self.n, self.n)))
        self.intervals = [
            Ellipsoids(p.knot, float(p.start), float(p.end), *map(_floats, (p.first, p.last, p.bend)))
            for p in intervals
        ]
        self.start = (self.intervals[0].knot + self.intervals[0].start) * self.dt
        self.end = len(self._u) * self.dt

    @classmethod
    @np.errstate(all="ignore")
    def of(cls, path: Path, beyond: float = 1.0) -> "Motions":
        """Of a certificate's file.

        Raises:
            UserError: the file cannot be read, or is no certificate.
        """
        try:
            return cls(check.parse(check.read_bytes(path)), beyond)
        except OSError as error:
            raise UserError(f"{path}: {error.strerror}") from None
        except (Refused, Undecided, KeyError, TypeError, RecursionError, OverflowError, LinAlgError) as error:
            raise UserError(f"{path} is no certificate ({error}): `rtcd check` says more") from None

    @np.errstate(all="ignore")  # what is absurd shows in the results
    def follow(self, count: int, steps: int, random: np.random.Generator) -> MotionResults:
        """`count` motions to the goal, by `steps` steps an interval.

        They start in every interval in proportion to its length, at an instant of it drawn at random, every other one
        on the boundary, the others uniform inside.
        """
        lengths = np.cumsum([p.end - p.start for p in self.intervals])
        places = np.searchsorted(lengths / lengths[-1], (np.arange(count) + 0.5) / count)
        y, x = _ball(self.n, count, random), np.empty((self.n, count))
        drawn = draw(self.claim, count, self.beyond, random)
        flight = _Flight(self._bounds, self.claim.keep_out, x, x[:, ::REPEATED].copy(), drawn, random)
        for place, interval in enumerate(self.intervals):
            before, after = np.searchsorted(places, (place, place + 1))
            fraction = random.uniform(interval.start, interval.end)
            x[:, before:after] = (
                self.centers(interval.knot, fraction, drawn.part(slice(before, after)))
                + interval.axes(fraction) @ y[:, before:after]
            )
            flight.again[:] = np.where(np.arange(0, count, REPEATED) >= before, x[:, ::REPEATED], flight.again)
            self._through(interval, interval.start, flight, slice(0, before), steps)
            self._through(interval, fraction, flight, slice(before, after), steps)
        arrived, growth = self._settle(flight, steps) if self.claim.catch is None else self._catch(flight)
        return MotionResults(flight.level, flight.share_of_limit, growth, arrived, flight.error)

    def _through(self, interval: Ellipsoids, start: float, flight: "_Flight", who: slice, steps: int) -> None:
        """Carries some motions from a fraction of the interval to its end."""
        if who.start == who.stop:
            return
        again = slice(-(-who.start // REPEATED), -(-who.stop // REPEATED))
        fractions = np.linspace(start, interval.end, steps + 1)
        step = (fractions[1] - fractions[0]) * self.dt
        law, drawn = self.tracking(interval.knot), flight.drawn.part(who)
        twice = slice(-who.start % REPEATED, None, REPEATED)  # of these motions, those that are run again
        held = held_again = None
        for i, (fraction, ahead) in enumerate(itertools.pairwise(fractions)):
            t, x = fraction * self.dt, flight.x[:, who]
            if (steps_held := int(self._age / step)) and i % steps_held == 0:
                held, held_again = (law.feedback(t, each) for each in (x, flight.again[:, again]))
            inward = np.linalg.inv(interval.axes(fraction))
            center = self.centers(interval.knot, fraction, drawn)
            acting = Acting(drawn, self._signs(law, t, x, inward, center, drawn, flight), held)
            flight.x[:, who] = self.advanced(law, t, step, x, 1, acting)
            acting = acting.part(twice)._replace(held=held_again)
            flight.again[:, again] = self.advanced(law, t, step, flight.again[:, again], 2, acting)
            inward = np.linalg.inv(interval.axes(ahead))
            flight.measure(self.centers(interval.knot, ahead, drawn), inward, who, again)

    def _settle(self, flight: "_Flight", steps: int) -> tuple[np.ndarray, np.ndarray]:
        """Whether every motion arrives, and the largest growth of |y| in one step."""
        count, step = flight.x.shape[1], float(np.clip(COARSER * self.dt / steps, *SETTLING))
        arrived, growth = np.zeros(count, bool), np.zeros(count)
        moving, near, law = np.arange(count), max(ARRIVED, self.rest), self._holding
        for _ in range(round(LONGEST / TOGETHER)):
            x, level = flight.x[:, moving], self.goal_level(flight.x[:, moving])
            drawn, held = flight.drawn.part(moving), None
            for i in range(round(TOGETHER / step)):
                if (steps_held := int(self._age / step)) and i % steps_held == 0:
                    held = law.feedback(0.0, x)
                signs = self._signs(law, 0.0, x, self._outward, self._goal[:, None], drawn, flight)
                x = self.advanced(law, i * step, step, x, 1, Acting(drawn, signs, held))
                now = self.goal_level(x)
                grown = np.where(level > near, now - level, 0) if self.rest else now - level
                growth[moving] = np.maximum(growth[moving], grown)
                level = now
                flight.measure_limits(x, moving)
            flight.x[:, moving] = x
            arrived[moving[level <= near]] = True
            moving = moving[(level > near) & (level < LOST)]
            if not moving.size:
                break
        return arrived, growth

    def _catch(self, flight: "_Flight") -> tuple[np.ndarray, np.ndarray]:
        """Whether every motion is in the catch set at t_N, or behind the reset; nothing grows."""
        assert self.claim.catch is not None
        center, _, reset = self.claim.catch
        x = flight.x if reset is None else after_reset(self.claim.robot, reset, flight.drawn, flight.x)
        level = np.linalg.norm(self._outward @ (x - _floats(center)[:, None]), axis=0)
        return level <= 1, np.zeros(len(level))

    def goal_level(self, x: np.ndarray) -> np.ndarray:
        """|y| [M] of states in the goal region's coordinates."""
        return np.linalg.norm(self._outward @ (x - self._goal[:, None]), axis=0)

    def nominal(self, k: int, t: float) -> np.ndarray:
        """x* at a fraction of an interval: the cubic Hermite interpolant."""
        return self._cubics(self._x, self._rates, k, t)

    def centers(self, k: int, t: float, drawn: Drawn) -> np.ndarray:
        """c_p [n M], or x* [n 1], at a fraction of an interval."""
        center = self.nominal(k, t)[:, None]
        for powers, x, rates in self._shifts:
            factor = 1.0
            for name, power in zip(self.claim.uncertain, powers, strict=True):
                low, high = map(float, self.claim.parameters[name])
                factor = factor * ((2 * drawn.numbers[name] - low - high) / (high - low)) ** power
            center = center + self._cubics(x, rates, k, t)[:, None] * factor
        return center

    def _cubics(self, x: np.ndarray, rates: np.ndarray, k: int, t: float) -> np.ndarray:
        a, b, va, vb = x[k], x[k + 1], rates[k][0] * self.dt, rates[k][1] * self.dt
        return a + t * (va + t * (3 * (b - a) - 2 * va - vb + t * (2 * (a - b) + va + vb)))

    def tracking(self, k: int) -> Law:
        """The controller's law on interval k."""

        def feedback(t: float, x: np.ndarray) -> np.ndarray:
            fraction = t / self.dt
            gain = self._gains[k] + fraction * (self._gains[k + 1] - self._gains[k])
            return gain @ (x - self.nominal(k, fraction)[:, None])

        largest = np.maximum(np.abs(self._gains[k]), np.abs(self._gains[k + 1]))
        return Law(float(self._u[k]), feedback, float(largest @ self._noise))

    @property
    def _holding(self) -> Law:
        def feedback(_: float, x: np.ndarray) -> np.ndarray:
            return self._goal_gain @ (x - self._goal[:, None])

        return Law(0.0, feedback, float(np.abs(self._goal_gain) @ self._noise))

    def _signs(self, law: Law, t: float, x, inward, center, drawn: Drawn, flight: "_Flight") -> np.ndarray:
        """Of w and of the errors: those by which |y| grows fastest, or random ones; 1 where nothing acts."""
        if not (law.errors or self.claim.disturbance):
            return np.ones(x.shape[1])
        u = np.zeros(x.shape[1])
        pushed = rate(self.claim.robot, drawn, x, u + 1) - rate(self.claim.robot, drawn, x, u)
        greedy = np.sum((inward @ (x - center)) * (inward @ pushed), axis=0)
        return np.where(
            drawn.greedy > 0, np.where(greedy >= 0, 1.0, -1.0), flight.random.choice([-1.0, 1.0], x.shape[1])
        )

    def _slope(self, law: Law, t: float, x: np.ndarray, acting: Acting) -> np.ndarray:
        drawn, signs = acting.drawn, acting.signs
        feedback = law.feedback(t, x) if acting.held is None else acting.held
        asked = law.feedforward - feedback + signs * drawn.errors * law.errors
        u = np.clip(asked, -drawn.limit, drawn.limit) + signs * drawn.disturbance
        return rate(self.claim.robot, drawn, x, u)

    def advanced(self, law: Law, t: float, step: float, x: np.ndarray, parts: int, acting: Acting) -> np.ndarray:
        """The states after one step, taken in `parts` classical Runge-Kutta steps."""
        h = step / parts
        for part in range(parts):
            now = t + part * h
            a = self._slope(law, now, x, acting)
            b = self._slope(law, now + h / 2, x + h / 2 * a, acting)
            c = self._slope(law, now + h / 2, x + h / 2 * b, acting)
            d = self._slope(law, now + h, x + h * c, acting)
            x = x + h / 6 * (a + 2 * (b + c) + d)
        return x


class _Flight:
    """Motions under way: their states [n M], every `REPEATED`-th by halved steps, and their results so far."""

    def __init__(
        self,
        bounds: np.ndarray,
        keep_out: Sequence[check.HalfSpace | check.Ellipsoid],
        x: np.ndarray,
        again: np.ndarray,
        drawn: Drawn,
        random: np.random.Generator,
    ):
        self.x, self.again, self.error = x, again, 0.0
        self.drawn, self.random = drawn, random
        self.level, self.share_of_limit = np.zeros(x.shape[1]), np.zeros(x.shape[1])
        self._limited = np.isfinite(bounds)
        self._bounds, self._keep_out = bounds[self._limited, None], keep_out

    def measure(self, center: np.ndarray, inward: np.ndarray, who: slice, again: slice) -> None:
        """|y| at an instant of the funnel; `inward` is L^-1."""
        level = np.linalg.norm(inward @ (self.x[:, who] - center), axis=0)
        its_own = center if center.shape[1] == 1 else center[:, -who.start % REPEATED :: REPEATED]
        finer = np.linalg.norm(inward @ (self.again[:, again] - its_own), axis=0)
        self.level[who] = np.maximum(self.level[who], level)
        self.measure_limits(self.x[:, who], who)
        if finer.size:
            difference = np.max(np.abs(level[-who.start % REPEATED :: REPEATED] - finer))
            self.error = float(np.maximum(self.error, difference))  # a NaN stays one

    def measure_limits(self, x: np.ndarray, who: Any) -> None:
        if self._limited.any():
            fraction = np.max(np.abs(x[self._limited]) / self._bounds, axis=0)
            self.share_of_limit[who] = np.maximum(self.share_of_limit[who], fraction)
        for each in self._keep_out:
            self.share_of_limit[who] = np.maximum(self.share_of_limit[who], _share(each, x))


def _share(each: check.HalfSpace | check.Ellipsoid, x: np.ndarray) -> np.ndarray:
    """Above 1 exactly in the set, of states [n M]; of a half space by the distance along its normal."""
    if isinstance(each, check.HalfSpace):
        normal = _floats(each.normal)
        return 1 + (normal @ x - float(each.offset)) / np.linalg.norm(normal)
    axes = np.array([np.inf if axis is None else float(axis) for axis in each.semi_axes])
    return 1 / np.linalg.norm((x - _floats(each.center)[:, None]) / axes[:, None], axis=0)


def _ball(n: int, count: int, random: np.random.Generator) -> np.ndarray:
    """Points [n M] of the unit ball, every other one on its boundary, the others uniform inside."""
    y = random.normal(size=(n, count))
    radius = random.uniform(size=count) ** (1 / n)
    radius[::2] = 1
    return radius * y / np.linalg.norm(y, axis=0)


def _floats(values: Any) -> np.ndarray:
    """Nested lists of exact numbers."""
    if not isinstance(values, list | tuple):
        return np.asarray(float(values))
    return np.array([_floats(v) for v in values])
