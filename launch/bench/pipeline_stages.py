"""The pipeline's steps one by one, each compiled and timed on the results of the one before."""

import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from rtcd_jax import funnel
from rtcd_jax.analysis.scale.clock import timed
from rtcd_jax.config.load import Config
from rtcd_jax.evaluation import device_chunk, make_evaluate, search_budget
from rtcd_jax.genome import decode, initial_genome
from rtcd_jax.policy import stabilize
from rtcd_jax.problem import make_problem
from rtcd_jax.run.folder import RunFolder
from rtcd_jax.search import search
from rtcd_jax.system.devices import memory_of
from rtcd_jax.trajectory import plan
from rtcd_jax.validation import Rollouts, validate_intervals

REPEATS = 3
"""Timed calls of every stage."""


@final
class Stage(NamedTuple):
    """One step of the pipeline: compilation [s], CPU time of all threads for one candidate [ms]; `iterations` [P] are
    the trajectory optimizer's."""

    name: str
    compilation: float
    cpu_ms: float
    iterations: Int[np.ndarray, " P"] | None = None


def stages(config: Config, population: int) -> Iterator[Stage]:
    """The steps of a generation of `population` candidates whose genomes are uniform in the unit box, on one device."""
    problem = make_problem(config)
    budget = search_budget(problem)
    key = jax.random.key(0)
    chunk = device_chunk(problem, population, memory_of(jax.local_devices()[0]))

    def measure(function: Callable, *arguments):
        compiled, compilation = timed(lambda: jax.jit(function).lower(*arguments).compile())
        result = jax.block_until_ready(compiled(*arguments))
        _, calls = timed(lambda: [jax.block_until_ready(compiled(*arguments)) for _ in range(REPEATS)])
        return result, (compilation.wall, 1e3 * calls.cpu / REPEATS / population)

    def chunked(function: Callable):
        return lambda *arguments: jax.lax.map(lambda row: function(*row), arguments, batch_size=chunk)

    def prepared(candidate, policy):
        rollouts = Rollouts.of(problem, candidate, policy, budget.funnel)
        return rollouts, rollouts.sets.radii_inside(jnp.asarray(problem.state_limits))

    def goal(candidate, policy):
        rollouts, boxes = prepared(candidate, policy)
        saturated = funnel.saturating_radius(problem, policy, rollouts.sets.part(slice(-1, None)))
        return funnel.goal_level(rollouts, boxes[-1], saturated, key, budget)

    def scan(candidate, policy, last):
        rollouts, boxes = prepared(candidate, policy)
        return funnel.knot_levels(rollouts, boxes, last, key, budget)

    def held_out(candidate, policy, levels):
        return validate_intervals(Rollouts.of(problem, candidate, policy, budget.funnel), levels, key, budget)

    genomes = jax.random.uniform(key, (population, len(problem.free)))
    candidates = jax.vmap(partial(decode, problem))(genomes)
    trajectories, cost = measure(partial(plan, problem), candidates)
    yield Stage("trajectory", *cost, np.asarray(trajectories.iterations))
    policies, cost = measure(chunked(partial(stabilize, problem)), candidates, trajectories)
    yield Stage("Riccati", *cost)
    last, cost = measure(chunked(goal), candidates, policies)
    yield Stage("goal region", *cost)
    levels, cost = measure(chunked(scan), candidates, policies, last)
    yield Stage("levels, knot by knot", *cost)
    _, cost = measure(chunked(held_out), candidates, policies, levels)
    yield Stage("held-out samples", *cost)
    evaluation, cost = measure(make_evaluate(problem), genomes, key)
    yield Stage("all of these in one program", *cost)

    settings = config.search.model_copy(update={"population": population})
    order = search.Plan(settings, config.elites, tuple(initial_genome(problem).tolist()), problem.design_dims)
    state = search.start(order, jax.eval_shape(lambda: evaluation))
    answered = lambda genomes, key: evaluation  # noqa: E731
    (state, _), first = timed(lambda: search.step(order, answered, state))
    (state, _), then = timed(lambda: search.step(order, answered, state))
    yield Stage("CMA-ES and archive", first.wall - then.wall, 1e3 * then.cpu / population)
    with tempfile.TemporaryDirectory() as folder, RunFolder.open(Path(folder) / "run", config) as run:
        run.save(state, 1)
        _, saved = timed(lambda: run.save(state, 2))
    yield Stage("checkpoint", 0.0, 1e3 * saved.cpu / population)
