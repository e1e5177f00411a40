"""Policy x states -> end states: the saturated closed loop, by the closed form or by MJX.

On [t_k, t_{k+1}] with the fraction s of the interval:  u = clip(u_k - K(s) (x - x*(s))), x* the cubic Hermite
interpolant, K linear between K_k and K_{k+1}; after t_N the goal's LQR, if the goal is held. Errors of angles are not
wrapped. States are [n ...], elementwise over all further axes, so that one call carries every knot and sample of a
candidate.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtcd_jax.adversary import Drawn, Opponent, Situation
from rtcd_jax.config.schema import FunnelConfig
from rtcd_jax.numerics.batched import mm, spectral_radius
from rtcd_jax.numerics.integrate import END, MIDDLE, STABLE, START, rk4_varying_step, split
from rtcd_jax.numerics.loops import on_gpu, short_scan
from rtcd_jax.plants.base import Plant
from rtcd_jax.policy import inputs_at_knots, linearize, nominal
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Policy

MOST_PARTS = 16
"""Into so many a step about the goal is divided at most."""


class Dynamics(NamedTuple):
    """`rate(design, x [n ...], u [m ...]) -> x' [n ...]`; a `large` one is put once into a step's program.

    With an `opponent`, x' is what that makes of the nominal robot.
    """

    rate: Callable
    large: bool
    opponent: Opponent | None = None


def closed_form(plant: Plant, opponent: Opponent | None = None) -> Dynamics:
    """The plant's own equations. A CPU's compiler would repeat what an opponent chooses at one stage in the next."""
    return Dynamics(plant.dynamics, large=opponent is not None and not on_gpu(), opponent=opponent)


def mjx(plant: Plant, drawn: Drawn | None = None) -> Dynamics:
    """The plant's MJCF under MJX; of the `drawn` robots, each with its own edits of the model."""
    if drawn is not None:
        return Dynamics(plant.dynamics, large=True, opponent=drawn._replace(motion=mjx_rate))
    return Dynamics(partial(mjx_rate, plant), large=True)


def mjx_rate(
    plant: Plant, design: eqx.Module, x: Float[Array, "n *batch"], u: Float[Array, "m *batch"]
) -> Float[Array, "n *batch"]:
    """x' by MJX; the numbers of plant and design are broadcast to the states' trailing axes."""
    from rtcd_jax.plants.mjx import MjxStepper  # mujoco takes seconds to import

    def one(robot: tuple[Plant, eqx.Module], x, u):
        return MjxStepper(robot[0]).dynamics(robot[1], x, u)

    robot, axes = (plant, design), jax.tree.map(lambda leaf: -1 if jnp.ndim(leaf) else None, (plant, design))
    flat = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, x.shape[1:]).reshape(-1) if jnp.ndim(leaf) else leaf, robot)
    over_states = jax.vmap(one, in_axes=(axes, -1, -1), out_axes=-1)
    return over_states(flat, x.reshape(plant.n, -1), u.reshape(plant.m, -1)).reshape(x.shape)


class TrackingData(NamedTuple):
    """Feed-forward and gain schedule: what the controller looks up at both ends and the middle of every Runge-Kutta
    step. Leading axes are (step, stage). For opponents, where the problem has an uncertainty: S(t) and the rates of
    x*(t), and by how much V's center is beside x*(t), where it is.
    """

    states: Float[Array, "steps 3 n intervals"]
    gains: Float[Array, "steps 3 m n intervals"]
    inputs: Float[Array, "m intervals"]
    step: Float[Array, ""]
    others: tuple[Float[Array, "steps 3 n n intervals"], Float[Array, "steps 3 n intervals"]] | None
    shift: Float[Array, "steps 3 n intervals"] | None = None

    def part(self, which: Int[Array | np.ndarray, " chosen"]) -> "TrackingData":
        """The intervals `which`."""
        tables = jax.tree.map(lambda table: table[..., which], self._replace(step=None))
        return tables._replace(step=self.step)


def tracking_data(problem: Problem, candidate: Candidate, policy: Policy, steps: int) -> TrackingData:
    """The nominal motion and the gains that `steps` Runge-Kutta steps an interval look up."""
    motion = nominal(problem, candidate, policy.trajectory)
    grid, stages = _grid(steps)
    linear = partial(linear_in_intervals, steps=steps)
    states, others = motion.at(grid), None
    if problem.uncertainty is not None:
        inputs = jnp.broadcast_to(motion.inputs[..., None], (problem.plant.m, *states.shape[1:]))
        rates = problem.plant.dynamics(candidate.design, states, inputs)
        others = linear(policy.values), jnp.moveaxis(rates, -1, 0)[stages]
    return TrackingData(
        states=jnp.moveaxis(states, -1, 0)[stages],
        gains=linear(policy.gains),
        inputs=motion.inputs,
        step=policy.trajectory.dt / steps,
        others=others,
    )


def _grid(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Fractions of an interval at which a stage of `steps` Runge-Kutta steps is, and which of them, [step 3]."""
    return np.arange(2 * steps + 1) / (2 * steps), 2 * np.arange(steps)[:, None] + np.arange(3)


def linear_in_intervals(table: Float[Array, "knots *shape"], steps: int) -> Float[Array, "steps 3 *shape intervals"]:
    """What is given at the knots, between them, where the stages of `steps` Runge-Kutta steps an interval are."""
    grid, stages = _grid(steps)
    shares, at_knots = grid.reshape(-1, *(1,) * table.ndim), jnp.moveaxis(table, 0, -1)[None]
    return (at_knots[..., :-1] * (1 - shares) + at_knots[..., 1:] * shares)[stages]


def roll_intervals(
    problem: Problem,
    candidate: Candidate,
    tracking: TrackingData,
    x: Float[Array, "n intervals *batch"],
    dynamics: Dynamics,
) -> tuple[Float[Array, "n intervals *batch"], Float[Array, "intervals *batch"]]:
    """End states after one interval each, and the peaks: the largest |x_i| / limit_i at any step, above 1 as well in a
    set to keep out of.

    `x` are states at the intervals' starts.
    """
    bounds = _column(problem.input_limits(candidate.design), x)
    align = partial(_align, behind=x.ndim - 2)
    feedforward = align(tracking.inputs)

    def step(carry, stage):
        x, peak = carry
        states, gains, others, shift = stage

        def slope(x, place):
            error = [a - align(b) for a, b in zip(x, states[place], strict=True)]
            gain = align(gains[place])
            asked = feedforward - _feedback(gain, error)
            cost, rate = jax.tree.map(lambda table: align(table[place]), others or (None, None))
            beside = None if shift is None else align(shift[place])
            return _rate(dynamics, candidate, Situation(x, error, asked, gain, cost, rate, bounds, beside))

        x = _step(slope, x, tracking.step, dynamics.large)
        return (x, jnp.maximum(peak, _fill(x, problem))), None

    others = (None, None) if dynamics.opponent is None else (tracking.others, tracking.shift)
    tables = tracking.states, tracking.gains, *others
    start = split(x)
    (ends, peak), _ = short_scan(step, (start, _fill(start, problem)), tables)
    return jnp.stack(ends), peak


def roll_at_goal(
    problem: Problem,
    candidate: Candidate,
    goal_lqr: tuple[Float[Array, "m n"], Float[Array, "n n"]],
    x: Float[Array, "n *batch"],
    dynamics: Dynamics,
    duration: float,
    step: float,
    parts: Int[Array, ""] | int = 1,
) -> tuple[Float[Array, "n *batch"], Float[Array, "*batch"]]:
    """End states after `duration` [s] under the goal's LQR, and the peaks till then.

    `goal_lqr` are its gain and its value matrix. Each `step` [s] is taken in equal `parts`.
    """
    bounds = _column(problem.input_limits(candidate.design), x)
    gain, cost = (_align(part, x.ndim - 1) for part in goal_lqr)
    rest = jnp.zeros((x.shape[0], *(1,) * (x.ndim - 1)), x.dtype)

    def slope(x, _):
        error = [a - b for a, b in zip(x, problem.goal.astype(x[0].dtype), strict=True)]
        return _rate(dynamics, candidate, Situation(x, error, -_feedback(gain, error), gain, cost, rest, bounds))

    def advance(_, carry):
        x, peak = carry
        x = _step(slope, x, dt, dynamics.large)
        return x, jnp.maximum(peak, _fill(x, problem))

    def over_the_steps(_, carry):  # a loop of a fixed length: under vmap one of a traced length masks every turn
        return jax.lax.fori_loop(0, round(duration / step), advance, carry)

    dt = jnp.asarray(step / parts, x.dtype)
    start = split(x)
    ends, peak = jax.lax.fori_loop(0, parts, over_the_steps, (start, _fill(start, problem)))
    return jnp.stack(ends), peak


class Stiffness(NamedTuple):
    """`parts` into which a step about the goal has to be divided, for the integrator to be stable for the closed loop's
    fastest mode; `too_stiff`: it is not in `MOST_PARTS` parts, or not in the steps along the motion.
    """

    parts: Int[Array, ""]
    too_stiff: Bool[Array, ""]


def stiffness(problem: Problem, candidate: Candidate, policy: Policy, funnel: FunnelConfig) -> Stiffness:
    """How fast the loop is for the steps of its rollouts; where it is too fast, or not finite, one part has to do."""
    inputs = inputs_at_knots(problem, policy.trajectory)
    a, b = linearize(problem, candidate, policy.trajectory.xs.T, inputs)
    fastest = spectral_radius(a - mm(b, jnp.moveaxis(policy.gains, 0, -1)))
    parts = jnp.ceil(fastest[-1] * funnel.goal.step / STABLE) if not problem.caught else jnp.ones_like(fastest[-1])
    along = jnp.max(fastest) * policy.trajectory.dt / funnel.steps
    too_stiff = (parts > MOST_PARTS) | (along > STABLE)
    return Stiffness(jnp.where((parts > 1) & ~too_stiff, parts, 1).astype(int), too_stiff)


def _rate(dynamics: Dynamics, candidate: Candidate, at: Situation):
    """The components of x' in a closed loop."""
    if dynamics.opponent is not None:
        return dynamics.opponent.rate(candidate.design, at)
    return split(dynamics.rate(candidate.design, jnp.stack(at.x), jnp.clip(at.asked, -at.bounds, at.bounds)))


def _feedback(gain, error) -> Array:
    """K e [m ...] for components e."""
    return cast(Array, sum(gain[:, i] * e for i, e in enumerate(error)))


def _fill(x, problem: Problem):
    """Largest |x_i| / limit_i, or what stands for it of a set to keep out of; not a number where a component that
    counts is none.
    """
    fill = jnp.zeros_like(x[0])
    for component, limit in zip(x, problem.state_limits, strict=True):
        if np.isfinite(limit):
            fill = jnp.maximum(fill, jnp.abs(component) / limit)
    for each in problem.keep_out:
        fill = jnp.maximum(fill, each.fill(x))
    return fill


def _step(slope, x, dt, looped: bool):
    """A Runge-Kutta step; `looped` takes the stages in a loop, so that `slope` stands in the program once."""
    if not looped:
        return rk4_varying_step(slope, x, dt)

    def stage(carry, tableau):
        k, total = carry
        node, place, weight = tableau
        k = slope(tuple(a + node * dt * b for a, b in zip(x, k, strict=True)), place)
        return (k, tuple(a + weight * b for a, b in zip(total, k, strict=True))), None

    dtype = x[0].dtype
    nodes, weights = np.array([0, 0.5, 0.5, 1], dtype), np.array([1, 2, 2, 1], dtype) / 6
    zero = tuple(jnp.zeros_like(a) for a in x)
    (_, total), _ = jax.lax.scan(stage, (zero, zero), (nodes, np.array([START, MIDDLE, MIDDLE, END]), weights))
    return tuple(a + dt * b for a, b in zip(x, total, strict=True))


def _align(a, behind: int):
    """`a` with `behind` axes of length one at its end."""
    return a.reshape(*a.shape, *(1,) * behind)


def _column(values, x):
    return jnp.asarray(values, x.dtype).reshape(-1, *(1,) * (x.ndim - 1))
