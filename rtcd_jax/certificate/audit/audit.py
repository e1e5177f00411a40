"""`rtcd audit`: where a funnel from outside fails, and a mended nominal about which one can be proved.

Of every knot's ellipsoid, uniform random states are followed to the last knot under the true dynamics and the file's
own controller, u = clip(u_k - R^-1 B'S (x - x*(t))): an invariant funnel lets none out.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rtcd_jax.certificate.audit.external import Cost, Outside, elite_of
from rtcd_jax.certificate.audit.repair import defects, repaired
from rtcd_jax.elite.closed_loop import ClosedLoop, runge_kutta
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import write_elite
from rtcd_jax.elite.simulators import CLOSED_FORMS
from rtcd_jax.system.console import Console, table
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder, replace_json

STEPS = 50
"""Runge-Kutta steps of an interval."""
WORST = 8
"""Knots in the table."""
RECORD = "audit.json"


class Escapes(NamedTuple):
    """Of the states of every knot's ellipsoid but the last one's: the shares outside the next one and outside any later
    one, and the largest V / rho at the next and at any later knot."""

    next_share: Float[np.ndarray, " N"]
    share: Float[np.ndarray, " N"]
    next_level: Float[np.ndarray, " N"]
    level: Float[np.ndarray, " N"]


def escapes(elite: Elite, states: int, seed: int) -> Escapes:
    """What `states` uniform random states of every ellipsoid do."""
    f, intervals = CLOSED_FORMS[elite.plant](elite.parameters), len(elite.u)
    loop = ClosedLoop.of(elite, f)
    knots, x = elite.sample(states * (intervals + 1), np.random.default_rng(seed))
    level, next_level = np.zeros(len(x)), np.zeros(len(x))
    for k in range(intervals):
        moving, step = knots <= k, (elite.time[k + 1] - elite.time[k]) / STEPS
        *_, x[moving] = runge_kutta(f, step)(loop.tracking(k), elite.time[k], elite.time[k + 1], x[moving])
        now = elite.value(k + 1, x[moving]) / elite.rho[k + 1]
        next_level[knots == k] = now[knots[moving] == k]
        level[moving] = np.maximum(level[moving], now)
    per_knot = [level.reshape(-1, states)[:-1] for level in (next_level, level)]  # sampled knot by knot
    return Escapes(*((each > 1).mean(1) for each in per_knot), *(each.max(1) for each in per_knot))


def audit(given: Outside, cost: Cost, states: int, seed: int, out: Path, console: Console) -> bool:
    """Audits a funnel and stores, as elites of `out`, 000 the mended one and 001 the given one; True if none left it.

    `out`/audit.json has the numbers, knot by knot. `rtcd certify out --elites 2` proves what can be proved of both.

    Raises:
        UserError: no mended motion was found, or a folder that holds something else or cannot be written.
    """
    _claim(out)
    seen = escapes(Elite.of(*elite_of(given, cost)), states, seed)
    off = np.max(np.abs(defects(given)), axis=0)
    mended = repaired(given, cost)
    replace_json(out / RECORD, _record(given, mended, seen, off, states, seed))
    make_folder(out / "elites")
    for name, outside in (("000", mended), ("001", given)):
        write_elite(out / "elites", name, *elite_of(outside, cost))
    console.message(_table(given, seen))
    console.message(_summary(given, mended, seen, off, states))
    console.message(f"stored: {out}/elites/000 (mended), 001 (as given); prove them by `rtcd certify {out} --elites 2`")
    return not np.any(seen.share > 0)


def _claim(out: Path) -> None:
    """Makes the folder, unless it holds what is no audit's."""
    foreign = sorted(item.name for item in out.iterdir()) if out.is_dir() and not (out / RECORD).is_file() else []
    if foreign:
        raise UserError(f"--out = {out}: must be a new or empty folder, or a former audit's: it has {foreign[0]}")
    make_folder(out)


def _record(given: Outside, mended: Outside, seen: Escapes, off: np.ndarray, states: int, seed: int) -> dict[str, Any]:
    return {
        "states": states,
        "seed": seed,
        "volumes_claimed": {"sum": given.volumes.sum(), "integral": np.trapezoid(given.volumes, dx=given.dt)},
        "largest_defect": off,
        "moved_by_mending": np.max(np.abs(mended.x - given.x), axis=0),
        "knots": seen._asdict(),
    }


def _table(given: Outside, seen: Escapes) -> str:
    worst = np.argsort(-seen.next_share, kind="stable")[:WORST]
    rows = [
        (
            f"{k}", f"{k * given.dt:.3g}", f"{seen.next_share[k]:.1%}", f"{seen.next_level[k]:.3g}",
            f"{seen.share[k]:.1%}", f"{seen.level[k]:.3g}",
        )
        for k in [0, *sorted(int(k) for k in worst if k)]
    ]  # fmt: skip
    headings = ("knot", "t, s", "leave the next", "worst V/rho there", "leave later", "worst V/rho")
    return table(headings, rows, "the funnel as given, true dynamics: its first and its worst knots")


def _summary(given: Outside, mended: Outside, seen: Escapes, off: np.ndarray, states: int) -> str:
    names = given.plant.states
    moved = np.max(np.abs(mended.x - given.x), axis=0)

    def listed(numbers: np.ndarray) -> str:
        return ", ".join(f"{name} {number:.3g}" for name, number in zip(names, numbers, strict=True))

    intervals = len(given.u)
    return (
        f"{states} states of each ellipsoid: from {np.sum(seen.next_share > 0)} of {intervals} some leave the next "
        f"one, from {np.sum(seen.share > 0)} some leave a later one, {seen.share[0]:.1%} of the first one's. The "
        f"nominal motion misses its next knot by up to {listed(off)}; mending moves its knots by up to {listed(moved)}."
    )
