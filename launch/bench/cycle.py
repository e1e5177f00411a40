"""Swing after swing of a cycle of tasks: states of the first ellipsoid, through all motions and the resets between.

    python launch/bench/cycle.py RUN [--swings 8] [--states 1000] [--robots 16] [--scale 1] [--figure FILE]

Each task's best elite, in C MuJoCo by fixed Runge-Kutta steps, from uniform states of the first task's first ellipsoid
(times `--scale` in radius). V/rho is the largest at the start of a swing; a state is out once it is outside of an
ellipsoid at a knot, or beyond the limits at a step. The figure shows the first four swings of one state.

Under the run's uncertainty the states are shared out to `--robots` corners of the box (times `--scale`), each of which
goes through all swings, with a disturbance of the largest size and a random sign in every interval. Nothing is said of
noise and age.
"""

import argparse
import itertools
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from measure import as_script

from rtcd_jax.config.schema import UncertaintyConfig
from rtcd_jax.elite.closed_loop import ClosedLoop, fastest_rate, outside_limits, runge_kutta
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import read_config, task_folders
from rtcd_jax.elite.simulators import STEP_OF_FASTEST, STEPS, mujoco_of
from rtcd_jax.problem import RESETS, Reset
from rtcd_jax.system.errors import UserError

SHOWN, EVERY = 4, 5
"""Swings of the figure, and which of the knots it shows."""


def swing(
    elite: Elite, robot: Elite, w: float, random: np.random.Generator, x: np.ndarray, out: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The states [N+1 S n] at the knots, and which of them are out of the elite's funnel or were before; it is the
    `robot` that moves.
    """
    nominal, f = (mujoco_of(each, max(len(x), 2 * (elite.x_goal.size + elite.u_max.size))) for each in (elite, robot))
    loop, step = ClosedLoop.of(elite, nominal), float(elite.time[1]) / STEPS
    march = runge_kutta(f, min(step, STEP_OF_FASTEST / fastest_rate(robot, f)))
    knots, out = [x], out | ~(elite.value(0, x) <= elite.rho[0])
    for k, (begin, end) in enumerate(itertools.pairwise(elite.time)):
        tracking, push = loop.tracking(k), w * random.choice((-1.0, 1.0), (len(x), elite.u_max.size))

        def policy(t: float, x: np.ndarray, tracking=tracking, push=push) -> np.ndarray:
            return np.clip(tracking(t, x), -robot.u_max, robot.u_max) + push

        for after in march(policy, begin, end, knots[k]):
            out = out | outside_limits(elite, after)
        knots.append(after)
        out = out | ~(elite.value(k + 1, after) <= elite.rho[k + 1])
    return np.array(knots), out


def robots_of(
    elites: list[Elite], box: UncertaintyConfig, reset: Reset, scale: float, random: np.random.Generator
) -> list[Elite]:
    """A robot at a corner of the box: as each of the tasks has it."""
    first = elites[0]
    widths = {name: scale * width for name, width in (box.design | box.plant).items()}
    factors = {name: 1 + width * random.choice((-1.0, 1.0)) for name, width in widths.items()}
    share = 1 + scale * box.input_limit * random.choice((-1.0, 1.0))
    numbers = dict(first.parameters) | {name: first.parameters[name] * factor for name, factor in factors.items()}
    robots = []
    for elite in elites:
        robots.append(replace(elite, parameters=numbers, u_max=share * elite.u_max))
        numbers = numbers | reset.numbers(numbers)
    return robots


def draw(motions: list[np.ndarray], robot: Mapping[str, float], file: Path) -> None:
    """Both arms, and the body between them, of one state's `motions` [N+1 n], bar after bar; an arm keeps its color."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(10, 3.2))
    bar = 0.0
    for number, knots in enumerate(motions):
        angles = np.cumsum(knots[:, : knots.shape[1] // 2], 1).T
        along = np.stack([np.sin(angles), -np.cos(angles)], -1)
        hook = np.full((len(knots), 2), [bar, 0.0])
        shoulder = hook + robot["arm_length"] * along[0]
        free = shoulder + robot["arm_length"] * along[-1]
        colors = ("tab:blue", "tab:red") if number % 2 == 0 else ("tab:red", "tab:blue")
        links = [(hook, shoulder, colors[0]), (shoulder, free, colors[1])]
        if "body_center" in robot:
            links.insert(0, (shoulder, shoulder + 2 * robot["body_center"] * along[1], "tab:orange"))
        for start, end, color in links:
            lines = np.stack([start, end])[:, ::EVERY]
            axes.plot(lines[..., 0], lines[..., 1], color=color, alpha=0.35, linewidth=1.2)
        axes.plot(*free.T, color="0.3", linewidth=0.8)
        axes.plot(bar, 0, "ko", markersize=5)
        bar = free[-1, 0]
    axes.plot(bar, 0, "ko", markersize=5)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="z [m]")
    figure.savefig(file, dpi=100, bbox_inches="tight")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--swings", type=int, default=8)
    parser.add_argument("--states", type=int, default=1000)
    parser.add_argument("--robots", type=int, default=16)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--figure", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    folders = task_folders(options.run)
    elites = [Elite.read(folder, 0) for folder in folders]
    config = read_config(options.run)
    if not config.task.catch.cyclic:
        raise UserError(f"{options.run}: is no cycle of tasks (task.catch.reset)")
    box, reset, random = config.uncertainty, RESETS[config.task.catch.reset], np.random.default_rng(1)
    x = elites[0].points(np.zeros(options.states, int), np.random.default_rng(0))
    x = elites[0].x[0] + options.scale * (x - elites[0].x[0])
    shares = np.array_split(np.arange(len(x)), 1 if box.empty else min(options.robots, len(x)))
    robots = [robots_of(elites, box, reset, options.scale, random) for _ in shares]
    out, motions = np.zeros(len(x), bool), []
    print("| swing | task | duration [s] | largest V/rho at its start | states out |\n|---|---|---|---|---|")
    for number in range(options.swings):
        name, elite = folders[number % len(elites)].name, elites[number % len(elites)]
        level = elite.value(0, x).max() / elite.rho[0]
        ends = np.empty_like(x)
        for share, own in zip(shares, robots, strict=True):
            robot, w = own[number % len(elites)], options.scale * box.input
            knots, out[share] = swing(elite, robot, w, random, x[share], out[share])
            ends[share] = np.asarray(reset.state(robot.parameters, jnp.asarray(knots[-1].T))).T
            if share[0] == 0:
                motions.append(knots[:, 0])
        print(f"| {number + 1} | {name} | {elite.time[-1]:.3g} | {level:.3g} | {out.sum()} of {len(out)} |")
        x = ends
    if options.figure:
        draw(motions[:SHOWN], elites[0].parameters, options.figure)


if __name__ == "__main__":
    as_script(main)
