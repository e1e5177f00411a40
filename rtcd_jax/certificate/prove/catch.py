"""The end of a motion in its catch set, or where a reset leads it: the level of the outlet, and the squares."""

from concurrent.futures import Executor
from typing import NamedTuple

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, Refused, Squares
from rtcd_jax.certificate.prove.backward import Effort, prove
from rtcd_jax.certificate.prove.closed_loop import Loop
from rtcd_jax.certificate.prove.goal import OUTLET_CLEARANCE, TIERS, largest_offset
from rtcd_jax.certificate.prove.levels import last_level, unit_directions
from rtcd_jax.certificate.prove.sdp import SOLVER, data_of, lowest

FEWEST = 1
"""Least degree of the squares' monomials: without a reset what must be positive is quadratic."""


class CaughtEnd(NamedTuple):
    """The level of the funnel's outlet, the order of the models, and the squares."""

    outlet: float
    order: int
    cases: dict[str, Squares]


def caught_end(
    claim: Claim, loop: Loop, exact: bool, solver: str = SOLVER, pool: Executor | None = None
) -> CaughtEnd | None:
    """The largest outlet that is a little within the catch set; None where the centers of some robots are outside."""
    assert claim.catch is not None
    off = largest_offset(claim, claim.catch.axes, claim.catch.center)
    if off >= 1:
        return None
    outlet = (1 - off) ** 2 * (1 - OUTLET_CLEARANCE) * last_level(loop, unit_directions(claim.n))
    found = catch_proof(claim, loop.outlet_axes(outlet), exact, solver, pool)
    return found and CaughtEnd(outlet, *found)


def catch_proof(
    claim: Claim, outlet: list, exact: bool, solver: str = SOLVER, pool: Executor | None = None
) -> tuple[int, dict[str, Squares]] | None:
    """The order of the models and the squares of the claim's catch, from the last ellipsoid; None if there are none."""
    for tier in TIERS[claim.n]:
        try:
            todo = check.catch_obligations(claim, outlet, tier.order, "catch")
            shapes = tier.shapes(todo, claim, FEWEST, tier.time_order)
            proof = prove(todo, shapes, 0.0, exact, Effort(unit_directions(claim.n), solver), pool)
        except Refused:
            continue
        if proof is not None:
            return tier.order, proof[0]
    return None


def largest_level(claim: Claim, outlet: list) -> float:
    """The largest |y|^2 in the catch set of sampled states from the rim of the last ellipsoid; infinite where the
    models do not say it.
    """
    tier = TIERS[claim.n][-1]
    try:
        todo = check.catch_obligations(claim, outlet, tier.order, "catch")
    except Refused:
        return np.inf
    shapes = {case: each[-1] for case, each in tier.shapes(todo, claim, tier.degree, tier.time_order).items()}
    directions = unit_directions(claim.n)
    return 1 - min(lowest(data_of(each, shapes[case]), shapes[case], directions) for case, each in todo.items())
