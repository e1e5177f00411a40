"""The proof of a funnel, interval by interval backward from the goal. Its levels are those that can be proved.

On an interval the level follows the fastest growth of V, found on sampled directions, plus a decay margin: a rate that
the level gives away so that V falls strictly. The limits on the states cap the level. The semidefinite program then
only verifies. Where it fails, the decay margin is raised, then the interval halved, then the margin raised again. Where
it leaves much more than it needs, the interval is proved once more with a lower decay margin.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple, cast, final

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, GramCertificate, Interval, Obligation, Refused
from rtcd_jax.certificate.prove import sdp as program
from rtcd_jax.certificate.prove.closed_loop import Loop, on_grid
from rtcd_jax.certificate.prove.levels import carried_back, unit_directions

DECAY_MARGINS = {2: (0.005, 0.015, 0.04, 0.1), 4: (0.02, 0.06, 0.2, 0.5)}
"""By the number of states: decay margins [1/s] in the order of trial, before an interval is halved."""
LARGE_DECAY_MARGINS = (0.25, 0.6, 1.5, 4.0, 10.0, 25.0)
"""Further ones for an interval of the shortest length."""
RECLAIMED = 0.8
"""Share of the certificates' margin by which the decay margin is lowered."""
WASTED = 1 / 4
"""Share of the decay margin beyond which the certificates' margin is worth a second attempt."""
SHORTEST = 1 / 16
"""Shortest fraction of the knots' interval."""
TIME_ORDER, MULTIPLIER = 5, 1
"""Orders in s of Taylor models and of multipliers; u_lin has order 4 (K times L), so that all fit into degree 5."""
TIERS = {2: ((5, 3), (7, 4), (9, 5), (11, 6)), 4: ((3, 2), (5, 3))}
"""By the number of states: orders in y of Taylor models and degrees of monomials, the cheapest first."""
ERROR_FRACTION = 1 / 3
"""A Taylor model is good enough if its error is at most this fraction of the decay margin."""


class Proved(NamedTuple):
    """A proved interval, its level at the start, its decay margin [1/s], and the margin of its certificates [1/s]."""

    interval: Interval
    rho: float
    decay_margin: float
    margin: float


class ProofState(NamedTuple):
    """How far the proof has come: a fraction of an interval, the level and the ellipsoid there.

    `first_margin` [1/s] is the decay margin that the next interval begins with.
    """

    knot: int
    fraction: float
    rho: float
    axes: list
    first_margin: float


@final
class BackwardProof:
    """The proof of one elite's funnel. `exact` runs the checker after every interval (*proved*)."""

    def __init__(self, claim: Claim, loop: Loop, exact: bool, solver: str = program.SOLVER):
        self.claim, self.loop, self.exact, self.solver = claim, loop, exact, solver
        self._directions, self._rates = unit_directions(claim.n), DECAY_MARGINS[claim.n]

    def outlet(self, rho: float) -> ProofState:
        """The state at which the proof begins: t_N with the level rho."""
        last = len(self.loop.u) - 1
        return ProofState(last, 1.0, rho, on_grid(self.loop.axes(last, 1.0, rho, 0.0)[0]), self._rates[0])

    def intervals_from(self, state: ProofState) -> Iterator[Proved]:
        """The proved intervals from the state back to t = 0, or to where nothing can be proved."""
        waiting = [(k, 0.0, 1.0) for k in range(state.knot)]
        waiting += [(state.knot, 0.0, state.fraction)] if state.fraction > 0 else []
        while waiting:
            k, start, end = waiting.pop()
            short = end - start <= SHORTEST
            proved = self._least_margin(k, start, end, state, short)
            if proved is None and short:
                return
            if proved is None:
                middle = (start + end) / 2
                waiting += [(k, start, middle), (k, middle, end)]
                continue
            first_margin = self.first_margin(proved.decay_margin, proved.margin)
            state = ProofState(k, start, proved.rho, proved.interval.first, first_margin)
            yield proved

    def first_margin(self, decay_margin: float, margin: float) -> float:
        """The decay margin that the interval begins with which comes behind one of these margins."""
        return min(self._lowered(decay_margin, margin), self._rates[-1])

    def _lowered(self, decay_margin: float, margin: float) -> float:
        """A decay margin that the certificates' margin still allows, if that is much; the same if not."""
        wasted = margin > max(WASTED * decay_margin, self._rates[0])
        return max(self._rates[0], decay_margin - RECLAIMED * margin) if wasted else decay_margin

    def _least_margin(self, k: int, start: float, end: float, state: ProofState, short: bool) -> Proved | None:
        """The interval with nearly the least decay margin with which it can be proved."""
        rates = self._rates + (LARGE_DECAY_MARGINS if short else ())
        for rate in (state.first_margin, *(rate for rate in rates if rate > state.first_margin)):
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
            interval, todo, degree = self._models(interval, decay_margin)
            proof = prove(todo, degree, interval.orders[0], self.exact, self._directions, self.solver)
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
        rho, first_growth, last_growth = carried_back(loop, k, start, end, state.rho, decay_margin, self._directions)
        a, a_rate = loop.axes(k, start, rho, first_growth)
        b, b_rate = loop.axes(k, end, state.rho, last_growth)
        chord = (b - a) / 2
        at_start, at_end = (a_rate * half - chord) / 2, (chord - b_rate * half) / 2
        bend = [on_grid((at_end + at_start) / 2), on_grid((at_end - at_start) / 2)]
        fractions = check.rational(start), check.rational(end)
        order = TIERS[self.claim.n][0][0]
        late = loop.late_rows(k, start, end) if self.claim.first_order else []
        sides = loop.sides(k, start, end)
        return Interval(k, *fractions, on_grid(a), state.axes, bend, (TIME_ORDER, order), {}, late, sides), rho

    def _models(self, interval: Interval, decay_margin: float) -> tuple[Interval, dict[str, Obligation], int]:
        """The interval's obligations by the cheapest Taylor models that are good enough."""
        *cheaper, (order, degree) = TIERS[self.claim.n]
        for order_here, degree_here in cheaper:
            attempt = interval._replace(orders=(TIME_ORDER, order_here))
            todo = check.funnel_obligations(self.claim, attempt, "interval")
            if max(float(each.error) for each in todo.values()) <= ERROR_FRACTION * decay_margin:
                return attempt, todo, degree_here
        interval = interval._replace(orders=(TIME_ORDER, order))
        return interval, check.funnel_obligations(self.claim, interval, "interval"), degree


def prove(
    todo: dict[str, Obligation], degree: int, order: int, exact: bool, directions: np.ndarray, solver: str
) -> tuple[dict[str, GramCertificate], float] | None:
    """Gram certificates by case and the least margin; None where a case has none. `exact`: the checker's margin.

    The `directions` [n D] are tried before a program is solved.

    Raises:
        Refused: the checker does not accept a certificate of the solver's.
    """
    certificates, least = {}, np.inf
    shapes = {
        case: program.shape_of(each, degree, order, MULTIPLIER if each.where else 0) for case, each in todo.items()
    }
    data = {case: program.data_of(each, shapes[case]) for case, each in todo.items()}
    if any(program.lowest(data[case], shapes[case], directions) <= 0 for case in todo):
        return None
    for case, each in todo.items():
        solution = program.solve(data[case], shapes[case], solver)
        if solution is None:
            return None
        certificates[case] = solution.certificate
        margin = float(cast(Any, check.margin(each, solution.certificate, case))) if exact else solution.margin
        least = min(least, margin)
    return certificates, least
