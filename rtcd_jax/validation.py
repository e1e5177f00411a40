"""Funnel -> epsilon: held-out samples, independent of whatever chose the levels.

States uniform in each ellipsoid are rolled out; a failure shrinks its level, and everything is repeated with new states
until a whole round has none. At the start of a round its levels are fixed and its states are new: if some knot's
failure probability is above epsilon, the round is clean with a probability of at most (1 - epsilon)^M for M states a
knot. At most R rounds are made and the first clean one ends them, so that the levels that stand are wrong with a
probability of at most R (1 - epsilon)^M, whatever the rounds before did to them (docs/theory.md, section 4).
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from rtcd_jax import rollout
from rtcd_jax.adversary import Constant, Drawn, Worst
from rtcd_jax.centers import Robots, facing, for_each
from rtcd_jax.config.schema import FunnelConfig, GoalConfig
from rtcd_jax.numerics import sampling
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.numerics.loops import packed_scan
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Policy, Status

SAFETY = 0.98
"""Level over that of the lowest held-out sample that failed."""

CHEAP_ROUNDS = 20
"""On average at most, before each round on which epsilon rests."""


@dataclasses.dataclass(frozen=True)
class Dynamics:
    """Whose physics the directions and the held-out samples feel; `share` a part of these."""

    directions: rollout.Dynamics
    held_out: rollout.Dynamics
    share: rollout.Dynamics | None = None


@dataclasses.dataclass(frozen=True)
class SamplingBudget:
    """How thoroughly a funnel is sampled.

    `rounds` of held-out samples at most: of `funnel.trials` states a knot over one interval, then of as many to the
    goal, and at last of `samples_per_knot` to the goal (0: none of either), `batch` states at a time.
    """

    funnel: FunnelConfig
    dynamics: Dynamics
    rounds: int
    samples_per_knot: int = 0
    batch: int = 2048


class Rollouts(NamedTuple):
    """What rollouts of a policy need, over one interval or from any knot to the goal.

    `robots` are those whose own motions are the centers of the sets, where not all have x* as theirs.
    """

    problem: Problem
    candidate: Candidate
    policy: Policy
    sets: Ellipsoids
    tracking: rollout.TrackingData
    stiffness: rollout.Stiffness
    goal: GoalConfig
    robots: Robots | None = None

    @classmethod
    def of(cls, problem: Problem, candidate: Candidate, policy: Policy, funnel: FunnelConfig) -> "Rollouts":
        sets = Ellipsoids.about(policy.trajectory.xs.T, jnp.moveaxis(policy.values, 0, -1))
        tracking = rollout.tracking_data(problem, candidate, policy, funnel.steps)
        stiffness = rollout.stiffness(problem, candidate, policy, funnel)
        robots, uncertainty = None, problem.uncertainty
        if uncertainty is not None and uncertainty.moving:
            robots = Robots.of(problem, candidate, tracking, sets.centers, uncertainty)
        return cls(problem, candidate, policy, sets, tracking, stiffness, funnel.goal, robots)

    def about(self, robot: Robots | None) -> "Rollouts":
        """With one robot's own motion as the center of the sets."""
        if robot is None:
            return self
        tracking = self.tracking._replace(shift=robot.shifts)
        return self._replace(sets=self.sets._replace(centers=robot.centers), tracking=tracking)

    def offsets(self) -> Float[Array, " knots"] | None:
        """The largest sqrt(V_k) of a robot's own motion."""
        if self.robots is None:
            return None
        return jnp.sqrt(jnp.max(jax.vmap(self.sets.level)(self.robots.centers), 0))

    @property
    def intervals(self) -> int:
        return self.sets.centers.shape[1] - 1

    @property
    def time_behind(self) -> float:
        """For how long states are followed after t_N [s]: not at all from a catch set."""
        return self.goal.horizon if not self.problem.caught else 0.0

    def roll(
        self, tracking: rollout.TrackingData, x: Float[Array, "n intervals *batch"], dynamics: rollout.Dynamics
    ) -> tuple[Float[Array, "n intervals *batch"], Float[Array, "intervals *batch"]]:
        """End states and peaks after one interval each."""
        return rollout.roll_intervals(self.problem, self.candidate, tracking, x, dynamics)

    def at_goal(
        self, x: Float[Array, "n *batch"], dynamics: rollout.Dynamics
    ) -> tuple[Float[Array, "n *batch"], Float[Array, "*batch"]]:
        """End states and peaks after the horizon under the goal's LQR."""
        lqr, timing = (self.policy.gains[-1], self.policy.values[-1]), (self.goal.horizon, self.goal.step)
        return rollout.roll_at_goal(self.problem, self.candidate, lqr, x, dynamics, *timing, self.stiffness.parts)

    def interval(
        self, x: Float[Array, "n S"], k: Int[Array, ""], dynamics: rollout.Dynamics
    ) -> tuple[Float[Array, "n S"], Bool[Array, " S"]]:
        """States after interval `k`, and whether they stayed in the boxes till then."""
        ends, peaks = self.roll(self.tracking.part(k + np.arange(1)), x[:, None], dynamics)
        return ends[:, 0], peaks[0] <= 1

    def arrive(
        self, x: Float[Array, "n S"], dynamics: rollout.Dynamics, last: Float[Array, ""]
    ) -> tuple[Float[Array, "n S"], Bool[Array, " S"]]:
        """States after the horizon behind t_N, and whether they came closer to the goal, inside the boxes.

        Against an opponent it is enough that they stay in the residual set of the region of level `last`. With a catch
        set the motion is over: the states are those of t_N, and nothing is asked.
        """
        if self.problem.caught:
            return x, jnp.ones(x.shape[1:], bool)
        ends, peaks = self.at_goal(x, dynamics)
        before, after = self.level(x, self.intervals), self.level(ends, self.intervals)
        closer = after < before
        if isinstance(dynamics.opponent, Worst | Drawn):
            closer |= after <= dynamics.opponent.uncertainty.residual**2 * last
        return ends, (peaks <= 1) & closer

    def level(
        self, x: Float[Array, "n S"], k: Int[Array, ""] | int, centers: Float[Array, "n S"] | None = None
    ) -> Float[Array, " S"]:
        """V_k of states at one knot, each about its own center where that is not x*_k."""
        sets = self.sets.part(k + np.arange(1))
        return (sets.level(x[:, None]) if centers is None else sets.value_of_error((x - centers)[:, None]))[0]

    def uniform(
        self, levels: Float[Array, " knots"], born: Int[Array | np.ndarray, " S"], key: PRNGKeyArray
    ) -> Float[Array, "n S"]:
        """States, each uniform in the ellipsoid of the knot in which it is born."""
        y = sampling.ball(key, born.shape, self.sets.centers.shape[0], levels.dtype)
        return self.sets.part(born).points(jnp.sqrt(levels)[born], y)


class OwnMotions(NamedTuple):
    """The centers [n S] of drawn robots' funnels at one knot, for states that are `born` at some knot with an `offset`
    from their robot's center; all None where x* is the center of all.
    """

    centers: Float[Array, "n S"] | None
    offset: Float[Array, "n S"] | None
    born: Int[Array | np.ndarray, " S"] | None
    robots: Constant | None

    @classmethod
    def of(
        cls, rollouts: Rollouts, drawn: Drawn | None, x: Float[Array, "n S"], born: Int[Array | np.ndarray, " S"]
    ) -> "OwnMotions":
        """At x*(0), for states that were drawn about x*."""
        if drawn is None or not drawn.uncertainty.moving:
            return cls(None, None, None, None)
        at_knots = rollouts.sets.centers
        start = jnp.broadcast_to(at_knots[:, :1], x.shape)
        return cls(start, x - at_knots[:, born], jnp.asarray(born), Constant(drawn.plant, drawn.scales))

    def first(self, knot: Int[Array | np.ndarray, ""]) -> Int[Array | np.ndarray, ""] | int:
        """The knot to begin with, if the first state is born at `knot`."""
        return knot if self.centers is None else 0

    def start(self, x: Float[Array, "n S"], k: Int[Array, ""] | int) -> Float[Array, "n S"]:
        """The states at knot k, where those that are born there are about their own centers."""
        if self.centers is None or self.offset is None:
            return x
        return jnp.where(self.born == k, self.centers + self.offset, x)

    def onward(self, rollouts: Rollouts, k: Int[Array, ""]) -> "OwnMotions":
        """At the knot behind k."""
        if self.centers is None:
            return self
        alone = rollout.closed_form(rollouts.problem.plant, self.robots)
        return self._replace(centers=rollouts.interval(self.centers, k, alone)[0])


class _Validated(NamedTuple):
    levels: Float[Array, " knots"]
    failures: Int[Array, " knots"]
    clean: Bool[Array, ""]
    round: Int[Array, ""]


def validate_intervals(
    rollouts: Rollouts, levels: Float[Array, " knots"], key: PRNGKeyArray, budget: SamplingBudget
) -> tuple[Float[Array, " knots"], Int[Array, " knots"]]:
    """Levels and samples after held-out states were rolled out over one interval each: B_k into B_{k+1}.

    The last level keeps zero samples: no interval starts there.
    """
    count = budget.funnel.trials

    def one_round(levels, key):
        inner, share = jax.random.split(key)

        def rolled(robot):
            """Levels of the samples at the intervals' starts and ends, and their peaks."""
            own = rollouts.about(robot)
            starts, nexts = own.sets.part(slice(0, -1)), own.sets.part(slice(1, None))
            x = _uniform(starts, levels[:-1], inner, count)
            ends, peaks = own.roll(own.tracking, x, facing(budget.dynamics.held_out, robot))
            if budget.dynamics.share is not None:
                which = _share(share, x.shape[1], budget.funnel)
                chosen = x[:, which.knots, : which.states]
                new_ends, new_peaks = own.roll(own.tracking.part(which.knots), chosen, budget.dynamics.share)
                ends = ends.at[:, which.knots, : which.states].set(new_ends)
                peaks = peaks.at[which.knots, : which.states].set(new_peaks)
            return starts.level(x), nexts.level(ends), peaks <= 1

        samples = for_each(rollouts.robots, rolled)
        if rollouts.robots is not None:
            samples = [jnp.concatenate(list(of_robots), 1) for of_robots in samples]
        shrunk, failures = _shrink(levels, *samples)
        return shrunk, jnp.append(failures, 0)

    done = _repeat(one_round, levels, key, budget.rounds)
    samples = jnp.where(done.failures == 0, count, 0).at[-1].set(0)
    return done.levels, samples.astype(jnp.int32)


def validate_paths(
    rollouts: Rollouts,
    levels: Float[Array, " knots"],
    key: PRNGKeyArray,
    budget: SamplingBudget,
    samples_per_knot: Int[Array, ""] | int | None = None,
) -> tuple[Float[Array, " knots"], Int[Array, " knots"]]:
    """Levels and samples after held-out states of all knots were followed to the goal, by the closed form.

    In rounds of `samples_per_knot` (a number or a tracer; the budget's), on which epsilon rests. Before each of them
    come cheap ones of `budget.funnel.trials` states a knot, until one is clean.

    Where every robot has its own center, it is followed beside the state of its funnel from x*(0) on.

    A state fails if it leaves the funnel at a later knot, leaves the boxes, or, where the goal is held, does not come
    closer to it (by its V) over the horizon after t_N. Wherever a path leaves the funnel, the level from which it left
    is the one to shrink: paths of many knots run together, into corners that states uniform in that knot's ellipsoid
    hardly visit.

    The states of a round go in batches, knot by knot from the last one, since a path needs the levels of later knots
    alone: each batch finds the levels as the batches before left them, and a round without failures leaves them as they
    were. A batch starts at the first knot of its own, and only its states are held in memory. A round on which epsilon
    would rest begins with the knots that failed in the last such round and ends with the first knot that fails, so that
    nearly all of the work is the clean round's.
    """
    knots, most = levels.shape[0], budget.samples_per_knot
    batch = min(budget.batch, knots * most)
    last_count = jnp.asarray(most if samples_per_knot is None else samples_per_knot, int)
    first_count = jnp.asarray(min(budget.funnel.trials, most), int)
    plant, uncertainty = rollouts.problem.plant, rollouts.problem.uncertainty

    # Without a funnel no round would ever be clean.
    hopeful = (rollouts.policy.status == Status.OK) & jnp.all(jnp.isfinite(levels) & (levels > 0))

    def follow(levels, born, key):
        """Levels below those of states of the knots `born` that failed, and which of these states did."""
        drawn = None if uncertainty is None else Drawn.of(plant, uncertainty, jax.random.fold_in(key, 1), batch)
        x = rollouts.uniform(levels, born, key)
        own = OwnMotions.of(rollouts, drawn, x, born)

        def forward(k, state):
            x, own, values, inside = state
            started = born <= k
            x = own.start(x, k)
            opponent = drawn if drawn is None else drawn.at_knot(k)
            ends, within = rollouts.interval(x, k, rollout.closed_form(plant, opponent))
            values = values.at[k].set(rollouts.level(x, k, own.centers))
            return jnp.where(started, ends, x), own.onward(rollouts, k), values, inside.at[k].set(within)

        blank = jnp.zeros((knots - 1, batch), x.dtype), jnp.zeros((knots - 1, batch), bool)
        first = own.first(jnp.min(born))
        x, own, values, inside = jax.lax.fori_loop(first, knots - 1, forward, (x, own, *blank))
        x = own.start(x, knots - 1)
        _, arrives = rollouts.arrive(x, rollout.closed_form(plant, drawn), levels[-1])
        last = rollouts.level(x, knots - 1, own.centers)
        final = _below(levels[-1], last, ~arrives)

        def backward(carry, knot):
            target, after, failed = carry
            k, level, value, within = knot
            left = (born <= k) & ~(within & (after <= target))
            shrunk = _below(level, value, left)
            return (shrunk, value, failed | left), shrunk

        rows = jnp.arange(knots - 1), levels[:-1], values, inside
        (_, _, failed), shrunk = jax.lax.scan(backward, (final, last, ~arrives), rows, reverse=True)
        return jnp.append(shrunk, final), failed

    def one_round(levels, count, order, stops, key):
        """Levels and failures [K] after `count` states of each knot, the knots in the `order` given."""

        def goes_on(carry):
            number, _, failures = carry
            ends_a_knot = (number * batch) % count < batch
            spoilt = stops & ends_a_knot & jnp.any(failures > 0)
            return (number * batch < knots * count) & ~spoilt

        def one_batch(carry):
            number, levels, failures = carry
            place = (number * batch + np.arange(batch)) // count
            born = order[jnp.minimum(place, knots - 1)]  # the last batch is filled up
            levels, failed = follow(levels, born, jax.random.fold_in(key, number))
            return number + 1, levels, failures.at[born].add(failed)

        start = 0, levels, jnp.zeros(knots, int)
        return jax.lax.while_loop(goes_on, one_batch, start)[1:]

    def again(state):
        decides = state.settled
        failed_before = jnp.where(decides, state.failures, 0)[::-1]
        order = knots - 1 - jnp.argsort(-failed_before, stable=True)
        count = jnp.where(decides, last_count, first_count)
        number = state.cheap + state.decisive
        levels, failures = one_round(state.levels, count, order, decides, jax.random.fold_in(key, number))
        clean = jnp.all(failures == 0)
        cheap = state.cheap + ~decides
        return _Followed(
            levels,
            jnp.where(decides, failures, state.failures),
            settled=~decides & (clean | (cheap >= CHEAP_ROUNDS * (state.decisive + 1))),
            done=decides & clean,
            cheap=cheap,
            decisive=state.decisive + decides,
        )

    def goes_on(state: _Followed) -> Bool[Array, ""]:
        return hopeful & ~state.done & (state.decisive < budget.rounds)

    no, none = jnp.asarray(False), jnp.asarray(0)
    last = jax.lax.while_loop(goes_on, again, _Followed(levels, jnp.zeros(knots, int), no, no, none, none))
    samples = jnp.where(last.done, last_count, 0)
    return last.levels, jnp.broadcast_to(samples, knots).astype(jnp.int32)


class _Followed(NamedTuple):
    """`failures` of the last round that decides; `settled`: the last cheap one was clean, or there were enough."""

    levels: Float[Array, " knots"]
    failures: Int[Array, " knots"]
    settled: Bool[Array, ""]
    done: Bool[Array, ""]
    cheap: Int[Array, ""]
    decisive: Int[Array, ""]


class PhysicsComparison(eqx.Module):
    """MJX beside the closed form on `states` held-out states, followed from their knots to the goal.

    `failures` of them fail by MJX. `difference` is the largest one of the two physics at any knot and at the end of the
    horizon, in radii of that knot's ellipsoid: sqrt(V_k(x_mjx - x_closed) / rho_k). It is that of the state `start` of
    `knot`, and `closed_form` and `mjx` are where it is `time` [s] then.
    """

    states: Int[Array, ""]
    failures: Int[Array, ""]
    difference: Float[Array, ""]
    knot: Int[Array, ""]
    time: Float[Array, ""]
    start: Float[Array, " n"]
    closed_form: Float[Array, " n"]
    mjx: Float[Array, " n"]


class _Pair(NamedTuple):
    """States of both physics side by side, where they were born, and the largest difference so far with its place."""

    starts: Float[Array, "n S"]
    closed_form: Float[Array, "n S"]
    mjx: Float[Array, "n S"]
    failed: Bool[Array, " S"]
    difference: Float[Array, " S"]
    place: Int[Array, " S"]
    ends: Float[Array, "2 n S"]

    def starting(self, own: OwnMotions, k: Int[Array, ""] | int) -> "_Pair":
        """With the states that are born at knot k."""
        starts, closed_form, mjx = (own.start(x, k) for x in (self.starts, self.closed_form, self.mjx))
        return self._replace(starts=starts, closed_form=closed_form, mjx=mjx)

    def seen(self, place: Int[Array, ""] | int, difference: Float[Array, " S"]) -> "_Pair":
        """With the states of now where they differ more than ever; a NaN differs without limit."""
        difference = jnp.where(jnp.isnan(difference), jnp.inf, difference)
        larger = difference > self.difference
        return self._replace(
            difference=jnp.maximum(difference, self.difference),
            place=jnp.where(larger, place, self.place),
            ends=jnp.where(larger, jnp.stack([self.closed_form, self.mjx]), self.ends),
        )


def compare_physics(
    rollouts: Rollouts,
    levels: Float[Array, " knots"],
    key: PRNGKeyArray,
    states: int,
    mjx: Callable[..., rollout.Dynamics] = rollout.mjx,
) -> PhysicsComparison:
    """Follows `states` new states, spread evenly over the knots' ellipsoids, by the closed form and by `mjx`.

    Under an uncertainty every state has a drawn robot of its own, the same in both.
    """
    plant, uncertainty = rollouts.problem.plant, rollouts.problem.uncertainty
    knots = levels.shape[0]
    blocks = -(-states // _MJX_BLOCK)
    born = np.sort(np.arange(states) % knots)
    born = np.append(born, np.repeat(born[-1:], -states % blocks)).reshape(blocks, -1)

    def difference(x, other, k):
        return jnp.sqrt(rollouts.sets.part(k + np.arange(1)).value_of_error((other - x)[:, None])[0] / levels[k])

    def block(_, mine):
        number, born = mine
        key_of_block = jax.random.fold_in(key, number)
        x = rollouts.uniform(levels, born, key_of_block)
        robots = None
        if uncertainty is not None:
            robots = Drawn.of(plant, uncertainty, jax.random.fold_in(key_of_block, 1), born.shape[0])

        def forward(k, state: tuple[_Pair, OwnMotions]) -> tuple[_Pair, OwnMotions]:
            pair, own = state
            pair, own, started = pair.starting(own, k), own.onward(rollouts, k), born <= k
            drawn = robots if robots is None else robots.at_knot(k)
            ends, _ = rollouts.interval(pair.closed_form, k, rollout.closed_form(plant, drawn))
            other, inside = rollouts.interval(pair.mjx, k, mjx(plant, drawn))
            left = started & ~(inside & (rollouts.level(other, k + 1, own.centers) <= levels[k + 1]))
            pair = pair._replace(
                closed_form=jnp.where(started, ends, pair.closed_form),
                mjx=jnp.where(started, other, pair.mjx),
                failed=pair.failed | left,
            )
            apart = difference(pair.closed_form, pair.mjx, k + 1)
            return pair.seen(k + 1, jnp.where(started, apart, 0)), own

        nothing = jnp.zeros(born.shape, bool), jnp.full(born.shape, -1.0), born, jnp.stack([x, x])
        own = OwnMotions.of(rollouts, robots, x, born)
        start = _Pair(x, x, x, *nothing), own
        pair, own = jax.lax.fori_loop(own.first(born[0]), knots - 1, forward, start)
        pair = pair.starting(own, knots - 1)
        ends, _ = rollouts.arrive(pair.closed_form, rollout.closed_form(plant, robots), levels[-1])
        other, arrives = rollouts.arrive(pair.mjx, mjx(plant, robots), levels[-1])
        pair = pair._replace(closed_form=ends, mjx=other, failed=pair.failed | ~arrives)
        return None, pair.seen(knots, difference(ends, other, knots - 1))

    _, pairs = jax.lax.scan(block, None, (np.arange(blocks), born))
    flat = jnp.argmax(pairs.difference)
    where = flat // born.shape[1], flat % born.shape[1]
    closed, other = pairs.ends[where[0], :, :, where[1]]
    dt = rollouts.policy.trajectory.dt
    place = pairs.place[where]
    return PhysicsComparison(
        states=jnp.asarray(states),
        failures=jnp.sum(pairs.failed.reshape(-1)[:states]),
        difference=pairs.difference[where],
        knot=jnp.asarray(born)[where],
        time=jnp.where(place == knots, (knots - 1) * dt + rollouts.time_behind, place * dt),
        start=pairs.starts[where[0], :, where[1]],
        closed_form=closed,
        mjx=other,
    )


_MJX_BLOCK = 256
"""States that MJX follows together: they start at the first knot of theirs, and wait till it is their turn."""


def _below(level, values, failed):
    """The level, or less than the lowest value that failed below it."""
    lowest = jnp.min(jnp.where(failed & (values <= level), values, jnp.inf))
    return jnp.minimum(level, SAFETY * lowest)


def _repeat(one_round: Callable, levels, key, rounds) -> _Validated:
    def again(state: _Validated):
        levels, failures = one_round(state.levels, jax.random.fold_in(key, state.round))
        return _Validated(levels, failures, jnp.sum(failures) == 0, state.round + 1)

    state = _Validated(levels, jnp.ones(levels.shape, int), jnp.asarray(False), jnp.asarray(0))  # nothing tried yet
    return jax.lax.while_loop(lambda state: ~state.clean & (state.round < rounds), again, state)


def _uniform(sets: Ellipsoids, levels, key, count: int):
    """States [n K count], uniform in each ellipsoid."""
    shape = (levels.shape[0], count)
    y = sampling.ball(key, shape, sets.centers.shape[0], levels.dtype)
    return sets.points(jnp.broadcast_to(jnp.sqrt(levels)[:, None], shape), y)


def _shrink(levels, starts, ends, inside):
    """Levels below the lowest held-out sample that failed, backward over the knots, and how many failed [N]."""

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
    """A random share of the held-out samples, the same for all candidates.

    The states of one knot are exchangeable: the first few of randomly chosen knots are as good as any.
    """
    per_knot = funnel.mjx_share * funnel.trials
    states = max(1, round(per_knot))
    chosen = max(1, round(knots * min(1.0, per_knot / states)))
    return _Share(jax.random.permutation(key, np.arange(knots))[:chosen], states)
