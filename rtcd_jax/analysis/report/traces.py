"""A chart as plotly.js reads it: plain mappings, which page.js adds the common layout to."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from rtcd_jax.analysis.report.canvas import GRAY
from rtcd_jax.analysis.report.charts import Band, Chart, Curve, Panel, Shares

Plot = dict[str, Any]
GAP = 0.06
"""Between two panels, of the plot's height."""
_STYLES = {
    "solid": ("lines", "solid"),
    "dashed": ("lines", "dash"),
    "dotted": ("lines", "dot"),
    "points": ("markers", "solid"),
    "marked": ("lines+markers", "solid"),
}


def plots_of(name: str, chart: Chart) -> dict[str, Plot]:
    """The plots of a chart by their names on the page: NAME, or NAME0, NAME1, … where every panel has its own."""
    if chart.columns == 1:
        return {name: plot(chart)}
    return {f"{name}{i}": plot(replace(chart, panels=[panel])) for i, panel in enumerate(chart.panels)}


def plot(chart: Chart) -> Plot:
    """Panels below one another; a single one has its title above it."""
    data: list[Plot] = []
    layout: Plot = {"showlegend": chart.columns == 1}
    groups, room = set[str](), 1 - GAP * (len(chart.panels) - 1)
    total, top = sum(panel.height for panel in chart.panels), 1.0
    named = [_groups(panel) for panel in chart.panels]
    shared = all(each <= named[0] for each in named)
    for number, panel in enumerate(chart.panels, 1):
        suffix, bottom = "" if number == 1 else str(number), top - room * panel.height / total
        own = {} if shared else {"legend": f"legend{suffix}"}
        if not shared:
            groups = set()
            layout[f"legend{suffix}"] = {"y": round(top, 4)}
        for trace in (trace for mark in panel.marks for trace in _traces(mark, panel)):
            shown = trace.pop("shown", True) and trace["legendgroup"] not in groups
            groups |= {trace["legendgroup"]} if shown else set()
            data.append(trace | own | {"yaxis": f"y{suffix}", "showlegend": shown})
        domain = [round(max(bottom, 0.0), 4), round(top, 4)]
        layout[f"yaxis{suffix}"] = {
            "title": {"text": panel.label.replace("\n", "<br>")},
            "domain": domain,
            **_scale(panel),
        }
        layout["xaxis"] = {"title": {"text": chart.x}, "anchor": f"y{suffix}"}
        top = bottom - GAP
    if len(chart.panels) == 1 and chart.panels[0].title:
        layout["title"] = {"text": chart.panels[0].title}
    line = {"type": "line", "yref": "paper", "y0": 0, "y1": 1, "line": {"color": GRAY, "dash": "dot", "width": 1}}
    layout["shapes"] = [line | {"x0": at, "x1": at} for at in numbers(np.asarray(chart.events))]
    return {"data": data, "layout": layout}


def legend(panel: Panel) -> dict[str, str]:
    """The labels of a panel with their colors."""
    labels: dict[str, str] = {}
    for mark in panel.marks:
        if isinstance(mark, Shares):
            labels |= {label: color for label, (_, color) in mark.parts.items()}
        elif mark.label:
            labels.setdefault(mark.label, mark.color)
    return labels


def _groups(panel: Panel) -> set[str]:
    """What a panel's legend has an entry for."""
    lines = {mark.group or mark.label for mark in panel.marks if not isinstance(mark, Shares) and mark.label}
    return lines.union(*(mark.parts for mark in panel.marks if isinstance(mark, Shares)))


def _scale(panel: Panel) -> Plot:
    if not panel.logarithmic:
        return {"range": list(panel.window)} if panel.window else {}
    scale: Plot = {"type": "log", "exponentformat": "e"}
    if panel.window:
        return scale | {"range": np.log10(panel.window).tolist(), "dtick": 1}
    y = np.concatenate([np.empty(0), *(mark.y for mark in panel.marks if isinstance(mark, Curve))])
    y = y[np.isfinite(y) & (y > 0)]
    # Over few decades plotly.js would write all digits from 1 to 9, one over the other: 1, 2 and 5 are enough.
    return scale | ({"dtick": "D2"} if y.size and y.max() < 30 * y.min() else {})


def _traces(mark: Curve | Band | Shares, panel: Panel) -> Iterator[Plot]:
    """Traces with their legend's group; `shown` is false for those that no legend names."""
    match mark:
        case Curve():
            mode, dash = _STYLES[mark.style]
            look = {"mode": mode, "line": {"color": mark.color, "dash": dash, "width": mark.width}}
            name = {"name": mark.label or panel.label, "legendgroup": mark.group or mark.label or panel.label}
            marker = {"marker": {"size": 4, "color": mark.color}} if "markers" in mode else {}
            yield {"x": numbers(mark.x), "y": numbers(mark.y), "shown": bool(mark.label)} | name | look | marker
        case Band():
            edge = {"x": numbers(mark.x), "mode": "lines", "line": {"width": 0, "color": mark.color}}
            group = mark.group or mark.label
            edge |= {"hoverinfo": "skip", "legendgroup": group, "name": mark.label or group, "shown": bool(mark.label)}
            yield edge | {"y": numbers(mark.low), "shown": False}
            yield edge | {"y": numbers(mark.high), "fill": "tonexty", "fillcolor": faint(mark.color, 0.15)}
        case Shares():
            for label, (values, color) in mark.parts.items():
                line = {"mode": "lines", "line": {"width": 0, "color": color}, "fillcolor": color}
                name = {"name": label, "legendgroup": label, "stackgroup": "shares"}
                yield {"x": numbers(mark.x), "y": numbers(values)} | line | name


def faint(color: str, opacity: float) -> str:
    """A color #RRGGBB that lets others through."""
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{opacity})"


def numbers(values: np.ndarray) -> list[float | None]:
    """Six significant digits, None for what is not finite."""
    return [float(f"{value:.6g}") if np.isfinite(value) else None for value in np.asarray(values, float)]
