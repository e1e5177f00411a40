"""CMA-ES in the unit box as pure ask and tell; it never knows what it minimizes.

min f(clip(u)) over u in R^d, clip onto [0, 1]^d. The Gaussian lives outside the box too: f is evaluated at clip(u), and
u itself is ranked by f + gamma |u - clip(u)|^2. The updates are evosax's (Hansen, "The CMA Evolution Strategy: A
Tutorial", arXiv 1604.00772, called "the tutorial" below); the box, the ranks, the stops and the restarts stand here.
All state is data of fixed shape: it vmaps, scans and checkpoints.
"""

import dataclasses
import enum
import functools
import math
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
from evosax.algorithms import CMA_ES
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

# Tutorial, appendix B.3.
TOLERANCE_X = 1e-12
TOLERANCE_COST = 1e-12
LARGEST_CONDITION = 1e14
LARGEST_GROWTH = 1e4
SMALLEST_POPULATION = 4


class Stop(enum.IntEnum):
    """Why a search has nothing left to win where it is; `NONE` while it goes on."""

    NONE = 0
    NOT_FINITE = 1
    CONDITION = 2
    GROWTH = 3
    NOTHING_FEASIBLE = 4
    TOLERANCE_X = 5
    FLAT = 6
    GENERATIONS = 7


@final
@dataclasses.dataclass(frozen=True)
class Strategy:
    """What is fixed during a search: number of variables, points a generation, first step size [box widths].

    Raises ValueError for no variable, a population below 4 or a step size that is not positive.
    """

    dimensions: int
    population: int
    sigma: float

    def __post_init__(self):
        if self.dimensions < 1:
            raise ValueError(f"CMA-ES needs at least 1 free variable, got {self.dimensions}")
        if self.population < SMALLEST_POPULATION:
            raise ValueError(f"CMA-ES needs a population of at least {SMALLEST_POPULATION}, got {self.population}")
        if not (self.sigma > 0 and math.isfinite(self.sigma)):
            raise ValueError(f"CMA-ES needs a positive, finite sigma, got {self.sigma}")

    @property
    def memory(self) -> int:
        """Generations over which the best cost must not have moved for a `FLAT` stop (tutorial, TolFun)."""
        return 10 + math.ceil(30 * self.dimensions / self.population)

    @property
    def patience(self) -> int:
        """Generations after which a search is restarted in any case (the default of pycma's maxiter)."""
        return int(100 + 150 * (self.dimensions + 3) ** 2 / math.sqrt(self.population))


@final
class State(eqx.Module):
    """One search. `evolution` is evosax's state (its `best_*` fields see ranks and mean nothing here).

    `recent` holds the best penalized cost of the last H generations since the start, newest first, +inf where nothing
    was feasible; `spread` is the range of the feasible costs of the last one.
    """

    evolution: PyTree
    recent: Float[Array, " H"]
    spread: Float[Array, ""]
    restarts: Int[Array, ""]


def start(strategy: Strategy, mean: Float[Array, " d"]) -> State:
    """A search whose first population has the member `mean` (in the unit box) and spreads by `sigma` about it.

    Raises ValueError if JAX runs without float64: in single precision the covariance of CMA-ES does not stay definite.
    """
    es, params = _evosax(strategy.dimensions, strategy.population)
    params = params.replace(std_init=jnp.asarray(strategy.sigma, jnp.float64))
    evolution = es.init(jax.random.key(0), jnp.asarray(mean, jnp.float64), params)  # the key is not used
    return State(
        evolution=jax.tree.map(_strong, evolution),
        recent=jnp.full(strategy.memory, jnp.inf, jnp.float64),
        spread=jnp.asarray(jnp.inf, jnp.float64),
        restarts=jnp.asarray(0, jnp.int32),
    )


def ask(strategy: Strategy, state: State, key: Key[Array, ""]) -> tuple[State, Float[Array, "P d"]]:
    """The next population, not clipped; the first of the first generation is the mean itself.

    The returned state holds the eigenvectors that the points were drawn with: `tell` needs it.
    """
    es, params = _evosax(strategy.dimensions, strategy.population)
    points, evolution = es.ask(key, state.evolution, params)
    first = evolution.generation_counter == 0
    points = points.at[0].set(jnp.where(first, evolution.mean, points[0]))
    return eqx.tree_at(lambda s: s.evolution, state, evolution), points


def clip(points: Float[Array, "*any d"]) -> Float[Array, "*any d"]:
    """The point of the unit box at which f is evaluated."""
    return jnp.clip(points, 0.0, 1.0)


def tell(strategy: Strategy, state: State, points: Float[Array, "P d"], costs: Float[Array, " P"]) -> State:
    """The state after a population: `costs` [P] are f(clip(points)) to be minimized, not finite where f failed."""
    es, params = _evosax(strategy.dimensions, strategy.population)
    costs = jnp.asarray(costs, jnp.float64)
    feasible = jnp.isfinite(costs)
    outside = jnp.sum((points - clip(points)) ** 2, axis=-1)
    penalized = jnp.where(feasible, costs, 0.0) + _weight(costs, feasible) * outside
    # Failures rank last, those nearer to the box first, so that a search without any feasible point stays about the
    # box. Ranks are ordinal: average ranks of ties would break the recombination weights.
    ranks = jnp.argsort(jnp.lexsort((penalized, ~feasible)))
    evolution, _ = es.tell(jax.random.key(0), points, ranks.astype(jnp.float64), state.evolution, params)
    best = jnp.min(jnp.where(feasible, penalized, jnp.inf))
    return State(
        evolution=evolution,
        recent=jnp.roll(state.recent, 1).at[0].set(best),
        spread=jnp.max(jnp.where(feasible, costs, -jnp.inf)) - jnp.min(jnp.where(feasible, costs, jnp.inf)),
        restarts=state.restarts,
    )


def stop(strategy: Strategy, state: State) -> Int[Array, ""]:
    """The first `Stop` that holds after a `tell` (tutorial, appendix B.3)."""
    evolution = state.evolution
    full = evolution.generation_counter >= strategy.memory
    span = jnp.max(state.recent) - jnp.min(state.recent)  # NaN or inf if some generation had nothing feasible
    steps = evolution.std * jnp.maximum(jnp.abs(evolution.p_c), jnp.sqrt(jnp.abs(jnp.diag(evolution.C))))
    holds = {
        Stop.NOT_FINITE: ~_finite(evolution),
        Stop.CONDITION: jnp.max(evolution.D) ** 2 > LARGEST_CONDITION * jnp.min(evolution.D) ** 2,
        Stop.GROWTH: evolution.std * jnp.max(evolution.D) > LARGEST_GROWTH * strategy.sigma,
        Stop.NOTHING_FEASIBLE: full & jnp.all(jnp.isposinf(state.recent)),
        Stop.TOLERANCE_X: jnp.all(steps < TOLERANCE_X * strategy.sigma),
        Stop.FLAT: full & ((span == 0) | ((span <= TOLERANCE_COST) & (state.spread <= TOLERANCE_COST))),
        Stop.GENERATIONS: evolution.generation_counter >= strategy.patience,
    }
    return jnp.select(list(holds.values()), [jnp.int32(reason) for reason in holds], jnp.int32(Stop.NONE))


def step_size(state: State) -> Float[Array, ""]:
    """Standard deviation of the population along its widest axis [box widths]."""
    return state.evolution.std * jnp.sqrt(jnp.linalg.eigvalsh(state.evolution.C)[-1])


def restart(strategy: Strategy, state: State, key: Key[Array, ""]) -> State:
    """The same state, or, where `stop` holds, a new search from a mean drawn uniformly from the box.

    The population keeps its size: shapes are fixed under jit, so the growth of IPOP is not to be had.
    """
    mean = jax.random.uniform(key, (strategy.dimensions,), jnp.float64)
    fresh = eqx.tree_at(lambda s: s.restarts, start(strategy, mean), state.restarts + 1)
    stopped = stop(strategy, state) != Stop.NONE
    return jax.tree.map(lambda new, old: jnp.where(stopped, new, old), fresh, state)


def _weight(costs: Float[Array, " P"], feasible: Bool[Array, " P"]) -> Float[Array, ""]:
    """gamma = 100 max(1, median f - min f) over the feasible points."""
    known = jnp.where(feasible, costs, jnp.nan)
    return 100.0 * jnp.where(jnp.any(feasible), jnp.maximum(1.0, jnp.nanmedian(known) - jnp.nanmin(known)), 1.0)


def _finite(evolution: PyTree) -> Bool[Array, ""]:
    moved = (evolution.mean, evolution.std, evolution.p_std, evolution.p_c, evolution.C)
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for part in moved]))


def _strong(leaf: Array) -> Array:
    """A scan's carry may not change its dtype: evosax starts with Python scalars."""
    leaf = jnp.asarray(leaf)
    return leaf.astype(jnp.float64 if jnp.issubdtype(leaf.dtype, jnp.floating) else jnp.int32)


def _weights_of_ranks(population, ranks, state, params):
    return params.weights[ranks.astype(jnp.int32)]


@functools.cache
def _evosax(dimensions: int, population: int):
    if jnp.result_type(float) != jnp.float64:
        raise ValueError("CMA-ES needs float64, but jax_enable_x64 is False: set it before the search starts")
    # A first call inside jit would otherwise keep its tracers in the cache.
    with jax.ensure_compile_time_eval():
        es = CMA_ES(population, jnp.zeros(dimensions), fitness_shaping_fn=_weights_of_ranks)
        return es, es.default_params
