"""Policy -> Policy: gains K_k and shapes S_k by gradients, so that the funnel under the run's `uncertainty` is large.

{V <= rho} holds all motions that are in it if V' <= (rho'/rho - DECAY_MARGIN) V wherever V = rho, for the worst input,
motor and robot (adversary.py). So the levels follow backward from the goal's:

    g(t, rho) = max {V' / V : V = rho, adversary},    d ln rho / dt = g(t, rho) + DECAY_MARGIN,    rho <= the boxes'.

This is not marched but solved for all instants at once, by Newton: g and its slope in ln rho at the levels of the
iterate before, then a linear recursion. Its last round is differentiated, the worst directions held (envelope theorem),
and Adam moves gains and shapes. (`jax.grad` straight through the rollouts of funnel.py gives NaN.)

What an optimizer is measured by must be finer than what it moves: the instants jump within their cells at every step,
and the worst directions are carried from step to step, tried nearby, and a third of them replaced by fresh ones. The
box of uncertainty grows from nothing, and waits while a funnel is dying. A result counts if `marched`, by
other directions and instants, agree with it, and if the elites' own estimator finds a larger volume.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from rtcd_jax.adversary import Situation, Worst
from rtcd_jax.numerics import sampling
from rtcd_jax.numerics.batched import cholesky, mv, solve_lower_transposed
from rtcd_jax.numerics.ellipsoid import Ellipsoids, half_widths, log_volume
from rtcd_jax.numerics.hermite import cubic_hermite, cubic_hermite_rate
from rtcd_jax.policy import Nominal, input_jumps, nominal, value_rates
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Policy, Uncertainty
from rtcd_jax.volume import VOLUMES, Knots, largest_pushes

DECAY_MARGIN = 0.02
"""[1/s]"""
FRACTION_OF_LIMIT = 0.99
"""Of the room to a limit on the states that an ellipsoid may fill."""
WIDEST = {2: 3.0}
WIDEST_OF_MANY = 0.6
"""Largest half width along an angle [rad], by the number of states: proofs follow no wider sine well."""
LARGEST_STATE = 1e3
"""In the place of no limit."""

CELLS = {2: 8}
CELLS_OF_MANY = 6
"""Instants in an interval, by the number of states."""
CLIMBERS, FRESH = 12, 32
"""Worst directions of an instant that are carried, and new ones tried, in each step."""
REACHES = np.array([0.3, 0.1, 0.03])
"""Standard deviations of the tries near a carried direction."""
GOAL_LEVELS, GOAL_FRESH = 40, 300
TEMPERATURE = 0.05
"""[1/s], of the weights of the carried directions in the gradient."""
GOAL_PENALTY, GOAL_DECAY = 3.0, 0.05
"""Of V that falls by less than this [1/s] at the goal, outside of what the uncertainty keeps from it."""
RESIDUAL = 0.6
"""Share of `uncertainty.residual` from which on V must fall at the goal."""
FASTEST_GROWTH = 67.0
"""V'/V [1/s] by the uncertainty beyond which a funnel is dying, and the gradient is that of its logarithm."""
SPEED_LIMIT = 300.0
"""[1/s], of the levels."""

RATE = {2: 0.02}
RATE_OF_MANY = 0.015
"""Adam's, by the number of states."""
SECOND_MOMENT = 0.99
RAMP = 0.5
"""Share of the steps in which the box of uncertainty grows, and the objective follows the geometric mean."""
INITIAL_ELLIPSOID = 0.1
"""Weight of the logarithm of the initial ellipsoid's volume beside the objective's."""
START_BELOW_BOX, DYING, DEAD = 5.0, 12.0, 25.0
"""ln of levels under those that the boxes allow: at first; where the uncertainty grows no further; at least."""
SETTLING = 25
"""Steps, before and after, in which levels and directions settle and nothing is changed."""
ANCHORED = 10
"""Steps between two changes to which a step that is not finite goes back."""

HEUN_STEPS = 12
"""Of an interval, in the independent levels."""
MARCH_DIRECTIONS = {2: 360}
MARCH_DIRECTIONS_OF_MANY = 600
AGREEMENT = 0.02
"""Largest relative difference of the objective by the two kinds of levels."""

_key = 1 << 33  # no search, no elite draws from it


@final
class Freedom(NamedTuple):
    """Changes, all zero at first: S = W T T' W' with S_0 = W W' and T = I + `shapes` (exponential on the diagonal), S'
    = S_0' + the change's slope + W X W' / dt with X = `rates`, K = K_0 + `gains` in units of |K_0|.
    """

    shapes: Float[Array, "knots n n"]
    rates: Float[Array, "intervals 2 n n"]
    gains: Float[Array, "knots m n"]


@final
class Start(NamedTuple):
    """What a refinement keeps of its candidate, and the policy that it begins with."""

    design: eqx.Module
    motion: Nominal
    values: Float[Array, "knots n n"]
    factors: Float[Array, "knots n n"]
    value_rates: Float[Array, "intervals 2 n n"]
    gains: Float[Array, "knots m n"]
    gain_units: Float[Array, "knots m n"]
    jumps: Float[Array, "knots n m"]
    free: Freedom
    """1 for what is moved, 0 for what stays."""


@final
class Shape(NamedTuple):
    """A policy's gains and value function, knots first."""

    values: Float[Array, "knots n n"]
    rates: Float[Array, "intervals 2 n n"]
    gains: Float[Array, "knots m n"]


@final
class Instants(NamedTuple):
    """The loop at T times; `factors` L of S = L L', `box` the logarithm of the level that touches a limit."""

    values: Float[Array, "n n T"]
    rates: Float[Array, "n n T"]
    centers: Float[Array, "n T"]
    center_rates: Float[Array, "n T"]
    gains: Float[Array, "m n T"]
    inputs: Float[Array, "m T"]
    factors: Float[Array, "n n T"]
    box: Float[Array, " T"]


@final
class State(NamedTuple):
    """What a refinement remembers between two steps: changes, Adam's moments, ln rho at the instants, directions, how
    much of the uncertainty is borne, the share of the rate that is left, and where a failed step goes back to.
    """

    freedom: Freedom
    moments: Any
    levels: Float[Array, " T"]
    directions: Float[Array, "n T M"]
    goal_directions: Float[Array, "n G M"]
    box: Float[Array, ""]
    rate: Float[Array, ""]
    anchor: Freedom


@final
class Estimate(NamedTuple):
    """Of one step: volumes and pushes of the knots, the share of the uncertainty borne, whether all is finite."""

    knots: Knots
    box: Float[Array, ""]
    finite: Bool[Array, ""]


@final
@dataclasses.dataclass(frozen=True)
class Refinement:
    """`steps` of Adam on gains and shapes.

    Its methods are pure, for one candidate, and to be mapped over several.
    """

    problem: Problem
    steps: int

    @property
    def _n(self) -> int:
        return self.problem.plant.n

    @property
    def _cells(self) -> int:
        return CELLS.get(self._n, CELLS_OF_MANY)

    @property
    def total(self) -> int:
        """Steps, those included that only settle."""
        return self.steps + 2 * SETTLING

    def start(self, candidate: Candidate, policy: Policy, free: Sequence[str]) -> Start:
        """`free` are "gains", "shapes" or both."""
        gains = policy.gains
        shapes, of_gains = (jnp.asarray(float(name in free), gains.dtype) for name in ("shapes", "gains"))
        units = jnp.maximum(jnp.abs(gains), 0.2 * jnp.max(jnp.abs(gains), 0))
        factors = jnp.moveaxis(cholesky(jnp.moveaxis(policy.values, 0, -1))[0], -1, 0)
        rates = value_rates(self.problem, candidate, policy)
        motion = nominal(self.problem, candidate, policy.trajectory)
        jumps, moved = input_jumps(self.problem, candidate, policy.trajectory), Freedom(shapes, shapes, of_gains)
        return Start(candidate.design, motion, policy.values, factors, rates, gains, units, jumps, moved)

    def begin(self, start: Start) -> State:
        """The state before the first step."""
        knots, _, n = start.gains.shape
        instants, zeros = (knots - 1) * self._cells, jnp.zeros_like
        freedom = Freedom(zeros(start.values), zeros(start.value_rates), zeros(start.gains))
        shape = self.shape(start, freedom)
        at = self._instants(start, shape, self._fractions(0.5))
        first, second = jax.random.split(jax.random.key(_key))
        one = jnp.ones((), start.gains.dtype)
        return State(
            freedom,
            _adam().init(freedom),
            at.box - START_BELOW_BOX,
            _unit(jax.random.normal(first, (n, instants, CLIMBERS))),
            _unit(jax.random.normal(second, (n, GOAL_LEVELS, CLIMBERS))),
            0 * one if self.problem.uncertainty is not None else one,
            one,
            freedom,
        )

    def step(self, start: Start, state: State, index: Array | int) -> tuple[State, Estimate]:
        """Step `index` of `total`; all candidates draw the same random numbers."""
        share = jnp.clip((index - SETTLING) / self.steps, 0, 1)
        moves = (index >= SETTLING) & (index < SETTLING + self.steps)
        rate = RATE.get(self._n, RATE_OF_MANY) * (0.02 + 0.49 * (1 + jnp.cos(jnp.pi * share))) * moves * state.rate
        keys = jax.random.split(jax.random.fold_in(jax.random.key(_key), index), 4)
        places = jax.random.uniform(keys[0], (self._cells,), minval=0.02, maxval=0.98)
        uncertainty = self._uncertainty(state.box)

        shape = self.shape(start, state.freedom)
        at = self._instants(start, shape, self._fractions(places))
        directions = self._worse(start, at, state.levels, state.directions, uncertainty, keys[1], FRESH)
        goal, goal_levels = self._goal(start, shape)
        goal_directions = state.goal_directions
        for key in keys[2:]:
            goal_directions = self._worse(start, goal, goal_levels, goal_directions, uncertainty, key, GOAL_FRESH)

        def loss(freedom: Freedom):
            shape = self.shape(start, freedom)
            found = self._levels(start, shape, state.levels, places, directions, goal_directions, uncertainty)
            weight, logs = jnp.minimum(share / RAMP, 1.0), found.knots.logs
            wanted = jnp.log(VOLUMES[self.problem.config.search.objective].of(found.knots))
            merit = weight * wanted + (1 - weight) * logs.mean() + INITIAL_ELLIPSOID * logs[0]
            return GOAL_PENALTY * found.goal_violation - merit, found

        (value, found), slope = jax.value_and_grad(loss, has_aux=True)(state.freedom)
        finite = jnp.isfinite(value) & jnp.all(jnp.array([jnp.all(jnp.isfinite(a)) for a in jax.tree.leaves(slope)]))
        change, moments = _adam().update(slope, state.moments)
        changed = jax.tree.map(
            lambda old, free, new: old - rate * free * _smoothed(new), state.freedom, start.free, change
        )
        least = jnp.min(found.levels - at.box)
        growth = moves * (least > -DYING) / max(1.0, RAMP * self.steps)
        pick = lambda new, old: jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)  # noqa: E731
        anchored = finite & (index % ANCHORED == 0)
        after = State(
            freedom=pick(changed, state.anchor),
            moments=pick(moments, state.moments),
            levels=jnp.where(jnp.isfinite(found.levels), found.levels, state.levels),
            directions=pick(directions, state.directions),
            goal_directions=pick(goal_directions, state.goal_directions),
            box=jnp.minimum(state.box + growth, 1.0),
            rate=jnp.where(finite, state.rate, 0.7 * state.rate),
            anchor=jax.tree.map(lambda a, b: jnp.where(anchored, a, b), state.freedom, state.anchor),
        )
        return after, Estimate(found.knots, state.box, finite)

    def shape(self, start: Start, freedom: Freedom) -> Shape:
        """Gains and value function after the changes."""
        n, dt = self._n, start.motion.dt
        diagonal = jnp.exp(jnp.einsum("kii->ki", freedom.shapes))
        triangle = jnp.tril(freedom.shapes, -1) + diagonal[:, :, None] * jnp.eye(n)
        factors = start.factors @ triangle
        values = factors @ jnp.swapaxes(factors, 1, 2)
        change = values - start.values
        inner = (change[2:] - change[:-2]) / (2 * dt)
        slopes = jnp.concatenate([(change[1:2] - change[:1]) / dt, inner, (change[-1:] - change[-2:-1]) / dt])
        lower = jnp.tril(freedom.rates)
        symmetric = lower + jnp.swapaxes(jnp.tril(lower, -1), -1, -2)
        ends = jnp.stack([factors[:-1], factors[1:]], 1)
        bent = ends @ symmetric @ jnp.swapaxes(ends, -1, -2) / dt
        rates = start.value_rates + jnp.stack([slopes[:-1], slopes[1:]], 1) + bent
        return Shape(values, rates, start.gains + start.gain_units * freedom.gains)

    def policy(self, policy: Policy, start: Start, state: State) -> Policy:
        """The policy with the gains and the value function of a state."""
        shape = self.shape(start, state.freedom)
        return dataclasses.replace(policy, gains=shape.gains, values=shape.values, value_rates=shape.rates)

    def marched(self, start: Start, state: State, key: PRNGKeyArray) -> Knots:
        """Volumes and pushes by independent levels under the whole uncertainty: Heun's method backward in `HEUN_STEPS`
        steps an interval, along directions of its own; zero where a level has fallen to nothing.
        """
        n, shape = self._n, self.shape(start, state.freedom)
        uncertainty = self._uncertainty(1.0)
        count = MARCH_DIRECTIONS.get(n, MARCH_DIRECTIONS_OF_MANY)
        keys = jax.random.split(key, 3)
        even = sampling.directions(keys[0], count, n, start.gains.dtype)[:, None]
        goal, goal_levels = self._goal(start, shape)
        aims = jnp.broadcast_to(even, (n, GOAL_LEVELS, count))
        growth = jnp.max(self._growth(start, goal, goal_levels, aims, uncertainty), -1) + DECAY_MARGIN
        last, violation = self._goal_level(goal, goal_levels, growth, 1.0)
        last = jnp.where(violation > GOAL_DECAY, -jnp.inf, last)

        at = self._instants(start, shape, np.arange(HEUN_STEPS + 1) / HEUN_STEPS)
        at = jax.tree.map(lambda a: jnp.moveaxis(a.reshape(*a.shape[:-1], -1, HEUN_STEPS + 1), (-2, -1), (0, 1)), at)
        h = start.motion.dt / HEUN_STEPS

        def fastest(at: Instants, level, directions, key):
            one = jax.tree.map(lambda a: a[..., None], at)
            directions = self._worse(start, one, level[None], directions, uncertainty, key, 3 * CLIMBERS)
            both = jnp.concatenate([even, directions], -1)
            growth = self._growth(start, one, level[None], both, uncertainty)[0]
            return jnp.clip(jnp.max(growth) + DECAY_MARGIN, -SPEED_LIMIT, SPEED_LIMIT), directions

        def interval(carry, at: Instants):
            def back(i, carry):
                level, directions, number = carry
                j = HEUN_STEPS - i
                here, there = (jax.tree.map(lambda a: a[k], at) for k in (j, j - 1))  # noqa: B023
                key = jax.random.fold_in(keys[1], number)
                slope, directions = fastest(here, level, directions, key)
                guess = jnp.minimum(level - h * slope, there.box)
                other, directions = fastest(there, guess, directions, jax.random.fold_in(key, 1))
                level = jnp.minimum(level - h * (slope + other) / 2, there.box)
                return level, directions, number + 1

            carry = jax.lax.fori_loop(0, HEUN_STEPS, back, carry)
            return carry, carry[0]

        directions = _unit(jax.random.normal(keys[2], (n, 1, CLIMBERS)))
        _, levels = jax.lax.scan(interval, (last, directions, 0), at, reverse=True)
        levels = jnp.append(levels, last)
        return self._knots(start, shape, jnp.where(jnp.isfinite(levels), levels, -jnp.inf))

    def _knots(self, start: Start, shape: Shape, levels: Float[Array, " knots"]) -> Knots:
        """What the volumes are made of, at levels of which these are the logarithms."""
        factors = cholesky(jnp.moveaxis(shape.values, 0, -1))[0]
        logs = log_volume(factors, jnp.ones_like(levels)) + self._n / 2 * levels
        pushes = largest_pushes(shape.values, jnp.exp(levels), start.jumps)
        return Knots(jnp.exp(logs), logs, pushes, start.motion.dt)

    def _uncertainty(self, share: Array | float) -> Uncertainty | None:
        """That share of the problem's."""
        return None if self.problem.uncertainty is None else self.problem.uncertainty.times(share)

    def _fractions(self, places: Float[Array, " S"] | float) -> Float[Array, " S"]:
        """Of an interval, from the places [0, 1] of the instants in their cells."""
        return (jnp.arange(self._cells) + places) / self._cells

    def _instants(self, start: Start, shape: Shape, fractions: Float[Array | np.ndarray, " S"]) -> Instants:
        """At these fractions of every interval, in the order of time."""
        fractions, motion = jnp.asarray(fractions, start.gains.dtype), start.motion

        def spread(a):
            """Intervals last, and an axis for the fractions."""
            return jnp.moveaxis(a, 0, -1)[..., None]

        ends = (
            spread(shape.values[:-1]), spread(shape.rates[:, 0]), spread(shape.values[1:]), spread(shape.rates[:, 1]),
        )  # fmt: skip
        path = tuple(a[..., None] for a in (motion.starts, motion.start_rates, motion.ends, motion.end_rates))
        gains = (1 - fractions) * spread(shape.gains[:-1]) + fractions * spread(shape.gains[1:])
        inputs = jnp.broadcast_to(motion.inputs[..., None], (*motion.inputs.shape, fractions.shape[0]))
        arrays = (
            cubic_hermite(fractions, motion.dt, *ends), cubic_hermite_rate(fractions, motion.dt, *ends),
            cubic_hermite(fractions, motion.dt, *path), cubic_hermite_rate(fractions, motion.dt, *path), gains, inputs,
        )  # fmt: skip
        return self._finished(*(a.reshape(*a.shape[:-2], -1) for a in arrays))

    def _goal(self, start: Start, shape: Shape) -> tuple[Instants, Float[Array, " G"]]:
        """The goal's loop once for each level, and the logarithms of the levels, up to the boxes'."""

        def often(a):
            a = jnp.asarray(a, start.gains.dtype)
            return jnp.broadcast_to(a[..., None], (*a.shape, GOAL_LEVELS))

        value, gain, goal = shape.values[-1], shape.gains[-1], self.problem.goal
        arrays = value, jnp.zeros_like(value), goal, np.zeros(self._n), gain, np.zeros(self.problem.plant.m)
        at = self._finished(*map(often, arrays), widest=np.pi)
        return at, at.box[0] + 2 * jnp.log(jnp.arange(1, GOAL_LEVELS + 1) / GOAL_LEVELS)

    def _finished(self, values, rates, centers, center_rates, gains, inputs, *, widest: float = np.inf) -> Instants:
        factors = cholesky(values)[0]
        limits = jnp.asarray(np.minimum(self.problem.state_limits, LARGEST_STATE), values.dtype)[:, None]
        widest = min(widest, WIDEST.get(self._n, WIDEST_OF_MANY))
        angles = np.array([unit == "rad" for unit in self.problem.plant.state_units])[:, None]
        room = jnp.where(angles, jnp.minimum(limits - jnp.abs(centers), widest), limits - jnp.abs(centers))
        room = jnp.maximum(FRACTION_OF_LIMIT * room, 1e-6)
        box = jnp.min(2 * jnp.log(room / half_widths(factors)), 0)
        for each in self.problem.keep_out:
            clear = FRACTION_OF_LIMIT * each.radii_clear(Ellipsoids(centers, values, factors))
            box = jnp.minimum(box, 2 * jnp.log(jnp.maximum(clear, 1e-6)))
        return Instants(values, rates, centers, center_rates, gains, inputs, factors, box)

    def _growth(
        self, start: Start, at: Instants, levels: Float[Array, " T"], y: Float[Array, "n #T D"], box: Uncertainty | None
    ) -> Float[Array, "T D"]:
        """V'/V [1/s] at the boundary points in the directions y."""
        plant = self.problem.plant
        values, rates, factors, gains = (a[..., None] for a in (at.values, at.rates, at.factors, at.gains))
        rho = jnp.exp(levels)[:, None]
        y = jnp.broadcast_to(y, (y.shape[0], rho.shape[0], y.shape[2]))
        error = jnp.sqrt(rho) * solve_lower_transposed(factors, y[:, None])[:, 0]
        x, slope = at.centers[..., None] + error, mv(values, error)
        asked = at.inputs[..., None] - mv(gains, error)
        bounds = jnp.asarray(self.problem.input_limits(start.design), rho.dtype)[:, None, None]
        center_rates = at.center_rates[..., None]
        drift = jnp.sum(error * mv(rates, error), 0)

        def growth(rate):
            return (2 * jnp.sum(slope * (rate - center_rates), 0) + drift) / rho

        nominal = growth(plant.dynamics(start.design, x, jnp.clip(asked, -bounds, bounds)))
        if box is None:
            return nominal
        situation = Situation(tuple(x), list(error), asked, gains, values, center_rates, bounds)
        worst = growth(jnp.stack(Worst(plant, box).rate(start.design, situation)))
        return nominal + _slowed(jnp.maximum(worst - nominal, 0))

    def _worse(self, start: Start, at: Instants, levels, y, box: Uncertainty | None, key: PRNGKeyArray, fresh: int):
        """Directions [n T M] in which V grows at least as fast as in the best two thirds of y, the others new."""
        n, instants, count = y.shape
        near, new = jax.random.split(key)
        tried = y[..., None] + REACHES * jax.random.normal(near, (n, 1, count, len(REACHES)), y.dtype)
        tried = _unit(jnp.concatenate([y[..., None], tried], -1))
        growth = self._growth(start, at, levels, tried.reshape(n, instants, -1), box)
        growth = growth.reshape(instants, count, -1)
        best = jnp.take_along_axis(tried, jnp.argmax(growth, -1)[None, ..., None], -1)[..., 0]
        drawn = _unit(jax.random.normal(new, (n, 1, fresh), y.dtype))
        of_drawn = self._growth(start, at, levels, drawn, box)
        replaced = count // 3
        newcomers = drawn[:, 0][:, jax.lax.top_k(of_drawn, replaced)[1]]
        order = jnp.argsort(-jnp.max(growth, -1), -1)[:, : count - replaced]
        return jnp.concatenate([jnp.take_along_axis(best, order[None], -1), newcomers], -1)

    def _goal_level(self, goal: Instants, levels: Float[Array, " G"], growth: Float[Array, " G"], share: float):
        """ln of the largest level from which V falls, and how much faster it should fall further in: at that share of
        `uncertainty.residual`, or next to the goal.
        """
        falls = growth < 0
        uncertainty = self.problem.uncertainty
        uncertain = uncertainty is not None
        # Below the first level from which V falls lies what the disturbance keeps away from the goal.
        first = jnp.argmax(falls) if uncertain else 0
        bad = ~falls & (jnp.arange(GOAL_LEVELS) >= first)
        i = jnp.argmax(bad)
        before = jnp.maximum(i - 1, 0)
        steep = jnp.maximum(growth[i] - growth[before], 1e-9)
        crossing = levels[before] + (levels[i] - levels[before]) * jnp.clip(-growth[before] / steep, 0, 1)
        last = jnp.where(jnp.any(bad), crossing, goal.box[0])
        last = jnp.where(jnp.any(falls), last, levels[0])
        radii = jnp.arange(1, GOAL_LEVELS + 1) / GOAL_LEVELS
        inner = growth[0]
        if uncertainty is not None:
            reach = jax.lax.stop_gradient(jnp.exp((last - goal.box[0]) / 2))
            inner = jnp.interp(share * uncertainty.residual * reach, radii, growth)
        slowest = jnp.where(jnp.any(falls), inner, jnp.min(growth)) + GOAL_DECAY
        return last, jnp.maximum(slowest, 0.0)

    def _levels(self, start: Start, shape: Shape, before, places, directions, goal_directions, box) -> "_Found":
        """Two rounds of Newton from the levels `before`; the second one is differentiable."""
        at = self._instants(start, shape, self._fractions(places))
        goal, goal_levels = self._goal(start, shape)
        growth = _largest(self._growth(start, goal, goal_levels, goal_directions, box)) + DECAY_MARGIN
        last, violation = self._goal_level(goal, goal_levels, growth, RESIDUAL)

        def fastest(levels):
            return _largest(self._growth(start, at, levels, directions, box))

        middle = before
        for _ in range(2):
            level = jnp.clip(middle, at.box - DEAD, at.box)
            level = jax.lax.stop_gradient(jnp.where(jnp.isfinite(level), level, at.box - DEAD))
            growth, slope = jax.jvp(fastest, (level,), (jnp.ones_like(level),))
            cells, middle = _recursion(start, last, growth, jax.lax.stop_gradient(slope), level, at.box, 1 - places)
        return _Found(self._knots(start, shape, jnp.append(cells[:: self._cells], last)), middle, violation)


class _Found(NamedTuple):
    knots: Knots
    levels: Float[Array, " T"]
    goal_violation: Float[Array, ""]


def _adam() -> optax.GradientTransformation:
    return optax.scale_by_adam(b2=SECOND_MOMENT)


def _recursion(start: Start, last, growth, slope, at_levels, box, rest):
    """ln rho [T] at the cells' starts and at their instants, backward from `last` by the linearized growth.

    `rest` [S] is the share of a cell behind its instant.
    """
    cells = rest.shape[0]
    h = start.motion.dt / cells

    def back(level, cell):
        growth, slope, at_level, box, rest = cell
        ahead = jnp.clip(level - h * rest * DECAY_MARGIN - at_level, -3.0, 3.0)
        rate = (growth + slope * ahead) / jnp.maximum(1 + h * rest * slope, 0.3)
        rate = jnp.clip(rate, -SPEED_LIMIT, SPEED_LIMIT) + DECAY_MARGIN
        middle, first = (jnp.minimum(level - h * share * rate, box) for share in (rest, 1.0))
        return first, (first, middle)

    rests = jnp.tile(rest, growth.shape[0] // cells)
    return jax.lax.scan(back, last, (growth, slope, at_levels, box, rests), reverse=True)[1]


def _largest(growth: Float[Array, "T D"]) -> Float[Array, " T"]:
    """The maximum over the directions; its gradient is shared by those that are nearly as large."""
    weights = jax.nn.softmax(jax.lax.stop_gradient(growth) / TEMPERATURE, -1)
    mean = jnp.sum(weights * growth, -1)
    return jax.lax.stop_gradient(jnp.max(growth, -1) - mean) + mean


def _slowed(growth: Float[Array, "T D"]) -> Float[Array, "T D"]:
    """The same up to FASTEST_GROWTH, its logarithm from there."""
    beyond = jnp.maximum(growth, FASTEST_GROWTH)
    return jnp.where(growth < FASTEST_GROWTH, growth, FASTEST_GROWTH * (1 + jnp.log(beyond / FASTEST_GROWTH)))


def _smoothed(a: Array) -> Array:
    """Averaged with its neighbors in time."""
    wide = jnp.concatenate([a[:1], a, a[-1:]])
    return 0.25 * wide[:-2] + 0.5 * wide[1:-1] + 0.25 * wide[2:]


def _unit(y: Array) -> Array:
    return y / jnp.sqrt(jnp.sum(y**2, 0))
