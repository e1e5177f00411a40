"""`rtcd verify`: all chunks of a run's trials on all cores; a stopped one goes on from its journals."""

import functools
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import asdict, fields
from pathlib import Path
from typing import NamedTuple, final

import numpy as np

from rtcd_jax.analysis.verify.verification import Trial, Verification
from rtcd_jax.elite.closed_loop import Outcome
from rtcd_jax.elite.elite import Elite, NoFunnel
from rtcd_jax.elite.records import INITIAL, elite_digests, require_elites
from rtcd_jax.system.console import Clock, Console, Progress, table
from rtcd_jax.system.files import make_folder, plain, replace_json
from rtcd_jax.system.journal import Journal
from rtcd_jax.system.processes import processes

FUNNELS = "000", INITIAL
"""Which funnels of a run are verified."""
KINDS = tuple(field.name for field in fields(Outcome))
"""Of failures."""


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

    Stores `verification/000.json` and `verification/initial.json`. Until then a journal beside each has the finished
    chunks, from where the same call goes on. The workers' number changes nothing. An initial candidate without a funnel
    is reported instead.

    Raises:
        UserError: no run folder, a run without elites, or a folder that cannot be read or written.
    """
    require_elites(folder)
    make_folder(folder / "verification")
    trials, journals = {}, {}
    for funnel in FUNNELS:
        try:
            trials[funnel] = _trial(folder, funnel, states, seed)
        except NoFunnel as error:
            console.message(f"{funnel}: nothing to verify, it has no funnel ({error.status})")
        else:
            journals[funnel] = _journal(folder, funnel, trials[funnel])
    jobs = [
        Job(folder, funnel, states, seed, simulator, chunk)
        for funnel, trial in trials.items()
        for simulator in trial.names
        for chunk in range(trial.chunks)
    ]
    outcomes = _outcomes(jobs, journals, workers, console)
    verifications = {}
    for funnel, trial in trials.items():
        by_chunk = {(job.simulator, job.chunk): outcomes[job] for job in jobs if job.funnel == funnel}
        verifications[funnel] = trial.verification(by_chunk)
        replace_json(folder / "verification" / f"{funnel}.json", verifications[funnel].record())
    for journal in journals.values():
        journal.close()
    if verifications:
        console.message(_table(verifications))
        console.message(f"stored: {', '.join(f'{folder}/verification/{name}.json' for name in verifications)}")
    return not any(verification.refuted for verification in verifications.values())


@functools.cache
def _trial(folder: Path, funnel: str, states: int, seed: int) -> Trial:
    return Trial(Elite.read(folder, funnel), states, seed)


def _journal(run: Path, funnel: str, trial: Trial) -> Journal:
    """Of a funnel's finished chunks; its head is all that their outcomes depend on."""
    head = {"funnel": elite_digests(run, funnel), "states": trial.states, "seed": trial.seed, "chunks": trial.chunks}
    return Journal(run / "verification" / f".{funnel}.partial.jsonl", head)


def _outcomes(
    jobs: Sequence[Job], journals: Mapping[str, Journal], workers: int, console: Console
) -> dict[Job, Outcome]:
    """Of all jobs: from the journals where they are finished, the others simulated and added there."""
    finished = {
        (funnel, line["simulator"], line["chunk"]): Outcome(**{name: np.array(line[name]) for name in KINDS})
        for funnel, journal in journals.items()
        for line in journal.lines
    }
    outcomes = {job: finished[key] for job in jobs if (key := (job.funnel, job.simulator, job.chunk)) in finished}
    clock, total = Clock(before=len(outcomes)), len(jobs)
    for job, outcome in _simulated([job for job in jobs if job not in outcomes], workers):
        journals[job.funnel].append({"simulator": job.simulator, "chunk": job.chunk, **plain(asdict(outcome))})
        outcomes[job] = outcome
        failures = sum(int(each.failed.sum()) for each in outcomes.values())
        text = f"{len(outcomes)}/{total} chunks of states  {failures} failures  {clock.times(len(outcomes), total)}"
        console.progress(Progress(len(outcomes), total, text))
    return outcomes


def _simulated(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Job, Outcome]]:
    """The jobs with their outcomes, as they come; in this process if there is nothing to share out."""
    if min(workers, len(jobs)) <= 1:
        yield from ((job, _simulate(job)) for job in jobs)
        return
    with processes(min(workers, len(jobs))) as pool:
        waiting = {pool.submit(_simulate, job): job for job in jobs}
        for future in as_completed(waiting):
            yield waiting[future], future.result()


def _simulate(job: Job) -> Outcome:
    return _trial(job.run, job.funnel, job.states, job.seed).outcome(job.simulator, job.chunk)


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
