"""The funnel, interval by interval backward from the goal: its levels are what can be proved, not what was sampled.

On an interval the level grows backward by the loop's own fastest growth of V, found on sampled directions, plus a
spare rate; the limits on the states cap it. The program then has only to verify. Where it fails, the spare rate is
raised, the interval halved, and the rate raised again.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple, cast, final

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, Obligation, Q, Refused, Stretch, Witness
from rtcd_jax.certificate.prove import sdp as program
from rtcd_jax.certificate.prove.closed_loop import Loop
from rtcd_jax.certificate.prove.levels import carried_back, directions

GRID = 34
"""Ellipsoids are rounded to multiples of 2^-34."""
SPARE = {2: (0.005, 0.015, 0.04, 0.1), 4: (0.02, 0.06, 0.2, 0.5)}
"""By the number of states: rates [1/s] that a level gives away, in the order of trial, before an interval is halved."""
LARGE_SPARE = (0.25, 0.6, 1.5, 4.0, 10.0, 25.0)
"""And for an interval of the shortest share."""
SHORTEST = 1 / 16
"""Shortest share of the knots' interval."""
TIME_ORDER, MULTIPLIER = 5, 1
"""Orders in s of Taylor models and of multipliers; u_lin has order 4 (K times L), so that all fit into degree 5."""
TIERS = {2: ((5, 3), (7, 4), (9, 5), (11, 6)), 4: ((3, 2), (5, 3))}
"""By the number of states: orders in y of Taylor models and degrees of monomials, the cheapest first."""
ERROR_SHARE = 1 / 3
"""A Taylor model is good enough if its error is at most this share of the spare rate."""


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


def on_grid(matrix: np.ndarray) -> list[list]:
    """The exact matrix nearest to `matrix` on the grid."""
    return [[Q(int(c), 1 << GRID) for c in row] for row in np.rint(matrix * 2.0**GRID)]


@final
class Descent:
    """The search for one elite's funnel. `exact` asks the checker after every interval (rung *proved*)."""

    def __init__(self, claim: Claim, loop: Loop, exact: bool):
        self.claim, self.loop, self.exact = claim, loop, exact
        self._directions = directions(claim.n)

    def outlet(self, rho: float) -> Front:
        """Where the descent begins: t_N with the level rho."""
        last = len(self.loop.u) - 1
        return Front(last, 1.0, rho, on_grid(self.loop.axes(last, 1.0, rho, 0.0)[0]), 0)

    def down_from(self, front: Front) -> Iterator[Proved]:
        """The intervals from the front back to t = 0, or to where nothing can be proved."""
        waiting = [(k, 0.0, 1.0) for k in range(front.knot)]
        waiting += [(front.knot, 0.0, front.share)] if front.share > 0 else []
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
            piece, rho = self._piece(k, start, end, front, spare)
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
        loop, half = self.loop, (end - start) * self.loop.dt / 2
        rho, first_growth, last_growth = carried_back(loop, k, start, end, front.rho, spare, self._directions)
        a, a_rate = loop.axes(k, start, rho, first_growth)
        b, b_rate = loop.axes(k, end, front.rho, last_growth)
        chord = (b - a) / 2
        at_start, at_end = (a_rate * half - chord) / 2, (chord - b_rate * half) / 2
        bend = [on_grid((at_end + at_start) / 2), on_grid((at_end - at_start) / 2)]
        shares = Q(*start.as_integer_ratio()), Q(*end.as_integer_ratio())
        order = TIERS[self.claim.n][0][0]
        return Stretch(k, *shares, on_grid(a), front.axes, bend, (TIME_ORDER, order), {}), rho

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
        margin = float(cast(Any, check.margin(each, found.witness, case))) if exact else found.margin
        least = min(least, margin)
    return witnesses, least
