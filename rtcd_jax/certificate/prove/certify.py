"""One elite's certificate: goal region or catch, then funnel. A journal keeps all steps: a killed proof goes on."""

import contextlib
import hashlib
import json
import math
import re
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, Halves, Node, Refused, Squares
from rtcd_jax.certificate.enlarge import all_knots as joint
from rtcd_jax.certificate.enlarge import knot_by_knot as backward
from rtcd_jax.certificate.prove.backward import BackwardProof, ProofState, Proved
from rtcd_jax.certificate.prove.catch import caught_end
from rtcd_jax.certificate.prove.closed_loop import Loop, claim_of, double, matrix_record, with_digests
from rtcd_jax.certificate.prove.goal import GoalRegion, goal_region
from rtcd_jax.certificate.prove.levels import leveled, unit_directions
from rtcd_jax.certificate.prove.margins import feedback_delay, push_margin
from rtcd_jax.certificate.prove.sdp import SOLVER
from rtcd_jax.certificate.prove.uncertainty import bounds_of, uncertainty_of
from rtcd_jax.certificate.standing import accepted, remember, standing_of
from rtcd_jax.config.schema import UncertaintyConfig
from rtcd_jax.elite.elite import Elite
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import held, removed, replace
from rtcd_jax.system.journal import Journal

TASK = "task"
"""Note of a certificate: the digest of what was to be proved, and how."""
ENDING_ZEROS = re.compile(r"\.?0*p")
"""Of a double as certificates write it."""
MOST_THREADS = 8
"""Of one elite's proof: few cases take most of an interval's time, and each thread some of the memory."""
COARSER = 2
"""Stride of the directions for funnels that are not proved yet."""


class Step(NamedTuple):
    """How far an elite's certificate is: the interval, the fraction of it and the time [s] reached, rho there, its
    margin [1/s].
    """

    elite: str
    knot: int
    fraction: float
    knots: int
    time: float
    rho: float
    margin: float


class Checking(NamedTuple):
    """How many intervals of an elite's finished certificate the checker has accepted."""

    elite: str
    done: int
    of: int


class Outcome(NamedTuple):
    """A finished certificate beside what was sampled; volumes over the knots from `start` [s] on.

    `volumes` are the certificate's. `beside` is the guarantee of the `sampled` ones: another for an external elite.
    `seconds` is NaN for a certificate that was there already.
    """

    elite: str
    guarantee: str
    start: float
    intervals: int
    seconds: float
    sampled: dict[str, float]
    volumes: dict[str, float]
    beside: str = "sampled"

    @property
    def whole(self) -> bool:
        """Whether the funnel reaches back to t = 0."""
        return self.start == 0.0


def certify_elite(
    run: Path,
    name: str,
    guarantee: str,
    on_step: Callable[[Step | Checking], None],
    optimize_value: bool = False,
    uncertainty: Path | UncertaintyConfig | None = None,
    solver: str = SOLVER,
    share: float = 1.0,
    target: str = "certificates",
    threads: int = 1,
) -> Outcome | None:
    """Writes NAME.json into a run's folder `target`; None if not even a goal region, or the catch, can be shown.

    `optimize_value` chooses the ellipsoids' shapes so that the funnel is large. The certificate bears what the run
    bore, or another `uncertainty`, or that of a file. `solver` is by cvxpy's name. With a `share` below 1 no level is
    above so much of the sampled ones. The `threads` share out the cases of an interval. A certificate that is there
    already, of the same claim in the same way, is not made again.

    Raises:
        UserError: an elite that is not there, or of a plant that the checker does not know, or that another process is
            proving.
    """
    lock = run / target / f".{name}.lock"
    with held(lock, f"elite {name} of {run}", "it is being proved there"), removed(lock), _pool(threads) as pool:
        return _certified(run, name, guarantee, on_step, optimize_value, uncertainty, solver, share, target, pool)


def _pool(threads: int) -> contextlib.AbstractContextManager[Executor | None]:
    threads = min(threads, MOST_THREADS)
    return ThreadPoolExecutor(threads) if threads > 1 else contextlib.nullcontext()


def _certified(
    run: Path,
    name: str,
    guarantee: str,
    on_step: Callable[[Step | Checking], None],
    optimize_value: bool,
    uncertainty: Path | UncertaintyConfig | None,
    solver: str,
    share: float,
    target: str,
    pool: Executor | None,
) -> Outcome | None:
    """`certify_elite` of an elite that no other process is at."""
    began = time.perf_counter()
    elite = Elite.read(run, name)
    if optimize_value and elite.keep_out:
        raise UserError(f"--optimize_value: {run} has sets to keep out of (task.keep_out), which it does not know")
    if optimize_value and elite.caught:
        raise UserError(f"--optimize_value: {run} ends in a catch set (task.catch), whose shape is given")
    if optimize_value and share < 1:
        raise UserError("--optimize_value: has no sampled levels of which --share could be a part")
    bounds, folder = bounds_of(elite, uncertainty_of(elite, uncertainty)), run / target
    if bounds.age and elite.caught:
        raise UserError(
            f"{run} ends in a catch set (task.catch): no proof of it bears old measurements, uncertainty.age"
        )
    loop_record = claim_of(elite, bounds)
    misfits: tuple[Any, ...] = ()
    if bounds.age:
        delay = feedback_delay(_read(loop_record, elite), elite)
        loop_record |= delay.record()
        misfits = delay.misfits, delay.misfit_at_goal
    head = {"claim": check.digest(loop_record), "rung": guarantee, "optimize_value": optimize_value, "solver": solver}
    if share < 1:
        head |= {"share": share}

    def checking(done: int, of: int) -> None:
        on_step(Checking(name, done, of))

    if (content := _finished(folder / f"{name}.json", head, loop_record, elite, checking)) is not None:
        return _outcome(name, content, elite, guarantee, math.nan)
    claim = _read(loop_record, elite)
    loop, exact = Loop(claim, elite, *misfits, share=share), guarantee == "proved"
    journal = Journal(folder / f".{name}.partial.jsonl", head)
    if optimize_value:
        loop = _shaped(loop, journal)
    last = "goal" if claim.catch is None else "catch"
    ended = _end(claim, loop, exact, bounds.rest, journal, last, solver, pool)
    if ended is None:
        return None
    end, outlet = ended
    proof = BackwardProof(claim, loop, exact, solver, pool)
    state = _resumed(proof, claim, outlet, journal)
    for proved in proof.intervals_from(state):
        interval = proved.interval
        journal.append(
            {
                "stretch": _interval_record(interval),
                "rho": proved.rho,
                "spare": proved.decay_margin,
                "margin": proved.margin,
            }
        )
        at = (interval.knot + float(interval.start)) * loop.dt
        on_step(Step(name, interval.knot, float(interval.start), len(loop.u), at, proved.rho, proved.margin))
    seconds = time.perf_counter() - began
    intervals = [line["stretch"] for line in journal.lines if "stretch" in line][::-1]
    if not intervals:
        return None
    start = [intervals[0]["knot"], intervals[0]["start"]]
    push = push_margin(claim, [check.read_interval(Node("funnel", each), claim) for each in intervals])
    content = {
        "format": check.FORMAT,
        "version": check.VERSION,
        "claim": with_digests({**loop_record, "start": start, "push": double(push)}),
        "funnel": intervals,
        last: end,
        "notes": {"elite": name, "rung at writing": guarantee, "solver": solver, TASK: check.digest(head)},
    }
    content = with_digests(content)
    write_certificate(folder / f"{name}.json", content, guarantee, checking)
    journal.close()
    return _outcome(name, content, elite, guarantee, seconds)


def write_certificate(
    path: Path, content: dict[str, Any], guarantee: str, progress: Callable[[int, int], None]
) -> None:
    """Writes the certificate; one that says *proved* after the checker has accepted the whole file."""
    file = (json.dumps(content, separators=(",", ":")) + "\n").encode()
    if guarantee == "proved":
        digest = hashlib.sha256(file).hexdigest()
        remember(digest, accepted(check.check(check.parse(file), progress), digest))
    replace(path, file)


def _finished(
    path: Path,
    head: Mapping[str, Any],
    loop_record: Mapping[str, Any],
    elite: Elite,
    progress: Callable[[int, int], None],
) -> dict[str, Any] | None:
    """The certificate that is there, if it is of this task, whole, and as good as it says; None if it is to be made."""
    with contextlib.suppress(OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError, Refused):
        content = check.parse(path.read_bytes())
        claim = {key: value for key, value in content["claim"].items() if key not in ("start", "push", "sha256")}
        if elite.caught:  # behind a reset there is another set
            claim["catch"] = loop_record["catch"]
        whole = with_digests({key: value for key, value in content.items() if key != "sha256"}) == content
        ours = content["notes"].get(TASK) == check.digest(head) and check.digest(claim) == head["claim"]
        if whole and ours and (head["rung"] != "proved" or standing_of(path, elite, progress).proved):
            return content
    return None


def _outcome(name: str, content: Mapping[str, Any], elite: Elite, guarantee: str, seconds: float) -> Outcome:
    """A certificate beside what was sampled."""
    claim = check.read_claim(Node("claim", content["claim"]))
    intervals = [check.read_interval(Node("funnel", each), claim) for each in content["funnel"]]
    region = content["goal"] if claim.catch is None else content["claim"]["catch"]
    volumes, _ = check.volumes_of(claim, intervals, Node("axes", region["axes"]).array(claim.n, claim.n))
    volumes.setdefault("goal", volumes["outlet"])  # as the searches have it for a motion that ends in a catch
    start = float(intervals[0].knot + intervals[0].start)
    per_knot, step = elite.volumes_per_knot[int(np.ceil(start)) :], float(elite.time[1])
    sampled = {
        "inlet": float(per_knot[0]),
        "sum": float(per_knot.sum()),
        "integral": float(np.trapezoid(per_knot, dx=step)),
        "goal": float(per_knot[-1]),
    }
    return Outcome(name, guarantee, start * step, len(intervals), seconds, sampled, volumes, elite.guarantee)


def unproved(elite: Elite, uncertainty: Path | UncertaintyConfig | None = None) -> Claim:
    """The claim about an elite that bears what its run bore, or another uncertainty; nothing of it is proved."""
    return _read(claim_of(elite, bounds_of(elite, uncertainty_of(elite, uncertainty))), elite)


def _read(loop_record: Mapping[str, Any], elite: Elite) -> Claim:
    """The claim, with nothing proved yet."""
    nothing = {"start": [len(elite.u) - 1, double(1.0)], "push": double(0.0)}
    return check.read_claim(Node("claim", with_digests({**loop_record, **nothing})))


def _end(
    claim: Claim, loop: Loop, exact: bool, rest: float, journal: Journal, last: str, solver: str, pool: Executor | None
) -> tuple[dict[str, Any], float] | None:
    """The record of the goal or the catch, the `last` of the two, and the outlet's level; from the journal if it has
    them.
    """
    for line in journal.lines:
        if last in line:
            return line[last], line["outlet"]
    if claim.catch is None:
        region = goal_region(claim, loop, exact, rest, solver, pool)
        record = None if region is None else _goal_record(region)
    else:
        region = caught_end(claim, loop, exact, solver, pool)
        record = None if region is None else catch_end_record(region.order, region.cases)
    if region is None or record is None:
        return None
    journal.append({last: record, "outlet": region.outlet})
    return record, region.outlet


def _shaped(loop: Loop, journal: Journal) -> Loop:
    """The loop with the value function that is optimized with the funnel, from the journal if it has one."""
    for line in journal.lines:
        if "values" in line:
            return loop.shaped(np.array(line["values"]), np.array(line["slopes"]))
    loop = largest(loop)
    journal.append({"values": loop.values.tolist(), "slopes": loop.slopes.tolist()})
    return loop


def largest(loop: Loop) -> Loop:
    """The loop with a value function whose funnel is larger, its level about 1; the same loop if it has no funnel."""
    directions = unit_directions(loop.n)[:, ::COARSER]
    try:
        funnel = leveled(loop, directions)
    except Refused:
        return loop
    return joint.enlarged(funnel, directions) if loop.n == 2 else backward.grown(funnel, directions)


def _resumed(proof: BackwardProof, claim: Claim, outlet: float, journal: Journal) -> ProofState:
    """The state at which the journal ends."""
    state = proof.outlet(outlet)
    for line in journal.lines:
        if "stretch" in line:
            interval = check.read_interval(Node("journal", line["stretch"]), claim)
            state = proof.after(Proved(interval, line["rho"], line["spare"], line["margin"]))
    return state


def _interval_record(interval: check.Interval) -> dict[str, Any]:
    return with_digests(
        {
            "knot": interval.knot,
            "start": double(interval.start),
            "end": double(interval.end),
            "first": matrix_record(interval.first),
            "last": matrix_record(interval.last),
            "bend": [matrix_record(each) for each in interval.bend],
            "orders": list(interval.orders),
            "cases": _cases_record(interval.cases),
            **({"late": matrix_record(interval.late)} if interval.late else {}),
            **_sides_record(interval.sides),
        }
    )


def _goal_record(region: GoalRegion) -> dict[str, Any]:
    """The weight of the S-lemma lies between those that the two scaled copies of one ellipsoid allow."""
    determinant = float(np.linalg.det(np.array([[float(c) for c in row] for row in region.axes])))
    weight = determinant**2 * (1 + region.outlet / region.rho - region.off**2) / 2
    shells = [
        with_digests({"start": double(s.start), "end": double(s.end), "cases": _cases_record(s.cases)})
        for s in region.shells
    ]
    record = {"axes": matrix_record(region.axes), "order": region.order, "weight": double(weight)}
    late = {"late": [double(c) for c in region.late]} if region.late else {}
    others = {**late, **_sides_record(region.sides)}
    return with_digests({**record, "rest": double(region.rest), "shells": shells, **others})


def catch_end_record(order: int, cases: Mapping[str, Squares]) -> dict[str, Any]:
    return with_digests({"order": order, "cases": _cases_record(cases)})


def _sides_record(sides: list) -> dict[str, Any]:
    return {"sides": [matrix_record(each) for each in sides]} if sides else {}


def _cases_record(cases: Mapping[str, Squares]) -> dict[str, Any]:
    return {case: _squares_record(squares) for case, squares in cases.items()}


def _squares_record(squares: Squares) -> Any:
    if isinstance(squares, Halves):
        return [_squares_record(half) for half in squares]
    return {
        "degree": squares.degree,
        "gram": [_triangle(matrix) for matrix in squares.gram],
        "multipliers": [[_triangle(matrix) for matrix in each] for each in squares.multipliers],
        **({"further": [list(each) for each in squares.further]} if squares.further else {}),
    }


def _triangle(matrix: list[list]) -> list[str]:
    """Without the zeros that end most numbers on the grid: these are most of a file."""
    return [ENDING_ZEROS.sub("p", double(float(c))) for i, row in enumerate(matrix) for c in row[i:]]
