"""ask -> evaluate -> tell -> elites, one generation at a time; no files, no clock, no devices.

The search sees its problem through one deterministic function alone:

    evaluate(genomes [P, d], key) -> Evaluated      a population in the unit box, `key` its common random numbers

At its end the elites are evaluated once more, with more samples and other directions; `finish` sorts them by that.

All randomness of a generation is fold_in(key(seed), index): the same state always has the same next state.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, Self, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from rtcd_jax.config.schema import ElitesConfig, SearchConfig
from rtcd_jax.search import archive as elites
from rtcd_jax.search import cmaes
from rtcd_jax.search.archive import Elites, Evaluated, Records
from rtcd_jax.search.cmaes import Stop
from rtcd_jax.search.nesting import Joint, Nested, NestedState
from rtcd_jax.system.errors import UserError
from rtcd_jax.types import Status

Evaluate = Callable[[Float[Array, "P d"], Key[Array, ""]], Evaluated]

# Generations after which a search without any feasible candidate is given up.
PATIENCE = 10

GAIN = 1e-3
"""Share by which the best volume must grow within `search.patience` generations."""


class NothingFeasible(UserError):
    """Not one candidate so far has a funnel; `counts` says how many failed for which reason."""

    def __init__(self, counts: dict[Status, int], generations: int):
        self.counts = counts
        reasons = [f"  {count} {status.name}: {status.message}" for status, count in counts.items() if count]
        head = f"nothing is feasible: none of {sum(counts.values())} candidates in {generations} generations"
        super().__init__("\n".join([head, *reasons]))


@final
@dataclasses.dataclass(frozen=True)
class Plan:
    """What is fixed during a search. `initial` is the first genome, `design` tells its design entries from weights;
    `tasks` are the names of several.

    Raises ValueError if the initial genome is empty or outside the unit box, or if nested loops lack a design
    variable or a weight.
    """

    settings: SearchConfig
    elites: ElitesConfig
    initial: tuple[float, ...]
    design: tuple[bool, ...]
    tasks: tuple[str, ...] = ()

    def __post_init__(self):
        if len(self.design) != len(self.initial):
            raise ValueError(f"design has {len(self.design)} flags for {len(self.initial)} free variables")
        outside = [f"{i}: {value}" for i, value in enumerate(self.initial) if not 0 <= value <= 1]
        if outside:
            raise ValueError(f"the initial genome leaves the unit box [0, 1] at {', '.join(outside)}")
        _loop(self)  # refuses what cannot be searched, before anything is evaluated


@final
class SearchState(eqx.Module):
    """All that a search must remember between two generations.

    `generation` and `evaluations` count what is done; `counts` [len(Status)] are the candidates by status so far,
    `restarts` those of all loops.
    """

    strategy: cmaes.State | NestedState
    elites: Elites
    generation: Int[Array, ""]
    evaluations: Int[Array, ""]
    restarts: Int[Array, ""]
    counts: Int[Array, " statuses"]


@final
@dataclasses.dataclass(frozen=True)
class Generation:
    """One generation's results, on the host; volumes are NaN where a candidate failed.

    `volumes` are [P] each by the objectives' names; `best` (that ranks first) and `median` (over the feasible) are
    those of `objective` in this generation, `best_so_far` that of the archive (all sampled); `feasible` is a share,
    `counts` and `stops` leave out what did not occur; `sigma` is the (outer) population's standard deviation along its
    widest axis [box widths], `evaluations` and `restarts` count from the search's start. Of several tasks `volumes` are
    those over them, and `tasks` has, by name, each one's `volumes` and `statuses` [P].
    """

    index: int
    evaluations: int
    objective: str
    best: float
    median: float
    best_so_far: float
    feasible: float
    counts: dict[str, int]
    sigma: float
    restarts: int
    stops: dict[str, int]
    genomes: np.ndarray
    statuses: np.ndarray
    volumes: dict[str, np.ndarray]
    tasks: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        """As generations.jsonl has it; `tasks` where there are several."""
        return {key: value for key, value in vars(self).items() if key != "tasks" or value}


def start(plan: Plan, example: Records) -> SearchState:
    """The state before generation 0. `example` is an evaluated population of any size, or its shapes."""
    zero = jnp.zeros((), jnp.int32)
    return SearchState(
        strategy=_loop(plan).start(),
        elites=elites.empty(plan.elites.count, example),
        generation=zero,
        evaluations=zero,
        restarts=zero,
        counts=jnp.zeros(len(Status), jnp.int32),
    )


def step(plan: Plan, evaluate: Evaluate, state: SearchState) -> tuple[SearchState, Generation]:
    """One generation: P candidates asked for, evaluated, told, and merged into the elites."""
    key = jax.random.fold_in(jax.random.key(plan.settings.seed), state.generation)
    draw, directions, anew = jax.random.split(key, 3)
    strategy, points, genomes = _ask(plan, state.strategy, draw)
    evaluation = evaluate(genomes, directions)
    summary = _Summary.of(evaluation, plan.settings)
    graded = elites.graded_cost(evaluation, plan.settings)
    strategy, stops = _tell(plan, strategy, points, graded, anew)
    after = SearchState(
        strategy=strategy,
        elites=elites.merge(state.elites, evaluation, plan.settings, int(state.generation), plan.elites.distance),
        generation=state.generation + 1,
        evaluations=state.evaluations + len(summary.costs),
        restarts=state.restarts + jnp.sum(stops != Stop.NONE, dtype=jnp.int32),
        counts=state.counts + np.bincount(summary.statuses, minlength=len(Status)).astype(np.int32),
    )
    return after, _record(plan, after, summary, np.asarray(stops))


def settled(settings: SearchConfig, best: Sequence[float]) -> bool:
    """Whether a search is over before its last generation: the `best` volume so far, one number a generation, has not
    grown by `GAIN` in the latest `patience` ones (of the outer search; 0: never). Under demands it may have to fall.
    """
    if settings.at_least:
        return False
    patience = settings.patience * (settings.nested.generations if settings.mode == "nested" else 1)
    return 0 < patience < len(best) and best[-1] <= (1 + GAIN) * best[-1 - patience]


def run(
    plan: Plan, evaluate: Evaluate, state: SearchState, best: Sequence[float] = ()
) -> Iterator[tuple[SearchState, Generation]]:
    """The generations that are left from `state` on, each with the state after it; `best` are the volumes of the best
    candidate so far after each of the generations before.

    Raises NothingFeasible once `PATIENCE` generations (or all, if fewer) have passed without any feasible candidate.
    """
    total, best = plan.settings.generations, list(best)
    while True:
        done = int(state.generation)
        if done >= min(PATIENCE, total) and not int(state.elites.count):
            raise NothingFeasible({status: int(state.counts[status]) for status in Status}, done)
        if done >= total or settled(plan.settings, best):
            return
        state, generation = step(plan, evaluate, state)
        best.append(generation.best_so_far)
        yield state, generation


def finish(plan: Plan, state: SearchState, evaluation: Records) -> Elites:
    """The elites by their second `evaluation` [E], slot by slot, sorted anew; those that failed it are dropped.

    A sampled volume that won among thousands is likely to have been lucky: only the second one may be reported.
    """
    first = state.elites
    status = jnp.where(jnp.isfinite(first.costs), evaluation.status, jnp.int32(Status.NOT_FINITE))
    evaluation = eqx.tree_at(lambda e: e.status, evaluation, status)
    none = elites.empty(plan.elites.count, evaluation)
    return elites.merge(none, evaluation, plan.settings, first.generations, 0.0)


class _Loop(Protocol):
    """One search or nested ones; the states are its own."""

    def start(self) -> Any: ...
    def ask(self, state: Any, key: Key[Array, ""], /) -> tuple[Any, Array, Array]: ...
    def tell(self, state: Any, points: Array, costs: Array, key: Key[Array, ""], /) -> tuple[Any, Array]: ...
    def sigma(self, state: Any, /) -> Array: ...


def _loop(plan: Plan) -> _Loop:
    settings = plan.settings
    if settings.mode == "joint":
        strategy = cmaes.Strategy(len(plan.initial), settings.population, settings.sigma)
        return Joint(strategy, plan.initial)
    return Nested.plan(
        population=settings.population,
        designs=settings.nested.designs,
        generations=settings.nested.generations,
        sigma=settings.sigma,
        initial=plan.initial,
        design=plan.design,
    )


@functools.partial(jax.jit, static_argnums=0)
def _ask(plan: Plan, strategy: cmaes.State | NestedState, key: Key[Array, ""]):
    return _loop(plan).ask(strategy, key)


@functools.partial(jax.jit, static_argnums=0)
def _tell(plan: Plan, strategy: cmaes.State | NestedState, points, costs: Float[Array, " P"], key: Key[Array, ""]):
    return _loop(plan).tell(strategy, points, costs, key)


@final
class _Summary(NamedTuple):
    """The numbers of a population's evaluation that the search itself looks at, on the host."""

    genomes: np.ndarray
    statuses: np.ndarray
    costs: np.ndarray
    volumes: dict[str, np.ndarray]
    tasks: tuple[np.ndarray, dict[str, np.ndarray]] | None

    @classmethod
    def of(cls, evaluation: Evaluated, settings: SearchConfig) -> Self:
        volumes, tasks = evaluation.volumes.named, evaluation.tasks
        costs = elites.cost(evaluation, settings)
        each = None if tasks is None else (tasks.status, tasks.volumes.named)
        summary = cls(*jax.device_get((evaluation.genome, evaluation.status, costs, volumes, each)))
        feasible = np.isfinite(summary.costs)
        return summary._replace(volumes={name: np.where(feasible, v, np.nan) for name, v in summary.volumes.items()})

    def of_tasks(self, names: Sequence[str]) -> dict[str, dict[str, Any]]:
        """Volumes and statuses [P] of each task by name; volumes are NaN where a candidate failed in it."""
        if self.tasks is None:
            return {}
        statuses, volumes = self.tasks
        volumes = {key: np.where(statuses == Status.OK, value, np.nan) for key, value in volumes.items()}
        return {
            name: {"statuses": statuses[:, t], "volumes": {key: value[:, t] for key, value in volumes.items()}}
            for t, name in enumerate(names)
        }


def _record(plan: Plan, after: SearchState, summary: _Summary, stops: np.ndarray) -> Generation:
    objective = plan.settings.objective
    feasible = np.isfinite(summary.costs)
    volumes = summary.volumes[objective][feasible]
    ranked_first = summary.costs[feasible] == np.min(summary.costs, initial=np.inf)
    archive = after.elites
    return Generation(
        index=int(after.generation) - 1,
        evaluations=int(after.evaluations),
        objective=objective,
        best=float(volumes[ranked_first].max()) if volumes.size else float("nan"),
        median=float(np.median(volumes)) if volumes.size else float("nan"),
        best_so_far=float(archive.evaluation.volumes[objective][0]) if int(archive.count) else float("nan"),
        feasible=float(feasible.mean()),
        counts={status.name: n for status in Status if (n := int(np.sum(summary.statuses == status)))},
        sigma=float(_loop(plan).sigma(after.strategy)),
        restarts=int(after.restarts),
        stops={reason.name: n for reason in Stop if reason and (n := int(np.sum(stops == reason)))},
        genomes=summary.genomes,
        statuses=summary.statuses,
        volumes=summary.volumes,
        tasks=summary.of_tasks(plan.tasks),
    )
