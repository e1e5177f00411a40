"""plan -> stabilize -> estimate_funnel -> funnel_volume, and the only vmap over candidates.

Trajectories are planned for the whole population at once, because the solver balances its own lanes; everything behind
them is written for one candidate and mapped over batches that stay in a CPU's cache; a GPU takes all of them at once.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from rtcd_jax import rollout
from rtcd_jax.adversary import Worst
from rtcd_jax.dirtrel import dirtrel
from rtcd_jax.funnel import estimate_funnel
from rtcd_jax.genome import decode
from rtcd_jax.numerics.interior_point import CACHE, VECTOR
from rtcd_jax.numerics.loops import on_gpu
from rtcd_jax.policy import input_jumps, stabilize
from rtcd_jax.problem import Problem
from rtcd_jax.reset import closed, values_at_resets
from rtcd_jax.system.devices import path_batch
from rtcd_jax.system.errors import UserError
from rtcd_jax.trajectory import plan
from rtcd_jax.types import Candidate, Evaluation, Funnel, Policy, Status, TaskEvaluations, Trajectory, Volumes
from rtcd_jax.validation import Dynamics, PhysicsComparison, Rollouts, SamplingBudget, compare_physics
from rtcd_jax.volume import DIRTREL, OVER_TASKS, funnel_volume

TEMPORARIES = 16
"""Memory of a candidate on a GPU over that of its held-out samples, as counted by launch/bench/gpu_budget.py."""
MOST_ON_A_CPU = 512

Evaluate = Callable[[Float[Array, "P d"], PRNGKeyArray], Evaluation | TaskEvaluations]
Budget = Callable[[Problem], SamplingBudget]

RESET_SAMPLES, RESET_SHARE = 1000, 0.9
"""Samples of every reset in a search, and the share of the next task's first level that they may fill: more directions
and samples, those of the elites, find lower levels.
"""

FIRST_SAMPLES = 2000
"""Held-out samples a knot, at most, of the first, cheap rounds of the elites, and of those under further keys."""


def search_budget(problem: Problem) -> SamplingBudget:
    """That of a generation: two rounds of held-out samples, a share of them through MJX if the rollouts are mixed.

    Where the goal's region is searched for, held-out samples of it are followed, too.
    """
    funnel = problem.config.funnel
    share = rollout.mjx(problem.plant) if funnel.rollouts == "mixed" else None
    physics = _physics(problem)
    paths = funnel.trials if problem.config.at_rest else 0
    return SamplingBudget(funnel, Dynamics(physics, physics, share), rounds=2, samples_per_knot=paths)


def elite_budget(problem: Problem) -> SamplingBudget:
    """That of the elites: more directions, held-out samples followed to the goal until a round has no failure."""
    elites = problem.config.elites
    counts = {"directions": elites.directions, "trials": min(elites.trials, FIRST_SAMPLES)}
    physics = _physics(problem)
    funnel = problem.config.funnel.model_copy(update=counts)
    return SamplingBudget(
        funnel, Dynamics(physics, physics), rounds=40, samples_per_knot=elites.trials, batch=path_batch()
    )


def _physics(problem: Problem) -> rollout.Dynamics:
    if problem.uncertainty is not None:
        return rollout.closed_form(problem.plant, Worst(problem.plant, problem.uncertainty))
    use = rollout.mjx if problem.config.funnel.rollouts == "mjx" else rollout.closed_form
    return use(problem.plant)


def elite_key() -> PRNGKeyArray:
    """The random numbers with which elites and initial candidates are evaluated again, in every run.

    A candidate has the same numbers in every run, whatever its seed and its generations; no search draws from this
    key, since seeds are below 2^32.
    """
    return jax.random.key(1 << 32)


def make_evaluate(problem: Problem, budget: Budget = search_budget) -> Evaluate:
    """`evaluate(genomes [P d], key) -> Evaluation [P]`, to be jitted; all candidates share the key's random numbers.

    Of several tasks it is TaskEvaluations: one program evaluates the P T candidates.
    """

    def evaluate(genomes: Float[Array, "P d"], candidates: Candidate, key: PRNGKeyArray) -> Evaluation:
        trajectories = plan(problem, candidates)
        count = genomes.shape[0]
        batch = count if on_gpu() else batch_in_cache(problem, count)

        def stabilized(one):
            return stabilize(problem.of(one[0]), *one)

        def stiffness(candidate, policy):
            return rollout.stiffness(problem.of(candidate), candidate, policy, budget(problem).funnel)

        lasts = None if problem.reset is None else around_cycles(candidates, trajectories, batch)
        policies = in_batches(stabilized, (candidates, trajectories, lasts), batch)
        # A batch takes the steps that its stiffest candidate needs.
        order = jnp.argsort(jax.vmap(stiffness)(candidates, policies).parts)
        assess = lambda one: _with_funnel(problem, budget, key, *one)  # noqa: E731
        return in_batches(assess, (genomes, candidates, policies), batch, order)

    def around_cycles(candidates: Candidate, trajectories: Trajectory, batch: int) -> Float[Array, "PT n n"]:
        values = in_batches(
            lambda one: values_at_resets(problem, *one),
            jax.tree.map(of_each_genome, (candidates, trajectories)),
            max(1, batch // tasks),
        )
        return values.reshape(-1, *values.shape[2:])

    def of_each_genome(leaf: Array) -> Array:
        return leaf.reshape(-1, tasks, *leaf.shape[1:])

    def of_the_task(genomes: Float[Array, "P d"], key: PRNGKeyArray) -> Evaluation:
        return evaluate(genomes, jax.vmap(partial(decode, problem))(genomes), key)

    def of_all_tasks(genomes: Float[Array, "P d"], key: PRNGKeyArray) -> TaskEvaluations:
        count = genomes.shape[0]
        each = jnp.repeat(genomes, tasks, axis=0)
        candidates = jax.vmap(partial(decode, problem))(each, jnp.tile(jnp.arange(tasks), count))
        each_task = jax.tree.map(of_each_genome, evaluate(each, candidates, key))
        whole = over_tasks(each_task, problem.config.search.over_tasks)
        if problem.reset is None:
            return whole
        found = jax.vmap(lambda one: closed(problem, one, key, RESET_SAMPLES, RESET_SHARE))(whole)
        return replace(found, worst_at_resets=None)

    tasks = len(problem.tasks)
    if problem.reset is not None and not tasks:
        raise UserError("task.catch.reset leads from task to task: it needs `tasks`, two at least")
    return of_all_tasks if problem.tasks else of_the_task


def over_tasks(tasks: Evaluation, how: str) -> TaskEvaluations:
    """What a search makes of the evaluations [... T] of each genome on every task; `how` is one of `OVER_TASKS`."""
    status = tasks.status
    reduce = OVER_TASKS[how]
    named = {name: reduce(tasks.volumes[name]) for name in tasks.volumes.named}
    first = jnp.take_along_axis(status, jnp.argmax(status != Status.OK, -1)[..., None], -1)[..., 0]
    per_knot = reduce(jnp.moveaxis(tasks.volumes.per_knot, -2, -1))
    return TaskEvaluations(tasks.genome[..., 0, :], tasks, Volumes(per_knot, named), first)


def batch_in_cache(problem: Problem, count: int) -> int:
    """Candidates behind their trajectories at once on a CPU: whole vectors, as many as have their states in the cache.

    Of `count`, in batches as equal as whole vectors allow.
    """
    most = max(VECTOR, 2 * CACHE // _bytes_of_states(problem) // VECTOR * VECTOR)
    batches = -(-count // most)
    return min(count, -(-count // batches // VECTOR) * VECTOR)


def device_chunk(problem: Problem, share: int, memory: float) -> int:
    """Candidates that a device with so much `memory` [bytes] is given at once, of its `share` of a population.

    What `search.chunk` says or, where it says `auto`, all that fit; on a CPU no more than take some seconds, since only
    between chunks a request to stop is heard.
    """
    chunk = problem.config.search.chunk
    if chunk == "auto":
        fit = int(0.8 * memory / (TEMPORARIES * _bytes_of_states(problem))) // VECTOR * VECTOR
        chunk = max(VECTOR, fit if on_gpu() else min(fit, MOST_ON_A_CPU))
        chunk = max(1, chunk // max(1, len(problem.tasks)))
    return min(chunk, share)


def _bytes_of_states(problem: Problem) -> int:
    """Those of one candidate's held-out samples at all knots."""
    return 8 * problem.config.trajectory.knots * problem.plant.n * problem.config.funnel.trials


def in_batches(f: Callable, xs: PyTree, batch: int, order: Int[Array | np.ndarray, " P"] | None = None) -> PyTree:
    """f of every candidate, `batch` of them at once, in the `order` given; the last batch is filled up."""
    count = jax.tree.leaves(xs)[0].shape[0]
    if batch == count:
        return jax.lax.map(f, xs, batch_size=batch)
    order = np.arange(count) if order is None else order
    filled = order[np.minimum(np.arange(count + -count % batch), count - 1)]
    return _take(jax.lax.map(f, _take(xs, filled), batch_size=batch), jnp.argsort(order))


def _take(tree: PyTree, rows: Int[Array | np.ndarray, " E"]) -> PyTree:
    return jax.tree.map(lambda leaf: leaf[rows], tree)


def resample(
    problem: Problem,
    budget: Budget,
    evaluation: Evaluation,
    key: PRNGKeyArray,
    samples_per_knot: Int[Array, ""] | int | None = None,
) -> Evaluation:
    """One candidate's evaluation with its funnel estimated anew about the same policy."""
    known = evaluation.genome, evaluation.candidate, evaluation.funnel.policy
    return _with_funnel(problem, budget, key, *known, samples_per_knot)


def compare_with_mjx(problem: Problem, evaluation: Evaluation, key: PRNGKeyArray) -> PhysicsComparison:
    """`elites.mjx_states` held-out samples of one candidate's funnel, followed to the goal by both physics."""
    funnel, config, problem = evaluation.funnel, problem.config, problem.of(evaluation.candidate)
    rollouts = Rollouts.of(problem, evaluation.candidate, funnel.policy, config.funnel)
    return compare_physics(rollouts, funnel.levels, key, config.elites.mjx_states)


def _with_funnel(
    problem: Problem,
    budget: Budget,
    key: PRNGKeyArray,
    genome: Float[Array, " d"],
    candidate: Candidate,
    policy: Policy,
    samples_per_knot: Int[Array, ""] | int | None = None,
) -> Evaluation:
    problem = problem.of(candidate)
    funnel = estimate_funnel(problem, candidate, policy, key, budget(problem), samples_per_knot)
    volumes = volumes_of(problem, candidate, funnel)
    return Evaluation(genome, candidate, funnel, volumes, funnel.status)


def volumes_of(problem: Problem, candidate: Candidate, funnel: Funnel) -> Volumes:
    """All volumes of a candidate's funnel, and what else is searched for."""
    volumes = funnel_volume(funnel, input_jumps(problem, candidate, funnel.policy.trajectory))
    if problem.config.search.objective != DIRTREL:
        return volumes
    found = jnp.where(funnel.status == Status.OK, dirtrel(problem, candidate, funnel.policy), 0)
    return Volumes(volumes.per_knot, {**volumes.named, DIRTREL: found})
