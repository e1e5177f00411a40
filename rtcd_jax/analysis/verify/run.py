"""`rtcd verify`: all chunks of a run's trials on all cores; what is done is kept, so that a stopped one goes on."""

import contextlib
import functools
import hashlib
import io
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple, final

import numpy as np

from rtcd_jax.analysis.verify.verification import Trial, Verification
from rtcd_jax.elite.closed_loop import Outcome
from rtcd_jax.elite.elite import Elite, NoFunnel
from rtcd_jax.elite.records import INITIAL, elite_folder, require_elites
from rtcd_jax.system.console import Clock, Console, Progress, table
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder, reading, replace, replace_json, writing
from rtcd_jax.system.processes import processes

FUNNELS = "000", INITIAL
"""Which funnels of a run are verified."""


@final
class Job(NamedTuple):
    """One chunk of a funnel's held-out states, for one simulator."""

    run: Path
    funnel: str
    states: int
    seed: int
    simulator: str
    chunk: int


def verify_run(folder: Path, states: int, seed: int, workers: int, console: Console) -> bool:
    """Verifies a run's best elite and its initial candidate; True if no promise was refuted.

    Stores `verification/000.json` and `verification/initial.json`, and until then every finished chunk in
    `verification/.parts`, from where the same call goes on. The workers' number changes nothing. An initial candidate
    without a funnel is reported instead.

    Raises:
        UserError: no run folder, a run without elites, or a folder that cannot be read or written.
    """
    require_elites(folder)
    parts = folder / "verification" / ".parts"
    make_folder(parts)
    trials = {}
    for funnel in FUNNELS:
        try:
            trials[funnel] = _trial(folder, funnel, states, seed)
        except NoFunnel as error:
            console.message(f"{funnel}: nothing to verify, it has no funnel ({error.status})")
    jobs = [
        Job(folder, funnel, states, seed, simulator, chunk)
        for funnel, trial in trials.items()
        for simulator in trial.names
        for chunk in range(trial.chunks)
    ]
    outcomes = _outcomes(jobs, parts, workers, console)
    verifications = {}
    for funnel, trial in trials.items():
        found = {(job.simulator, job.chunk): seen for job, seen in outcomes.items() if job.funnel == funnel}
        verifications[funnel] = trial.verification(found)
        replace_json(folder / "verification" / f"{funnel}.json", verifications[funnel].record())
    with writing(parts):
        for part in parts.iterdir():
            part.unlink()
        parts.rmdir()
    if verifications:
        console.message(_table(verifications))
        console.message(f"stored: {', '.join(f'{folder}/verification/{name}.json' for name in verifications)}")
    return not any(verification.refuted for verification in verifications.values())


@functools.cache
def _trial(folder: Path, funnel: str, states: int, seed: int) -> Trial:
    return Trial(Elite.read(folder, funnel), states, seed)


def _outcomes(jobs: Sequence[Job], parts: Path, workers: int, console: Console) -> dict[Job, Outcome]:
    """Of all jobs, those that are kept already read, the others done and kept."""
    found = {job: seen for job in jobs if (seen := _kept(_part(parts, job))) is not None}
    clock, total = Clock(before=len(found)), len(jobs)
    for job, seen in _done([job for job in jobs if job not in found], workers):
        _keep(_part(parts, job), seen)
        found[job] = seen
        failures = sum(int(each.failed.sum()) for each in found.values())
        text = f"{len(found)}/{total} chunks of states  {failures} failures  {clock.times(len(found), total)}"
        console.progress(Progress(len(found), total, text))
    return {job: found[job] for job in jobs}


def _done(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, Outcome]]:
    """The jobs with their outcomes, as they come; in this process if there is nothing to share out."""
    if min(workers, len(jobs)) <= 1:
        yield from ((job, _do(job)) for job in jobs)
        return
    with processes(min(workers, len(jobs))) as pool:
        waiting = {pool.submit(_do, job): job for job in jobs}
        for future in as_completed(waiting):
            yield waiting[future], future.result()


def _do(job: Job) -> Outcome:
    return _trial(job.run, job.funnel, job.states, job.seed).outcome(job.simulator, job.chunk)


def _part(parts: Path, job: Job) -> Path:
    """Named by all that its contents depend on."""
    folder = elite_folder(job.run, job.funnel)
    mark = hashlib.sha256(repr(job[1:]).encode())
    for suffix in ("npz", "json"):
        mark.update((folder / f"{job.funnel}.{suffix}").read_bytes())
    return parts / f"{mark.hexdigest()[:24]}.npz"


def _keep(part: Path, outcome: Outcome) -> None:
    file = io.BytesIO()
    np.savez(file, **asdict(outcome))
    replace(part, file.getvalue())


def _kept(part: Path) -> Outcome | None:
    """None for what is not there, or is damaged: it is made again."""
    with contextlib.suppress(UserError), reading(part, "make it again"), np.load(part, allow_pickle=False) as stored:
        return Outcome(**stored)
    return None


def _table(verifications: Mapping[str, Verification]) -> str:
    headings = (
        "funnel", "simulator", "states", "left funnel", "left limits", "missed goal", "rate", "in", "promised <=", "",
    )  # fmt: skip
    rows = (_row(funnel, trial, simulator) for funnel, trial in verifications.items() for simulator in trial.outcomes)
    title = "random states of the funnels (promise: sampled); refuted where the interval lies above the promise"
    return table(headings, rows, title, left={"funnel", "simulator", ""})


def _row(funnel: str, verification: Verification, simulator: str) -> list[str]:
    outcome, states = verification.outcomes[simulator], len(verification.knots)
    lower, upper = verification.interval(simulator)
    return [
        funnel,
        simulator,
        f"{states}",
        f"{outcome.left_funnel.sum()}",
        f"{outcome.left_limits.sum()}",
        f"{outcome.missed_goal.sum()}",
        f"{verification.failures(simulator) / states:.2g}",
        f"[{lower:.2g}, {upper:.2g}]",
        f"{verification.epsilon:.2g} ({verification.confidence:g})",
        "REFUTED" if verification.refutes(simulator) else "not refuted",
    ]
