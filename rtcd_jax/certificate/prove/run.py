"""`rtcd certify`: elites of a run folder in parallel processes, one line of progress, a table at the end.

Cores that are left over share out the cases of an elite's intervals.
"""

import contextlib
import math
import os
import queue
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, cast

from scipy.stats import spearmanr

from rtcd_jax.certificate.prove.backward import tiers_of
from rtcd_jax.certificate.prove.certify import Checking, Outcome, Step, certify_elite
from rtcd_jax.certificate.prove.closed_loop import claim_of
from rtcd_jax.certificate.prove.sdp import SOLVER, require_solver
from rtcd_jax.certificate.prove.uncertainty import bounds_of, uncertainty_of
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import require_elites
from rtcd_jax.system.console import Clock, Console, Progress, table, times
from rtcd_jax.system.files import in_turn, make_folder, read_json, replace_json
from rtcd_jax.system.processes import CONTEXT, processes

POLL = 0.2
"""Seconds between looks at the workers' progress."""
_ADVICE = "remove it, or make it again"
RANKED = 3
"""Elites from which on a rank correlation says something."""


class Pace:
    """How fast the elites' proofs go, from every one's first interval in this call on: regions of goals come before."""

    def __init__(self, names: Sequence[str], workers: int):
        self._workers = max(1, min(workers, len(names)))
        self._at: dict[str, tuple[float, float]] = {}
        self._since: dict[str, tuple[float, float]] = {}
        self._reached = dict.fromkeys(names, 0.0)

    @property
    def done(self) -> float:
        """Elites, and shares of them."""
        return sum(self._reached.values())

    def step(self, name: str, share: float, now: float) -> None:
        """An elite's proof has come to this share of its way back to t = 0, at this second."""
        self._since.setdefault(name, (now, share))
        self._at[name], self._reached[name] = (now, share), share

    def finish(self, name: str) -> None:
        self._reached[name] = 1.0

    @property
    def left(self) -> float:
        """Seconds until all are done; NaN before two steps of one. An elite that waits takes as long as others."""
        paces = {}
        for name, (now, share) in self._at.items():
            begun, first = self._since[name]
            if share > first:
                paces[name] = (now - begun) / (share - first)
        if not paces:
            return math.nan
        usual = sum(paces.values()) / len(paces)
        each = [(1 - share) * paces.get(name, usual) for name, share in self._reached.items()]
        return max(sum(each) / self._workers, *each)


def certify_run(
    folder: Path,
    elites: int,
    guarantee: str,
    workers: int,
    console: Console,
    optimize_value: bool = False,
    uncertainty: Path | None = None,
    solver: str = SOLVER,
    share: float = 1.0,
    only: str | None = None,
) -> bool:
    """Certificates of a run's best elites, or `only` of one; True if every funnel was shown from t = 0 to the goal.

    Stores `certificates/NNN.json` and `certificates/summary.json`. What was finished before is not done again, and
    processes on other machines may do other elites of the same run meanwhile.

    Raises:
        UserError: no run folder, a run without elites, an elite that cannot be read or is of a plant that the checker
            does not know, a solver that is not there, or a folder that cannot be written.
    """
    if solver != SOLVER:
        solver = require_solver(solver)
    names = require_elites(folder)[:elites] if only is None else [only]
    for name in names:  # at once, and not from a worker
        elite = Elite.read(folder, name)
        bounds = bounds_of(elite, uncertainty_of(elite, uncertainty))
        claim_of(elite, bounds)
        tiers_of(len(elite.x_goal), sum(low < high for low, high in bounds.parameters.values()) * bounds.moving)
    target = folder / "certificates"
    make_folder(target)
    summary = target / "summary.json"
    if summary.is_file():
        read_json(summary, _ADVICE)  # what is damaged is told before the proofs, not after them
    outcomes: dict[str, Outcome | None] = {}
    clock, pace = Clock(), Pace(names, workers)
    for event in _events(folder, names, workers, (guarantee, optimize_value, uncertainty, solver, share)):
        match event:
            case Step():
                pace.step(event.elite, 1 - (event.knot + event.fraction) / event.knots, clock.elapsed)
                text = (
                    f"elite {event.elite}  interval {event.knot + 1}/{event.knots}  back to t = {event.time:.3f} s"
                    f"  rho {event.rho:.4g}  margin {event.margin:.2g}/s  {times(clock.elapsed, pace.left)}"
                )
            case Checking():
                text = f"elite {event.elite}  checking the file, interval {event.done}/{event.of}"
            case (name, outcome):
                outcomes[name] = outcome
                pace.finish(name)
                continue
        console.progress(Progress(pace.done, len(names), text))
    with in_turn(target / ".summary.lock"):
        former = read_json(summary, _ADVICE) if summary.is_file() else {}
        replace_json(summary, former | {name: _summary(outcomes[name], former.get(name)) for name in names})
    finished = [outcome for name in names if (outcome := outcomes[name]) is not None]
    beside = "/".join(dict.fromkeys(outcome.beside for outcome in finished)) or "sampled"
    console.message(_table(finished, f"volumes: {beside} / {guarantee}"))
    if len(finished) >= RANKED:
        correlation = rank_correlation(finished)
        console.message(
            f"rank correlation of sampled and {guarantee} sums over {len(finished)} elites: {correlation:.3f}"
        )
    for name in names:
        if outcomes[name] is None:
            console.message(f"{name}: no goal region or catch can be shown at any level that was tried")
    for outcome in finished:
        file = target / f"{outcome.elite}.json"
        console.message(f"stored: {file}; `rtcd check {file}` checks it")
    return all(outcome is not None and outcome.whole for outcome in outcomes.values())


def _events(
    folder: Path, names: Sequence[str], workers: int, how: tuple[str, bool, Path | None, str, float]
) -> Iterator[Step | Checking | tuple[str, Outcome | None]]:
    """Steps of all elites as they come, and every elite's outcome by its name."""
    # One thread each: there is a worker for every core, and small matrices in many threads cost ten times as much.
    for library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(library, "1")
    steps = CONTEXT.Queue()
    count = min(workers, len(names))
    with processes(count, _remember, steps) as pool:
        waiting: dict[Future, str] = {pool.submit(_work, folder, name, workers // count, *how): name for name in names}
        while waiting:
            with contextlib.suppress(queue.Empty):
                yield steps.get(timeout=POLL)
            for future in [future for future in waiting if future.done()]:
                yield waiting.pop(future), future.result()


_steps: Any = None


def _remember(steps: Any) -> None:
    """In a worker: where its progress goes. A system that asks to stop asks all; the first process ends the others."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    global _steps
    _steps = steps


def _work(folder: Path, name: str, threads: int, guarantee: str, *how: Any) -> Outcome | None:
    return certify_elite(folder, name, guarantee, _steps.put, *how, threads=threads)


def rank_correlation(outcomes: Sequence[Outcome]) -> float:
    """Spearman's, between the sampled and the shown sums of volumes: 1 if the proof would rank the elites the same."""
    sums = [[outcome.sampled["sum"], outcome.volumes["sum"]] for outcome in outcomes]
    return float(cast(Any, spearmanr(sums)).statistic)


def _summary(outcome: Outcome | None, former: dict[str, Any] | None) -> dict[str, Any] | None:
    """An outcome as `summary.json` has it: volumes as `found`, the guarantee as `rung`, the time that it took once."""
    if outcome is None:
        return None
    if math.isnan(outcome.seconds):
        outcome = outcome._replace(seconds=float((former or {}).get("seconds") or 0.0))
    names = {"guarantee": "rung", "volumes": "found"}
    return {names.get(key, key): value for key, value in outcome._asdict().items()}


def _table(outcomes: Sequence[Outcome], title: str) -> str:
    headings = ("elite", "from, s", "intervals", "took, s", "inlet", "sum", "ratio of sums", "integral", "goal")
    rows = []
    for outcome in outcomes:
        pairs = {key: f"{value:.4g} / {outcome.volumes[key]:.4g}" for key, value in outcome.sampled.items()}
        sampled = outcome.sampled["sum"]
        rows.append(
            [
                outcome.elite,
                f"{outcome.start:.4g}",
                f"{outcome.intervals}",
                "before" if math.isnan(outcome.seconds) else f"{outcome.seconds:.1f}",
                pairs["inlet"],
                pairs["sum"],
                f"{outcome.volumes['sum'] / sampled:.4f}" if sampled else "none",
                pairs["integral"],
                pairs["goal"],
            ]
        )
    return table(headings, rows, title, left={"elite"})
