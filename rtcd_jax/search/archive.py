"""The archive: the best evaluations of a search, no two of them closer than a distance."""

import functools
from typing import Protocol, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtcd_jax.config.schema import SearchConfig
from rtcd_jax.types import Evaluation, Status, TaskEvaluations, Volumes

FAILED = 1e3
"""Graded cost of a candidate that bears the uncertainty at all knots but one, more than any that has a funnel."""
TOO_SMALL = 500.0
"""Cost of a candidate that lacks next to nothing of `search.at_least`, more than any -log(volume)."""


TIE = 1e-9
"""Share of the mean over the tasks in the cost of the smallest volume: it decides between equals alone."""

Records = Evaluation | TaskEvaluations
"""Of one task or of several."""


class Outcomes(Protocol):
    """What a population [P] is worth on every one of T tasks."""

    @property
    def volumes(self) -> Volumes: ...
    @property
    def status(self) -> Int[Array | np.ndarray, "P T"]: ...


class Evaluated(Protocol):
    """A population's evaluation, wherever its records are: `Records`, or one that is sharded over devices; `tasks` is
    None where there is one.
    """

    @property
    def genome(self) -> Float[Array | np.ndarray, "P d"]: ...
    @property
    def volumes(self) -> Volumes: ...
    @property
    def status(self) -> Int[Array | np.ndarray, " P"]: ...
    @property
    def borne(self) -> Float[Array | np.ndarray, " P"] | None: ...
    @property
    def tasks(self) -> Outcomes | None: ...

    def take(self, rows: np.ndarray, /) -> Records:
        """The whole records of the candidates at `rows` [E]."""
        ...


@final
class Elites(eqx.Module):
    """At most E whole evaluations, best first. `costs` are ascending; slots from `count` on are empty, at cost +inf.

    `generations` are those in which the elites were evaluated, -1 in an empty slot.
    """

    evaluation: Records
    costs: Float[Array, " E"]
    generations: Int[Array, " E"]

    @property
    def count(self) -> Int[Array, ""]:
        return jnp.sum(jnp.isfinite(self.costs))


def cost(evaluation: Evaluated, search: SearchConfig) -> Float[Array, "*P"]:
    """-log(volume), to be minimized, in float64; +inf for a candidate that has failed.

    The logarithm keeps the order, and makes the penalty at the box independent of the volume's unit. A candidate below
    what `search.at_least` demands comes after all that are not, and the later the larger the mean of its shortfalls.
    Of the smallest volume over several tasks, which is flat in the others, their geometric mean breaks ties.
    """
    value = jnp.asarray(evaluation.volumes[search.objective], jnp.float64)
    feasible = (evaluation.status == Status.OK) & jnp.isfinite(value) & (value > 0)
    costs = jnp.where(feasible, -jnp.log(jnp.where(feasible, value, 1.0)), jnp.inf)
    if evaluation.tasks is not None and search.over_tasks == "min":
        each = jnp.asarray(evaluation.tasks.volumes[search.objective], jnp.float64)
        costs -= TIE * jnp.log(jnp.where(feasible[..., None], each, 1.0)).mean(-1)
    if not search.at_least:
        return costs
    lacking = shortfall(evaluation, search)
    return jnp.where(feasible & (lacking > 0), TOO_SMALL * (1 + lacking), costs)


def shortfall(evaluation: Evaluated | Evaluation, search: SearchConfig) -> Float[Array, "*P"]:
    """Mean share that a candidate lacks of what `search.at_least` demands: 0 where it has all, 1 without a funnel; of
    several tasks in the worst one.
    """
    tasks = evaluation.tasks
    volumes = {
        name: jnp.asarray(evaluation.volumes[name]) if tasks is None else jnp.asarray(tasks.volumes[name]).min(-1)
        for name in search.at_least
    }
    lacking = [1 - volumes[name] / least for name, least in search.at_least.items()]
    return jnp.mean(jnp.clip(jnp.stack(lacking), 0, 1), axis=0) if lacking else jnp.zeros(evaluation.status.shape)


def graded_cost(evaluation: Evaluated, search: SearchConfig) -> Float[Array, "*P"]:
    """`cost`, but finite for a candidate whose funnel does not bear the uncertainty, and less the more of its knots do.

    Under a large box nearly all candidates of the first generations fail: a search among equals would learn nothing.
    """
    costs = cost(evaluation, search)
    if evaluation.borne is None:
        return costs
    estimated = (evaluation.status == Status.FUNNEL_EMPTY) | (evaluation.status == Status.TOO_STIFF)
    return jnp.where(estimated, FAILED * (2 - evaluation.borne), costs)


def empty(capacity: int, example: Records) -> Elites:
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
    elites: Elites, evaluation: Evaluated, search: SearchConfig, generation: Int[Array, "*E"] | int, distance: float
) -> Elites:
    """The best E of the elites and a population, failures left out: greedily the best, without its neighbors.

    Neighbors are closer than `distance` in every coordinate of the unit box (Chebyshev). Among equal costs the older
    elite stays. Whatever was dropped by an earlier merge is gone, so that the order of merges matters only where
    evaluations are neighbors. Works on the host: only the records of those that enter are asked for.
    """
    capacity = elites.costs.shape[0]
    costs = jnp.concatenate([elites.costs, cost(evaluation, search)])
    genomes = jnp.concatenate([elites.evaluation.genome, jnp.asarray(evaluation.genome)])
    chosen, best = jax.device_get(_choose(costs, genomes, distance, capacity))
    filled, enters = np.isfinite(best), chosen >= capacity
    stays = np.minimum(chosen, capacity - 1)
    records = jax.tree.map(lambda leaf: np.asarray(leaf)[stays], elites.evaluation)
    if np.any(filled & enters):
        fresh = evaluation.take(np.where(filled & enters, chosen, chosen[filled & enters][0]) - capacity)
        records = jax.tree.map(lambda new, old: where(enters, new, old), fresh, records)
    born = np.broadcast_to(np.asarray(generation, np.int32), evaluation.status.shape)
    merged = Elites(records, best, jnp.concatenate([elites.generations, born])[chosen])
    blank = empty(capacity, elites.evaluation)
    return jax.tree.map(lambda new, old: jnp.asarray(where(filled, new, old)), merged, blank)


@functools.partial(jax.jit, static_argnums=3)
def _choose(costs: Float[Array, " K"], genomes: Float[Array, "K d"], distance: float, count: int):
    """Places and costs of the best `count`, +inf from where nothing is left."""

    def choose(remaining, _):
        best = jnp.argmin(remaining)
        near = jnp.max(jnp.abs(genomes - genomes[best]), axis=-1) < distance
        return jnp.where(near, jnp.inf, remaining).at[best].set(jnp.inf), (best, remaining[best])

    return jax.lax.scan(choose, costs, length=count)[1]


def where(mask: Bool[np.ndarray, " E"], new: np.ndarray, old: np.ndarray) -> np.ndarray:
    """Rows [E …] of `new` where the mask holds, of `old` elsewhere."""
    return np.where(mask.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
