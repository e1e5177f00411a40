"""The proof of a funnel, interval by interval backward from the goal. Its levels are those that can be proved.

On an interval the level follows the fastest growth of V, found on sampled directions, plus a decay margin: a rate that
the level gives away so that V falls strictly. The limits on the states cap the level. The semidefinite program then
only verifies, case by case: where it has to, on halves of the time, halves of these, and so on. Where it fails, the
decay margin is raised, then the interval halved, and so on. Where it leaves much more than it needs, the interval is
proved once more with a lower decay margin.
"""

import itertools
import math
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from threading import Event
from typing import Any, NamedTuple, cast, final

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, GramCertificate, Halves, Interval, Obligation, Refused, Squares
from rtcd_jax.certificate.prove import sdp as program
from rtcd_jax.certificate.prove.closed_loop import Loop, on_grid
from rtcd_jax.certificate.prove.levels import followed, unit_directions
from rtcd_jax.certificate.prove.sdp import Shape, Solution
from rtcd_jax.system.errors import UserError

RECLAIMED = 0.8
"""Share of the certificates' margin by which the decay margin is lowered."""
LOW = 0.35
"""Share of the largest decay margin up to which one is low: the next interval is twice as long."""
SHORTEST = 1 / 16
"""Shortest fraction of the knots' interval."""
FEWEST = 2
"""Least degree of the squares' monomials: a case with a margin above the decay margin needs no more."""
MULTIPLIER = 1
"""Order in s of multipliers."""


class Tier(NamedTuple):
    """Orders in s and y of Taylor models, the degree of the squares' monomials, and whether they have further ones.

    About own motions a power of a robot's number counts as `stride` powers of y.
    """

    time_order: int
    order: int
    degree: int
    further: bool = False
    stride: int = 1

    def orders(self, claim: Claim, degrees: tuple[int, ...]) -> tuple[int, ...]:
        """An interval's; `degrees` are those in the robot's numbers."""
        return (self.time_order, self.order, *((self.stride, *degrees) if claim.shifts else ()))

    def shapes(self, todo: dict[str, Obligation], claim: Claim, fewest: int, bernstein: int) -> dict[str, list[Shape]]:
        """Of the programs of each case, the cheapest first: of every degree from `fewest` on, then the tier's own;
        `bernstein` is the degree in s.
        """
        further = program.of_the_angles(claim.n, len(claim.robot.hinges), self.degree) if self.further else ()
        lower = [(degree, ()) for degree in range(fewest, self.degree + self.further)]
        sizes: list[tuple[int, program.Monomials]] = [*lower, (self.degree, further)]
        return {
            case: [
                program.shape_of(each, degree, bernstein, MULTIPLIER if each.where else 0, monomials)
                for degree, monomials in sizes
            ]
            for case, each in todo.items()
        }


class Strategy(NamedTuple):
    """How robots of so many states are proved.

    The decay margins [1/s] are in the order of trial. Beyond the `largest` one an interval is halved rather; of a part,
    over its length; the shortest have all. The tiers are the cheapest first; `about_own_motions` are those of claims
    with shifts. The squares have Bernstein polynomials of degree `bernstein` in s; in the proof of a case the interval
    may be halved `halvings` times. A case whose margin is beyond the share `enough` of the decay margin needs no larger
    program; a margin of all cases beyond the share `wasted` is worth a second attempt.
    """

    decay_margins: tuple[float, ...]
    largest: float
    tiers: tuple[Tier, ...]
    about_own_motions: tuple[Tier, ...]
    bernstein: int
    halvings: int
    enough: float
    wasted: float


STRATEGIES = {
    2: Strategy(
        decay_margins=(0.005, 0.015, 0.04, 0.1, 0.25, 0.6, 1.5, 4.0, 10.0, 25.0),
        largest=0.1,
        tiers=(Tier(5, 5, 3), Tier(5, 7, 4), Tier(5, 9, 5), Tier(5, 11, 6)),
        about_own_motions=(Tier(5, 5, 3), Tier(5, 7, 4), Tier(5, 9, 5, stride=2), Tier(5, 11, 6, stride=2)),
        bernstein=5,
        halvings=0,
        enough=1.0,
        wasted=1 / 4,
    ),
    4: Strategy(
        decay_margins=(0.02, 0.05, 0.1, 0.2, 0.5, 1.5, 4.0, 10.0, 25.0),
        largest=0.06,
        tiers=(Tier(5, 3, 2), Tier(5, 5, 3), Tier(7, 8, 3, True), Tier(7, 9, 3, True)),
        about_own_motions=(Tier(5, 5, 3), Tier(5, 6, 3, True), Tier(7, 8, 3, True, 2)),
        bernstein=3,
        halvings=3,
        enough=1 / 4,
        wasted=1 / 2,
    ),
}
"""By the number of states."""
HIGHEST_DEGREE = 3
"""In each of a robot's numbers about own motions: a number has one control point more."""
ENOUGH_OF_DEGREES = 1.25
"""Times the error of the models: higher degrees do not help then."""
FROM_THE_CHEAPEST = 8
"""Knots after which programs begin with the cheapest again, instead of with those that were enough before, and four
states with an interval twice as long.
"""
GAIN = 0.5
"""Times what is enough: where a half has so little more than the whole, it is not halved once more."""
ERROR_FRACTION = 1 / 3
"""A Taylor model is good enough if its error is at most this fraction of the decay margin."""


def tiers_of(n: int, moving: int) -> tuple[Tier, ...]:
    """The cheapest first, for so many states, and about own motions so many uncertain numbers, else 0.

    Raises:
        UserError: there are none.
    """
    if n not in STRATEGIES:
        raise UserError(f"no certificate for {n} states: proofs are for {' and '.join(map(str, STRATEGIES))}")
    tiers = tuple(
        tier
        for tier in (STRATEGIES[n].about_own_motions if moving else STRATEGIES[n].tiers)
        if check.count_terms(n, tier.time_order, tier.order, (moving, tier.stride)) <= check.MAX_TERMS
    )
    if not tiers:
        raise UserError(
            f"no certificate about own motions with {moving} uncertain numbers and {n} states: its polynomials would "
            "be too long; `center: common` has no such limit"
        )
    return tiers


def moving(claim: Claim) -> int:
    """The uncertain numbers, if the claim is about own motions."""
    return len(claim.uncertain) if claim.shifts else 0


def degrees_of(claim: Claim) -> list[tuple[int, ...]]:
    """In the robot's numbers about own motions, those with the fewest control points first; else nothing but ()."""
    choices = itertools.product(range(1, HIGHEST_DEGREE + 1), repeat=moving(claim))
    return sorted(choices, key=lambda degrees: (math.prod(degree + 1 for degree in degrees), degrees))


class Proved(NamedTuple):
    """A proved interval, its level at the start, its decay margin [1/s], and the margin of its certificates [1/s]."""

    interval: Interval
    rho: float
    decay_margin: float
    margin: float

    @property
    def length(self) -> float:
        """As a fraction of the knots' interval."""
        return float(self.interval.end - self.interval.start)


class ProofState(NamedTuple):
    """How far the proof has come: a fraction of an interval, the level and the ellipsoid there.

    `first_margin` [1/s] is the decay margin that the next interval begins with, and `length` its fraction; by case,
    `sizes` of the squares' monomials were enough for the last one, and all of it was `halved` so often at least.
    """

    knot: int
    fraction: float
    rho: float
    axes: list
    first_margin: float
    length: float
    sizes: Mapping[str, tuple[int, int]]
    halved: Mapping[str, int]


@final
class BackwardProof:
    """The proof of one elite's funnel. `exact` runs the checker after every interval (*proved*)."""

    def __init__(
        self, claim: Claim, loop: Loop, exact: bool, solver: str = program.SOLVER, pool: Executor | None = None
    ):
        self.claim, self.loop, self.exact, self.solver, self.pool = claim, loop, exact, solver, pool
        self._directions, self._strategy = unit_directions(claim.n), STRATEGIES[claim.n]
        self._rates = self._strategy.decay_margins
        self._tiers, self._degrees = tiers_of(claim.n, moving(claim)), degrees_of(claim)

    def outlet(self, rho: float) -> ProofState:
        """The state at which the proof begins: t_N with the level rho."""
        last = len(self.loop.u) - 1
        return ProofState(last, 1.0, rho, self.loop.outlet_axes(rho), self._rates[0], 1.0, {}, {})

    def intervals_from(self, state: ProofState) -> Iterator[Proved]:
        """The proved intervals from the state back to t = 0, or to where nothing can be proved."""
        while state.knot or state.fraction:
            k, end = (state.knot, state.fraction) if state.fraction else (state.knot - 1, 1.0)
            length = state.length
            while end % length:
                length /= 2
            while (proved := self._least_margin(k, end - length, end, state)) is None:
                if length <= SHORTEST:
                    return
                length /= 2
            state = self.after(proved)
            yield proved

    def after(self, proved: Proved) -> ProofState:
        """The state behind a proved interval. Where a low decay margin was enough, the next one is longer."""
        k, start, length = proved.interval.knot, float(proved.interval.start), proved.length
        largest = self._strategy.largest
        anew = self._strategy.halvings and start == 0 and k % FROM_THE_CHEAPEST == 0
        longer = min(1.0, 2 * length) if anew or proved.decay_margin <= LOW * largest else length
        first_margin = min(self._lowered(proved.decay_margin, proved.margin), largest / longer)
        sizes = {case: max(map(size_of, pieces(each))) for case, each in proved.interval.cases.items()}
        halved = {case: least_halvings(each) for case, each in proved.interval.cases.items()}
        return ProofState(k, start, proved.rho, proved.interval.first, first_margin, longer, sizes, halved)

    def _lowered(self, decay_margin: float, margin: float) -> float:
        """A decay margin that the certificates' margin still allows, if that is much; the same if not."""
        wasted = margin > max(self._strategy.wasted * decay_margin, self._rates[0])
        return max(self._rates[0], decay_margin - RECLAIMED * margin) if wasted else decay_margin

    def _least_margin(self, k: int, start: float, end: float, state: ProofState) -> Proved | None:
        """The interval with nearly the least decay margin with which it can be proved."""
        length, first = end - start, state.first_margin
        largest = self._strategy.largest / length if length > SHORTEST else np.inf
        for rate in (first, *(rate for rate in self._rates if first < rate <= largest)):
            proved = self._attempt(k, start, end, state, rate)
            if proved is not None:
                lower = self._lowered(rate, proved.margin)
                again = self._attempt(k, start, end, state, lower) if lower < rate else None
                return again or proved
        return None

    def _attempt(self, k: int, start: float, end: float, state: ProofState, decay_margin: float) -> Proved | None:
        try:
            interval, rho = self._interval(k, start, end, state, decay_margin)
            data = check.motion(self.claim, interval)
            check.require_bounds(self.claim, data, "limits")
            check.require_kept_out(self.claim, interval, data, "sets")
            if self.claim.first_order:
                check.require_jump(self.claim, interval, "jumps")
            interval, todo, tier = self._models(interval, decay_margin)
            shapes = tier.shapes(todo, self.claim, FEWEST, self._strategy.bernstein)
            halved = state.halved if k % FROM_THE_CHEAPEST else {}
            if self.claim.shifts and k % FROM_THE_CHEAPEST:  # of their many programs
                shapes = {case: _from(each, state.sizes.get(case, (0, 0))) for case, each in shapes.items()}
            effort = Effort(self._directions, self.solver, self._strategy.halvings, halved)
            enough = self._strategy.enough * decay_margin
            proof = prove(todo, shapes, enough, self.exact, effort, self.pool)
        except Refused:
            return None
        if proof is None:
            return None
        cases, margin = proof
        return Proved(interval._replace(cases=cases), rho, decay_margin, margin)

    def _interval(
        self, k: int, start: float, end: float, state: ProofState, decay_margin: float
    ) -> tuple[Interval, float]:
        """The interval's ellipsoids, from the state's level and the decay margin; Refused if the level vanishes."""
        loop, half = self.loop, (end - start) * self.loop.dt / 2
        rho, (a, a_rate, b, b_rate) = followed(loop, k, start, end, state.rho, decay_margin, self._directions)
        chord = (b - a) / 2
        at_start, at_end = (a_rate * half - chord) / 2, (chord - b_rate * half) / 2
        bend = [on_grid((at_end + at_start) / 2), on_grid((at_end - at_start) / 2)]
        fractions = check.rational(start), check.rational(end)
        late = loop.late_rows(k, start, end) if self.claim.first_order else []
        sides = loop.sides(k, start, end)
        orders = self._tiers[0].orders(self.claim, self._degrees[0])
        return Interval(k, *fractions, on_grid(a), state.axes, bend, orders, {}, late, sides), rho

    def _models(self, interval: Interval, decay_margin: float) -> tuple[Interval, dict[str, Obligation], Tier]:
        """The interval's obligations by the cheapest Taylor models that are good enough, or the richest."""
        allowed = ERROR_FRACTION * decay_margin
        for tier in self._tiers:
            interval = interval._replace(orders=tier.orders(self.claim, self._degrees[0]))
            models = check.funnel_models(self.claim, interval, "interval")
            own = max(float(q.r + q.d) for _, q in models.values())
            if own <= allowed:
                break
        for degrees in self._degrees:
            interval = interval._replace(orders=tier.orders(self.claim, degrees))
            todo = check.obligations_of(self.claim, models, degrees)
            if max(float(each.error) for each in todo.values()) <= max(allowed, ENOUGH_OF_DEGREES * own):
                break
        return interval, todo, tier


def pieces(squares: Squares) -> Iterator[GramCertificate]:
    """First to last."""
    if isinstance(squares, Halves):
        for half in squares:
            yield from pieces(half)
    else:
        yield squares


def least_halvings(squares: Squares) -> int:
    return 1 + min(map(least_halvings, squares)) if isinstance(squares, Halves) else 0


def size_of(squares: GramCertificate | Shape) -> tuple[int, int]:
    """Degree of the monomials, and how many there are beyond it."""
    return squares.degree, len(squares.further)


def _from(shapes: list[Shape], size: tuple[int, int]) -> list[Shape]:
    """Without those that are smaller, which were not enough before; the last one at least."""
    return [shape for shape in shapes if size_of(shape) >= size] or shapes[-1:]


class Effort(NamedTuple):
    """What goes into squares: the directions [n D] that are tried before a program is solved, cvxpy's solver, how often
    an interval may be halved, and by case how often it is before anything else.
    """

    directions: np.ndarray
    solver: str
    halvings: int = 0
    halved: Mapping[str, int] = {}


def prove(
    todo: dict[str, Obligation],
    shapes: dict[str, list[Shape]],
    enough: float,
    exact: bool,
    effort: Effort,
    pool: Executor | None = None,
) -> tuple[dict[str, Squares], float] | None:
    """Squares by case and the least margin; None where a case has none. `exact`: the checker's margin.

    The threads of a `pool` share the cases out, the hardest first.

    Raises:
        Refused: the checker does not accept squares of the solver's.
    """
    hardest = {case: _sampled(each, shapes[case][-1], effort.directions) for case, each in todo.items()}
    if min(hardest.values()) <= 0:
        return None
    ended = Event()

    def shown(case: str) -> tuple[Squares, float] | None:
        found = _squares(todo[case], shapes[case], enough, effort, ended, effort.halved.get(case, 0))
        if found.squares is None:
            ended.set()
            return None
        squares = found.squares
        return squares, float(cast(Any, check.margin(todo[case], squares, case))) if exact else found.margin

    cases, least = {}, np.inf
    order = sorted(todo, key=hardest.__getitem__)
    try:
        for case, found in zip(order, (pool.map if pool else map)(shown, order), strict=True):
            if found is None:
                return None
            cases[case] = found[0]
            least = min(least, found[1])
    finally:
        ended.set()
    return {case: cases[case] for case in todo}, least


def _sampled(todo: Obligation, shape: Shape, directions: np.ndarray) -> float:
    """The least of what must be positive over the directions; no margin is larger, be the interval whole or not."""
    order = max(e[0] for e, _ in check.terms_of(todo.p))
    shape = shape._replace(bernstein=max(shape.bernstein, order))
    return program.lowest(program.data_of(todo, shape), shape, directions)


def _squares(
    todo: Obligation,
    shapes: list[Shape],
    enough: float,
    effort: Effort,
    ended: Event,
    halve: int = 0,
    whole: float = -math.inf,
) -> Solution:
    """By the first of the shapes with a margin of `enough`; where none has, by halves as long as these have much more;
    by further monomials only where nothing else has a margin. `whole` is the margin of what this is a half of; it is
    halved `halve` times at once.
    """
    usual = [shape for shape in shapes if not (shape.further and effort.halvings)] or shapes
    at_once = halve and effort.halvings
    best = Solution(-math.inf) if at_once else _by_shapes(todo, usual, enough, effort, ended)
    if best.margin >= enough:
        return best
    if best.margin == -math.inf and usual != shapes and _sampled(todo, usual[-1], effort.directions) <= 0:
        return _squares(todo, shapes[-1:], enough, effort, ended, halve, whole)
    if best.margin - whole < GAIN * enough:
        return best
    if effort.halvings and not ended.is_set():
        half_of, least, halves = effort._replace(halvings=effort.halvings - 1), math.inf, []
        for half in check.halves_of(todo):
            found = _squares(half, usual, enough, half_of, ended, max(halve - 1, 0), best.margin)
            if found.squares is None:
                break
            least = min(least, found.margin)
            halves.append(found.squares)
        else:
            return Solution(least, Halves(*halves))
    if best.margin > 0 or usual == shapes:
        return best
    return _squares(todo, shapes[-1:], enough, effort, ended)


def _by_shapes(todo: Obligation, shapes: list[Shape], enough: float, effort: Effort, ended: Event) -> Solution:
    """By the first of the shapes with a margin of `enough`, or else by the last."""
    best = Solution(-math.inf)
    for shape in shapes:
        needed = 0 if shape is shapes[-1] else enough
        data = program.data_of(todo, shape)
        if program.lowest(data, shape, effort.directions) > needed and not ended.is_set():
            best = program.solve(data, shape, effort.solver)
            if best.margin > needed:
                break
    return best
