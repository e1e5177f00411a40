"""Funnels in the planes of the state as plotly.js reads them, with what the page's time slider needs."""

from collections.abc import Sequence

import numpy as np

from rtcd_jax.analysis.report.canvas import BLACK, GRAY
from rtcd_jax.analysis.report.plane import Plane, Shadow, plane_of
from rtcd_jax.analysis.report.reading import FunnelView
from rtcd_jax.analysis.report.shapes import other_planes, planes
from rtcd_jax.analysis.report.traces import Plot, faint, numbers
from rtcd_jax.analysis.report.words import letter, volume_unit
from rtcd_jax.config.load import Config

POINTS, COARSE = 49, 33
"""Of an ellipse's outline, in the plane of a coordinate and its velocity and in another one: a page of 200 knots stays
small."""


def planes_of(config: Config, funnels: Sequence[FunnelView]) -> tuple[dict[str, Plot], dict[str, Plot]]:
    """The funnels by the plots' names: in every plane of a coordinate and its velocity, and in all other planes."""
    unit, n = volume_unit(config), len(config.plant.states)

    def plots(pairs: Sequence[tuple[int, int]], points: int, first: int) -> dict[str, Plot]:
        drawn = ((pair, plane_of(config, funnels, pair, points)) for pair in pairs)
        return {f"plane{i}": plane_plot(plane, unit, pair, points) for i, (pair, plane) in enumerate(drawn, first)}

    usual = planes(n)
    return plots(usual, POINTS, 0), plots(other_planes(n), COARSE, len(usual))


def plane_plot(plane: Plane, unit: str, pair: tuple[int, int], points: int) -> Plot:
    """Funnels over one another; `moments` says which traces the time slider fills from which, `pair` which states."""
    bodies = [_body(shadow) for shadow in plane.shadows]
    motions = [_motion(shadow, unit) for shadow in plane.shadows]
    moments = [_outline(shadow.funnel) for shadow in plane.shadows]
    labels = [f"{letter(name)} [{dimension}]" for name, dimension in plane.states]
    count = len(plane.shadows)
    return {
        "data": [*bodies, *motions, *moments, *_ends(plane)],
        "layout": {
            "xaxis": {"title": {"text": labels[0]}, "range": numbers(plane.window[:, 0])},
            "yaxis": {"title": {"text": labels[1]}, "range": numbers(plane.window[:, 1])},
            "shapes": [
                *(_limit(axis, value) for axis, value in plane.visible_limits),
                *map(_kept_out, plane.kept_out),
            ],
        },
        "moments": [
            {"source": i, "trace": 2 * count + i, "times": numbers(shadow.funnel.elite.time), "points": points + 1}
            for i, shadow in enumerate(plane.shadows)
        ],
        "pair": pair,
    }


def _body(shadow: Shadow) -> Plot:
    """All ellipses as one trace, a gap behind each."""
    gaps = np.full((len(shadow.outlines), 1, 2), np.nan)
    x, y = np.concatenate([shadow.outlines, gaps], axis=1).reshape(-1, 2).T
    funnel = shadow.funnel
    return {
        "x": _rounded(x),
        "y": _rounded(y),
        "mode": "lines",
        "fill": "toself",
        "fillcolor": faint(funnel.color, 0.10),
        "line": {"color": faint(funnel.color, 0.45), "width": 0.3 if shadow.fine else 0.6},
        "name": funnel.label,
        "legendgroup": funnel.label,
        "showlegend": False,
        "hoverinfo": "skip",
    }


def _motion(shadow: Shadow, unit: str) -> Plot:
    """The nominal motion, which tells of a knot what is under the pointer."""
    x, y = map(_rounded, shadow.motion.T)
    funnel, elite = shadow.funnel, shadow.funnel.elite
    return {
        "x": x,
        "y": y,
        "mode": "lines+markers",
        "line": {"color": funnel.color, "width": 1.5},
        "marker": {"size": 2.5 if shadow.fine else 4},
        "name": funnel.label,
        "legendgroup": funnel.label,
        "customdata": [numbers(row) for row in np.stack([elite.time, elite.rho, elite.volumes_per_knot], axis=1)],
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


def _ends(plane: Plane) -> list[Plot]:
    ends = (("start", plane.start, "circle-open"), ("goal", plane.goal, "star-open"))
    return [
        {
            "x": [x],
            "y": [y],
            "mode": "markers",
            "marker": {"symbol": symbol, "size": 12, "color": BLACK, "line": {"width": 1.5}},
            "name": name,
        }
        for name, (x, y), symbol in ends
    ]


def _limit(axis: int, value: float) -> Plot:
    """A dashed line across the plane."""
    upright = {"x0": value, "x1": value, "y0": 0, "y1": 1, "xref": "x", "yref": "paper"}
    across = {"y0": value, "y1": value, "x0": 0, "x1": 1, "yref": "y", "xref": "paper"}
    return {"type": "line", "line": {"color": GRAY, "dash": "dash", "width": 1}} | (across if axis else upright)


def _kept_out(polygon: np.ndarray) -> Plot:
    """A set to keep out of, below all else."""
    corners = "L".join(f"{x:.6g},{y:.6g}" for x, y in polygon)
    return {
        "type": "path",
        "path": f"M{corners}Z",
        "fillcolor": faint(GRAY, 0.3),
        "line": {"width": 0},
        "layer": "below",
    }


def _rounded(values: np.ndarray) -> list[float | None]:
    """To a millionth, None for what is not finite: an ellipse needs no more, and there are many."""
    return [None if value != value else value for value in np.round(values, 6).tolist()]
