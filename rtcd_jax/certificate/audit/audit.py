"""`rtcd audit`: where an external funnel fails, and its nominal projected onto the dynamics, for a proof.

Of every knot's ellipsoid, uniform random states are followed to the last knot under the true dynamics and the file's
own controller, u = clip(u_k - R^-1 B'S (x - x*(t))): an invariant funnel lets none out.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rtcd_jax.certificate.audit.external import Cost, ExternalFunnel, elite_of
from rtcd_jax.certificate.audit.folder import config_of, write_folder
from rtcd_jax.certificate.audit.projection import defects, projected, with_fitting_inputs
from rtcd_jax.elite.closed_loop import ClosedLoop, runge_kutta
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.simulators import dynamics_of
from rtcd_jax.system.console import Console, table
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder, replace_json, require_own_folder

STEPS = 50
"""Runge-Kutta steps of an interval."""
WORST = 8
"""Knots in the table."""
RECORD = "audit.json"


class Escapes(NamedTuple):
    """Of the states of every knot's ellipsoid but the last one's: the shares outside the next one, outside any later
    one, outside the last one (the goal's) and beyond the limits on the states, and the largest V / rho at the next and
    at any later knot."""

    next_share: Float[np.ndarray, " N"]
    share: Float[np.ndarray, " N"]
    goal_share: Float[np.ndarray, " N"]
    limit_share: Float[np.ndarray, " N"]
    next_level: Float[np.ndarray, " N"]
    level: Float[np.ndarray, " N"]


def escapes(elite: Elite, states: int, seed: int) -> Escapes:
    """What `states` uniform random states of every ellipsoid do."""
    f, intervals = dynamics_of(elite), len(elite.u)
    loop = ClosedLoop.of(elite, f)
    knots, x = elite.sample(states * (intervals + 1), np.random.default_rng(seed))
    level, next_level, now = np.zeros(len(x)), np.zeros(len(x)), np.zeros(len(x))
    beyond = np.any(np.abs(x) > elite.state_limits, axis=1)
    with np.errstate(all="ignore"):  # a state that diverges is outside
        for k in range(intervals):
            moving, step = knots <= k, (elite.time[k + 1] - elite.time[k]) / STEPS
            for state in runge_kutta(f, step)(loop.tracking(k), elite.time[k], elite.time[k + 1], x[moving]):
                beyond[moving] |= ~np.all(np.abs(state) <= elite.state_limits, axis=1)
                x[moving] = state
            ratio = elite.value(k + 1, x[moving]) / elite.rho[k + 1]
            now[moving] = np.nan_to_num(ratio, nan=np.inf, posinf=np.inf)
            next_level[knots == k] = now[knots == k]
            level[moving] = np.maximum(level[moving], now[moving])
    next_level, level, now, beyond = (
        each.reshape(-1, states)[:-1]  # sampled knot by knot
        for each in (next_level, level, now, beyond)
    )
    shares = (next_level > 1).mean(1), (level > 1).mean(1), (now > 1).mean(1), beyond.mean(1)
    return Escapes(*shares, next_level.max(1), level.max(1))


def audit_funnel(external: ExternalFunnel, cost: Cost, states: int, seed: int, out: Path, console: Console) -> bool:
    """Audits a funnel and stores it as a run folder `out`; True if no state left it.

    Elite 000 is the funnel about the motion projected onto the dynamics, 001 and the initial candidate are the funnel
    as given: `rtcd certify out --elites 2` proves what can be proved of both. `out`/audit.json has the numbers.

    Raises:
        UserError: no such motion was found, numbers that no robot has, or a folder that holds something else or cannot
            be written.
    """
    given, misfits = with_fitting_inputs(external)
    config = config_of(given, cost)
    require_own_folder(out, "an audit", (out / RECORD).is_file())
    make_folder(out)
    try:
        result = escapes(Elite.of(*elite_of(given, cost)), states, seed)
        off = np.max(np.abs(defects(given)), axis=0)
        solution = projected(given, cost)
    except np.linalg.LinAlgError as error:
        raise UserError(f"the numbers of the robot, its cost and its funnel do not go together: {error}") from None
    replace_json(out / RECORD, _record(given, solution, result, off, misfits, states, seed))
    write_folder(out, config, given, solution, cost)
    console.message(_table(given, result))
    for line in [*_inputs(misfits, given), *_summary(given, solution, result, off, states)]:
        console.message(line)
    console.message(
        f"stored as a run: {out}/elites/000 (projected onto the dynamics), 001 (as given); prove them by `rtcd certify "
        f"{out} --elites 2`"
    )
    return not np.any(result.share > 0)


def _record(
    given: ExternalFunnel,
    solution: ExternalFunnel,
    result: Escapes,
    off: np.ndarray,
    misfits: Mapping[str, float],
    states: int,
    seed: int,
) -> dict[str, Any]:
    return {
        "states": states,
        "seed": seed,
        "volumes_claimed": {"sum": given.volumes.sum(), "integral": np.trapezoid(given.volumes, dx=given.dt)},
        "misfit_of_inputs": misfits,
        "largest_defect": off,
        "moved_by_mending": np.max(np.abs(solution.x - given.x), axis=0),
        "knots": result._asdict(),
    }


def _table(given: ExternalFunnel, result: Escapes) -> str:
    worst = np.argsort(-result.next_share, kind="stable")[:WORST]
    rows = [
        (
            f"{k}", f"{k * given.dt:.3g}", f"{result.next_share[k]:.1%}", f"{result.next_level[k]:.3g}",
            f"{result.share[k]:.1%}", f"{result.level[k]:.3g}", f"{result.goal_share[k]:.1%}",
            f"{result.limit_share[k]:.1%}",
        )
        for k in [0, *sorted(int(k) for k in worst if k)]
    ]  # fmt: skip
    headings = (
        "knot", "t, s", "leave the next", "worst V/rho there", "leave later", "worst V/rho", "miss the goal",
        "leave limits",
    )  # fmt: skip
    return table(headings, rows, "the funnel as given, true dynamics: its first and its worst knots")


def _inputs(misfits: Mapping[str, float], given: ExternalFunnel) -> list[str]:
    """Which row of inputs was taken, where the file leaves a choice."""
    if len(misfits) < 2:
        return []
    taken = "as written" if np.array_equal(given.u, given.inputs[:-1]) else "moved by one knot"
    texts = ", ".join(f"{name} {misfit:.2g}" for name, misfit in misfits.items())
    return [f"inputs taken {taken}; largest misfit of a knot, in shares of the states' largest values: {texts}"]


def _summary(
    given: ExternalFunnel, solution: ExternalFunnel, result: Escapes, off: np.ndarray, states: int
) -> list[str]:
    names, intervals = given.states, len(given.u)
    moved = np.max(np.abs(solution.x - given.x), axis=0)

    def by_state(numbers: np.ndarray) -> str:
        return ", ".join(f"{name} {number:.3g}" for name, number in zip(names, numbers, strict=True))

    return [
        f"{states} states of each ellipsoid: from {np.sum(result.next_share > 0)} of {intervals} some leave the next "
        f"one, from {np.sum(result.share > 0)} some leave a later one, {result.share[0]:.1%} of the first one's",
        f"of all states {result.goal_share.mean():.1%} miss the goal's ellipsoid at the last knot, "
        f"{result.limit_share.mean():.1%} leave the limits on the states; of the first ellipsoid's "
        f"{result.goal_share[0]:.1%} and {result.limit_share[0]:.1%}",
        f"the nominal motion misses its next knot by up to {by_state(off)}; projecting it onto the dynamics moves its "
        f"knots by up to {by_state(moved)}",
    ]
