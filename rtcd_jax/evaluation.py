"""plan -> stabilize -> estimate_funnel -> funnel_volume, and the only vmap over candidates.

Trajectories are planned for the whole population at once, because the solver balances its own lanes; everything behind
them is written for one candidate and mapped over batches that stay in a CPU's cache; a GPU takes all of them at once.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from rtcd_jax import rollout
from rtcd_jax.funnel import estimate_funnel
from rtcd_jax.genome import decode
from rtcd_jax.numerics.interior_point import CACHE, VECTOR
from rtcd_jax.numerics.loops import on_gpu
from rtcd_jax.policy import stabilize
from rtcd_jax.problem import Problem
from rtcd_jax.trajectory import plan
from rtcd_jax.types import Candidate, Evaluation, Policy, Trajectory
from rtcd_jax.validation import Dynamics, Effort
from rtcd_jax.volume import funnel_volume

TEMPORARIES = 16
"""Memory of a candidate on a GPU over that of its held-out samples, as counted by launch/bench/gpu_budget.py."""
MOST_ON_A_CPU = 512

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
        count = genomes.shape[0]
        batch = count if on_gpu() else batch_in_cache(problem, count)
        padded = jax.tree.map(lambda leaf: _padded(leaf, -count % batch), (genomes, candidates, trajectories))
        found = jax.lax.map(assess, padded, batch_size=batch)
        return jax.tree.map(lambda leaf: leaf[:count], found)

    return evaluate


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
    return min(chunk, share)


def _bytes_of_states(problem: Problem) -> int:
    """Those of one candidate's held-out samples at all knots."""
    return 8 * problem.config.trajectory.knots * problem.plant.n * problem.config.funnel.trials


def _padded(leaf, count: int):
    return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], count, axis=0)]) if count else leaf


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
