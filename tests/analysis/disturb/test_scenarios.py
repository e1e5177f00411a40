"""The rollouts are the loop that is verified, and their perturbations are what they are said to be."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.analysis.disturb.scenarios import CHUNK, STEP, Loops, advance, start, undisturbed
from rtcd_jax.elite.closed_loop import ClosedLoop, runge_kutta
from tests.plants.robots import BY_HAND, ENERGIES

COUNT = 512
"""Rollouts of every test, so that they share a program."""
KEY = jax.random.key(0)


def rollouts_of(comparison, loop, x):
    """Undisturbed ones, in the number that the compiled program takes."""
    which = np.arange(COUNT) % len(x)
    return undisturbed(comparison.plant, comparison.design, np.asarray(loop)[which], np.asarray(x, float)[which].T)


def moved(comparison, rollouts, chunks=1, key=KEY):
    """The motion after so many chunks."""
    motion = start(comparison.loops, rollouts)
    for chunk in range(chunks):
        motion = advance(comparison.loops, rollouts, motion, jnp.asarray(chunk * CHUNK), key)
    return motion


def with_law(comparison, **changes):
    """The comparison with another table, from its elites with some arrays replaced by functions of them."""
    elites = [
        dataclasses.replace(elite, **{name: change(getattr(elite, name)) for name, change in changes.items()})
        for elite in comparison.elites
    ]
    return dataclasses.replace(
        comparison, loops=Loops.of(elites, [np.zeros((len(e.u), 2, e.x_goal.size)) for e in elites])
    )


def test_the_law_is_that_of_the_verifications_loop(robots):
    random = np.random.default_rng(0)
    f = BY_HAND[robots.elites[0].plant](robots.elites[0].parameters)
    last = robots.elites[0].time[-1]
    for t in [*random.uniform(0, 1.3 * last, 30), 0.0, last]:
        x = robots.elites[0].x_goal + 0.1 * random.normal(size=(2, robots.plant.n))
        found = robots.loops.law(jnp.arange(2), jnp.asarray(t), tuple(jnp.asarray(x).T))
        for i, elite in enumerate(robots.elites):
            k = int(t / elite.time[1])
            policy = ClosedLoop.of(elite, f).tracking(k) if t < last else ClosedLoop.of(elite, f).holding()
            np.testing.assert_allclose(jnp.stack(found)[:, i], policy(t, x[i : i + 1])[0], rtol=1e-9, atol=1e-9)


def test_undisturbed_motions_are_the_verifications_up_to_the_hold(robots):
    """Deviations from the motion that starts on x*: holding the input lags the loop by half a step, here below 1 %."""
    elite = robots.elites[0]
    f = BY_HAND[elite.plant](elite.parameters)
    loop = ClosedLoop.of(elite, f)
    offsets = 0.02 * np.random.default_rng(1).normal(size=(8, robots.plant.n))
    offsets[0] = 0
    motion = moved(robots, rollouts_of(robots, np.zeros(8, int), elite.x[0] + offsets))
    x, seconds, march = elite.x[0] + offsets, CHUNK * STEP, runge_kutta(f, STEP)
    for k in range(len(elite.u)):
        *_, x = march(loop.tracking(k), elite.time[k], elite.time[k + 1], x)
    *_, x = march(loop.holding(), 0.0, seconds - elite.time[-1], x)
    found = np.asarray(motion.x[:, :8].T)
    np.testing.assert_allclose(found - found[0], x - x[0], atol=1e-2 * np.abs(offsets).max())
    assert not motion.left.any()


def test_dry_friction_takes_its_force_times_the_path_of_the_motor(robots):
    """From the energy of a robot without dampers, motors off: the first joint is the motor's on both robots."""
    off = with_law(robots, K=np.zeros_like, u=np.zeros_like, K_goal=np.zeros_like)
    x = np.zeros((2, robots.plant.n))
    x[:, robots.plant.n // 2] = 3.0, -3.0
    free = rollouts_of(off, [0, 1], x)
    for name in (name for name in vars(robots.plant) if name.endswith("damping")):
        free = eqx.tree_at(lambda r, name=name: getattr(r.plant, name), free, jnp.zeros(COUNT))
    force = 0.05 * robots.elites[0].u_max[0]
    rubbed = dataclasses.replace(free, friction=jnp.full((1, COUNT), force), slips=jnp.full((1, COUNT), 1e-3))
    np.testing.assert_allclose(free.plant.motor_speeds(free.design, free.x)[0], free.x[robots.plant.n // 2], rtol=1e-9)
    ends = [moved(off, each).x[:, :2] for each in (free, rubbed)]
    energies = [ENERGIES[elite.plant](elite.parameters) for elite in robots.elites]
    before, kept, after = (
        np.array([energy(state[:, i]) for i, energy in enumerate(energies)]) for state in (x.T, *map(np.asarray, ends))
    )
    np.testing.assert_allclose(kept, before, rtol=1e-6)
    assert np.all(np.abs(ends[1][0]) > 0.1)
    np.testing.assert_allclose(before - after, force * np.abs(ends[1][0]), rtol=2e-3)


def _oracle(comparison, index, x, seconds, *, actuator_scale, period, delay, lag, center, width, height, scale):
    """One rollout, all perturbations but noise, step by step in numpy; `scale` is the first design variable's."""
    elite = comparison.elites[index]
    first = {"pendulum": "m", "cartpole": "lp"}[elite.plant]
    parameters = elite.parameters | {first: elite.parameters[first] * scale}
    if elite.plant == "cartpole":
        parameters["inertia_about_com"] = parameters["Mp"] * parameters["lp"] ** 2 / 3
    f = BY_HAND[elite.plant](parameters)
    known = ClosedLoop.of(elite, BY_HAND[elite.plant](elite.parameters))
    past, given, command = [x], 0.0, 0.0
    for i in range(round(seconds / STEP)):
        t = i * STEP
        if i % period == 0:
            seen = past[max(0, i - delay)]
            k = int(np.floor(t / elite.time[1]))
            policy = known.tracking(k) if k < len(elite.u) else known.holding()
            command = policy(t, seen[None])[0, 0]
        given += (1 - np.exp(-STEP / lag)) * (command - given)
        bound = actuator_scale * elite.u_max[0]
        bell = height * np.exp(-0.5 * ((t + STEP / 2 - center) / width) ** 2)
        pushed = np.clip(given, -bound, bound) + bell
        *_, now = runge_kutta(f, STEP)(lambda t, x, u=pushed: np.full((1, 1), u), 0.0, STEP, past[-1][None])
        past.append(now[0])
    return past[-1]


@pytest.mark.parametrize("index", [0, 1])
def test_all_troubles_at_once_are_those_of_a_simulation_written_apart(robots, index):
    told = {"actuator_scale": 0.7, "period": 7, "delay": 23, "lag": 0.02, "center": 0.1, "width": 0.015, "scale": 1.1}
    height = 0.8 * robots.elites[0].u_max[0]
    x = robots.elites[0].x[0] + 0.02
    rollouts = rollouts_of(robots, [index], [x])
    first = next(iter(robots.plant.design_units))
    rollouts = dataclasses.replace(
        rollouts,
        actuator_scale=jnp.full(COUNT, told["actuator_scale"]),
        period=jnp.full(COUNT, told["period"]),
        delay=jnp.full(COUNT, told["delay"]),
        lag=jnp.full(COUNT, told["lag"]),
        centers=rollouts.centers.at[1].set(told["center"]),
        widths=rollouts.widths.at[1].set(told["width"]),
        heights=rollouts.heights.at[1].set(height),
        design=eqx.tree_at(
            lambda d: getattr(d, first), rollouts.design, getattr(rollouts.design, first) * told["scale"]
        ),
    )
    expected = _oracle(robots, index, x, CHUNK * STEP, height=height, **told)
    np.testing.assert_allclose(moved(robots, rollouts).x[:, 0], expected, rtol=1e-9, atol=1e-9)


def test_a_push_changes_the_momentum_by_its_impulse(pendulums):
    """From rest, hanging, without feedback: m l^2 theta_dot = J, less what gravity and damping take in 40 ms."""
    free = with_law(pendulums, K=np.zeros_like, K_goal=np.zeros_like, u=np.zeros_like)
    rollouts = rollouts_of(free, [0], [[0.0, 0.0]])
    impulse, width = 1e-3, 0.004
    height = impulse / (width * np.sqrt(2 * np.pi))
    rollouts = dataclasses.replace(
        rollouts,
        centers=rollouts.centers.at[0].set(0.23),
        widths=rollouts.widths.at[0].set(width),
        heights=rollouts.heights.at[0].set(height),
    )
    p = pendulums.elites[0].parameters
    speed = moved(free, rollouts).x[1, 0]
    np.testing.assert_allclose(speed * p["m"] * p["l"] ** 2, impulse, rtol=0.03)


def test_noise_on_the_input_walks_as_it_should(pendulums):
    """Of its own standard deviation, and held for a period: a constant torque, which moves in proportion."""
    free = with_law(pendulums, K=np.zeros_like, K_goal=np.zeros_like, u=np.zeros_like)
    rollouts = rollouts_of(free, [0], [[0.0, 0.0]])
    rollouts = dataclasses.replace(rollouts, input_noise=jnp.full((1, COUNT), 0.1), period=jnp.full(COUNT, CHUNK))
    motion = moved(free, rollouts)
    noise = np.asarray(motion.noise[0])
    np.testing.assert_allclose(noise.std(), 0.1, rtol=0.1)
    np.testing.assert_allclose(noise.mean(), 0, atol=0.015)
    small = np.abs(noise) < 0.05
    np.testing.assert_allclose(motion.x[1, small] / noise[small], motion.x[1, 0] / noise[0], rtol=0.02)


def test_noise_on_the_velocity_reaches_the_controller_through_the_gain(pendulums):
    elite = pendulums.elites[0]
    rollouts = rollouts_of(pendulums, [0], [elite.x[0]])
    quiet = moved(pendulums, dataclasses.replace(rollouts, period=jnp.full(COUNT, CHUNK)))
    noisy = dataclasses.replace(rollouts, velocity_noise=jnp.full((1, COUNT), 0.01), period=jnp.full(COUNT, CHUNK))
    spread = np.asarray(moved(pendulums, noisy).command - quiet.command)
    np.testing.assert_allclose(spread.std(), 0.01 * abs(elite.K[0, 0, 1]), rtol=0.1)


def test_a_lane_that_leaves_the_limits_stays_where_it_did_and_harms_nobody(pendulums):
    elite = pendulums.elites[0]
    beyond = elite.state_limits[1] * np.array([0.0, 1.0]) + np.array([np.pi, 1e-3])
    bad = np.array([np.nan, 0.0])
    x = np.stack([elite.x[0], elite.x_goal, beyond, bad])
    motion = moved(pendulums, rollouts_of(pendulums, np.zeros(4, int), x))
    np.testing.assert_array_equal(motion.left[:4], [False, False, True, True])
    alone = moved(pendulums, rollouts_of(pendulums, [0], [elite.x[0]]))
    np.testing.assert_array_equal(motion.x[:, 0], alone.x[:, 0])
    later = moved(pendulums, rollouts_of(pendulums, np.zeros(4, int), x), chunks=2)
    np.testing.assert_array_equal(later.x[:, 2], motion.x[:, 2])


def test_noises_are_those_of_the_key(pendulums):
    rollouts = rollouts_of(pendulums, [0], [pendulums.elites[0].x[0]])
    noisy = dataclasses.replace(rollouts, input_noise=jnp.full((1, COUNT), 0.1))
    one, again = moved(pendulums, noisy), moved(pendulums, noisy)
    np.testing.assert_array_equal(one.x, again.x)
    assert not np.array_equal(one.x, moved(pendulums, noisy, key=jax.random.key(1)).x)
    assert len(np.unique(np.asarray(one.x[0]))) == COUNT
