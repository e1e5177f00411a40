"""Many perturbed rollouts of a run's closed loops at once: each has a robot, a controller and perturbations of its own.

The robot is the plant's closed form with the rollout's true parameters, by Runge-Kutta steps of `STEP`, its input held
in each. The controller knows nothing of what is wrong: at its own rate it evaluates the loop's law, from the state of a
while ago and with noise on the velocities; what it asks for lags, is noisy, and ends at the robot's true limits. Dry
friction on the motors' axes opposes their speeds, and is held in a step.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtcd_jax.elite.elite import Elite
from rtcd_jax.numerics.integrate import rk4_step, split
from rtcd_jax.numerics.keep_out import Set
from rtcd_jax.plants.base import Plant

STEP = 1e-3
"""Of the integration [s]; control periods and delays are multiples of it."""
LONGEST_DELAY = 0.1
"""Of the measurements [s]."""
PULSES = 3
"""Bell-shaped pushes that a rollout can take."""
CHUNK = 250
"""Steps of one call of the compiled program; between two, the host checks whether all motions are over."""
WATCHED = 1.0
"""Time at the end in which a motion must hold its place [s]."""


@final
class Loops(eqx.Module):
    """The controllers of C elites as one table, a row for each interval and one for the goal behind them.

    A row holds the cubics of x*(t) [n 4], K [m n] at the interval's start and its change over it, and u* [m].
    """

    rows: Float[Array, "C*(N+1) F"]
    dt: Float[Array, " C"]
    goal: Float[Array, " n"]
    goal_shape: Float[Array, "C n n"]
    input_limits: Float[Array, "C m"]
    state_limits: Float[Array, " n"]
    intervals: int = eqx.field(static=True)
    keep_out: tuple[Set, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, elites: Sequence[Elite], rates: Sequence[np.ndarray]) -> "Loops":
        """Those of elites of one run; `rates` [N 2 n] are x*' at both ends of every interval."""
        first = elites[0]
        return cls(
            rows=jnp.asarray(np.concatenate([_rows(*pair) for pair in zip(elites, rates, strict=True)])),
            dt=jnp.asarray([elite.time[1] for elite in elites]),
            goal=jnp.asarray(first.x_goal),
            goal_shape=jnp.asarray([elite.S[-1] / elite.rho[-1] for elite in elites]),
            input_limits=jnp.asarray([elite.u_max for elite in elites]),
            state_limits=jnp.asarray(first.state_limits),
            intervals=len(first.u),
            keep_out=first.keep_out,
        )

    def law(self, which: Int[Array, " L"], t: Float[Array, ""], x: tuple) -> list:
        """u [m] x [L] = clip(u* - K (x - x*)) at time t."""
        n, m = self.goal.size, self.input_limits.shape[1]
        place = t / self.dt[which]
        k = jnp.minimum(jnp.floor(place).astype(int), self.intervals)
        s = place - k
        row = self.rows[which * (self.intervals + 1) + k]
        cubics, gains, changes, feedforward = jnp.split(row, np.cumsum([4 * n, m * n, m * n]), axis=1)
        limits, error = self.input_limits[which], []
        for i in range(n):
            c0, c1, c2, c3 = (cubics[:, 4 * i + power] for power in range(4))
            error.append(x[i] - (c0 + s * (c1 + s * (c2 + s * c3))))
        u = []
        for j in range(m):
            terms = ((gains[:, j * n + i] + s * changes[:, j * n + i]) * error[i] for i in range(n))
            u.append(jnp.clip(feedforward[:, j] - sum(terms), -limits[:, j], limits[:, j]))
        return u

    def inside(self, x: Float[Array, "n L"]) -> Bool[Array, " L"]:
        """Whether the states keep the limits, and out of the sets to keep out of; what is no number does not."""
        inside = jnp.all(jnp.abs(x) <= jnp.minimum(self.state_limits, jnp.finfo(x.dtype).max)[:, None], axis=0)
        for each in self.keep_out:
            inside &= ~each.entered(x)
        return inside

    def distance(self, which: Int[Array, " L"], x: Float[Array, "n L"]) -> Float[Array, " L"]:
        """V / rho of the goal's region."""
        error = x - self.goal[:, None]
        return jnp.einsum("il,lij,jl->l", error, self.goal_shape[which], error)


@final
class Rollouts(eqx.Module):
    """L motions and what perturbs them; leaves [L], with the states' or inputs' axis before it.

    `loop` is the controller's index and `x` the state at t = 0. Of the robot: `plant` and `design` with its true
    numbers, `actuator_scale`, its true input limit over the nominal one, and Coulomb `friction` on the motors' axes [m]
    with the speeds `slips` [m] below which it falls to zero. Of the controller: control period and delay [steps], noise
    on the velocities (standard deviation [n/2]). Of the motor: `lag`, the time constant [s], noise (standard deviation
    [m]). Pulses on the inputs: center [s], width (standard deviation [s]) and height.
    """

    loop: Int[Array, " L"]
    x: Float[Array, "n L"]
    plant: Plant
    design: Any
    actuator_scale: Float[Array, " L"]
    friction: Float[Array, "m L"]
    slips: Float[Array, "m L"]
    period: Int[Array, " L"]
    delay: Int[Array, " L"]
    velocity_noise: Float[Array, "n/2 L"]
    input_noise: Float[Array, "m L"]
    lag: Float[Array, " L"]
    centers: Float[Array, "J L"]
    widths: Float[Array, "J L"]
    heights: Float[Array, "J m L"]


@final
class Motion(eqx.Module):
    """Where the rollouts are: state, what the motors give and are asked for, their noise, past states, who left."""

    x: Float[Array, "n L"]
    input: Float[Array, "m L"]
    command: Float[Array, "m L"]
    noise: Float[Array, "m L"]
    past: Float[Array, "D n L"]
    left: Bool[Array, " L"]


class Outcome(NamedTuple):
    """Of every rollout: whether it left the limits; V/rho at the goal in the end, the largest in the last second."""

    left_limits: np.ndarray
    final: np.ndarray
    held: np.ndarray


def undisturbed(plant: Plant, design: Any, loop: np.ndarray, x: np.ndarray) -> Rollouts:
    """Rollouts from states [n L] without perturbations; leaves of `plant` and `design` [C] are those of the loops."""
    count, n, m = len(loop), plant.n, plant.m

    def zeros(*shape: int) -> jax.Array:
        return jnp.zeros((*shape, count))

    own = jax.tree.map(lambda leaf: jnp.asarray(leaf)[loop], (plant, design))
    return Rollouts(
        loop=jnp.asarray(loop),
        x=jnp.asarray(x),
        plant=own[0],
        design=own[1],
        actuator_scale=jnp.ones(count),
        friction=zeros(m),
        slips=jnp.ones((m, count)),
        period=jnp.ones(count, int),
        delay=jnp.zeros(count, int),
        velocity_noise=zeros(n // 2),
        input_noise=zeros(m),
        lag=zeros(),
        centers=zeros(PULSES),
        widths=jnp.ones((PULSES, count)),
        heights=zeros(PULSES, m),
    )


def start(loops: Loops, rollouts: Rollouts) -> Motion:
    """All rollouts at t = 0, where the delayed measurements say that they have always been."""
    delays = round(LONGEST_DELAY / STEP) + 1
    nothing = jnp.zeros_like(rollouts.input_noise)
    past = jnp.broadcast_to(rollouts.x, (delays, *rollouts.x.shape))
    return Motion(rollouts.x, nothing, nothing, nothing, past, ~loops.inside(rollouts.x))


@jax.jit
def advance(loops: Loops, rollouts: Rollouts, motion: Motion, first: Int[Array, ""], key: jax.Array) -> Motion:
    """The rollouts after `CHUNK` more steps, from step `first` on; one that left the limits stays where it did."""
    noisy = jnp.any(rollouts.velocity_noise > 0) | jnp.any(rollouts.input_noise > 0)
    rubs, free = jnp.any(rollouts.friction > 0), jnp.zeros_like(rollouts.friction)
    follow = jnp.where(rollouts.lag > 0, -jnp.expm1(-STEP / jnp.maximum(rollouts.lag, STEP * 1e-3)), 1.0)

    def slope(x: tuple, u):
        return split(rollouts.plant.dynamics(rollouts.design, jnp.stack(x), u))

    def step(motion: Motion, index):
        t = index * STEP
        past = motion.past.at[index % len(motion.past)].set(motion.x)
        command, noise = _decide(loops, rollouts, motion, past, index, key, noisy)
        given = motion.input + follow * (command - motion.input)
        bound = rollouts.actuator_scale * loops.input_limits[rollouts.loop].T
        pushed = jnp.clip(given + noise, -bound, bound) + _pushes(rollouts, t + STEP / 2)
        rubbing = jax.lax.cond(rubs, lambda: _friction(rollouts, motion.x), lambda: free)
        x = rk4_step(slope, split(motion.x), pushed - rubbing, STEP)
        moved = jnp.where(motion.left, motion.x, jnp.stack(x))
        return Motion(moved, given, command, noise, past, motion.left | ~loops.inside(moved)), None

    return jax.lax.scan(step, motion, first + jnp.arange(CHUNK))[0]


def _decide(loops: Loops, rollouts: Rollouts, motion: Motion, past, index, key, noisy):
    """What the controllers ask for after step `index`, and the motors' noise: new where a control period begins."""
    count = len(rollouts.loop)
    measured = past[(index - rollouts.delay) % len(past), :, jnp.arange(count)].T
    m, half = loops.input_limits.shape[1], loops.goal.size // 2

    def draw():
        return jax.random.normal(jax.random.fold_in(key, index), (half + m, count))

    random = jax.lax.cond(noisy, draw, lambda: jnp.zeros((half + m, count)))
    measured = measured.at[half:].add(rollouts.velocity_noise * random[:half])
    due = index % rollouts.period == 0
    asked = jnp.stack(loops.law(rollouts.loop, index * STEP, split(measured)))
    return jnp.where(due, asked, motion.command), jnp.where(due, rollouts.input_noise * random[half:], motion.noise)


def _friction(rollouts: Rollouts, x: Float[Array, "n L"]) -> Float[Array, "m L"]:
    """Coulomb's, smoothed below the speeds `slips`."""
    speeds = rollouts.plant.motor_speeds(rollouts.design, x)
    return rollouts.friction * speeds / jnp.sqrt(speeds**2 + rollouts.slips**2)


def _pushes(rollouts: Rollouts, t) -> Float[Array, "m L"]:
    bells = jnp.exp(-0.5 * ((t - rollouts.centers) / rollouts.widths) ** 2)
    return jnp.sum(rollouts.heights * bells[:, None], axis=0)


def _rows(elite: Elite, rates: np.ndarray) -> np.ndarray:
    """An elite's part of the table [N+1 F]."""
    x, h = elite.x, elite.time[1]
    begin, end, first, last = x[:-1], x[1:], h * rates[:, 0], h * rates[:, 1]
    cubics = np.stack([begin, first, 3 * (end - begin) - 2 * first - last, 2 * (begin - end) + first + last], axis=2)
    gains = elite.K.reshape(len(x), -1)
    moving = [cubics.reshape(len(begin), -1), gains[:-1], np.diff(gains, axis=0), elite.u]
    still = np.stack([elite.x_goal, *3 * [0 * elite.x_goal]], axis=1).ravel()
    holding = [still, elite.K_goal.ravel(), 0 * elite.K_goal.ravel(), 0 * elite.u_max]
    return np.concatenate([np.concatenate(moving, axis=1), np.concatenate(holding)[None]])


def steps_of(seconds: float) -> int:
    """Whole chunks of steps that last at least so long."""
    return CHUNK * math.ceil(seconds / STEP / CHUNK)
