"""Fresh states for a funnel: what (epsilon, beta) rests on.

Independent states, uniform in each ellipsoid, are rolled out; a failure shrinks its level, and everything is repeated
with new states until a whole pass has none. M states without a failure leave a failure probability of at most
1 - beta^(1/M) with confidence 1 - beta.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtcd_jax import rollout
from rtcd_jax.config.schema import FunnelConfig
from rtcd_jax.numerics import sampling
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.numerics.loops import packed_scan

SAFETY = 0.98
"""Level over that of the lowest fresh state that failed."""


@dataclasses.dataclass(frozen=True)
class Dynamics:
    """Whose physics the directions and the fresh states feel; `share` a part of these."""

    directions: rollout.Dynamics
    fresh: rollout.Dynamics
    share: rollout.Dynamics | None = None


@dataclasses.dataclass(frozen=True)
class Effort:
    """How thoroughly a funnel is sampled.

    `rounds` of fresh states at most, and whether these are followed to the goal in the end.
    """

    funnel: FunnelConfig
    dynamics: Dynamics
    rounds: int
    follow: bool


class _Confirmed(NamedTuple):
    levels: Float[Array, " K"]
    failures: Int[Array, " K"]
    clean: Bool[Array, ""]
    round: Int[Array, ""]


def confirm(problem, candidate, sets: Ellipsoids, tracked, levels, key, effort: Effort):
    """Levels [K] and trials [K] after fresh states were rolled out over one interval each: B_k into B_{k+1}.

    The last level keeps zero trials: no interval starts there.
    """
    starts, nexts = sets.part(slice(0, -1)), sets.part(slice(1, None))

    def one_pass(levels, key):
        inner, share = jax.random.split(key)
        x = _fresh(starts, levels[:-1], inner, effort.funnel.trials)
        ends, peaks = rollout.roll_intervals(problem, candidate, tracked, x, effort.dynamics.fresh)
        if effort.dynamics.share is not None:
            which = _share(share, x.shape[1], effort.funnel)
            part = tracked.part(which.knots)
            chosen = x[:, which.knots, : which.states]
            new_ends, new_peaks = rollout.roll_intervals(problem, candidate, part, chosen, effort.dynamics.share)
            ends = ends.at[:, which.knots, : which.states].set(new_ends)
            peaks = peaks.at[which.knots, : which.states].set(new_peaks)
        shrunk, failures = _shrink(levels, starts.level(x), nexts.level(ends), peaks <= 1)
        return shrunk, jnp.append(failures, 0)

    done = _repeat(one_pass, levels, key, effort.rounds)
    trials = jnp.where(done.failures == 0, effort.funnel.trials, 0).at[-1].set(0)
    return done.levels, trials.astype(jnp.int32)


def follow(problem, candidate, policy, sets: Ellipsoids, tracked, levels, key, effort: Effort):
    """Levels [K] and trials [K] after fresh states of all knots were followed to the goal, by the closed form.

    A state fails if it leaves the funnel at a later knot, leaves the boxes, or does not come closer to the goal (by its
    V) over the horizon after t_N. Wherever a path leaves the funnel, the level from which it left is the one to shrink:
    paths of many knots run together, into corners that states uniform in that knot's ellipsoid hardly visit.
    """
    count, goal = effort.funnel.trials, effort.funnel.goal
    dynamics = rollout.closed_form(problem.plant)
    knots = levels.shape[0]
    born = np.repeat(np.arange(knots), count)[None]
    last = sets.part(slice(-1, None))

    def one_pass(levels, key):
        fresh = _fresh(sets, levels, key, count)
        flat = fresh.reshape(fresh.shape[0], 1, -1)  # every state is in the same interval at the same time

        def interval(x, k):
            ends, peaks = rollout.roll_intervals(problem, candidate, tracked.part(k + np.arange(1)), x, dynamics)
            started = born <= k
            return jnp.where(started, ends, x), (sets.part(k + np.arange(1)).level(x), peaks <= 1, started)

        x, path = jax.lax.scan(interval, flat, jnp.arange(knots - 1))
        ends, peaks = rollout.roll_at_goal(problem, candidate, policy.gains[-1], x, dynamics, goal.horizon, goal.step)
        arrives = (peaks <= 1) & (last.level(ends) < last.level(x))
        final = _below(levels[-1], last.level(x), ~arrives)

        def backward(carry, knot):
            target, after, failed = carry
            level, (here, inside, started) = knot
            left = started & ~(inside & (after <= target))
            shrunk = _below(level, here, left)
            return (shrunk, here, failed | left), shrunk

        (_, _, failed), shrunk = jax.lax.scan(
            backward, (final, last.level(x), ~arrives), (levels[:-1], path), reverse=True
        )
        return jnp.append(shrunk, final), jnp.sum(failed.reshape(knots, count), 1)

    done = _repeat(one_pass, levels, key, effort.rounds)
    return done.levels, jnp.where(done.failures == 0, count, 0).astype(jnp.int32)


def _below(level, values, failed):
    """The level, or less than the lowest value that failed below it."""
    lowest = jnp.min(jnp.where(failed & (values <= level), values, jnp.inf))
    return jnp.minimum(level, SAFETY * lowest)


def _repeat(one_pass: Callable, levels, key, rounds: int) -> _Confirmed:
    def again(state: _Confirmed):
        levels, failures = one_pass(state.levels, jax.random.fold_in(key, state.round))
        return _Confirmed(levels, failures, jnp.sum(failures) == 0, state.round + 1)

    state = _Confirmed(levels, jnp.ones(levels.shape, int), jnp.asarray(False), jnp.asarray(0))  # nothing tried yet
    return jax.lax.while_loop(lambda state: ~state.clean & (state.round < rounds), again, state)


def _fresh(sets: Ellipsoids, levels, key, count: int):
    """States [n K count], uniform in each ellipsoid."""
    shape = (levels.shape[0], count)
    y = sampling.ball(key, shape, sets.centers.shape[0], levels.dtype)
    return sets.points(jnp.broadcast_to(jnp.sqrt(levels)[:, None], shape), y)


def _shrink(levels, starts, ends, inside):
    """Levels below the lowest fresh state that failed, backward over the knots, and how many failed [N]."""

    def backward(target, knot):
        level, starts, ends, inside = knot
        failed = ~(inside & (ends <= target))
        shrunk = _below(level, starts, failed)
        return shrunk, (shrunk, jnp.sum(failed))

    knots = levels[:-1], starts, ends, inside
    _, (shrunk, failures) = packed_scan(backward, levels[-1], knots, reverse=True)
    return jnp.append(shrunk, levels[-1]), failures


class _Share(NamedTuple):
    knots: Int[Array, " chosen"]
    states: int


def _share(key, knots: int, funnel: FunnelConfig) -> _Share:
    """A random share of the fresh states, the same for all candidates.

    The states of one knot are exchangeable: the first few of randomly chosen knots are as good as any.
    """
    per_knot = funnel.mjx_share * funnel.trials
    states = max(1, round(per_knot))
    chosen = max(1, round(knots * min(1.0, per_knot / states)))
    return _Share(jax.random.permutation(key, np.arange(knots))[:chosen], states)
