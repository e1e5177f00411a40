"""Funnels in the planes of the state as plotly.js reads them, with what the page's time slider needs."""

from collections.abc import Sequence

import numpy as np

from rtcd_jax.analysis.report.canvas import BLACK, GRAY
from rtcd_jax.analysis.report.funnels import MANY, shadow, visible_limits, window
from rtcd_jax.analysis.report.reading import FunnelView
from rtcd_jax.analysis.report.shapes import planes
from rtcd_jax.analysis.report.traces import Plot, faint, numbers
from rtcd_jax.analysis.report.words import letter, volume_unit
from rtcd_jax.config.load import Config

POINTS = 49
"""Of an ellipse's outline: a page of 200 knots stays below two megabytes."""


def planes_of(config: Config, funnels: Sequence[FunnelView]) -> dict[str, Plot]:
    """The funnels in every plane of a coordinate and its velocity, by the plots' names on the page."""
    pairs = planes(len(config.plant.states))
    return {f"plane{i}": plane_plot(config, funnels, plane) for i, plane in enumerate(pairs)}


def plane_plot(config: Config, funnels: Sequence[FunnelView], plane: tuple[int, int]) -> Plot:
    """Funnels over one another; `moments` says which traces the time slider fills from which."""
    lowest_first = sorted(funnels, key=lambda funnel: -float(funnel.elite.volumes_per_knot.max()))
    bodies = [_body(funnel, plane) for funnel in lowest_first]
    motions = [_motion(config, funnel, plane) for funnel in lowest_first]
    moments = [_outline(funnel) for funnel in lowest_first]
    view = window(funnels, plane)
    names = list(config.plant.states.items())
    labels = [f"{letter(name)} [{unit}]" for name, unit in (names[i] for i in plane)]
    count = len(funnels)
    return {
        "data": [*bodies, *motions, *moments, *_ends(config, plane)],
        "layout": {
            "xaxis": {"title": {"text": labels[0]}, "range": numbers(view[:, 0])},
            "yaxis": {"title": {"text": labels[1]}, "range": numbers(view[:, 1])},
            "shapes": [_limit(axis, value) for axis, value in visible_limits(config, plane, view)],
        },
        "moments": [
            {"source": i, "trace": 2 * count + i, "times": numbers(funnel.elite.time), "points": POINTS + 1}
            for i, funnel in enumerate(lowest_first)
        ],
    }


def _body(funnel: FunnelView, plane: tuple[int, int]) -> Plot:
    """All ellipses as one trace, a gap behind each."""
    curves = shadow(funnel, plane, POINTS)
    gaps = np.full((len(curves), 1, 2), np.nan)
    x, y = np.concatenate([curves, gaps], axis=1).reshape(-1, 2).T
    return {
        "x": _rounded(x),
        "y": _rounded(y),
        "mode": "lines",
        "fill": "toself",
        "fillcolor": faint(funnel.color, 0.10),
        "line": {"color": faint(funnel.color, 0.45), "width": 0.6 if len(funnel.elite.time) <= MANY else 0.3},
        "name": funnel.label,
        "legendgroup": funnel.label,
        "showlegend": False,
        "hoverinfo": "skip",
    }


def _motion(config: Config, funnel: FunnelView, plane: tuple[int, int]) -> Plot:
    """The nominal motion, which tells of a knot what is under the pointer."""
    unit = volume_unit(config)
    x, y = (_rounded(funnel.elite.x[:, i]) for i in plane)
    return {
        "x": x,
        "y": y,
        "mode": "lines+markers",
        "line": {"color": funnel.color, "width": 1.5},
        "marker": {"size": 4 if len(funnel.elite.time) <= MANY else 2.5},
        "name": funnel.label,
        "legendgroup": funnel.label,
        "customdata": [
            numbers(row)
            for row in np.stack([funnel.elite.time, funnel.elite.rho, funnel.elite.volumes_per_knot], axis=1)
        ],
        "hovertemplate": (
            "t = %{customdata[0]:.3f} s<br>(%{x:.4g}, %{y:.4g})<br>ρ = %{customdata[1]:.3g}<br>"
            f"volume %{{customdata[2]:.3g}} {unit}<extra>{funnel.label}</extra>"
        ),
    }


def _outline(funnel: FunnelView) -> Plot:
    """Where the slider draws the ellipse of its time."""
    return {
        "x": [None],
        "y": [None],
        "mode": "lines",
        "line": {"color": funnel.color, "width": 3},
        "legendgroup": funnel.label,
        "showlegend": False,
        "hoverinfo": "skip",
    }


def _ends(config: Config, plane: tuple[int, int]) -> list[Plot]:
    ends = (("start", config.start, "circle-open"), ("goal", config.task.goal, "star-open"))
    return [
        {
            "x": [point[plane[0]]],
            "y": [point[plane[1]]],
            "mode": "markers",
            "marker": {"symbol": symbol, "size": 12, "color": BLACK, "line": {"width": 1.5}},
            "name": name,
        }
        for name, point, symbol in ends
    ]


def _limit(axis: int, value: float) -> Plot:
    """A dashed line across the plane."""
    upright = {"x0": value, "x1": value, "y0": 0, "y1": 1, "xref": "x", "yref": "paper"}
    across = {"y0": value, "y1": value, "x0": 0, "x1": 1, "yref": "y", "xref": "paper"}
    return {"type": "line", "line": {"color": GRAY, "dash": "dash", "width": 1}} | (across if axis else upright)


def _rounded(values: np.ndarray) -> list[float | None]:
    """To a millionth, None for what is not finite: an ellipse needs no more, and there are many."""
    return [None if value != value else value for value in np.round(values, 6).tolist()]
