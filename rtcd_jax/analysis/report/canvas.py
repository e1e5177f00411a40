"""matplotlib as all print figures use it: one style, no window, equal figures as equal bytes; charts in print."""

import contextlib
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rtcd_jax.analysis.report.charts import Band, Chart, Curve, Panel, Shares
from rtcd_jax.system.files import make_folder, replace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 7.2
"""[in], the text width of a two-column paper."""
BLACK, GRAY, LIGHT = "#000000", "#8A8A8A", "#DDDDDD"
SMALL = 8
"""Font size of legends [pt]."""

_STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "legend.fontsize": SMALL,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "pdf.fonttype": 42,  # text that can be searched and edited
}
_DPI = 200
WIDE = 1e4
"""Ratio of a logarithmic axis' ends from which on it is labeled at powers of ten alone."""
_FORMATS = {"solid": "-", "dashed": "--", "dotted": ":", "points": ".", "marked": ".-"}


def logarithmic(axes: "Axes") -> None:
    """A logarithmic y axis whose few labels are plain numbers, for small panels."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3) if high < WIDE * low else (1,), numticks=5))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


@contextlib.contextmanager
def blank(size: tuple[float, float]) -> Iterator["Figure"]:
    """A figure [in] that no window and no other figure knows, drawn in the style of all figures."""
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with style.context(["default", _STYLE]):
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def print_chart(chart: Chart, folder: Path, name: str) -> list[Path]:
    """Draws a chart; the files written. UserError if the folder cannot be written."""
    from matplotlib.ticker import MaxNLocator

    with blank((WIDTH, chart.height)) as figure:
        rows = -(-len(chart.panels) // chart.columns)
        heights = [panel.height for panel in chart.panels[:: chart.columns]]
        grid = figure.subplots(rows, chart.columns, sharex=True, squeeze=False, height_ratios=heights)
        places = list(grid.ravel())
        drawn, unused = places[: len(chart.panels)], places[len(chart.panels) :]
        for axes, panel in zip(drawn, chart.panels, strict=True):
            draw_panel(axes, panel)
            if len(chart.events):
                at = axes.get_xaxis_transform()
                axes.vlines(chart.events, 0, 1, transform=at, color=GRAY, ls=":", lw=1, label=chart.event)
            if chart.x == "generation":
                axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        for axes in unused:
            axes.remove()
        labels = [axes.get_legend_handles_labels()[1] for axes in drawn]
        if all(each == labels[0] for each in labels):
            figure.legend(**shared_legend(drawn), title=chart.note or None, loc="outside upper center")
        else:
            look = {"title_fontsize": SMALL, "frameon": True, "framealpha": 0.8, "edgecolor": "none"}
            for axes, names in zip(drawn, labels, strict=True):
                if axes is drawn[0]:
                    axes.legend(title=chart.note or None, **look)
                elif names:
                    axes.legend(ncols=len(names), **look)
        figure.supxlabel(chart.x, fontsize=9)
        return written(figure, folder, name)


def draw_panel(axes: "Axes", panel: Panel) -> None:
    """Draws a panel into its axes."""
    groups = set()
    for mark in panel.marks:
        match mark:
            case Curve():
                group = mark.group or mark.label
                label = "_" if group in groups or not mark.label else mark.label
                groups.add(group)
                look = {"color": mark.color, "lw": mark.width, "label": label}
                axes.plot(mark.x, mark.y, _FORMATS[mark.style], ms=4, **look)
            case Band():
                axes.fill_between(mark.x, mark.low, mark.high, color=mark.color, alpha=0.15, lw=0, label=mark.label)
            case Shares():
                below = np.zeros(len(mark.x))
                for label, (values, color) in mark.parts.items():
                    axes.fill_between(mark.x, below, below + values, step="mid", lw=0, label=label, color=color)
                    below = below + values
    if panel.logarithmic:
        logarithmic(axes)
    if panel.window:
        axes.set_ylim(panel.window)
    axes.set(ylabel=panel.label, title=panel.title)
    axes.grid(axis="y", lw=0.4, color=LIGHT)


def shared_legend(panels: Sequence["Axes"]) -> dict[str, Any]:
    """The entries of a legend for all that the panels have in common, in one row where they fit."""
    entries = (zip(*axes.get_legend_handles_labels(), strict=True) for axes in panels)
    handles = {label: handle for pairs in entries for handle, label in pairs}
    columns = len(handles) if len(handles) <= 6 else 4
    return {"handles": list(handles.values()), "labels": list(handles), "ncols": columns}


def written(figure: "Figure", folder: Path, name: str) -> list[Path]:
    """Writes NAME.png and NAME.pdf; UserError if the folder cannot be written."""
    make_folder(folder)
    paths = []
    for suffix, undated in (("png", {"Software": None}), ("pdf", {"CreationDate": None})):
        content = io.BytesIO()
        figure.savefig(content, format=suffix, metadata=undated)
        paths.append(folder / f"{name}.{suffix}")
        replace(paths[-1], content.getvalue())
        figure.set_layout_engine(None)  # the print has the picture's places, which take a fifth of the time to find
    return paths
