"""A whole run: config -> search -> elites evaluated again -> run folder. Stops and resumes at any generation."""

import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax import search
from rtcd_jax.config import Config
from rtcd_jax.console import Console, Progress
from rtcd_jax.errors import UserError
from rtcd_jax.evaluation import Evaluate, elite_effort, make_evaluate, resample, spread
from rtcd_jax.population import initial_genome
from rtcd_jax.problem import Problem, make_problem
from rtcd_jax.report import report
from rtcd_jax.results import arrays_of, record_of
from rtcd_jax.storage import RunFolder, elite_names
from rtcd_jax.types import Evaluation, Status

LAST_FILE = Path("figures") / "convergence.pdf"
"""Written when all else is."""


def optimize(config: Config, folder: Path, console: Console) -> None:
    """Search as `config` says and leave everything in the run folder; goes on where an earlier call stopped.

    Raises:
        UserError: the folder belongs to something else, or nothing at all is feasible.
    """
    problem = make_problem(config)
    evaluate = spread(make_evaluate(problem), jax.devices())
    plan = search.Plan(config.search, config.elites, tuple(initial_genome(problem).tolist()), problem.design_dims)
    with RunFolder.open(folder, config) as run, ThreadPoolExecutor(1) as pool:
        genomes = jnp.zeros((config.search.population, len(problem.free)))
        example = jax.eval_shape(evaluate, genomes, jax.random.key(0))
        begun = run.restore(search.start(plan, example))
        done = int(begun.generation)
        if done == config.search.generations and (folder / LAST_FILE).is_file():
            console.message(f"{folder} is complete: {done} generations, {len(elite_names(folder))} elites")
            return
        if done:
            console.message(f"{folder}: going on after generation {done}")
        console.message(f"compiling the evaluation of {config.search.population} candidates on {_devices()}")
        again = pool.submit(_compile_resample, problem, example)  # beside the evaluation's own compilation
        state, clock = begun, _Clock(config.search.population)
        for state, generation in search.run(plan, evaluate, begun):
            run.append(vars(generation))
            run.save_if_due(state, int(state.generation))
            console.progress(_progress(config, generation, clock))
        run.save(state, int(state.generation))
        _finish(problem, plan, evaluate, again, state, run, console)


class _Clock:
    """Wall time of this process' generations; the first one compiles and says little about the others."""

    def __init__(self, population: int):
        self.population = population
        self.begun = time.monotonic()
        self.ends: list[float] = []

    def tick(self) -> tuple[float, float]:
        """At a generation's end: seconds since the start, candidates per second."""
        self.ends.append(time.monotonic())
        start, count = (self.begun, 1) if len(self.ends) == 1 else (self.ends[0], len(self.ends) - 1)
        return self.ends[-1] - self.begun, count * self.population / (self.ends[-1] - start)


def _devices() -> str:
    devices = jax.devices()
    return f"{len(devices)} {devices[0].device_kind} device{'s' if len(devices) > 1 else ''}"


def _progress(config: Config, generation: search.Generation, clock: _Clock) -> Progress:
    elapsed, rate = clock.tick()
    left = config.search.generations - generation.index - 1
    return Progress(
        generation=generation.index + 1,
        generations=config.search.generations,
        best=generation.best_so_far,
        median=generation.median,
        feasible=generation.feasible,
        rate=rate,
        elapsed=elapsed,
        left=left * config.search.population / rate,
        failures={name: count for name, count in generation.counts.items() if name != Status.OK.name},
    )


def _compile_resample(problem: Problem, population: Evaluation) -> jax.stages.Compiled:
    """`resample` with the elites' effort for one candidate of a `population` (arrays' shapes)."""
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), population)
    return jax.jit(partial(resample, problem, elite_effort(problem))).lower(one, jax.random.key(0)).compile()


def _finish(
    problem: Problem,
    plan: search.Plan,
    evaluate: Evaluate,
    again: Future[jax.stages.Compiled],
    state: search.SearchState,
    run: RunFolder,
    console: Console,
) -> None:
    """Sample the funnels of the elites and the initial candidate again, more thoroughly, and store everything."""
    effort = elite_effort(problem)
    elites = jax.device_get(state.elites)
    filled = int(elites.count)
    first = jnp.tile(jnp.asarray(initial_genome(problem)), (plan.settings.population, 1))

    def sampled(index: int, evaluation: Evaluation, key) -> Evaluation:
        found = jax.device_get(again.result()(evaluation, key))
        console.message(f"funnel sampled again: {index + 1} of {filled + 1}")
        return found

    def reevaluate(genomes, key) -> Evaluation:
        found = [sampled(k, _row(elites.evaluation, k), key) for k in range(filled)]
        found += [found[-1]] * (len(genomes) - filled)
        return jax.tree.map(lambda *leaves: np.stack(leaves), *found)

    finished = search.finish(plan, reevaluate, state)
    evaluated = jax.device_get(evaluate(first, jax.random.key(0)))
    initial = sampled(filled, _row(evaluated, 0), jax.random.key(plan.settings.seed))
    if not int(finished.count):
        raise UserError(
            f"none of the {filled} elites kept a funnel under more samples: raise funnel.directions or funnel.trials, "
            "so that the search is not misled by luck"
        )
    best_first = [_row(finished.evaluation, k) for k in range(int(finished.count))]
    run.write_initial(arrays_of(problem, initial), record_of(problem, effort, initial))
    run.write_elites((arrays_of(problem, found), record_of(problem, effort, found)) for found in best_first)
    run.tell_time()
    for line in _summary(problem, initial, best_first[0]):
        console.message(line)
    console.message(f"{len(best_first)} elites in {run.path}")
    _report(run.path, console)


def _report(folder: Path, console: Console) -> None:
    """The run's page and figures. The run is whole without them: what goes wrong here is told, and ends nothing."""
    try:
        page, *figures = report([folder])
    except Exception as error:
        console.message(f"the run is finished, but its report failed: {error!r}; `rtcd report {folder}` makes it")
    else:
        console.message(f"{page}, and {len(figures)} figures in {figures[0].parent}")


def _row(evaluation: Evaluation, index: int) -> Evaluation:
    return jax.tree.map(lambda leaf: leaf[index], evaluation)


def _summary(problem: Problem, initial: Evaluation, best: Evaluation) -> Iterator[str]:
    """The volumes of the initial and the best candidate with their ratios, and what the best one is."""
    yield f"{'volume (sampled)':20}{'initial':>12}{'best':>12}{'ratio':>9}"
    for label, name in (("sum", "total"), *((name,) * 2 for name in ("integral", "inlet", "geometric_mean"))):
        before, after = float(getattr(initial.volumes, name)), float(getattr(best.volumes, name))
        ratio = f"{after / before:9.2f}" if before > 0 else f"{'-':>9}"
        yield f"{label:20}{before:12.5g}{after:12.5g}{ratio}"
    if int(initial.status) != Status.OK:
        yield f"the initial candidate has no funnel: {Status(int(initial.status)).message}"
    design = ", ".join(
        f"{name} {float(getattr(best.candidate.design, name)):.4g} {unit}"
        for name, unit in problem.plant.design_units.items()
    )
    weights = ", ".join(f"{value:.4g}" for value in (*best.candidate.q.tolist(), *best.candidate.r.tolist()))
    yield f"best: {design}; diagonals of Q and R: {weights}"
