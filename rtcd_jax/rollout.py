"""Policy x states -> end states: the saturated closed loop, by the closed form or by MJX.

On [t_k, t_{k+1}] with the fraction s of the interval:  u = clip(u_k - K(s) (x - x*(s))), x* the cubic Hermite
interpolant, K linear between K_k and K_{k+1}; after t_N the goal's LQR. Errors of angles are not wrapped. States are
[n ...], elementwise over all further axes, so that one call carries every knot and sample of a candidate.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtcd_jax.numerics.batched import mv
from rtcd_jax.plants.base import Plant
from rtcd_jax.policy import nominal
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Policy

class Dynamics(NamedTuple):
    """`rate(design, x [n ...], u [m ...]) -> x' [n ...]`; a `large` program is compiled once a step, not once a stage."""

    rate: Callable
    large: bool


def closed_form(plant: Plant) -> Dynamics:
    """The plant's own equations."""
    return Dynamics(plant.dynamics, large=False)


def mjx(plant: Plant) -> Dynamics:
    """The plant's MJCF under MJX."""
    from rtcd_jax.plants.mjx import MjxStepper  # mujoco takes seconds to import

    stepper = MjxStepper(plant)

    def rate(design, x, u):
        over_states = jax.vmap(partial(stepper.dynamics, design), in_axes=-1, out_axes=-1)
        flat = over_states(x.reshape(plant.n, -1), u.reshape(plant.m, -1))
        return flat.reshape(x.shape)

    return Dynamics(rate, large=True)


class Reference(NamedTuple):
    """The controller's data at both ends and the middle of every Runge-Kutta step: leading axes (step, stage)."""

    states: Float[Array, "T 3 n N"]
    gains: Float[Array, "T 3 m n N"]
    inputs: Float[Array, "m N"]
    step: Float[Array, ""]

    def part(self, which) -> "Reference":
        """The intervals `which`."""
        return Reference(self.states[..., which], self.gains[..., which], self.inputs[..., which], self.step)


def reference(problem: Problem, candidate: Candidate, policy: Policy, steps: int) -> Reference:
    """The nominal motion and the gains that `steps` Runge-Kutta steps an interval look up."""
    motion = nominal(problem, candidate, policy.trajectory)
    grid = np.arange(2 * steps + 1) / (2 * steps)
    stages = 2 * np.arange(steps)[:, None] + np.arange(3)
    gains = jnp.moveaxis(policy.gains, 0, -1)[None]
    shares = grid[:, None, None, None]
    blended = (1 - shares) * gains[..., :-1] + shares * gains[..., 1:]
    return Reference(
        states=jnp.moveaxis(motion.at(grid), -1, 0)[stages],
        gains=blended[stages],
        inputs=motion.inputs,
        step=policy.trajectory.dt / steps,
    )


def roll_intervals(problem: Problem, candidate: Candidate, tracked: Reference, x, dynamics: Dynamics):
    """End states [n N ...] after one interval each, and whether the boxes on x held at every step [N ...].

    `x` [n N ...] are states at the intervals' starts.
    """
    limits = _column(problem.state_limits, x)
    bounds = _column(problem.input_limits, x)
    align = partial(_align, behind=x.ndim - 2)
    feedforward = align(tracked.inputs)

    def step(carry, stage):
        x, inside = carry
        states, gains = stage

        def rate(x, point):
            error = x - align(states[point])
            u = jnp.clip(feedforward - mv(align(gains[point]), error), -bounds, bounds)
            return dynamics.rate(candidate.design, x, u)

        x = _rk4_of_time(rate, x, tracked.step, dynamics.large)
        return (x, inside & jnp.all(jnp.abs(x) <= limits, 0)), None

    inside = jnp.all(jnp.abs(x) <= limits, 0)
    (x, inside), _ = jax.lax.scan(step, (x, inside), (tracked.states, tracked.gains))
    return x, inside


def roll_at_goal(problem: Problem, candidate: Candidate, gain, x, dynamics: Dynamics, duration: float, step: float):
    """End states [n ...] after `duration` [s] under the goal's LQR, and whether the boxes on x held on the way [...]."""
    goal, limits, bounds = (_column(a, x) for a in (problem.goal, problem.state_limits, problem.input_limits))
    gain = _align(gain, x.ndim - 1)

    def rate(x, _):
        return dynamics.rate(candidate.design, x, jnp.clip(-mv(gain, x - goal), -bounds, bounds))

    def advance(_, carry):
        x, inside = carry
        x = _rk4_of_time(rate, x, step, dynamics.large)
        return x, inside & jnp.all(jnp.abs(x) <= limits, 0)

    return jax.lax.fori_loop(0, round(duration / step), advance, (x, jnp.all(jnp.abs(x) <= limits, 0)))


def _rk4_of_time(rate, x, dt, looped: bool):
    """A Runge-Kutta step of x' = rate(x, point) with the data of the step's start (0), middle (1) and end (2).

    `looped` evaluates `rate` in a loop over the stages, so that it stands in the program once.
    """
    if not looped:
        k1 = rate(x, 0)
        k2 = rate(x + 0.5 * dt * k1, 1)
        k3 = rate(x + 0.5 * dt * k2, 1)
        k4 = rate(x + dt * k3, 2)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def stage(carry, tableau):
        slope, total = carry
        node, point, weight = tableau
        slope = rate(x + node * dt * slope, point)
        return (slope, total + weight * slope), None

    nodes, points, weights = np.array([0, 0.5, 0.5, 1]), np.array([0, 1, 1, 2]), np.array([1, 2, 2, 1]) / 6
    zero = jnp.zeros_like(x)
    (_, total), _ = jax.lax.scan(stage, (zero, zero), (nodes.astype(x.dtype), points, weights.astype(x.dtype)))
    return x + dt * total


def _align(a, behind: int):
    """`a` with `behind` axes of length one at its end."""
    return a.reshape(*a.shape, *(1,) * behind)


def _column(values, x):
    return jnp.asarray(values, x.dtype).reshape(-1, *(1,) * (x.ndim - 1))
