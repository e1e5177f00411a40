"""A whole run: config -> search -> elites evaluated again -> run folder. Stops and resumes at any generation."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax.config.load import Config
from rtcd_jax.config.schema import REFINABLE, REFINEMENT_STEPS
from rtcd_jax.elite.records import TASKS, Record, elite_names, read_generations, resets_in_words
from rtcd_jax.evaluation import device_chunk, elite_budget, elite_key, make_evaluate
from rtcd_jax.genome import genome_of_task, initial_genome
from rtcd_jax.problem import Problem, make_problem
from rtcd_jax.refinement import Refinement
from rtcd_jax.reset import closed
from rtcd_jax.run import live
from rtcd_jax.run.folder import RunFolder
from rtcd_jax.run.format import arrays_of, common_arrays, common_record, record_of
from rtcd_jax.run.reevaluation import Reevaluation, Reported, parts_of, physics_line, row
from rtcd_jax.run.refine import PARTIAL, PartialState, refine_elites
from rtcd_jax.run.sharding import Sharded, ShardedEvaluate
from rtcd_jax.run.tasks import store_task
from rtcd_jax.search import search
from rtcd_jax.search.archive import Elites, cost, shortfall
from rtcd_jax.system.cluster import Cluster, Preempted
from rtcd_jax.system.console import Clock, Console, Progress, times
from rtcd_jax.system.errors import UserError
from rtcd_jax.types import Status, TaskEvaluations

LAST_FILE = Path("initial.json")
"""Written when all else is: a folder that has it is complete."""


def optimize(config: Config, folder: Path, console: Console, cluster: Cluster, log: live.Kind | None = None) -> bool:
    """Search as `config` says and leave everything in the run folder; goes on where an earlier call stopped.

    Says whether anything was left to do. `log` shows the generations elsewhere, too, while it runs.

    Raises:
        UserError: the folder belongs to something else, or nothing at all is feasible.
        Preempted: the system asked to stop; the folder has all that was done.
    """
    problem = make_problem(config)
    share = -(-config.search.population // len(cluster.devices))
    chunk = device_chunk(problem, share, cluster.memory)
    evaluate = ShardedEvaluate(make_evaluate(problem), cluster, chunk)
    first, tasks = tuple(initial_genome(problem).tolist()), tuple(config.tasks if problem.tasks else ())
    plan = search.Plan(config.search, config.elites, first, problem.design_dims, tasks)
    example = evaluate.example(len(problem.free))
    with RunFolder.open(folder, config, cluster) as run:
        begun = run.restore(search.start(plan, example))
        for note in run.notes:
            console.message(note)
        done = int(begun.generation)
        best = _best_so_far(folder, done, cluster)
        over = done == config.search.generations or search.settled(config.search, best)
        whole = bool(cluster.agreed(np.asarray((folder / LAST_FILE).is_file())))
        if over and whole:
            console.message(f"{folder} is complete: {done} generations, {len(elite_names(folder))} elites")
            return False
        if done:
            console.message(f"{folder}: going on after generation {done}")
        console.message(
            f"compiling the evaluation of {config.search.population} candidates on {cluster}: a minute or so"
        )
        again = Reevaluation(problem, cluster, example, console)
        state, pace = begun, _Pace(config)
        generation = None
        with live.log(log if cluster.first else None, folder) as show:
            try:
                steps = search.run(plan, evaluate, begun, best)
                for state, generation in iter(partial(cluster.interruptible, partial(next, steps, None)), None):
                    line = generation.record()
                    run.append(line)
                    show(line)
                    run.save_if_due(state, int(state.generation))
                    console.progress(pace.progress(generation))
                    cluster.raise_if_preempted(int(state.generation))
            except Preempted:
                run.save(state, int(state.generation))
                raise
            except search.NothingFeasible as error:
                raise UserError("\n".join([str(error), *_open_cycle(problem, evaluate, generation)])) from error
        run.save(state, int(state.generation))
        if int(state.generation) < config.search.generations:
            console.message(f"no gain of {search.GAIN:.1%} in {config.search.patience} generations: the search is over")
        initial = cluster.interruptible(partial(_initial, problem, evaluate))
        *sampled, initial = again.sample([*_filled(state.elites), initial])
        best_first = _filled(search.finish(plan, state, _stacked(sampled, state.elites)))
        if not best_first:
            resets = resets_in_words(common_record(problem, sampled[0])) if problem.tasks else ()
            text = (
                "none of the elites kept a funnel under more samples: raise funnel.directions or funnel.trials, "
                "so that the search is not misled by luck"
            )
            raise UserError("\n".join([text, *resets]))
        refinements: Sequence[Record | None] = [None] * len(best_first)
        partial_state = PartialState(folder / PARTIAL, config.checkpoint.seconds, cluster)
        if config.search.refine:
            refinement = Refinement(problem, REFINEMENT_STEPS)
            console.message(f"refining {len(best_first)} elites: compiling takes a minute or so")
            pairs = refine_elites(refinement, best_first, REFINABLE, again, console, partial_state)
            by_volume = sorted(pairs, key=lambda pair: float(cost(pair[0], config.search)))
            best_first, refinements = zip(*by_volume, strict=True)
        of_tasks = zip(*map(parts_of, (*best_first, initial)), strict=True)
        reports = [again.report(elites, last) for *elites, last in of_tasks]
        if problem.tasks:
            cluster.on_first(lambda: _store_several(problem, best_first, initial, reports, run, console))
        else:
            ((elites, reported),) = reports
            elites = [each._replace(refinement=record) for each, record in zip(elites, refinements, strict=True)]
            cluster.on_first(lambda: _store(problem, elites, reported, run, console))
        partial_state.close()
        return True


def _best_so_far(folder: Path, done: int, cluster: Cluster) -> list[float]:
    """The best volume after each of the generations that are done, as process 0 reads it; NaN where there is none."""
    best = np.full(done, math.nan)
    for line in read_generations(folder) if cluster.first else ():
        if line["best_so_far"] is not None and line["index"] < done:
            best[line["index"]] = line["best_so_far"]
    return cluster.agreed(best).tolist()


class _Pace:
    """How fast this process' generations are; the first one compiles and says little about the others."""

    def __init__(self, config: Config):
        self._population, self._generations = config.search.population, config.search.generations
        self._clock = Clock()
        self._ends: list[float] = []

    def progress(self, generation: search.Generation) -> Progress:
        """What is known at a generation's end; volumes are sampled, NaN where there is none."""
        self._ends.append(self._clock.elapsed)
        done, later = generation.index + 1, len(self._ends) - 1
        seconds = (self._ends[-1] - self._ends[0]) / later if later else math.nan
        parts = [
            f"generation {done:{len(str(self._generations))}d}/{self._generations}",
            f"best {_volume(generation.best_so_far)} (sampled)",
            f"median {_volume(generation.median)}",
            f"feasible {generation.feasible:4.0%}",
            f"{self._population / seconds:.3g} candidates/s" if later else "compiled",
            times(self._ends[-1], (self._generations - done) * seconds),
        ]
        failures = [f"{count} {name.lower()}" for name, count in generation.counts.items() if name != Status.OK.name]
        text = "  ".join([*parts, f"failed: {', '.join(failures)}"] if failures else parts)
        return Progress(done, self._generations, text)


def _volume(value: float) -> str:
    return "none" if math.isnan(value) else f"{value:.5g}"


def _filled(elites: Elites) -> list[Any]:
    records = jax.device_get(elites.evaluation)
    return [row(records, k) for k in range(int(elites.count))]


def _stacked(evaluations: list[Any], elites: Elites) -> Any:
    """As many records as the archive has slots; what stands in the empty ones does not matter."""
    rows = [*evaluations, *evaluations[-1:] * (len(elites.costs) - len(evaluations))]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *rows)


def _initial(problem: Problem, evaluate: Callable[..., Sharded]) -> Any:
    genome = np.asarray(initial_genome(problem))
    return row(evaluate(genome[None], jax.random.key(0)).take(np.array([0])), 0)


def _open_cycle(problem: Problem, evaluate: ShardedEvaluate, last: search.Generation | None) -> Iterator[str]:
    """Of a cycle that no candidate closed: where the resets of the one that is nearest to it lead, among those of the
    last generation that have a funnel on every task; nothing where there is none.
    """
    if problem.reset is None or last is None:
        return
    funnels = np.all([task["statuses"] == Status.OK for task in last.tasks.values()], 0)
    if not funnels.any():
        return
    again: Any = evaluate(last.genomes[funnels], elite_key()).take(np.arange(funnels.sum()))
    nearest = row(again, int(np.argmin(np.max(again.after_reset, -1))))
    states = closed(problem, jax.tree.map(jnp.asarray, nearest), elite_key(), elite_budget(problem).samples_per_knot)
    yield "nearest to a closed cycle:"
    yield from resets_in_words(common_record(problem, jax.device_get(states)))


def _store(problem: Problem, elites: Sequence[Reported], initial: Reported, run: RunFolder, console: Console) -> None:
    """Elites and initial candidate in the run folder, a summary on the console."""
    run.write_elites((arrays_of(problem, elite.evaluation), record_of(problem, *elite)) for elite in elites)
    run.tell_time()
    run.write_initial(arrays_of(problem, initial.evaluation), record_of(problem, *initial))
    _tell(problem, elites, initial, console)
    console.message(f"{len(elites)} elites in {run.path}")


def _store_several(
    problem: Problem, elites: Sequence[TaskEvaluations], initial: TaskEvaluations,
    reports: Sequence[tuple[Sequence[Reported], Reported]], run: RunFolder, console: Console,
) -> None:  # fmt: skip
    """Every task's elites and initial candidate in a folder of its own, what they have in common in the run folder."""
    run.tell_time()
    for name, alone, (of_task, first) in zip(problem.config.tasks, problem.tasks, reports, strict=True):
        own = partial(genome_of_task, problem, name)
        console.message(f"task {name}:")
        _tell(alone, of_task, first, console)
        stored = []
        for each in (*of_task, first):
            evaluation = replace(each.evaluation, genome=own(np.asarray(each.evaluation.genome)))
            record = record_of(alone, *each._replace(evaluation=evaluation))
            stored.append((arrays_of(alone, evaluation), record))
        store_task(run.path, name, alone.config, own, stored[:-1], stored[-1])
    run.write_elites((common_arrays(each), common_record(problem, each)) for each in elites)
    run.write_initial(common_arrays(initial), common_record(problem, initial))
    for line in _over_tasks(problem, initial, elites[0]):
        console.message(line)
    console.message(f"{len(elites)} elites in {run.path}, and each task's in a folder of {run.path / TASKS}")


def _over_tasks(problem: Problem, initial: TaskEvaluations, best: TaskEvaluations) -> Iterator[str]:
    """The searched volume of the initial and the best candidate on every task and over them."""
    search = problem.config.search
    yield f"{f'{search.objective} (sampled)':24}{'initial':>12}{'best':>12}{'ratio':>9}"
    each = [evaluation.tasks.volumes[search.objective] for evaluation in (initial, best)]
    rows = list(zip(problem.config.tasks, *each, strict=True))
    rows.append((search.over_tasks, *(evaluation.volumes[search.objective] for evaluation in (initial, best))))
    for name, first, last in rows:
        ratio = f"{last / first:9.2f}" if first > 0 else f"{'-':>9}"
        yield f"{name:24}{float(first):12.5g}{float(last):12.5g}{ratio}"
    yield from resets_in_words(common_record(problem, best))


def _tell(problem: Problem, elites: Sequence[Reported], initial: Reported, console: Console) -> None:
    for line in summary(problem, initial, elites[0]):
        console.message(line)
    if compared := [reported.physics for reported in (*elites, initial) if reported.physics is not None]:
        console.message(physics_line(compared))


def summary(problem: Problem, initial: Reported, best: Reported) -> Iterator[str]:
    """The volumes of the initial and the best candidate with their spreads and ratios, and what the best one is."""
    before, after = record_of(problem, *initial), record_of(problem, *best)
    yield f"{'volume (sampled)':18}{'initial':>12}{'spread':>9}{'best':>12}{'spread':>9}{'ratio':>9}"
    for name in best.evaluation.volumes.named:
        cells = [f"{name:18}"]
        for record in (before, after):
            spread = record["spread"]["volumes"][name] if record["spread"] else None
            cells.append(f"{record['volumes'][name]:12.5g}{'-' if spread is None else f'{spread:.1%}':>9}")
        first, last = before["volumes"][name], after["volumes"][name]
        cells.append(f"{last / first:9.2f}" if first > 0 else f"{'-':>9}")
        yield "".join(cells)
    if float(shortfall(best.evaluation, problem.config.search)) > 0:
        wanted = ", ".join(f"{name} {least:g}" for name, least in problem.config.search.at_least.items())
        yield f"no candidate has what search.at_least demands ({wanted}); the best lacks least of it"
    if before["status"] != Status.OK.name:
        yield f"the initial candidate has no funnel: {Status[before['status']].message}"
    promise = f"probability <= {after['epsilon']:.2g} (confidence {after['confidence']:g})"
    yield f"best: a state uniform in any of its ellipsoids fails to arrive with {promise}"
    push, unit = after["push"], f"{problem.plant.input_units[0]} s"
    yield f"best: x*(t) and an impulse of up to {push['margin']:.3g} {unit} at any knot are in its funnel"
    yield f"all funnels bear: {problem.config.uncertainty.in_words(problem.config.plant)}"
    design = ", ".join(
        f"{name} {after['design'][name]:.4g} {unit}" for name, unit in problem.plant.design_units.items()
    )
    weights = ", ".join(f"{value:.4g}" for value in (*after["weights"]["q"], *after["weights"]["r"]))
    options = best.evaluation.candidate.policy
    searched = "".join(f"; {name} {float(value):.4g}" for name, value in options.items())
    yield f"best: {design}; diagonals of Q and R: {weights}{searched}"
