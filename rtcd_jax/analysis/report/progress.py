"""Print figures of a search: volumes, failures and step size over the generations, and every variable's course."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rtcd_jax.analysis.report.canvas import BLACK, GRAY, LIGHT, SMALL, WIDTH, blank, logarithmic, written
from rtcd_jax.analysis.report.history import QUANTILES, Course, Generations, column, courses, failures, spread
from rtcd_jax.analysis.report.reading import BLUE, VERMILION, Run
from rtcd_jax.analysis.report.words import volume_unit, words
from rtcd_jax.config.load import Config

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

GREEN = "#009E73"
STATUS_COLORS = {
    "OK": "#DCE4EE",
    "TRAJECTORY_NOT_SOLVED": "#E69F00",
    "RICCATI_INDEFINITE": "#CC79A7",
    "FUNNEL_EMPTY": "#56B4E9",
    "NOT_FINITE": "#000000",
}
SPREAD = f"{QUANTILES[0]} to {QUANTILES[1]} % of the population"
COLUMNS = 2


def draw_convergence(run: Run) -> list[Path]:
    """Draws the volumes, the candidates by status and the step size over the generations; the files written.

    Raises:
        UserError: a folder that cannot be written.
    """
    with blank((WIDTH, 5.8)) as figure:
        _convergence(figure, run.config, run.generations)
        return written(figure, run.figures, "convergence")


def draw_courses(run: Run) -> list[Path]:
    """Draws every searched variable over the generations, in its own unit; the files written.

    Raises:
        UserError: a folder that cannot be written.
    """
    variables = courses(run.config, run.generations)
    rows = -(-len(variables) // COLUMNS)
    with blank((WIDTH, 1.9 * rows + 0.4)) as figure:
        panels = figure.subplots(rows, COLUMNS, sharex=True, squeeze=False).ravel()
        for axes, course in zip(panels, variables, strict=False):
            _draw_course(axes, course, column(run.generations, "index"))
        for axes in panels[len(variables) :]:
            axes.remove()
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
        figure.supxlabel("generation", fontsize=9)
        return written(figure, run.figures, "courses")


def _convergence(figure: "Figure", config: Config, generations: Generations) -> None:
    volumes, share, sigma = figure.subplots(3, 1, sharex=True, height_ratios=[3, 1.2, 1])
    index = column(generations, "index")
    low, high = spread(generations)
    volumes.fill_between(index, low, high, color=GREEN, alpha=0.15, lw=0, label=f"{SPREAD} with a funnel")
    for name, color, style in (("best_so_far", VERMILION, "-"), ("best", BLUE, "."), ("median", GREEN, ".--")):
        volumes.plot(index, column(generations, name), style, ms=5, color=color, label=words(name))
    _draw_statuses(share, index, generations)
    sigma.plot(index, column(generations, "sigma"), ".-", ms=5, color=BLACK)
    restarts = index[np.diff(column(generations, "restarts"), prepend=0) > 0]
    for axes in (volumes, share, sigma):
        axes.grid(axis="y", lw=0.4, color=LIGHT)
        label = "restart" if restarts.size else "_"
        axes.vlines(restarts, 0, 1, transform=axes.get_xaxis_transform(), color=GRAY, ls=":", lw=1, label=label)
    for axes in (volumes, sigma):
        _wide(axes)
    search = config.search
    volumes.set_title(f"{config.plant.name}, {search.mode} search, population {search.population}, seed {search.seed}")
    volumes.set_ylabel(f"volume ({words(search.objective)}) [{volume_unit(config, search.objective)}]")
    volumes.legend(title="sampled, as the search saw it", title_fontsize=SMALL)
    sigma.set(ylabel="step size\n[box widths]", xlabel="generation")
    _whole_numbers(sigma)


def _draw_statuses(axes: "Axes", index: np.ndarray, generations: Generations) -> None:
    """Shares of the candidates by status, one over the other."""
    shares = failures(generations)
    below = np.zeros(len(index))
    for name, share in shares.items():
        label, color = status_words(name), STATUS_COLORS.get(name, GRAY)
        axes.fill_between(index, below, below + share, step="mid", lw=0, label=label, color=color)
        below = below + share
    axes.set(ylabel="candidates\nby status [-]", ylim=(0, 1.0))
    axes.legend(loc="lower right", ncols=len(shares), frameon=True, framealpha=0.8, edgecolor="none")


def status_words(name: str) -> str:
    """A status in words."""
    return "has a funnel" if name == "OK" else words(name).lower()


def _draw_course(axes: "Axes", course: Course, index: np.ndarray) -> None:
    axes.fill_between(index, course.low, course.high, color=GREEN, alpha=0.15, lw=0, label=SPREAD)
    axes.plot(index, course.median, "--", color=GREEN, label="median")
    axes.plot(index, course.best, ".", ms=4, color=VERMILION, label="best of the generation")
    axes.axhline(course.variable.initial, color=BLUE, lw=1, ls=":", label="initial")
    if course.logarithmic:
        logarithmic(axes)
    axes.set(ylim=course.window, title=course.title)
    _whole_numbers(axes)


def _whole_numbers(axes: "Axes") -> None:
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _wide(axes: "Axes") -> None:
    """A logarithmic axis for positive numbers of more than one decade, a linear one for fewer."""
    numbers = np.concatenate([line.get_ydata() for line in axes.lines])
    numbers = numbers[np.isfinite(numbers)]
    if numbers.size and 0 < 10 * numbers.min() < numbers.max():
        logarithmic(axes)
