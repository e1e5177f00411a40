"""plan -> stabilize -> estimate_funnel -> funnel_volume, and the only vmap over candidates.

Trajectories are planned for the whole population at once, because the solver balances its own lanes; everything behind
them is written for one candidate and mapped over chunks, which bounds the memory.
"""

from collections.abc import Callable
from functools import partial

import jax

from rtcd_jax import rollout
from rtcd_jax.funnel import estimate_funnel
from rtcd_jax.genome import decode
from rtcd_jax.policy import stabilize
from rtcd_jax.problem import Problem
from rtcd_jax.system.devices import path_batch
from rtcd_jax.trajectory import plan
from rtcd_jax.types import Candidate, Evaluation, Policy, Trajectory
from rtcd_jax.validation import Dynamics, PhysicsComparison, Rollouts, SamplingBudget, compare_physics
from rtcd_jax.volume import funnel_volume

Evaluate = Callable[[jax.Array, jax.Array], Evaluation]

FIRST_SAMPLES = 2000
"""Held-out samples a knot, at most, of the first, cheap rounds of the elites, and of those under further keys."""


def search_budget(problem: Problem) -> SamplingBudget:
    """That of a generation: two rounds of held-out samples, a share of them through MJX if the rollouts are mixed."""
    funnel = problem.config.funnel
    share = rollout.mjx(problem.plant) if funnel.rollouts == "mixed" else None
    use = rollout.mjx if funnel.rollouts == "mjx" else rollout.closed_form
    physics = use(problem.plant)
    return SamplingBudget(funnel, Dynamics(physics, physics, share), rounds=2)


def elite_budget(problem: Problem) -> SamplingBudget:
    """That of the elites: more directions, held-out samples followed to the goal until a round has no failure."""
    config = problem.config
    elites = config.elites
    counts = {"directions": elites.directions, "trials": min(elites.trials, FIRST_SAMPLES)}
    use = rollout.mjx if config.funnel.rollouts == "mjx" else rollout.closed_form
    physics = use(problem.plant)
    funnel = config.funnel.model_copy(update=counts)
    return SamplingBudget(
        funnel, Dynamics(physics, physics), rounds=40, samples_per_knot=elites.trials, batch=path_batch()
    )


def elite_key() -> jax.Array:
    """The random numbers with which elites and initial candidates are evaluated again, in every run.

    A candidate has the same numbers in every run, whatever its seed and its generations; no search draws from this
    key, since seeds are below 2^32.
    """
    return jax.random.key(1 << 32)


def make_evaluate(problem: Problem, budget: SamplingBudget | None = None) -> Evaluate:
    """`evaluate(genomes [P d], key) -> Evaluation [P]`, to be jitted; all candidates share the key's random numbers.

    Without a `budget` that of a generation is made.
    """
    budget = budget or search_budget(problem)

    def evaluate(genomes, key) -> Evaluation:
        candidates = jax.vmap(partial(decode, problem))(genomes)
        trajectories = plan(problem, candidates)
        assess = partial(_assess, problem, budget, key)
        chunk = min(problem.config.search.chunk, genomes.shape[0])
        return jax.lax.map(assess, (genomes, candidates, trajectories), batch_size=chunk)

    return evaluate


def resample(
    problem: Problem, budget: SamplingBudget, evaluation: Evaluation, key, samples_per_knot=None
) -> Evaluation:
    """One candidate's evaluation with its funnel estimated anew about the same policy."""
    known = evaluation.genome, evaluation.candidate, evaluation.funnel.policy
    return _with_funnel(problem, budget, key, *known, samples_per_knot)


def compare_with_mjx(problem: Problem, evaluation: Evaluation, key) -> PhysicsComparison:
    """`elites.mjx_states` held-out samples of one candidate's funnel, followed to the goal by both physics."""
    funnel, config = evaluation.funnel, problem.config
    rollouts = Rollouts.of(problem, evaluation.candidate, funnel.policy, config.funnel)
    return compare_physics(rollouts, funnel.levels, key, config.elites.mjx_states, rollout.mjx(problem.plant))


def _assess(
    problem: Problem, budget: SamplingBudget, key, planned: tuple[jax.Array, Candidate, Trajectory]
) -> Evaluation:
    genome, candidate, trajectory = planned
    policy = stabilize(problem, candidate, trajectory)
    return _with_funnel(problem, budget, key, genome, candidate, policy)


def _with_funnel(
    problem: Problem,
    budget: SamplingBudget,
    key,
    genome,
    candidate: Candidate,
    policy: Policy,
    samples_per_knot=None,
) -> Evaluation:
    funnel = estimate_funnel(problem, candidate, policy, key, budget, samples_per_knot)
    return Evaluation(genome, candidate, funnel, funnel_volume(funnel), funnel.status)
