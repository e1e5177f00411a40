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
from rtcd_jax.trajectory import plan
from rtcd_jax.types import Candidate, Evaluation, Policy, Trajectory
from rtcd_jax.validation import Dynamics, Effort
from rtcd_jax.volume import funnel_volume

Evaluate = Callable[[jax.Array, jax.Array], Evaluation]


def search_effort(problem: Problem) -> Effort:
    """That of a generation: two rounds of fresh states, a share of them through MJX if the rollouts are mixed."""
    funnel = problem.config.funnel
    share = rollout.mjx(problem.plant) if funnel.rollouts == "mixed" else None
    use = rollout.mjx if funnel.rollouts == "mjx" else rollout.closed_form
    physics = use(problem.plant)
    return Effort(funnel, Dynamics(physics, physics, share), rounds=2, follow=False)


def elite_effort(problem: Problem) -> Effort:
    """That of the elites: more directions and fresh states, through MJX unless all is closed form, until none fails.

    Fresh states are then followed to the goal.
    """
    config = problem.config
    counts = {"directions": config.elites.directions, "trials": config.elites.trials}
    use = rollout.closed_form if config.funnel.rollouts == "closed_form" else rollout.mjx
    physics = use(problem.plant)
    funnel = config.funnel.model_copy(update=counts)
    return Effort(funnel, Dynamics(physics, physics), rounds=40, follow=True)


def make_evaluate(problem: Problem, effort: Effort | None = None) -> Evaluate:
    """`evaluate(genomes [P d], key) -> Evaluation [P]`, to be jitted; all candidates share the key's random numbers.

    Without an `effort` that of a generation is made.
    """
    effort = effort or search_effort(problem)

    def evaluate(genomes, key) -> Evaluation:
        candidates = jax.vmap(partial(decode, problem))(genomes)
        trajectories = plan(problem, candidates)
        assess = partial(_assess, problem, effort, key)
        chunk = min(problem.config.search.chunk, genomes.shape[0])
        return jax.lax.map(assess, (genomes, candidates, trajectories), batch_size=chunk)

    return evaluate


def resample(problem: Problem, effort: Effort, evaluation: Evaluation, key) -> Evaluation:
    """One candidate's evaluation with its funnel estimated anew about the same policy."""
    return _with_funnel(problem, effort, key, evaluation.genome, evaluation.candidate, evaluation.funnel.policy)


def _assess(problem: Problem, effort: Effort, key, planned: tuple[jax.Array, Candidate, Trajectory]) -> Evaluation:
    genome, candidate, trajectory = planned
    policy = stabilize(problem, candidate, trajectory)
    return _with_funnel(problem, effort, key, genome, candidate, policy)


def _with_funnel(problem: Problem, effort: Effort, key, genome, candidate: Candidate, policy: Policy) -> Evaluation:
    funnel = estimate_funnel(problem, candidate, policy, key, effort)
    return Evaluation(genome, candidate, funnel, funnel_volume(funnel), funnel.status)
