"""How CMA-ES is laid over a genome: one search over all of it, or the paper's weights inside designs.

Both loops ask for one flat population [P, d] a generation, and say after it which of their searches stopped.
"""

import dataclasses
from typing import final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from rtcd_jax.search import cmaes
from rtcd_jax.search.cmaes import Stop, Strategy


@final
@dataclasses.dataclass(frozen=True)
class Joint:
    """One search over all free variables, from the genome `initial`."""

    strategy: Strategy
    initial: tuple[float, ...]

    def start(self) -> cmaes.State:
        return cmaes.start(self.strategy, jnp.asarray(self.initial, jnp.float64))

    def ask(self, state: cmaes.State, key: Key[Array, ""]):
        """The state and the points [P, d] that `tell` needs, and the genomes [P, d] in the unit box."""
        state, points = cmaes.ask(self.strategy, state, key)
        return state, points, cmaes.clip(points)

    def tell(self, state: cmaes.State, points: Float[Array, "P d"], costs: Float[Array, " P"], key: Key[Array, ""]):
        """The state after the population, and the `Stop` [1] at which the search was restarted."""
        state, reason = _told(self.strategy, state, points, costs, key)
        return state, reason[None]

    def sigma(self, state: cmaes.State) -> Float[Array, ""]:
        return cmaes.step_size(state)


@final
class NestedState(eqx.Module):
    """The outer search, its D designs as asked for, and for each an inner search, `age` generations old.

    `best` is the lowest cost that each design has reached, +inf for none.
    """

    outer: cmaes.State
    designs: Float[Array, "D a"]
    inner: cmaes.State
    best: Float[Array, " D"]
    age: Int[Array, ""]


@final
@dataclasses.dataclass(frozen=True)
class Nested:
    """An outer search over designs, each with an inner search over weights from the initial ones (paper, RTC-D).

    The inner searches run side by side: one generation of all of them is one population of `outer.population` times
    `inner.population` candidates, design by design; after `generations` of these the outer search is told each
    design's best.
    """

    outer: Strategy
    inner: Strategy
    generations: int
    initial: tuple[float, ...]
    design: tuple[bool, ...]

    @classmethod
    def plan(
        cls,
        population: int,
        designs: int,
        generations: int,
        sigma: float,
        initial: tuple[float, ...],
        design: tuple[bool, ...],
    ) -> "Nested":
        """The loops that evaluate `population` candidates at a time; `design` [d] flags the outer variables.

        Raises ValueError if either loop has no variable or the population is no multiple of the designs.
        """
        outer = sum(design)
        if not outer:
            raise ValueError("nested loops need a free design variable, but the design is pinned: search jointly")
        if outer == len(design):
            raise ValueError("nested loops need a free weight, but all weights are pinned: search jointly")
        if population % designs:
            raise ValueError(f"the population must be a multiple of the {designs} designs, got {population}")
        inner = Strategy(len(design) - outer, population // designs, sigma)
        return cls(Strategy(outer, designs, sigma), inner, generations, initial, design)

    def start(self) -> NestedState:
        design = self._part(outer=True)
        designs = self.outer.population
        return NestedState(
            outer=cmaes.start(self.outer, design),
            designs=jnp.tile(design, (designs, 1)),
            inner=self._fresh_inner(),
            best=jnp.full(designs, jnp.inf, jnp.float64),
            age=jnp.zeros((), jnp.int32),
        )

    def ask(self, state: NestedState, key: Key[Array, ""]):
        """The state and the points [D, P/D, w] that `tell` needs, and the genomes [P, d] in the unit box."""
        outer_key, *inner_keys = jax.random.split(key, 1 + self.outer.population)
        state = _where(state.age == 0, self._with_new_designs(state, outer_key), state)
        inner, points = jax.vmap(lambda s, k: cmaes.ask(self.inner, s, k))(state.inner, jnp.stack(inner_keys))
        return dataclasses.replace(state, inner=inner), points, self._genomes(state.designs, points)

    def tell(self, state: NestedState, points: Float[Array, "D L w"], costs: Float[Array, " P"], key: Key[Array, ""]):
        """The state after the population, and the `Stop` [1+D] of the outer and of the inner searches."""
        outer_key, *inner_keys = jax.random.split(key, 1 + self.outer.population)
        costs = costs.reshape(points.shape[:2])
        inner, inner_reasons = jax.vmap(lambda s, p, c, k: _told(self.inner, s, p, c, k))(
            state.inner, points, costs, jnp.stack(inner_keys)
        )
        best = jnp.minimum(state.best, jnp.min(costs, axis=1))
        outer, outer_reason = _told(self.outer, state.outer, state.designs, best, outer_key)
        age = state.age + 1
        over = age == self.generations
        after = NestedState(
            outer=_where(over, outer, state.outer),
            designs=state.designs,
            inner=inner,
            best=best,
            age=jnp.where(over, 0, age),
        )
        return after, jnp.concatenate([jnp.where(over, outer_reason, Stop.NONE)[None], inner_reasons])

    def sigma(self, state: NestedState) -> Float[Array, ""]:
        return cmaes.step_size(state.outer)

    def _with_new_designs(self, state: NestedState, key: Key[Array, ""]) -> NestedState:
        outer, designs = cmaes.ask(self.outer, state.outer, key)
        best = jnp.full_like(state.best, jnp.inf)
        return NestedState(outer, designs, self._fresh_inner(), best, state.age)

    def _fresh_inner(self) -> cmaes.State:
        inner = cmaes.start(self.inner, self._part(outer=False))
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (self.outer.population, *leaf.shape)), inner)

    def _part(self, outer: bool) -> Float[Array, " part"]:
        return jnp.asarray(self.initial, jnp.float64)[self._indices(outer)]

    def _indices(self, outer: bool) -> np.ndarray:
        return np.flatnonzero(np.asarray(self.design) == outer)

    def _genomes(self, designs: Float[Array, "D a"], points: Float[Array, "D L w"]) -> Float[Array, "P d"]:
        repeated = jnp.broadcast_to(designs[:, None], (*points.shape[:2], designs.shape[1]))
        genomes = jnp.zeros((*points.shape[:2], len(self.design)), points.dtype)
        genomes = genomes.at[..., self._indices(True)].set(repeated).at[..., self._indices(False)].set(points)
        return cmaes.clip(genomes.reshape(-1, len(self.design)))


def _told(strategy: Strategy, state: cmaes.State, points, costs, key: Key[Array, ""]):
    """The state after a population, restarted if it stopped, and why."""
    state = cmaes.tell(strategy, state, points, costs)
    return cmaes.restart(strategy, state, key), cmaes.stop(strategy, state)


def _where(condition, new, old):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)
