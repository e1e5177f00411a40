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
from rtcd_jax.config.schema import KeepOutConfig

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
    kept_out: Sequence[Float[np.ndarray, "corners 2"]]
    """Polygons of the sets to keep out of that the plane shows: those of its two states alone, in its window."""

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
    best = funnels[-1].elite
    limits, start, goal = ([values[i] for i in pair] for values in (config.task.state_limits, best.x[0], best.x_goal))
    shown = (_polygon(each, pair, window) for each in config.task.keep_out)
    kept_out = [polygon for polygon in shown if polygon is not None and len(polygon)]
    return Plane([states[i] for i in pair], limits, window, shadows, start, goal, kept_out)


def _polygon(
    each: KeepOutConfig, pair: tuple[int, int], window: Float[np.ndarray, "2 2"]
) -> Float[np.ndarray, "corners 2"] | None:
    """A set in the window, without corners if it is not there; None if other states bound it too."""
    others = np.delete(each.normal or 1 / np.array(each.semi_axes), pair)
    if np.any(others):
        return None
    (left, bottom), (right, top) = window
    if each.normal and each.offset is not None:
        polygon = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
        return _beyond(polygon, np.array(each.normal)[list(pair)], each.offset)
    center, axes = np.array(each.center)[list(pair)], np.array(each.semi_axes)[list(pair)]
    if np.all(np.isfinite(axes)):
        turn = np.linspace(0, 2 * np.pi, 181)
        polygon = center + axes * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    else:  # a strip
        low, high = (
            np.where(np.isfinite(axes), center + sign * axes, end) for sign, end in zip((-1, 1), window, strict=True)
        )
        polygon = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    for axis in (0, 1):
        for sign, end in ((1, window[0, axis]), (-1, -window[1, axis])):
            polygon = _beyond(polygon, sign * np.eye(2)[axis], end)
    return polygon


def _beyond(polygon: Float[np.ndarray, "corners 2"], normal: np.ndarray, offset: float) -> np.ndarray:
    """The part of a convex polygon in which normal . x >= offset (Sutherland and Hodgman, 1974)."""
    corners = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        before, after = normal @ a - offset, normal @ b - offset
        corners += [a] if before >= 0 else []
        corners += [a + before / (before - after) * (b - a)] if before * after < 0 else []
    return np.array(corners).reshape(-1, 2)


def _shadow(funnel: FunnelView, pair: tuple[int, int], points: int | None) -> Shadow:
    elite = funnel.elite
    points = points or (181 if len(elite.time) <= MANY else 91)
    motion = elite.x[:, pair]
    return Shadow(funnel, outlines(motion, projections(elite.S, elite.rho, pair), points), motion)
