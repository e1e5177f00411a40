"""One elite's certificate: goal region, then funnel, every step kept on disk, so that a killed search goes on."""

import hashlib
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, Node, Refused, Witness
from rtcd_jax.certificate.enlarge import all_knots as joint
from rtcd_jax.certificate.enlarge import knot_by_knot as backward
from rtcd_jax.certificate.prove.backward import SPARE, Descent, Front
from rtcd_jax.certificate.prove.closed_loop import Loop, claim_of, double, doubles, sealed
from rtcd_jax.certificate.prove.goal import GoalRegion, goal_region
from rtcd_jax.certificate.prove.levels import directions, leveled
from rtcd_jax.certificate.standing import accepted, remember
from rtcd_jax.elite.elite import Elite
from rtcd_jax.system.files import replace
from rtcd_jax.system.journal import Journal

RUNGS = ("certified", "proved")
COARSER = 2
"""One of so many directions is enough for funnels that are not proved yet."""


class Step(NamedTuple):
    """How far an elite's certificate is: the interval and time [s] reached, rho there, its margin [1/s]."""

    elite: str
    knot: int
    knots: int
    time: float
    rho: float
    margin: float


class Outcome(NamedTuple):
    """A finished certificate beside what was sampled; volumes over the knots from `start` [s] on.

    `beside` is the rung of the `sampled` volumes: another one where the elite comes from outside.
    """

    elite: str
    rung: str
    start: float
    intervals: int
    seconds: float
    sampled: dict[str, float]
    found: dict[str, float]
    beside: str = "sampled"

    @property
    def whole(self) -> bool:
        """Whether the funnel reaches back to t = 0."""
        return self.start == 0.0


def certify_elite(
    run: Path, name: str, rung: str, on_step: Callable[[Step], None], optimize_value: bool = False
) -> Outcome | None:
    """Writes `certificates/NAME.json` of a run folder; None if not even a goal region can be shown.

    `optimize_value` chooses the ellipsoids' shapes so that the funnel is large.

    Raises:
        UserError: an elite that is not there, or of a plant that the checker does not know.
    """
    began = time.perf_counter()
    elite = Elite.read(run, name)
    told, folder = claim_of(elite), run / "certificates"
    claim = _claim(told, len(elite.u), 1.0)
    loop, exact = Loop(claim, elite), rung == "proved"
    journal = Journal(
        folder / f".{name}.partial.jsonl", {"claim": check.seal(told), "rung": rung, "optimize_value": optimize_value}
    )
    if optimize_value:
        loop = _shaped(loop, journal)
    region = _region(claim, loop, exact, journal)
    if region is None:
        return None
    goal, outlet = region
    descent = Descent(claim, loop, exact)
    front = _front(descent, claim, outlet, journal)
    for proved in descent.down_from(front):
        piece = proved.piece
        journal.append(
            {"stretch": _stretch_record(piece), "rho": proved.rho, "spare": proved.spare, "margin": proved.margin}
        )
        at = (piece.knot + float(piece.start)) * loop.dt
        on_step(Step(name, piece.knot, len(loop.u), at, proved.rho, proved.margin))
    seconds = time.perf_counter() - began
    stretches = [line["stretch"] for line in journal.lines if "stretch" in line][::-1]
    if not stretches:
        return None
    start = [stretches[0]["knot"], stretches[0]["start"]]
    content = {
        "format": check.FORMAT,
        "version": check.VERSION,
        "claim": sealed({**told, "start": start}),
        "funnel": stretches,
        "goal": goal,
        "notes": {"elite": name, "rung at writing": rung},
    }
    outcome = _finish(folder / f"{name}.json", sealed(content), elite, rung, seconds, journal)
    return outcome._replace(beside=elite.guarantee)


def _finish(path: Path, content: dict[str, Any], elite: Elite, rung: str, seconds: float, journal: Journal) -> Outcome:
    """The written certificate; on the rung *proved* it was accepted as a whole before."""
    file = (json.dumps(content, separators=(",", ":")) + "\n").encode()
    if rung == "proved":
        digest = hashlib.sha256(file).hexdigest()
        remember(digest, accepted(check.check(check.parse(file)), digest))
    replace(path, file)
    journal.close()
    claim = check.read_claim(Node("claim", content["claim"]))
    pieces = [check.read_stretch(Node("funnel", each), claim) for each in content["funnel"]]
    axes = Node("goal.axes", content["goal"]["axes"]).array(claim.n, claim.n)
    found, _ = check.volumes_of(claim, pieces, axes)
    start = float(pieces[0].knot + pieces[0].start)
    per_knot, step = elite.volumes_per_knot[int(np.ceil(start)) :], float(elite.time[1])
    sampled = {
        "inlet": float(per_knot[0]),
        "sum": float(per_knot.sum()),
        "integral": float(np.trapezoid(per_knot, dx=step)),
        "goal": float(per_knot[-1]),
    }
    return Outcome(path.stem, rung, start * step, len(pieces), seconds, sampled, found)


def _claim(told: Mapping[str, Any], knot: int, share: float) -> Claim:
    start = [knot - 1, double(share)]
    return check.read_claim(Node("claim", sealed({**told, "start": start})))


def _region(claim: Claim, loop: Loop, exact: bool, journal: Journal) -> tuple[dict[str, Any], float] | None:
    """The goal's record and the outlet's level, from the journal if they are there."""
    for line in journal.lines:
        if "goal" in line:
            return line["goal"], line["outlet"]
    region = goal_region(claim, loop, exact)
    if region is None:
        return None
    goal = _goal_record(region)
    journal.append({"goal": goal, "outlet": region.outlet})
    return goal, region.outlet


def _shaped(loop: Loop, journal: Journal) -> Loop:
    """The loop with the value function that is optimized with the funnel, from the journal if it is there."""
    for line in journal.lines:
        if "values" in line:
            return loop.shaped(np.array(line["values"]), np.array(line["slopes"]))
    loop = largest(loop)
    journal.append({"values": loop.values.tolist(), "slopes": loop.slopes.tolist()})
    return loop


def largest(loop: Loop) -> Loop:
    """The loop with a value function whose funnel is larger, its level about 1; the same loop if it has no funnel."""
    aims = directions(loop.n)[:, ::COARSER]
    try:
        funnel = leveled(loop, aims)
    except Refused:
        return loop
    return joint.enlarged(funnel, aims) if loop.n == 2 else backward.grown(funnel, aims)


def _front(descent: Descent, claim: Claim, outlet: float, journal: Journal) -> Front:
    """Where the journal ends."""
    front = descent.outlet(outlet)
    for line in journal.lines:
        if "stretch" in line:
            piece = check.read_stretch(Node("journal", line["stretch"]), claim)
            rates = SPARE[claim.n]
            place = rates.index(line["spare"]) if line["spare"] in rates else len(rates) - 1
            trial = descent.next_trial(place, line["margin"])
            front = Front(piece.knot, float(piece.start), line["rho"], piece.first, trial)
    return front


def _stretch_record(piece: check.Stretch) -> dict[str, Any]:
    return sealed(
        {
            "knot": piece.knot,
            "start": double(piece.start),
            "end": double(piece.end),
            "first": _matrix(piece.first),
            "last": _matrix(piece.last),
            "bend": [_matrix(each) for each in piece.bend],
            "orders": list(piece.orders),
            "cases": _cases_record(piece.cases),
        }
    )


def _goal_record(region: GoalRegion) -> dict[str, Any]:
    """The weight of the S-lemma lies between those that the two scaled copies of one ellipsoid allow."""
    determinant = float(np.linalg.det(np.array([[float(c) for c in row] for row in region.axes])))
    weight = determinant**2 * (1 + region.outlet / region.rho) / 2
    shells = [
        sealed({"start": double(s.start), "end": double(s.end), "cases": _cases_record(s.cases)}) for s in region.shells
    ]
    record = {"axes": _matrix(region.axes), "order": region.order, "weight": double(weight), "shells": shells}
    return sealed(record)


def _cases_record(cases: Mapping[str, Witness]) -> dict[str, Any]:
    return {
        case: {
            "degree": witness.degree,
            "gram": [_triangle(matrix) for matrix in witness.gram],
            "multipliers": [[_triangle(matrix) for matrix in each] for each in witness.multipliers],
        }
        for case, witness in cases.items()
    }


def _matrix(matrix: list[list]) -> Any:
    return doubles([[float(c) for c in row] for row in matrix])


def _triangle(matrix: list[list]) -> list[str]:
    return [double(float(c)) for i, row in enumerate(matrix) for c in row[i:]]
