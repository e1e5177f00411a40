"""The experiments: off-nominal starts, pushes during the motion, and a robot that is not as the model says.

Every experiment gives a record for its JSON file, with a `summary` in it. What counts as recovered:

    off-nominal, pushes    stays inside the limits and ends with V <= 0.001 rho_N, as `rtcd verify` asks for
    robustness             stays inside the limits and in the last second inside the goal's region, V <= rho_N:
                           noise that never ends lets nothing settle
"""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax.analysis.disturb.comparison import Comparison, by_loop
from rtcd_jax.analysis.disturb.scenarios import (
    LONGEST_DELAY,
    PULSES,
    STEP,
    Outcome,
    Rollouts,
    undisturbed,
)
from rtcd_jax.elite.closed_loop import ARRIVED, outside_limits
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import linearized
from rtcd_jax.elite.simulators import dynamics_of
from rtcd_jax.numerics.proportion import clopper_pearson
from rtcd_jax.volume import largest_pushes

CONFIDENCE = 0.95
"""Of the two-sided intervals of the shares."""

FACTORS = 1, 2, 4, 8, 16
"""By which the first ellipsoids are enlarged, in every direction."""

TIMES, SIZES = 40, 41
"""Of the pushes: cells of the heat map."""
PUSH_WIDTH = 0.02
"""Standard deviation of a push's bell [s]."""
LARGEST_PUSH = 0.3
"""Impulse of the largest push over the input limit [s]."""

KICKS = 24
"""Sizes of a sudden push at each time."""

LEVELS = 21
"""Of every perturbation, from none to the largest (RealAIGym: N_var)."""
REPEATS = 10
"""Motions with noises of their own at each level."""
MODEL_ERROR = 0.25
"""Largest relative error of a parameter (RealAIGym: 0.75 to 1.25)."""
VELOCITY_NOISE = 0.1
"""Largest standard deviation over the joint's largest nominal speed."""
INPUT_NOISE = 0.2
"""Largest standard deviation over the input limit (RealAIGym: 1.1 of 6 N m)."""
LAG = 0.1
"""Largest time constant of the motor [s] (RealAIGym's slowest, 0.1 of the way in 2 ms, has 19 ms)."""
DELAY = LONGEST_DELAY
"""Largest delay of the measurements [s] (RealAIGym: 40 ms)."""
PROFILES = 50
"""Random sequences of pulses (RealAIGym's), each of `PULSES`."""
PULSE_WIDTHS = 0.05, 0.1
"""Standard deviation of a pulse's bell [s] (RealAIGym's)."""
PULSE_HEIGHTS = 0.08, 0.83
"""Of a pulse, over the input limit (RealAIGym: 0.5 to 5 of 6 N m)."""
FRICTION = 0.25
"""Largest dry friction on a motor's axis over its limit."""
SLIPS = 0.01
"""Speed below which dry friction falls to zero, over the motor's largest nominal one."""
HOLDS = 1, 2, 4, 8, 16
"""Control periods over that of an export."""
RATES = 1000, 500, 250, 200, 125, 100, 50
"""Of the controller [Hz]."""
SCORED = "model", "velocity noise", "torque noise", "response", "delay", "perturbation"
"""The criteria whose mean is the score."""

Simulate = Callable[[Rollouts, str, bool], Outcome]
"""Rollouts, the experiment's name, whether they may end early -> what became of them."""


def off_nominal(comparison: Comparison, states: int, seed: int, simulate: Simulate) -> dict[str, Any]:
    """Shares of uniform states of the first ellipsoids, and of enlarged ones, from which each controller arrives.

    Both controllers start from the same states, those of either funnel. An ellipsoid itself tests the promise, an
    enlarged one what lies beyond it; of these only states inside the limits are drawn.
    """
    random = np.random.default_rng(seed)
    places = [(name, factor) for name in comparison.names for factor in FACTORS]
    starts = [_starts(comparison.elites[comparison.indices[name]], factor, states, random) for name, factor in places]
    loops = len(comparison.names)
    x = np.repeat(np.stack(starts), loops, axis=0).reshape(-1, starts[0].shape[1])
    loop = np.tile(np.repeat(np.arange(loops), states), len(places))
    outcome = simulate(undisturbed(comparison.plant, comparison.design, loop, x.T), "off-nominal", True)
    arrived = _arrived(outcome).reshape(len(places), loops, states)
    return {
        "experiment": "uniform states of the first ellipsoids (sampled), and of ellipsoids enlarged by a factor",
        "states": states,
        "seed": seed,
        "confidence": CONFIDENCE,
        "factors": FACTORS,
        "summary": {
            f"{name} ellipsoid x {factor}": dict(_shares(comparison, cells))
            for (name, factor), cells in zip(places, arrived, strict=True)
        },
    }


def _starts(elite: Elite, factor: float, states: int, random: np.random.Generator) -> np.ndarray:
    """Uniform states [states n] of the first ellipsoid, enlarged, as far as it lies inside the limits."""
    inside = np.empty((0, elite.x_goal.size))
    while len(inside) < states:
        drawn = elite.x[0] + factor * (elite.points(np.zeros(states, int), random) - elite.x[0])
        inside = np.concatenate([inside, drawn[~outside_limits(elite, drawn)]])
    return inside[:states]


def _shares(comparison: Comparison, arrived: np.ndarray) -> Iterator[tuple[str, float]]:
    """Each controller's share of successes with both ends of its interval."""
    for name, row in by_loop(comparison, arrived):
        failures, trials = int((~row).sum()), len(row)
        lower, upper = clopper_pearson(failures, trials, (1 + CONFIDENCE) / 2)
        yield from {name: 1 - failures / trials, f"{name} lower": 1 - upper, f"{name} upper": 1 - lower}.items()


def impulse(comparison: Comparison, simulate: Simulate) -> dict[str, Any]:
    """For a bell-shaped push on the first input, over its time and its impulse: recovered or lost, each controller.

    Times are from the first whole push to the last knot, the same shares of that for each controller.
    """
    shares = np.linspace(0, 1, TIMES)
    limit = float(comparison.elites[0].u_max[0])
    impulses = np.linspace(-1, 1, SIZES) * LARGEST_PUSH * limit
    first = 3 * PUSH_WIDTH
    times = np.stack([first + shares * (elite.time[-1] - first) for elite in comparison.elites])
    loop, when, size = (axis.ravel() for axis in np.indices((len(times), TIMES, SIZES)))
    rollouts = from_start(comparison, loop)
    heights = np.zeros(rollouts.heights.shape)
    heights[0, 0] = impulses[size] / (PUSH_WIDTH * math.sqrt(2 * math.pi))
    rollouts = dataclasses.replace(
        rollouts,
        centers=rollouts.centers.at[0].set(times[loop, when]),
        widths=rollouts.widths.at[0].set(PUSH_WIDTH),
        heights=jnp.asarray(heights),
    )
    recovered = _arrived(simulate(rollouts, "impulse", True)).reshape(len(times), TIMES, SIZES)
    return {
        "experiment": f"a push on the first input, a bell with a standard deviation of {PUSH_WIDTH:g} s",
        "impulse_unit": f"{comparison.plant.input_units[0]} s",
        "times": dict(by_loop(comparison, times)),
        "impulses": impulses,
        "recovered": dict(by_loop(comparison, recovered)),
        "summary": {
            name: {"recovered": cells.mean(), "largest_at_all_times": largest_tolerated(impulses, cells)}
            for name, cells in by_loop(comparison, recovered)
        },
    }


def push_margin(comparison: Comparison, simulate: Simulate) -> dict[str, Any]:
    """The largest impulse on the first input that leaves x* + B J in the funnel, and the largest one recovered from.

    At `TIMES` knots, by pushes of one step to both sides, on a ladder of `KICKS` impulses that begins with the funnel's
    own: what is tolerated there is 0 where that one is lost, and the funnel's claim refuted.
    """
    elites = comparison.elites
    knots = np.stack([np.linspace(0, len(elite.u), TIMES).round().astype(int) for elite in elites])
    times = np.stack([elite.time[k] for elite, k in zip(elites, knots, strict=True)])
    inside = [_pushes_inside(elite) for elite in elites]
    claimed = np.stack([pushes[k] for pushes, k in zip(inside, knots, strict=True)])
    most = np.maximum(LARGEST_PUSH * elites[0].u_max[0], 4 * claimed)
    rungs = np.geomspace(claimed, most, KICKS, axis=-1)
    loop, when, size, side = (axis.ravel() for axis in np.indices((len(elites), TIMES, KICKS, 2)))
    rollouts = from_start(comparison, loop)
    steps = np.round(times / STEP)[loop, when]
    heights = np.zeros(rollouts.heights.shape)
    heights[0, 0] = rungs[loop, when, size] * np.where(side, -1, 1) / STEP
    rollouts = dataclasses.replace(
        rollouts,
        centers=rollouts.centers.at[0].set((steps + 0.5) * STEP),
        widths=rollouts.widths.at[0].set(STEP / 8),  # the steps before and after get less than 1e-13 of it
        heights=jnp.asarray(heights),
    )
    recovered = _arrived(simulate(rollouts, "push margin", True)).reshape(*rungs.shape, 2).all(axis=-1)
    borne = np.cumprod(recovered, axis=-1).sum(axis=-1)
    ladder = np.concatenate([np.zeros((*borne.shape, 1)), rungs], axis=-1)
    tolerated = np.take_along_axis(ladder, borne[..., None], axis=-1)[..., 0]
    return {
        "experiment": f"a push of {STEP:g} s on the first input, on the nominal motion at a knot",
        "impulse_unit": f"{comparison.plant.input_units[0]} s",
        "times": dict(by_loop(comparison, times)),
        "inside_funnel": dict(by_loop(comparison, claimed)),
        "tolerated": dict(by_loop(comparison, tolerated)),
        "summary": {
            name: {"push_margin": pushes.min(), "tolerated_at_all_times": limit.min()}
            for (name, limit), pushes in zip(by_loop(comparison, tolerated), inside, strict=True)
        },
    }


def _pushes_inside(elite: Elite) -> np.ndarray:
    """Of every knot, by the first input."""
    held = np.concatenate([elite.u, np.zeros_like(elite.u[:1])])
    _, jumps = linearized(dynamics_of(elite), elite.x, held)
    return largest_pushes(elite.S, elite.rho, jumps)[:, 0]


class Perturbation(NamedTuple):
    """One way in which the robot is not as the model says: `apply(rollouts, level [L], random) -> rollouts`.

    `levels` in `unit`; every level is simulated `repeats` times. A criterion's success is that of all its own.
    """

    criterion: str
    name: str
    unit: str
    levels: np.ndarray
    repeats: int
    apply: Callable[[Rollouts, np.ndarray, np.random.Generator], Rollouts]


def robustness(comparison: Comparison, seed: int, simulate: Simulate) -> dict[str, Any]:
    """Success by perturbation and level, and the score: the mean over six criteria of the share of successes.

    The criteria and their ranges follow the RealAIGym benchmark (Wiebe et al., "Open Source Dual-Purpose Acrobot and
    Pendubot Platform", IEEE Robotics & Automation Magazine 31(2), 2024), the robot and what counts as success are ours.
    """
    random = np.random.default_rng(seed)
    tested = perturbations(comparison)
    sizes = [len(perturbation.levels) * perturbation.repeats for perturbation in tested]
    loops = len(comparison.names)
    parts = []
    for perturbation in tested:
        level = np.repeat(perturbation.levels, perturbation.repeats)
        rollouts = from_start(comparison, np.repeat(np.arange(loops), len(level)))
        parts.append(perturbation.apply(rollouts, np.tile(level, loops), random))
    together = jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=-1), *parts)
    outcome = simulate(together, "robustness", False)
    stayed = np.split(~outcome.left_limits & (outcome.held <= 1), loops * np.cumsum(sizes)[:-1])
    successes = [part.reshape(loops, len(each.levels), -1) for part, each in zip(stayed, tested, strict=True)]
    return {
        "experiment": "the swing-up from its start on a robot that is not as the model says",
        "seed": seed,
        "troubles": [
            {
                "criterion": perturbation.criterion,
                "name": perturbation.name,
                "unit": perturbation.unit,
                "levels": perturbation.levels,
                "success": {name: part.mean(axis=1) for name, part in by_loop(comparison, success)},
            }
            for perturbation, success in zip(tested, successes, strict=True)
        ],
        "summary": dict(by_loop(comparison, _scores(tested, successes, loops))),
    }


def _scores(tested: list[Perturbation], successes: list[np.ndarray], loops: int) -> np.ndarray:
    """For each loop, every criterion's mean over its perturbations, and the score."""
    scores: list[dict[str, float]] = []
    for loop in range(loops):
        criteria: dict[str, list[float]] = {}
        for perturbation, success in zip(tested, successes, strict=True):
            criteria.setdefault(perturbation.criterion, []).append(float(success[loop].mean()))
        means = {criterion: float(np.mean(shares)) for criterion, shares in criteria.items()}
        scores.append({"score": float(np.mean([means[criterion] for criterion in SCORED])), **means})
    return np.array(scores, dtype=object)


def perturbations(comparison: Comparison) -> list[Perturbation]:
    """All of them, for the robot of a comparison."""
    unit = comparison.plant.input_units[0]
    elite = comparison.elites[0]
    half = elite.x_goal.size // 2
    limits = elite.u_max
    speeds = np.max([np.abs(elite.x[:, half:]).max(axis=0) for elite in comparison.elites], axis=0)
    relative = np.linspace(-MODEL_ERROR, MODEL_ERROR, LEVELS)

    def none_to(largest: float) -> np.ndarray:
        return np.linspace(0, largest, LEVELS)

    return [
        *(Perturbation("model", name, "relative", relative, 1, change)
          for name, change in _parameters(comparison).items()),
        Perturbation("velocity noise", "velocity noise", "largest nominal speed", none_to(VELOCITY_NOISE), REPEATS,
                lambda rollouts, level, _: dataclasses.replace(rollouts, velocity_noise=speeds[:, None] * level)),
        Perturbation("torque noise", "torque noise", "input limit", none_to(INPUT_NOISE), REPEATS,
                lambda rollouts, level, _: dataclasses.replace(rollouts, input_noise=limits[:, None] * level)),
        Perturbation("response", "response time", "s", none_to(LAG), 1,
                lambda rollouts, level, _: dataclasses.replace(rollouts, lag=jnp.asarray(level))),
        Perturbation("delay", "delay", "s", none_to(DELAY), 1,
                lambda rollouts, level, _: dataclasses.replace(rollouts, delay=_steps(level))),
        Perturbation("perturbation", "perturbation", "profile", np.arange(PROFILES, dtype=float), 1,
                lambda rollouts, level, random: pulsed(comparison, rollouts, random)),
        Perturbation("friction", "dry friction", unit, FRICTION * limits[0] * np.linspace(0, 1, LEVELS), 1,
                lambda rollouts, level, _: dataclasses.replace(
                    rollouts,
                    friction=limits[:, None] / limits[0] * level,
                    slips=SLIPS * _motor_speeds(comparison)[:, None] * jnp.ones_like(rollouts.friction))),
        Perturbation("hold", "hold", "times the export's period", np.array(HOLDS, float), 1,
                lambda rollouts, level, _: dataclasses.replace(
                    rollouts, period=_steps(level * comparison.export_periods[np.asarray(rollouts.loop)]))),
        Perturbation("control rate", "control rate", "Hz", np.array(RATES, float), 1,
                lambda rollouts, rate, _: dataclasses.replace(rollouts, period=_steps(1 / rate))),
    ]  # fmt: skip


def _parameters(comparison: Comparison) -> Mapping[str, Callable[[Rollouts, np.ndarray, Any], Rollouts]]:
    """What scales each uncertain number of the robot by 1 + level: its design, its constants, its input limit.

    Gravity is known.
    """

    def scaling(where: Callable[[Rollouts], Any]) -> Callable[[Rollouts, np.ndarray, Any], Rollouts]:
        return lambda rollouts, level, _: eqx.tree_at(where, rollouts, where(rollouts) * (1 + level))

    constants = [
        field.name
        for field in dataclasses.fields(comparison.plant)
        if field.name != "gravity"
        and not field.name.endswith("_limit")
        and np.any(getattr(comparison.plant, field.name))
    ]
    design = comparison.plant.design_units
    return {
        **{name: scaling(lambda rollouts, name=name: getattr(rollouts.design, name)) for name in design},
        **{name: scaling(lambda rollouts, name=name: getattr(rollouts.plant, name)) for name in constants},
        "input limit": scaling(lambda rollouts: rollouts.actuator_scale),
    }


def _motor_speeds(comparison: Comparison) -> np.ndarray:
    """The largest nominal speed of each motor [m], over all loops."""
    largest = []
    for index, elite in enumerate(comparison.elites):
        plant, design = jax.tree.map(lambda leaf, index=index: leaf[index], (comparison.plant, comparison.design))
        largest.append(np.abs(plant.motor_speeds(design, jnp.asarray(elite.x.T))).max(axis=1))
    return np.max(largest, axis=0)


def _steps(seconds: np.ndarray) -> jax.Array:
    """The nearest whole steps, one at least but for what is zero."""
    steps = np.round(seconds / STEP)
    return jnp.asarray(np.where(seconds > 0, np.maximum(steps, 1), 0), int)


def pulsed(comparison: Comparison, rollouts: Rollouts, random: np.random.Generator) -> Rollouts:
    """Random pulses, one in each part of the motion, the same for all loops but for the motions' lengths."""
    inputs = comparison.elites[0].u_max
    shares = (np.arange(PULSES)[:, None] + random.uniform(size=(PULSES, PROFILES))) / PULSES
    widths = random.uniform(*PULSE_WIDTHS, size=(PULSES, PROFILES))
    sizes = random.uniform(*PULSE_HEIGHTS, size=(PULSES, len(inputs), PROFILES))
    heights = inputs[:, None] * sizes * random.choice([-1, 1], size=sizes.shape)
    durations = np.array([elite.time[-1] for elite in comparison.elites])
    return dataclasses.replace(
        rollouts,
        centers=jnp.asarray(np.concatenate([shares * duration for duration in durations], axis=1)),
        widths=jnp.asarray(np.tile(widths, len(durations))),
        heights=jnp.asarray(np.tile(heights, len(durations))),
    )


def from_start(comparison: Comparison, loop: np.ndarray) -> Rollouts:
    """Undisturbed rollouts from the nominal motions' first states."""
    first = np.stack([elite.x[0] for elite in comparison.elites])
    return undisturbed(comparison.plant, comparison.design, loop, first[loop].T)


def _arrived(outcome: Outcome) -> np.ndarray:
    return ~outcome.left_limits & (outcome.final <= ARRIVED)


def largest_tolerated(impulses: np.ndarray, recovered: np.ndarray) -> float:
    """The largest |impulse| up to which all pushes, to both sides and at all times, were recovered from."""
    lost = np.abs(impulses)[~recovered.all(axis=0)]
    tolerated = np.abs(impulses)[np.abs(impulses) < lost.min()] if lost.size else np.abs(impulses)
    return float(tolerated.max(initial=0.0))
