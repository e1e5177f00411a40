"""plan -> stabilize -> estimate_funnel -> funnel_volume, and the only vmap over candidates.

Trajectories are planned for the whole population at once, because the solver balances its own lanes; everything behind
them is written for one candidate and mapped over chunks, which bounds the memory.
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp

from rtcd_jax import rollout
from rtcd_jax.config import FunnelConfig
from rtcd_jax.funnel import Dynamics, estimate_funnel
from rtcd_jax.policy import stabilize
from rtcd_jax.population import decode
from rtcd_jax.problem import Problem
from rtcd_jax.trajectory import plan
from rtcd_jax.types import Candidate, Evaluation, Trajectory
from rtcd_jax.volume import funnel_volume

SEARCH_ROUNDS = 2
ELITE_ROUNDS = 40
"""Passes of fresh states at most, see `estimate_funnel`."""


@dataclasses.dataclass(frozen=True)
class Effort:
    """How thoroughly a funnel is sampled."""

    funnel: FunnelConfig
    dynamics: Dynamics
    rounds: int
    chunk: int


def search_effort(problem: Problem) -> Effort:
    """That of a generation."""
    config = problem.config
    closed_form = rollout.closed_form(problem.plant)
    match config.funnel.rollouts:
        case "closed_form":
            dynamics = Dynamics(closed_form, closed_form, closed_form)
        case "mixed":
            dynamics = Dynamics(closed_form, closed_form, closed_form, share=rollout.mjx(problem.plant))
        case "mjx":
            dynamics = Dynamics(*[rollout.mjx(problem.plant)] * 3)
    return Effort(config.funnel, dynamics, SEARCH_ROUNDS, config.search.chunk)


def elite_effort(problem: Problem) -> Effort:
    """That of the elites' re-evaluation: more directions, more fresh states, all of them through MJX unless closed form."""
    config = problem.config
    elites = config.elites
    funnel = config.funnel.model_copy(update={"directions": elites.directions, "trials": elites.trials})
    use = rollout.closed_form if config.funnel.rollouts == "closed_form" else rollout.mjx
    return Effort(funnel, Dynamics(*[use(problem.plant)] * 3), ELITE_ROUNDS, chunk=1)


def make_evaluate(problem: Problem, effort: Effort | None = None) -> Callable:
    """`evaluate(genomes [P d], key) -> Evaluation [P]`; all candidates share the key's random directions."""
    effort = effort or search_effort(problem)

    def evaluate(genomes, key) -> Evaluation:
        candidates = jax.vmap(partial(decode, problem))(genomes)
        trajectories = plan(problem, candidates)
        assess = partial(_assess, problem, effort, key)
        return jax.lax.map(assess, (genomes, candidates, trajectories), batch_size=effort.chunk)

    return evaluate


def _assess(problem: Problem, effort: Effort, key, planned: tuple[jax.Array, Candidate, Trajectory]) -> Evaluation:
    genome, candidate, trajectory = planned
    policy = stabilize(problem, candidate, trajectory)
    funnel = estimate_funnel(problem, candidate, policy, key, effort.funnel, effort.dynamics, effort.rounds)
    return Evaluation(genome, candidate, funnel, funnel_volume(funnel), funnel.status)
