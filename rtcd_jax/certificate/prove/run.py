"""`rtcd certify`: elites of a run folder in parallel processes, one line of progress, a table at the end."""

import contextlib
import os
import queue
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, cast

from scipy.stats import spearmanr

from rtcd_jax.certificate.prove.backward import TIERS
from rtcd_jax.certificate.prove.certify import Outcome, Step, certify_elite
from rtcd_jax.certificate.prove.closed_loop import claim_of
from rtcd_jax.certificate.prove.sdp import SOLVER, require_solver
from rtcd_jax.certificate.prove.uncertainty import bounds_of, uncertainty_of
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import require_elites
from rtcd_jax.system.console import Clock, Console, Progress, table
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder, read_json, replace_json
from rtcd_jax.system.processes import CONTEXT, processes

POLL = 0.2
"""Seconds between looks at the workers' progress."""
RANKED = 3
"""Elites from which on a rank correlation says something."""


def certify_run(
    folder: Path,
    elites: int,
    guarantee: str,
    workers: int,
    console: Console,
    optimize_value: bool = False,
    uncertainty: Path | None = None,
    solver: str = SOLVER,
) -> bool:
    """Certificates of a run's best elites; True if every funnel was shown from t = 0 to the goal.

    Stores `certificates/NNN.json` and `certificates/summary.json`. What was finished before a kill is not done again.

    Raises:
        UserError: no run folder, a run without elites, an elite that cannot be read or is of a plant that the checker
            does not know, a solver that is not there, or a folder that cannot be written.
    """
    if solver != SOLVER:
        solver = require_solver(solver)
    names = require_elites(folder)[:elites]
    for name in names:  # at once, and not from a worker
        elite = Elite.read(folder, name)
        claim_of(elite, bounds_of(elite, uncertainty_of(elite, uncertainty)))
        if (n := len(elite.x_goal)) not in TIERS:
            raise UserError(f"no certificate for {n} states: proofs are for {' and '.join(map(str, TIERS))}")
    target = folder / "certificates"
    make_folder(target)
    summary = target / "summary.json"
    former = read_json(summary, "remove it, or make it again") if summary.is_file() else {}
    outcomes: dict[str, Outcome | None] = {}
    clock, reached = Clock(), dict.fromkeys(names, 0.0)
    for event in _events(folder, names, workers, (guarantee, optimize_value, uncertainty, solver)):
        if isinstance(event, Step):
            reached[event.elite] = 1 - event.knot / event.knots
            done = sum(reached.values())
            text = (
                f"elite {event.elite}  interval {event.knot + 1}/{event.knots}  back to t = {event.time:.3f} s"
                f"  rho {event.rho:.4g}  margin {event.margin:.2g}/s  {clock.times(done, len(names))}"
            )
            console.progress(Progress(done, len(names), text))
        else:
            outcomes[event[0]] = event[1]
    replace_json(summary, former | {name: _summary(outcomes[name]) for name in names})
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
            console.message(f"{name}: no goal region can be shown at any level that was tried")
    for outcome in finished:
        file = target / f"{outcome.elite}.json"
        console.message(f"stored: {file}; `rtcd check {file}` checks it")
    return all(outcome is not None and outcome.whole for outcome in outcomes.values())


def _events(
    folder: Path, names: Sequence[str], workers: int, how: tuple[str, bool, Path | None, str]
) -> Iterator[Step | tuple[str, Outcome | None]]:
    """Steps of all elites as they come, and every elite's outcome by its name."""
    # One thread each: there is a worker for every core, and small matrices in many threads cost ten times as much.
    for library in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(library, "1")
    steps = CONTEXT.Queue()
    with processes(min(workers, len(names)), _remember, steps) as pool:
        waiting: dict[Future, str] = {pool.submit(_work, folder, name, *how): name for name in names}
        while waiting:
            with contextlib.suppress(queue.Empty):
                yield steps.get(timeout=POLL)
            for future in [future for future in waiting if future.done()]:
                yield waiting.pop(future), future.result()


_steps: Any = None


def _remember(steps: Any) -> None:
    """In a worker: where its progress goes."""
    global _steps
    _steps = steps


def _work(folder: Path, name: str, guarantee: str, *how: Any) -> Outcome | None:
    return certify_elite(folder, name, guarantee, _steps.put, *how)


def rank_correlation(outcomes: Sequence[Outcome]) -> float:
    """Spearman's, between the sampled and the shown sums of volumes: 1 if the proof would rank the elites the same."""
    sums = [[outcome.sampled["sum"], outcome.volumes["sum"]] for outcome in outcomes]
    return float(cast(Any, spearmanr(sums)).statistic)


def _summary(outcome: Outcome | None) -> dict[str, Any] | None:
    """An outcome as `summary.json` has it: the certificate's volumes under `found`."""
    if outcome is None:
        return None
    names = {"volumes": "found"}
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
                f"{outcome.seconds:.1f}",
                pairs["inlet"],
                pairs["sum"],
                f"{outcome.volumes['sum'] / sampled:.4f}" if sampled else "none",
                pairs["integral"],
                pairs["goal"],
            ]
        )
    return table(headings, rows, title, left={"elite"})
