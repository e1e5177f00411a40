"""Charts of the swing-up over time: states with the funnel's extent, inputs, V/rho of disturbed motions, gains."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import final

import numpy as np
from jaxtyping import Float

from rtcd_jax.analysis.report.canvas import GRAY
from rtcd_jax.analysis.report.charts import Band, Chart, Curve, Panel
from rtcd_jax.analysis.report.reading import FunnelView
from rtcd_jax.analysis.report.words import letter
from rtcd_jax.config.load import Config
from rtcd_jax.elite.closed_loop import ClosedLoop, runge_kutta
from rtcd_jax.elite.elite import Elite, ellipsoid_axes
from rtcd_jax.elite.simulators import dynamics_of

STARTS = 64
"""Disturbed motions of each controller, from the boundary of its first ellipsoid."""
STEPS = 8
"""Runge-Kutta steps of a knots' interval."""
FRAME = 0.04
"""Longest time between two instants of a motion that is shown moving [s], if the steps allow it."""
HOLD = 1.0
"""Seconds at the goal."""


def charts_of_motion(config: Config, funnels: Sequence[FunnelView]) -> dict[str, Chart]:
    """The charts by name."""
    return {"motion": motion(config, funnels), "gains": gains(config, funnels)}


def motion(config: Config, funnels: Sequence[FunnelView]) -> Chart:
    """x*(t) with the funnel's extent in every state, u*(t) with its limits, and V/rho of disturbed motions."""
    states = [
        Panel(f"{letter(name)} [{unit}]", [mark for funnel in funnels for mark in _state(funnel, i)])
        for i, (name, unit) in enumerate(config.plant.states.items())
    ]
    inputs = [
        Panel(f"{name} [{unit}],\nlimit dashed", [*_limits(funnels, j), *(_input(funnel, j) for funnel in funnels)])
        for j, (name, unit) in enumerate(config.plant.input_units.items())
    ]
    ratios = [
        Curve(funnel.elite.time, boundary_ratio(funnel.elite), funnel.label, funnel.color, style="marked")
        for funnel in funnels
    ]
    ends = np.array([0.0, max(float(funnel.elite.time[-1]) for funnel in funnels)])
    edge = Curve(ends, np.ones(2), "", GRAY, style="dashed", width=1)
    panels = [*states, *inputs, Panel("largest V/ρ [-]", [edge, *ratios], logarithmic=True)]
    note = (
        f"bands: the funnel's extent in each state; V/ρ is the largest of {STARTS} simulated motions from the boundary "
        "of the first ellipsoid, each controller in its own funnel"
    )
    return Chart("Motion", "time [s]", panels, 1.5 * len(panels) + 0.8, note)


def gains(config: Config, funnels: Sequence[FunnelView]) -> Chart:
    """K(t), entry by entry."""
    panels = []
    for j, (input_, unit) in enumerate(config.plant.input_units.items()):
        for i, (state, per) in enumerate(config.plant.states.items()):
            curves = [Curve(f.elite.time, f.elite.K[:, j, i], f.label, f.color) for f in funnels]
            per = f"({per})" if "/" in per else per
            panels.append(Panel("", curves, f"{input_} by {letter(state)} [{unit}/{per}]"))
    rows = -(-len(panels) // 2)
    return Chart("Gains K(t)", "time [s]", panels, 1.9 * rows + 0.6, columns=2)


def boundary_ratio(elite: Elite) -> Float[np.ndarray, " knots"]:
    """The largest V/rho at every knot of motions that start on the boundary of the first ellipsoid."""
    motions = boundary_motions(elite)
    ratio = np.max(motions.ratio[:: motions.stride], axis=1)[: len(elite.time)]
    return np.where(np.isfinite(ratio), ratio, np.nan)


@final
@dataclass(frozen=True, eq=False)
class Motions:
    """`STARTS` motions from the boundary of the first ellipsoid, and the nominal one as the first.

    The times [s] are the knots and `stride` - 1 instants between two of them, and go on for `HOLD` seconds at the goal,
    where that is held.
    `ratio` is V/rho at the knots; between them it repeats the last one.
    """

    time: Float[np.ndarray, " T"]
    x: Float[np.ndarray, "T motions n"]
    ratio: Float[np.ndarray, "T motions"]
    stride: int

    @property
    def widest(self) -> int:
        """The disturbed motion that comes closest to the funnel's boundary after its start, or leaves it farthest."""
        after = np.nan_to_num(self.ratio[self.stride :], nan=np.inf)
        return 1 + int(np.argmax(np.max(after, axis=0)[1:]))


@lru_cache(maxsize=16)
def boundary_motions(elite: Elite) -> Motions:
    """The closed loop from the boundary of the first ellipsoid, to the goal and held there, or into the catch set.

    Raises:
        UserError: an unknown plant, or the elite's parameters lack one.
    """
    f = dynamics_of(elite)
    interval = float(elite.time[1] - elite.time[0])
    loop, march = ClosedLoop.of(elite, f), runge_kutta(f, interval / STEPS)
    every = next(each for each in (8, 4, 2, 1) if each * interval / STEPS <= FRAME or each == 1)
    y = np.random.default_rng(0).normal(size=(STARTS, elite.x_goal.size))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    x = np.concatenate([elite.x[:1], elite.x[0] + y @ ellipsoid_axes(elite.S[0], elite.rho[0]).T])
    ratio = np.r_[0.0, np.ones(STARTS)]
    times, states, ratios = [elite.time[:1]], [x], [ratio]
    held = 0 if elite.caught else math.ceil(HOLD / interval)
    ends = [*elite.time, *(elite.time[-1] + interval * np.arange(1, held + 1))]
    with np.errstate(all="ignore"):  # a motion far outside an external funnel may have no end; then there is a gap
        for k, (start, end) in enumerate(itertools.pairwise(ends)):
            policy = loop.tracking(k) if k < len(elite.u) else loop.holding()
            passed = list(march(policy, float(start), float(end), x))[every - 1 :: every]
            x = passed[-1]
            knot = min(k + 1, len(elite.u))
            before, ratio = ratio, elite.value(knot, x) / elite.rho[knot]
            states += passed
            ratios += [*[before] * (len(passed) - 1), ratio]
            times.append(np.linspace(start, end, len(passed) + 1)[1:])
    return Motions(np.concatenate(times), np.array(states), np.array(ratios), STEPS // every)


def _state(funnel: FunnelView, i: int) -> tuple[Band, Curve]:
    elite = funnel.elite
    half = np.sqrt(elite.rho * np.linalg.inv(elite.S)[:, i, i])  # of the ellipsoid's shadow on this axis
    x = elite.x[:, i]
    return (
        Band(elite.time, x - half, x + half, "", funnel.color, funnel.label),
        Curve(elite.time, x, funnel.label, funnel.color),
    )


def _input(funnel: FunnelView, j: int) -> Curve:
    """u*(t), held over every interval."""
    time, u = funnel.elite.time, funnel.elite.u[:, j]
    return Curve(np.repeat(time, 2)[1:-1], np.repeat(u, 2), funnel.label, funnel.color)


def _limits(funnels: Sequence[FunnelView], j: int) -> list[Curve]:
    limits = sorted({float(funnel.elite.u_max[j]) for funnel in funnels})
    end = max(float(funnel.elite.time[-1]) for funnel in funnels)
    return [
        Curve(np.array([0.0, end]), np.full(2, sign * limit), "", GRAY, style="dashed", width=1)
        for limit in limits
        for sign in (-1, 1)
    ]
