"""Gains and shapes of a run's elites refined by gradients: `search.refine` at the end of a search, or `rtcd refine`.

What a refinement finds is an elite like any other, in `elites/`, sorted among the others by the elites' own estimator
under the same random numbers. It takes the place of the elite that it began with only where the run's objective grew by
that estimator. What `rtcd refine` replaces stays in `unrefined/`.
"""

import dataclasses
import hashlib
import io
import shutil
import time
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax.config.schema import SearchConfig
from rtcd_jax.elite.records import (
    Arrays,
    Record,
    read_config,
    read_elite,
    require_elites,
    require_held_goal,
    task_of,
    write_elite,
)
from rtcd_jax.numerics.loops import on_gpu
from rtcd_jax.problem import Problem, make_problem
from rtcd_jax.refinement import AGREEMENT, Refinement, State
from rtcd_jax.run.folder import locked
from rtcd_jax.run.format import arrays_of, evaluation_of, record_of
from rtcd_jax.run.reevaluation import Reevaluation, Reported, row
from rtcd_jax.search.archive import cost
from rtcd_jax.system.cluster import Cluster
from rtcd_jax.system.console import Clock, Console, Progress, table
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder, replace, writing
from rtcd_jax.types import Evaluation, Policy, Status
from rtcd_jax.volume import OTHERS, VOLUMES, Knots

PARTIAL = ".refinement.npz"
"""In the run folder, until the elites are written: where a refinement goes on after a kill."""
LINES = 20
"""Of progress."""
MEASUREMENTS = 10
"""Of the refined levels, which differ in their instants: the mean of their logarithms counts."""

Refinements = Sequence[tuple[Evaluation, Record | None]]
"""Elites, those that were refined with the record of how."""


def refine_run(folder: Path, elites: int, free: tuple[str, ...], steps: int, console: Console) -> bool:
    """Refines the best elites of a run and sorts all of them anew; says whether any became better.

    Goes on where an earlier call with the same arguments was stopped.

    Raises:
        UserError: no run folder, a run without elites or one that is in use, a run for several tasks or for no volume,
            one whose motions end in a catch set, or files that cannot be read or written.
    """
    config = read_config(folder)
    require_held_goal(folder, "refine")
    if len(config.tasks) > 1 or task_of(folder):
        raise UserError(f"{folder} is for several tasks: an elite is refined for one, and would lose its place in them")
    if config.search.objective in OTHERS:
        raise UserError(f"{folder} searched for {config.search.objective}: a refinement goes up a volume of the funnel")
    with locked(folder):
        _finish_exchange(folder)
        stored = {name: read_elite(folder / "elites", name) for name in require_elites(folder)}
        problem = make_problem(config)
        names = list(stored)[:elites]
        begun = [evaluation_of(problem, *stored[name]) for name in names]
        cluster, refinement = Cluster.of(), Refinement(problem, steps)
        console.message(
            f"{folder}: refining {' and '.join(free)} of {len(names)} elites: compiling takes a minute or so"
        )
        again = Reevaluation(problem, cluster, jax.tree.map(lambda leaf: np.asarray(leaf)[None], begun[0]), console)
        partial_state = PartialState(folder / PARTIAL, config.checkpoint.seconds, cluster)
        results = refine_elites(refinement, begun, free, again, console, partial_state)
        better = {name: result for name, result in zip(names, results, strict=True) if result[1] is not None}
        if better:
            _exchange(folder, _sorted(problem, stored, better, again))
            console.message(f"stored in {folder / 'elites'}, best first; what they were is in {folder / 'unrefined'}")
        partial_state.close()
    return bool(better)


def refine_elites(
    refinement: Refinement, elites: Sequence[Evaluation], free: Sequence[str], again: Reevaluation, console: Console,
    partial_state: "PartialState",
) -> Refinements:  # fmt: skip
    """Of every elite the better one of itself and its refinement, in the elites' order.

    Raises Preempted; the latest steps are saved then.
    """
    search = refinement.problem.config.search
    objective = search.objective
    found = _refined(refinement, elites, free, again, console, partial_state)
    sampled = again.sample([_with_policy(e, each.policy) for e, each in zip(elites, found, strict=True)])
    results: list[tuple[Evaluation, Record | None]] = []
    rows = []
    for k, (before, after, levels) in enumerate(zip(elites, sampled, found, strict=True)):
        failure = _failure(search, before, after, levels)
        volumes = (before.volumes[objective], after.volumes[objective], levels.by_levels, levels.by_march)
        rows.append([str(k), *(f"{float(volume):.4g}" for volume in volumes), failure or "kept"])
        record = {
            "free": list(free),
            "steps": refinement.steps,
            "before": dict(before.volumes.named),
            "levels": {"refined": levels.by_levels, "independent": levels.by_march},
        }
        results.append((before, None) if failure else (after, record))
    headings = ("elite", "before", "refined", "by its levels", "by independent ones", "")
    console.message(table(headings, rows, f"{objective}: sampled, and by the levels of V", left={""}))
    return results


@final
class Found(NamedTuple):
    """A refined policy, and the objective by the levels that were refined and by independent ones."""

    policy: Policy
    by_levels: float
    by_march: float


def _failure(search: SearchConfig, before: Evaluation, after: Evaluation, levels: Found) -> str:
    """Why a refinement does not count; empty if it does."""
    if int(after.status) != Status.OK:
        return Status(int(after.status)).message
    if not cost(after, search) < cost(before, search):
        return "no larger than it was"
    if not abs(levels.by_levels - levels.by_march) <= AGREEMENT * levels.by_march:
        return f"its levels and independent ones differ by more than {AGREEMENT:.0%}"
    return ""


def _refined(
    refinement: Refinement, elites: Sequence[Evaluation], free: Sequence[str], again: Reevaluation, console: Console,
    partial_state: "PartialState",
) -> list[Found]:  # fmt: skip
    """All steps, for all elites at once on a GPU, one after another on a CPU."""
    objective, total = refinement.problem.config.search.objective, refinement.total
    stacked = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *elites)
    policies = stacked.funnel.policy
    over = partial(_over, len(elites) if on_gpu() else 1)
    starts = over(partial(refinement.start, free=free))(stacked.candidate, policies)
    states, done = partial_state.restore(over(refinement.begin)(starts), (starts, total))
    step = over(refinement.step, 1)

    def objectives(knots: Knots) -> list[float]:
        host = jax.device_get(knots)
        return [float(VOLUMES[objective].of(row(host, k))) for k in range(len(elites))]

    clock = Clock(done)
    for index in range(done, total):
        states, estimates = jax.block_until_ready(step(starts, states, index))
        partial_state.save_if_due(states, index + 1)
        again.raise_if_preempted()
        if (index + 1) % -(-total // LINES) == 0:
            uncertain = refinement.problem.uncertainty is not None
            borne = f"  under {float(np.min(estimates.box)):4.0%} of the uncertainty" if uncertain else ""
            volumes = ", ".join(f"{value:.4g}" for value in objectives(estimates.knots))
            text = f"refining: step {index + 1}/{total}{borne}  {objective} {volumes} (by levels)"
            console.progress(Progress(index + 1, total, f"{text}  {clock.times(index + 1, total)}"))
    partial_state.save(states, total)
    measured = []
    for index in range(total, total + MEASUREMENTS):  # nothing moves any more but the instants
        states, estimates = step(starts, states, index)
        measured.append(np.log(objectives(estimates.knots)))
    marched = objectives(over(refinement.marched, 1)(starts, states, jax.random.key(0)))
    refined = jax.device_get(over(refinement.policy)(policies, starts, states))
    by_levels = np.exp(np.mean(measured, 0)).tolist()
    return [Found(row(refined, k), *both) for k, both in enumerate(zip(by_levels, marched, strict=True))]


def _over(batch: int, function: Callable, shared: int = 0) -> Callable:
    """`function` over the leading axis of all arguments but the last `shared` ones, so many rows at a time, jitted."""

    def mapped(*arguments: Any) -> Any:
        own, common = arguments[: len(arguments) - shared], arguments[len(arguments) - shared :]
        return jax.lax.map(lambda each: function(*each, *common), own, batch_size=batch)

    return jax.jit(mapped)


@final
class PartialState:
    """The state of a refinement on disk, every few seconds; what process 0 reads is everybody's."""

    def __init__(self, path: Path, seconds: float, cluster: Cluster):
        self._path, self._seconds, self._cluster = path, seconds, cluster
        self._saved, self._mark = time.monotonic(), ""

    def restore(self, states: State, task: Any) -> tuple[State, int]:
        """The stored state and how many steps it is after, if it is of the same task (arrays); else `states` and 0."""
        leaves, structure = jax.tree.flatten(jax.device_get(states))
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(jax.device_get(task)):
            digest.update(np.asarray(leaf).tobytes())
        self._mark = digest.hexdigest()
        stored = self._cluster.agreed(self._read(leaves) if self._cluster.first else (0, leaves))
        return jax.tree.unflatten(structure, list(map(jnp.asarray, stored[1]))), int(stored[0])

    def _read(self, leaves: list[np.ndarray]) -> tuple[int, list[np.ndarray]]:
        try:
            with self._path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                if str(stored["mark"]) == self._mark:
                    return int(stored["done"]), [stored[f"leaf{k}"] for k in range(len(leaves))]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            pass  # none, or a damaged one: from the beginning
        return 0, leaves

    def save_if_due(self, states: State, done: int) -> None:
        if time.monotonic() - self._saved >= self._seconds:
            self.save(states, done)

    def save(self, states: State, done: int) -> None:
        """Keeps the states after so many steps."""
        if self._cluster.first:
            leaves = {f"leaf{k}": leaf for k, leaf in enumerate(jax.tree.leaves(jax.device_get(states)))}
            file = io.BytesIO()
            np.savez(file, mark=self._mark, done=done, **leaves)
            replace(self._path, file.getvalue())
        self._saved = time.monotonic()

    def close(self) -> None:
        """The elites are written, and the file is gone."""
        if self._cluster.first:
            self._path.unlink(missing_ok=True)


def _sorted(problem: Problem, stored: dict, better: dict, again: Reevaluation) -> list[tuple[Arrays, Record]]:
    """All elites as they are stored, the `better` ones in the place of what they were, best first."""
    search = problem.config.search
    evaluations = {name: evaluation for name, (evaluation, _) in better.items()}
    physics = dict(zip(better, again.compared(list(evaluations.values())), strict=True))
    all_of_them = {name: evaluation_of(problem, *stored[name]) for name in stored} | evaluations
    order = sorted(stored, key=lambda name: float(cost(all_of_them[name], search)))
    records = []
    for name in order:
        if name not in better:
            records.append(stored[name])
            continue
        evaluation, refinement = better[name]
        others = again.repeated([evaluation])[0] if name == order[0] else []
        reported = Reported(evaluation, others, physics[name], refinement)
        records.append((arrays_of(problem, evaluation), record_of(problem, *reported)))
    return records


def _exchange(folder: Path, records: Sequence[tuple[Arrays, Record]]) -> None:
    """Puts the records in the place of all elites, of which the first ones ever stay in `unrefined/`."""
    staged, elites, first = (folder / name for name in (_STAGED, "elites", "unrefined"))
    make_folder(staged)
    for index, record in enumerate(records):
        write_elite(staged, f"{index:03d}", *record)
    with writing(folder):
        if first.exists():
            shutil.rmtree(elites)
        else:
            elites.rename(first)
        staged.rename(elites)


def _finish_exchange(folder: Path) -> None:
    """After a kill: elites that were staged as a whole take their place, others are removed."""
    staged, elites = folder / _STAGED, folder / "elites"
    with writing(folder):
        if staged.is_dir() and not elites.is_dir():
            staged.rename(elites)
        elif staged.is_dir():
            shutil.rmtree(staged)


_STAGED = ".elites"


def _with_policy(evaluation: Evaluation, policy: Policy) -> Evaluation:
    return dataclasses.replace(evaluation, funnel=dataclasses.replace(evaluation.funnel, policy=policy))
