"""What a figure shows of funnels in one plane of the state, in print and on the page alike.

funnels.py prints a plane by matplotlib, plots.py hands it to plotly.js.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float

from rtcd_jax.analysis.report.reading import FunnelView
from rtcd_jax.analysis.report.shapes import outlines, projections
from rtcd_jax.config.load import Config

MANY = 100
"""Knots from which on lines and marks are finer, and outlines coarser."""


@final
@dataclass(frozen=True, eq=False)
class Shadow:
    """A funnel on a plane: the closed outlines of its ellipsoids and the nominal motion."""

    funnel: FunnelView
    outlines: Float[np.ndarray, "knots points 2"]
    motion: Float[np.ndarray, "knots 2"]

    @property
    def fine(self) -> bool:
        """Whether its knots are so many that lines and marks have to be fine."""
        return len(self.motion) > MANY


@final
@dataclass(frozen=True, eq=False)
class Plane:
    """Names and units of its two states, its window, the funnels, and the positions of start and goal.

    The `shadows` stand in the order of drawing: the funnel with the largest ellipsoid is the lowest.
    """

    states: Sequence[tuple[str, str]]
    limits: Sequence[float]
    window: Float[np.ndarray, "2 2"]
    """Its lower and its upper corner."""
    shadows: Sequence[Shadow]
    start: Sequence[float]
    goal: Sequence[float]

    @property
    def visible_limits(self) -> Iterator[tuple[int, float]]:
        """The limits on |x_i| that the window shows: on which of the two axes, and where."""
        for axis, (limit, (low, high)) in enumerate(zip(self.limits, self.window.T, strict=True)):
            yield from ((axis, value) for value in (-limit, limit) if low <= value <= high)


def plane_of(
    config: Config,
    funnels: Sequence[FunnelView],
    pair: tuple[int, int],
    points: int | None = None,
    motion: Float[np.ndarray, "samples n"] | None = None,
) -> Plane:
    """The plane of two states, with `points` points an outline; its window holds all funnels and a measured `motion`.

    Without `points` outlines are as smooth as print needs them.
    """
    largest_first = sorted(funnels, key=lambda funnel: -float(funnel.elite.volumes_per_knot.max()))
    shadows = [_shadow(funnel, pair, points) for funnel in largest_first]
    drawn = np.concatenate([shadow.outlines.reshape(-1, 2) for shadow in shadows])
    low, high = drawn.min(0), drawn.max(0)
    window = np.stack([low, high]) + 0.04 * np.outer([-1, 1], high - low)
    if motion is not None:
        measured = motion[:, pair]
        window = np.stack([np.minimum(window[0], measured.min(0)), np.maximum(window[1], measured.max(0))])
    states = list(config.plant.states.items())
    limits, start, goal = (
        [values[i] for i in pair] for values in (config.task.state_limits, config.start, config.task.goal)
    )
    return Plane([states[i] for i in pair], limits, window, shadows, start, goal)


def _shadow(funnel: FunnelView, pair: tuple[int, int], points: int | None) -> Shadow:
    elite = funnel.elite
    points = points or (181 if len(elite.time) <= MANY else 91)
    motion = elite.x[:, pair]
    return Shadow(funnel, outlines(motion, projections(elite.S, elite.rho, pair), points), motion)
