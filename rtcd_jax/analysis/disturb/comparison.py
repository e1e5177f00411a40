"""The controllers that are compared, and their rollouts in batches, with progress."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, final

import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax.analysis.disturb.scenarios import (
    CHUNK,
    STEP,
    WATCHED,
    Loops,
    Outcome,
    Rollouts,
    advance,
    start,
    steps_of,
)
from rtcd_jax.elite.closed_loop import ARRIVED, FORGOTTEN, ClosedLoop, settling_time
from rtcd_jax.elite.elite import Elite, initial_and_best
from rtcd_jax.elite.simulators import dynamics_of
from rtcd_jax.export.rate import control_rate
from rtcd_jax.plants import plant_of
from rtcd_jax.plants.base import Plant
from rtcd_jax.system.console import Clock, Console, Progress, times

BATCH = 2048
"""Rollouts in the compiled program."""
PREDICTED = 0.02
"""Share of the work from which on the time left is predicted; before it, most was compilation."""
REPORTED = 5.0
"""Least time between two lines of progress [s]."""


@final
@dataclass(frozen=True, eq=False)
class Comparison:
    """C closed loops of one run, by name; `plant` and `design` have leaves [C]; `horizon` [s] is for all motions.

    `config_hash` is that of the run.
    """

    names: tuple[str, ...]
    elites: tuple[Elite, ...]
    plant: Plant
    design: Any
    loops: Loops
    horizon: float
    config_hash: str | None

    @cached_property
    def export_periods(self) -> np.ndarray:
        """Control periods [C] that exports of these loops state [s]; the integrator's step where none suffices."""
        periods = [control_rate(elite, None).period for elite in self.elites]
        return np.array([STEP if period is None else period for period in periods])

    @property
    def indices(self) -> dict[str, int]:
        return {name: index for index, name in enumerate(self.names)}


@final
class Meter:
    """Shows on a console how many of all `motions` are done."""

    def __init__(self, console: Console, motions: int):
        self._console, self._motions = console, motions
        self._done = self._reported = 0.0
        self._clock = Clock()

    def tick(self, experiment: str, motions: float) -> None:
        """Counts `motions` more of an experiment as done."""
        self._done += motions
        elapsed = self._clock.elapsed
        if elapsed - self._reported >= REPORTED:
            self._reported = elapsed
            share = min(1.0, self._done / self._motions)
            shown = self._clock.times(share, 1) if share >= PREDICTED else times(elapsed, math.nan)
            self._console.progress(Progress(share, 1, f"{experiment:12} {share:4.0%}  {shown}"))


def read_comparison(folder: Path, console: Console) -> Comparison:
    """The initial candidate beside the best elite of a run folder; an initial one without a funnel is left out.

    Raises:
        UserError: no elites, or a folder that cannot be read.
    """
    elites, absence = initial_and_best(folder)
    if absence:
        console.message(f"{absence}: the best elite is disturbed alone")
    return comparison_of(elites, elites["best"].record.get("config_hash"))


def comparison_of(elites: dict[str, Elite], config_hash: str | None) -> Comparison:
    """Elites of the same run, by name."""
    robots = [plant_of(elite.robot, elite.parameters, elite.design_units) for elite in elites.values()]
    dynamics = [dynamics_of(elite) for elite in elites.values()]
    rates = [ClosedLoop.of(elite, f).rates for elite, f in zip(elites.values(), dynamics, strict=True)]
    ends = [elite.time[-1] + settling_time(elite, f) for elite, f in zip(elites.values(), dynamics, strict=True)]
    plant, design = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf, float) for leaf in leaves]), *robots)
    loops = Loops.of(list(elites.values()), rates)
    return Comparison(tuple(elites), tuple(elites.values()), plant, design, loops, max(ends), config_hash)


def run(comparison: Comparison, rollouts: Rollouts, seed: int, experiment: str, meter: Meter, settles: bool) -> Outcome:
    """What became of every rollout; `settles` lets a batch end as soon as all of its rollouts have left or arrived.

    The same rollouts and seed give the same outcome.
    """
    count = rollouts.loop.shape[0]
    parts = []
    for index, begin in enumerate(range(0, count, BATCH)):
        which = np.minimum(begin + np.arange(BATCH), count - 1)
        batch = jax.tree.map(lambda leaf, which=which: leaf[..., which], rollouts)
        key = jax.random.fold_in(jax.random.key(seed), index)
        part = _run_batch(comparison, batch, key, settles, meter, experiment)
        real = min(BATCH, count - begin)
        parts.append([np.asarray(leaf)[:real] for leaf in part])
    return Outcome(*(np.concatenate(leaves) for leaves in zip(*parts, strict=True)))


def motions(rollouts: int) -> int:
    """Those that `run` simulates, full batches of them."""
    return BATCH * math.ceil(rollouts / BATCH)


def _run_batch(
    comparison: Comparison, batch: Rollouts, key: jax.Array, settles: bool, meter: Meter, experiment: str
) -> Outcome:
    total, watched = steps_of(comparison.horizon), steps_of(WATCHED)
    quiet = _quiet_from(comparison, batch)
    motion, held = start(comparison.loops, batch), jnp.zeros(batch.loop.shape)
    final = held
    for first in range(0, total, CHUNK):
        motion = advance(comparison.loops, batch, motion, jnp.asarray(first), key)
        final = comparison.loops.distance(batch.loop, motion.x)
        if first + CHUNK > total - watched:
            held = jnp.maximum(held, final)
        over = settles and first * STEP > quiet and bool(jnp.all(motion.left | (final <= FORGOTTEN * ARRIVED)))
        meter.tick(experiment, BATCH * (total - first if over else CHUNK) / total)
        if over:
            held = final
            break
    return Outcome(*(np.asarray(leaf) for leaf in (motion.left, final, held)))


def _quiet_from(comparison: Comparison, batch: Rollouts) -> float:
    """The time from which on nothing but the goal's LQR acts [s]."""
    last_knot = max(elite.time[-1] for elite in comparison.elites)
    pushed = jnp.any(batch.heights != 0, axis=1)
    last_push = jnp.max(jnp.where(pushed, batch.centers + 6 * batch.widths, 0.0))
    return max(float(last_push), float(last_knot))


def by_loop(comparison: Comparison, values: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """`values` [C ...] by the loops' names."""
    return zip(comparison.names, values, strict=True)
