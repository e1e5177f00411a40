"""The archive: the best evaluations that a search has seen, no two of them closer than a distance."""

from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rtcd_jax.types import Evaluation, Status, Volumes

OBJECTIVES = {"sum": "total", "integral": "integral", "inlet": "inlet", "geometric_mean": "geometric_mean"}


@final
class Elites(eqx.Module):
    """At most E whole evaluations, best first. `costs` are ascending; slots from `count` on are empty, at cost +inf.

    `generations` are those in which the elites were evaluated, -1 in an empty slot.
    """

    evaluation: Evaluation
    costs: Float[Array, " E"]
    generations: Int[Array, " E"]

    @property
    def count(self) -> Int[Array, ""]:
        return jnp.sum(jnp.isfinite(self.costs))


def volume(volumes: Volumes, objective: str) -> Float[Array, "*P"]:
    """The volume that `objective` names. Raises ValueError for a name that is none of `OBJECTIVES`."""
    if objective not in OBJECTIVES:
        raise ValueError(f"objective {objective!r} is none of {', '.join(OBJECTIVES)}")
    return getattr(volumes, OBJECTIVES[objective])


def cost(evaluation: Evaluation, objective: str) -> Float[Array, "*P"]:
    """-log(volume), to be minimized, in float64; +inf for a candidate that has failed.

    The logarithm keeps the order, and makes the penalty at the box independent of the volume's unit.
    """
    value = volume(evaluation.volumes, objective).astype(jnp.float64)
    feasible = (evaluation.status == Status.OK) & jnp.isfinite(value) & (value > 0)
    return jnp.where(feasible, -jnp.log(jnp.where(feasible, value, 1.0)), jnp.inf)


def empty(capacity: int, example: Evaluation) -> Elites:
    """An archive without elites. `example` is a population's evaluation (arrays or their shapes, leading axis P)."""
    if capacity < 1:
        raise ValueError(f"an archive holds at least 1 elite, got {capacity}")
    blank = jax.tree.map(lambda leaf: jnp.zeros((capacity, *leaf.shape[1:]), leaf.dtype), example)
    return Elites(
        evaluation=eqx.tree_at(lambda e: e.status, blank, jnp.full_like(blank.status, Status.NOT_FINITE)),
        costs=jnp.full(capacity, jnp.inf, jnp.float64),
        generations=jnp.full(capacity, -1, jnp.int32),
    )


def merge(
    elites: Elites, evaluation: Evaluation, objective: str, generation: Int[Array, ""] | int, distance: float
) -> Elites:
    """The best E of the elites and a population, failures left out: greedily the best, without its neighbors.

    Neighbors are closer than `distance` in every coordinate of the unit box (Chebyshev). Among equal costs the older
    elite stays. Whatever was dropped by an earlier merge is gone, so that the order of merges matters only where
    evaluations are neighbors.
    """
    costs = jnp.concatenate([elites.costs, cost(evaluation, objective)])
    genomes = jnp.concatenate([elites.evaluation.genome, evaluation.genome])
    born = jnp.full(evaluation.status.shape, generation, jnp.int32)

    def choose(remaining, _):
        best = jnp.argmin(remaining)
        near = jnp.max(jnp.abs(genomes - genomes[best]), axis=-1) < distance
        return jnp.where(near, jnp.inf, remaining).at[best].set(jnp.inf), (best, remaining[best])

    _, (chosen, kept) = jax.lax.scan(choose, costs, length=elites.costs.shape[0])
    merged = jax.tree.map(lambda old, new: jnp.concatenate([old, new])[chosen], elites.evaluation, evaluation)
    filled = jnp.isfinite(kept)
    blank = empty(elites.costs.shape[0], evaluation)
    found = Elites(merged, kept, jnp.concatenate([elites.generations, born])[chosen])
    return jax.tree.map(lambda new, old: jnp.where(_like(filled, new), new, old), found, blank)


def _like(mask, leaf):
    return mask.reshape(mask.shape + (1,) * (leaf.ndim - 1))
