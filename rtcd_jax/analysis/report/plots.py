"""Figures of the page as plotly.js reads them: plain mappings, which page.js adds the common layout to."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rtcd_jax.analysis.report.canvas import BLACK, GRAY
from rtcd_jax.analysis.report.funnels import MANY, shadow, window
from rtcd_jax.analysis.report.history import Course, column, courses, failures, spread
from rtcd_jax.analysis.report.progress import GREEN, SPREAD, STATUS_COLORS, status_words
from rtcd_jax.analysis.report.reading import BLUE, VERMILION, FunnelView, Run, funnel_views
from rtcd_jax.analysis.report.shapes import planes
from rtcd_jax.analysis.report.words import letter, volume_unit, words
from rtcd_jax.config.load import Config

Plot = dict[str, Any]
SEARCHES = {"best_so_far": ("y", "solid", 2.2), "median": ("y", "dot", 1.2), "feasible": ("y2", "solid", 1.2)}
"""What is compared of searches: on which axis, and how its lines look."""
POINTS = 49
"""Of an ellipse's outline: a page of 200 knots stays below two megabytes."""


def plots(runs: Sequence[Run]) -> dict[str, Plot]:
    """The page's figures by name, for one run or several compared ones."""
    config, funnels = runs[0].config, funnel_views(runs)
    pairs = planes(len(config.plant.states))
    figures = {f"plane{i}": plane_plot(config, funnels, plane) for i, plane in enumerate(pairs)}
    figures["levels"] = levels_plot(config, funnels)
    if len(runs) > 1:
        figures["convergence"] = progress_plot(runs)
        return figures
    if not runs[0].generations:  # nothing was searched
        return figures
    figures["convergence"] = convergence_plot(runs[0])
    index = _numbers(column(runs[0].generations, "index"))
    for i, course in enumerate(courses(config, runs[0].generations)):
        figures[f"course{i}"] = course_plot(course, index)
    return figures


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
            "xaxis": {"title": {"text": labels[0]}, "range": _numbers(view[:, 0])},
            "yaxis": {"title": {"text": labels[1]}, "range": _numbers(view[:, 1])},
            "shapes": _limits(config, plane, view),
        },
        "moments": [
            {"source": i, "trace": 2 * count + i, "times": _numbers(funnel.elite.time), "points": POINTS + 1}
            for i, funnel in enumerate(lowest_first)
        ],
    }


def levels_plot(config: Config, funnels: Sequence[FunnelView]) -> Plot:
    """rho and the volume of every knot over time."""
    data = []
    for axis, values in (("y2", lambda elite: elite.rho), ("y", lambda elite: elite.volumes_per_knot)):
        for funnel in funnels:
            legend = {"name": funnel.label, "legendgroup": funnel.label, "showlegend": axis == "y2"}
            line = {"x": _numbers(funnel.elite.time), "y": _numbers(values(funnel.elite)), "yaxis": axis}
            look = {"mode": "lines+markers", "line": {"color": funnel.color}, "marker": {"size": 3}}
            data.append(legend | line | look)
    return {
        "data": data,
        "layout": {
            "xaxis": {"title": {"text": "time [s]"}, "anchor": "y"},
            "yaxis": {"title": {"text": f"volume [{volume_unit(config)}]"}, "domain": [0, 0.47], **_LOG},
            "yaxis2": {"title": {"text": "level ρ of V [-]"}, "domain": [0.53, 1], **_LOG},
        },
    }


def convergence_plot(run: Run) -> Plot:
    """Volumes, candidates by status and step size of one search over its generations."""
    generations, index = run.generations, _numbers(column(run.generations, "index"))
    low, high = (_numbers(bound) for bound in spread(generations))
    data: list[Plot] = [
        *_band(index, low, high, f"{SPREAD} with a funnel"),
        _line(index, column(generations, "median"), "median", GREEN, dash="dash"),
        _line(index, column(generations, "best"), "best", BLUE) | {"mode": "markers", "marker": {"size": 4}},
        _line(index, column(generations, "best_so_far"), "best so far", VERMILION),
    ]
    for name, share in failures(generations).items():
        color = STATUS_COLORS.get(name, GRAY)
        stacked = {"stackgroup": "status", "yaxis": "y2", "fillcolor": color}
        data.append(_line(index, share, status_words(name), color, width=0) | stacked)
    data.append(_line(index, column(generations, "sigma"), "σ", BLACK) | {"yaxis": "y3", "showlegend": False})
    objective = run.config.search.objective
    unit = volume_unit(run.config, objective)
    return {
        "data": data,
        "layout": {
            "xaxis": {"title": {"text": "generation"}, "anchor": "y3"},
            "yaxis": {"title": {"text": f"volume ({words(objective)}) [{unit}]"}, "domain": [0.5, 1]},
            "yaxis2": {"title": {"text": "candidates by status"}, "domain": [0.23, 0.45], "range": [0, 1]},
            "yaxis3": {"title": {"text": "step size σ"}, "domain": [0, 0.18], **_scale(column(generations, "sigma"))},
        },
    }


def progress_plot(runs: Sequence[Run]) -> Plot:
    """Several searches over their candidates, each by its own objective: volumes above, feasible shares below."""
    data, volumes, units = [], [], {volume_unit(run.config, run.config.search.objective) for run in runs}
    for run in runs:
        evaluated = _numbers(column(run.generations, "evaluations"))
        legend = f"{run.name} ({words(run.config.search.objective)})"
        for name, (axis, dash, width) in SEARCHES.items():
            first, values = name == "best_so_far", column(run.generations, name)
            label = legend if first else f"{run.name}, {words(name)}"
            group = {"legendgroup": run.name, "showlegend": first, "yaxis": axis}
            data.append(_line(evaluated, values, label, run.color, dash, width) | group)
            volumes += [values] * (axis == "y")
    scale = _scale(np.concatenate(volumes))
    return {
        "data": data,
        "layout": {
            "xaxis": {"title": {"text": "candidates"}, "anchor": "y2"},
            "yaxis": {"title": {"text": f"volume [{', '.join(sorted(units))}]"}, "domain": [0.32, 1], **scale},
            "yaxis2": {"title": {"text": "with a funnel"}, "domain": [0, 0.24], "range": [0, 1.03]},
        },
    }


def course_plot(course: Course, index: Sequence[float | None]) -> Plot:
    """One variable through the search, between the ends of its box."""
    low, high = course.window
    scale = {"type": "log", "range": [np.log10(low), np.log10(high)], "dtick": 1} if course.logarithmic else {}
    initial = [course.variable.initial] * 2
    return {
        "data": [
            *_band(index, _numbers(course.low), _numbers(course.high), SPREAD),
            _line(index, course.median, "median", GREEN, dash="dash"),
            _line(index, course.best, "best", VERMILION) | {"mode": "markers", "marker": {"size": 4}},
            _line([index[0], index[-1]], np.array(initial), "initial", BLUE, dash="dot"),
        ],
        "layout": {
            "title": {"text": course.title},
            "xaxis": {"title": {"text": "generation"}},
            "yaxis": {"range": [low, high]} | scale,
            "showlegend": False,
        },
    }


_LOG: Mapping[str, str] = {"type": "log", "exponentformat": "e"}


def _scale(values: np.ndarray) -> Mapping[str, str]:
    """A logarithmic axis for more than one decade."""
    return _LOG if np.nanmax(values) > 10 * np.nanmin(values) > 0 else {}


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
        "fillcolor": _faint(funnel.color, 0.10),
        "line": {"color": _faint(funnel.color, 0.45), "width": 0.6 if len(funnel.elite.time) <= MANY else 0.3},
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
            _numbers(row)
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
    ends = (("start", config.task.start, "circle-open"), ("goal", config.task.goal, "star-open"))
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


def _limits(config: Config, plane: tuple[int, int], view: np.ndarray) -> list[Plot]:
    """Dashed lines at the limits on |x_i| that the window shows."""
    lines = []
    for axis, i in enumerate(plane):
        for value in (-config.task.state_limits[i], config.task.state_limits[i]):
            if view[0, axis] <= value <= view[1, axis]:
                ends = {"x0": value, "x1": value, "y0": 0, "y1": 1, "xref": "x", "yref": "paper"}
                across = {"y0": value, "y1": value, "x0": 0, "x1": 1, "yref": "y", "xref": "paper"}
                line = {"color": GRAY, "dash": "dash", "width": 1}
                lines.append({"type": "line", "line": line} | (across if axis else ends))
    return lines


def _line(x: Sequence[Any], y: np.ndarray, name: str, color: str, dash: str = "solid", width: float = 1.8) -> Plot:
    line = {"color": color, "dash": dash, "width": width}
    return {"x": list(x), "y": _numbers(y), "mode": "lines", "line": line, "name": name}


def _band(x: Sequence[Any], low: Sequence[Any], high: Sequence[Any], name: str) -> list[Plot]:
    """Two traces, the area between them filled."""
    edge = {"x": list(x), "mode": "lines", "line": {"width": 0, "color": GREEN}, "hoverinfo": "skip"}
    filled = {"y": list(high), "fill": "tonexty", "fillcolor": _faint(GREEN, 0.15), "name": name}
    return [edge | {"y": list(low), "showlegend": False}, edge | filled]


def _faint(color: str, opacity: float) -> str:
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity})"


def _numbers(values: np.ndarray) -> list[float | None]:
    """Six significant digits, None for what is not finite."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in np.asarray(values, float)]


def _rounded(values: np.ndarray) -> list[float | None]:
    """To a millionth, None for what is not finite: an ellipse needs no more, and there are many."""
    return [None if value != value else value for value in np.round(values, 6).tolist()]
