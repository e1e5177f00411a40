"""What a figure shows, in print and on the page alike: panels of curves, bands and shares over one horizontal axis.

canvas.py prints a chart by matplotlib, traces.py hands it to plotly.js, `table` writes its numbers.
"""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, final

import numpy as np
from jaxtyping import Float

Style = Literal["solid", "dashed", "dotted", "points", "marked"]


@final
@dataclass(frozen=True, eq=False)
class Curve:
    """A line over x, broken where y is NaN.

    The curves of a `group`, by default all of one label, share a legend's entry, that of the first; without a label
    there is none.
    """

    x: Float[np.ndarray, " T"]
    y: Float[np.ndarray, " T"]
    label: str
    color: str
    style: Style = "solid"
    width: float = 1.4
    group: str = ""


@final
@dataclass(frozen=True, eq=False)
class Band:
    """The area between two curves; its `group` is as a curve's."""

    x: Float[np.ndarray, " T"]
    low: Float[np.ndarray, " T"]
    high: Float[np.ndarray, " T"]
    label: str
    color: str
    group: str = ""


@final
@dataclass(frozen=True, eq=False)
class Shares:
    """Parts of a whole one over the other, by their labels, each with its color."""

    x: Float[np.ndarray, " T"]
    parts: Mapping[str, tuple[Float[np.ndarray, " T"], str]]


@final
@dataclass(frozen=True, eq=False)
class Panel:
    """One vertical axis: its label with the unit, what is drawn over it, its share of a column's height.

    `window` are the ends of the axis, by default those of what is drawn.
    """

    label: str
    marks: Sequence[Curve | Band | Shares]
    title: str = ""
    logarithmic: bool = False
    window: tuple[float, float] | None = None
    height: float = 1.0


@final
@dataclass(frozen=True, eq=False)
class Chart:
    """A figure: panels, row by row, and the label of the horizontal axis that they share.

    `title` heads its section of the page, `note` says on what ground its numbers stand, `events` are instants to be
    marked, `reading` says on the page what to make of it, `height` [in] is that of the print. Of several `columns`
    every panel is a small plot of its own on the page.
    """

    title: str
    x: str
    panels: Sequence[Panel]
    height: float
    note: str = ""
    reading: str = ""
    columns: int = 1
    events: Sequence[float] = ()
    event: str = ""


def table(chart: Chart) -> str:
    """What the chart draws as CSV, one point a line: panel, curve, and both coordinates; an area is its two edges."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["panel", "curve", chart.x, "value"])
    for panel in chart.panels:
        label = (panel.label or panel.title).replace("\n", " ")
        for mark in panel.marks:
            for name, x, y in _curves(mark):
                points = zip(x.tolist(), y.tolist(), strict=True)
                writer.writerows([label, name, repr(x), repr(y)] for x, y in points)
    return text.getvalue()


def _curves(mark: Curve | Band | Shares) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    match mark:
        case Curve():
            yield mark.label, mark.x, mark.y
        case Band():
            for edge, y in (("from", mark.low), ("to", mark.high)):
                yield f"{mark.label or mark.group}, {edge}", mark.x, y
        case Shares():
            for name, (values, _) in mark.parts.items():
                yield name, mark.x, values


def more_than_a_decade(*values: Float[np.ndarray, " T"]) -> bool:
    """Whether a logarithmic axis suits these numbers: positive, and more than ten times apart. NaN are left out."""
    numbers = np.concatenate(values)
    numbers = numbers[np.isfinite(numbers)]
    return bool(numbers.size and 0 < 10 * numbers.min() < numbers.max())
