"""The funnel, interval by interval backward from the goal: its levels are what can be proved, not what was sampled.

On an interval the level grows backward by the loop's own fastest growth of V, found on sampled directions, plus a
spare rate; the limits on the states cap it. The program then has only to verify. Where it fails, the spare rate is
raised, the interval halved, and the rate raised again.
"""

from collections.abc import Iterator
from typing import NamedTuple, cast, final

import numpy as np
from scipy.linalg import expm

from rtcd_jax.certificate import check, flow, program
from rtcd_jax.certificate.check import Claim, Obligation, Q, Refused, Stretch, Witness
from rtcd_jax.certificate.loop import Loop

GRID = 34
"""Ellipsoids are rounded to multiples of 2^-34."""
SPARE = {2: (0.005, 0.015, 0.04, 0.1), 4: (0.02, 0.06, 0.2, 0.5)}
"""By the number of states: rates [1/s] that a level gives away, in the order of trial, before an interval is halved."""
LARGE_SPARE = (0.25, 0.6, 1.5, 4.0, 10.0, 25.0)
"""And for an interval of the shortest share."""
SHORTEST = 1 / 16
"""Shortest share of the knots' interval."""
HEUN_STEPS = 4
TIME_ORDER, MULTIPLIER = 5, 1
"""Orders in s of Taylor models and of multipliers; u_lin has order 4 (K times L), so that all fit into degree 5."""
TIERS = {2: ((5, 3), (7, 4)), 4: ((3, 2), (5, 3))}
"""By the number of states: orders in y of Taylor models and degrees of monomials, the cheapest first."""
ERROR_SHARE = 1 / 3
"""A Taylor model is good enough if its error is at most this share of the spare rate."""
COLLAPSE = 1e-3
"""Share of its level that a funnel must keep within an interval."""
BOX_SHARE = 0.999
"""Share of the level at which an ellipsoid would touch a limit."""
AIMS_SHARED = 4
"""Of so many directions, the linear programs of free ellipsoids get one."""
DIRECTIONS = {2: 720, 4: 4000}


Pair = tuple[np.ndarray, np.ndarray]


class Proved(NamedTuple):
    """One interval that went through, its level at the start, the rate that was spared, and the margin [1/s]."""

    piece: Stretch
    rho: float
    spare: float
    margin: float


class Front(NamedTuple):
    """How far the proof has come: a share of an interval, the level and the ellipsoid there."""

    knot: int
    share: float
    rho: float
    axes: list
    spare: int


def directions(n: int) -> np.ndarray:
    """Unit vectors [n D] that cover the sphere."""
    if n == 2:
        angle = np.linspace(0, 2 * np.pi, DIRECTIONS[2], endpoint=False)
        return np.stack([np.cos(angle), np.sin(angle)])
    found = np.random.default_rng(0).normal(size=(n, DIRECTIONS[n]))
    return found / np.linalg.norm(found, axis=0)


def on_grid(matrix: np.ndarray) -> list[list]:
    """The exact matrix nearest to `matrix` on the grid."""
    return [[Q(int(c), 1 << GRID) for c in row] for row in np.rint(matrix * 2.0**GRID)]


def _floats(axes: list[list]) -> np.ndarray:
    return np.array([[float(c) for c in row] for row in axes])


@final
class Descent:
    """The search for one elite's funnel. `exact` asks the checker after every interval (rung *proved*)."""

    def __init__(self, claim: Claim, loop: Loop, exact: bool, plan: flow.Plan | None = None):
        self.claim, self.loop, self.exact, self.plan = claim, loop, exact, plan
        self._directions = directions(claim.n)

    def outlet(self, rho: float) -> Front:
        """Where the descent begins: t_N with the level rho."""
        last = len(self.loop.u) - 1
        return Front(last, 1.0, rho, on_grid(self.loop.axes(last, 1.0, rho, 0.0)[0]), 0)

    def down_from(self, front: Front) -> Iterator[Proved]:
        """The intervals from the front back to t = 0, or to where nothing can be proved."""
        waiting = [(k, *part) for k in range(front.knot) for part in self._parts(k)]
        parts = self._parts(front.knot) if front.share > 0 else []
        waiting += [(front.knot, start, min(end, front.share)) for start, end in parts if start < front.share]
        while waiting:
            k, start, end = waiting.pop()
            short = end - start <= SHORTEST
            found = self._first(k, start, end, front, short)
            if found is None and short:
                return
            if found is None:
                middle = (start + end) / 2
                waiting += [(k, start, middle), (k, middle, end)]
                continue
            spare, proved = found
            front = Front(k, start, proved.rho, proved.piece.first, self.next_trial(spare, proved.margin))
            yield proved

    def _parts(self, k: int) -> list[tuple[float, float]]:
        return flow.shares(self.loop) if self._is_free(k) else [(0.0, 1.0)]

    def _is_free(self, k: int) -> bool:
        """Whether the ellipsoids of an interval have a free shape."""
        return self.plan is not None and k >= self.plan.until

    def next_trial(self, place: int, margin: float) -> int:
        """The place of the spare rate that the next interval begins with: a lower one if the margin allows it."""
        rates = SPARE[self.claim.n]
        place = min(place, len(rates) - 1)
        return place - 1 if place and margin > rates[place] - rates[place - 1] else place

    def _first(self, k: int, start: float, end: float, front: Front, short: bool) -> tuple[int, Proved] | None:
        """The least spare rate, by its place, with which the interval goes through."""
        rates = SPARE[self.claim.n] + (LARGE_SPARE if short else ())
        for place in range(min(front.spare, len(rates) - 1), len(rates)):
            proved = self._attempt(k, start, end, front, rates[place])
            if proved is not None:
                return place, proved
        return None

    def _attempt(self, k: int, start: float, end: float, front: Front, spare: float) -> Proved | None:
        try:
            shape = self._fastest_piece if self._is_free(k) else self._piece
            piece, rho = shape(k, start, end, front, spare)
            check.insist_bounds(self.claim, check.motion(self.claim, piece), "limits")
            piece, todo, degree = self._models(piece, spare)
            found = prove(todo, degree, piece.orders[0], self.exact, self._directions)
        except Refused:
            return None
        if found is None:
            return None
        return Proved(piece._replace(cases=found[0]), rho, spare, found[1])

    def _piece(self, k: int, start: float, end: float, front: Front, spare: float) -> tuple[Stretch, float]:
        """The interval's ellipsoids, from the front's level and the spare rate; Refused if the level vanishes."""
        loop, duration = self.loop, (end - start) * self.loop.dt
        held, turn = self._held(k, end, front)
        rho, last = self._level(k, start, end, held, spare)
        first_growth, last_growth = self._growth(k, start, rho, spare), last
        cap = BOX_SHARE * loop.box_level(k, start)
        if rho > cap:
            rho = cap
            first_growth = last_growth = float(np.log(held / rho) / duration)
        (a, a_rate), (b, b_rate) = loop.axes(k, start, rho, first_growth), loop.axes(k, end, held, last_growth)
        if self._joins_free(k, end):
            b, turned = _floats(front.axes), a @ turn
            return self._stretch(
                k, start, end, front, (turned, (b - turned) / duration), (b, (b - turned) / duration)
            ), rho
        return self._stretch(k, start, end, front, (a @ turn, a_rate @ turn), (b @ turn, b_rate @ turn)), rho

    def _joins_free(self, k: int, end: float) -> bool:
        """Whether an interval of TVLQR's level sets ends with an ellipsoid of free shape."""
        return self.plan is not None and (k + 1, end) == (self.plan.until, 1.0)

    def _held(self, k: int, end: float, front: Front) -> tuple[float, np.ndarray]:
        """The level of TVLQR's level set inside the front's ellipsoid b, and the rotation of its y.

        With a the level set's own L, a^-1 b = rotation times a symmetric P >= 1: turned, a grows into b all around.
        """
        if self.plan is None:
            return front.rho, np.eye(self.claim.n)
        b = _floats(front.axes)
        held = flow.held_level(self.loop.value(k, end)[0], b) if self._joins_free(k, end) else front.rho
        left, _, right = np.linalg.svd(np.linalg.solve(self.loop.axes(k, end, held, 0.0)[0], b))
        return held, left @ right

    def _stretch(self, k: int, start: float, end: float, front: Front, first: Pair, last: Pair) -> Stretch:
        """The interval between two ellipsoids with their rates, its last one exactly the front's."""
        (a, a_rate), (b, b_rate), duration = first, last, (end - start) * self.loop.dt
        chord = (b - a) / 2
        at_start, at_end = (a_rate * duration / 2 - chord) / 2, (chord - b_rate * duration / 2) / 2
        bend = [on_grid((at_end + at_start) / 2), on_grid((at_end - at_start) / 2)]
        shares = Q(*start.as_integer_ratio()), Q(*end.as_integer_ratio())
        order = TIERS[self.claim.n][0][0]
        return Stretch(k, *shares, on_grid(a), front.axes, bend, (TIME_ORDER, order), {})

    def _fastest_piece(self, k: int, start: float, end: float, front: Front, spare: float) -> tuple[Stretch, float]:
        """As `_piece` with ellipsoids of free shape; the level is that of the same volume."""
        loop, duration = self.loop, (end - start) * self.loop.dt
        b = _floats(front.axes)
        aims = self._directions[:, ::AIMS_SHARED]
        w = flow.fastest_growth(loop, k, start, end, b, spare, cast(flow.Plan, self.plan).aim, aims)
        if w is None:
            raise Refused("interval", "no ellipsoid can be carried back")
        a = b @ expm(-w * duration)
        volume = np.linalg.det(a) * np.sqrt(np.linalg.det(loop.value(k, start)[0]))
        return self._stretch(k, start, end, front, (a, a @ w), (b, b @ w)), float(volume ** (2 / loop.n))

    def _growth(self, k: int, share: float, rho: float, spare: float) -> float:
        return self.loop.growth(k, share, rho, self._directions) + spare

    def _level(self, k: int, start: float, end: float, rho: float, spare: float) -> tuple[float, float]:
        """The level at the start by Heun's method on its logarithm, and the growth at the end."""
        step, share, level = (end - start) / HEUN_STEPS, end, rho
        at_end = slope = self._growth(k, end, rho, spare)
        for i in range(HEUN_STEPS):
            share = end - (i + 1) * step
            guess = rho * np.exp(-step * self.loop.dt * slope)
            rho *= np.exp(-step * self.loop.dt * (slope + self._growth(k, share, guess, spare)) / 2)
            if rho < COLLAPSE * level:
                raise Refused("interval", "the level vanishes")
            slope = self._growth(k, share, rho, spare)
        return float(rho), at_end

    def _models(self, piece: Stretch, spare: float) -> tuple[Stretch, dict[str, Obligation], int]:
        """The interval's obligations by the cheapest Taylor models that are good enough."""
        *cheaper, (order, degree) = TIERS[self.claim.n]
        for order_here, degree_here in cheaper:
            attempt = piece._replace(orders=(TIME_ORDER, order_here))
            todo = check.funnel_obligations(self.claim, attempt, "interval")
            if max(float(each.error) for each in todo.values()) <= ERROR_SHARE * spare:
                return attempt, todo, degree_here
        piece = piece._replace(orders=(TIME_ORDER, order))
        return piece, check.funnel_obligations(self.claim, piece, "interval"), degree


def prove(
    todo: dict[str, Obligation], degree: int, order: int, exact: bool, aims: np.ndarray
) -> tuple[dict[str, Witness], float] | None:
    """Witnesses by case and the least margin; None where a case has none. `exact`: the checker's margin.

    The directions `aims` [n D] are tried before a program is solved.

    Raises:
        Refused: the checker does not accept a witness of the solver's.
    """
    witnesses, least = {}, np.inf
    shapes = {
        case: program.shape_of(each, degree, order, MULTIPLIER if each.where else 0) for case, each in todo.items()
    }
    data = {case: program.data_of(each, shapes[case]) for case, each in todo.items()}
    if any(program.lowest(data[case], shapes[case], aims) <= 0 for case in todo):
        return None
    for case, each in todo.items():
        found = program.solve(data[case], shapes[case])
        if found is None:
            return None
        witnesses[case] = found.witness
        margin = float(check.margin(each, found.witness, case)) if exact else found.margin
        least = min(least, margin)
    return witnesses, least
