"""Print figures of funnels: side by side in time's colors, over one another, and their levels over time."""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from rtcd_jax.analysis.report.canvas import BLACK, GRAY, SMALL, WIDTH, blank, draw_panel, shared_legend, written
from rtcd_jax.analysis.report.charts import Chart, Curve, Panel
from rtcd_jax.analysis.report.reading import FunnelView, Run, funnel_views
from rtcd_jax.analysis.report.shapes import outlines, planes, projections
from rtcd_jax.analysis.report.words import guarantee, listed, quantity, volume_unit, words
from rtcd_jax.config.load import Config
from rtcd_jax.volume import VOLUMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

MANY = 100
"""Knots from which on lines and marks are finer, and outlines coarser."""


def draw_funnels(run: Run) -> list[Path]:
    """Draws the best funnel beside the initial one, on the same axes; the files written.

    Above, the nominal motion and the ellipsoids of all knots in every plane of a coordinate and its velocity; below,
    the volume of every ellipsoid over time. Where the initial candidate has no funnel, the figure says so.

    Raises:
        UserError: a folder that cannot be written.
    """
    with blank((WIDTH, 2.9 * len(planes(run.best.x.shape[1])) + 3.1)) as figure:
        _beside(figure, run)
        return written(figure, run.figures, "funnel")


def levels(config: Config, funnels: Sequence[FunnelView], note: str = "") -> Chart:
    """rho and the volume of every knot over time."""
    rho = [Curve(funnel.elite.time, funnel.elite.rho, funnel.label, funnel.color, style="marked") for funnel in funnels]
    panels = [Panel("level ρ of V [-]", rho, logarithmic=True), volumes(config, funnels)]
    pushes = [
        Curve(funnel.elite.time, funnel.elite.pushes.min(axis=1), funnel.label, funnel.color, style="marked")
        for funnel in funnels
        if funnel.elite.pushes is not None
    ]
    if pushes:
        label = f"largest impulse inside\nthe funnel [{volume_unit(config, 'push')}]"
        panels.append(Panel(label, pushes, logarithmic=True))
    return Chart("Levels, volumes and pushes", "time [s]", panels, 2.3 * len(panels), note)


def volumes(
    config: Config, funnels: Sequence[FunnelView], label: Callable[[FunnelView], str] = lambda funnel: funnel.label
) -> Panel:
    """The volume of every knot's ellipsoid over time."""
    curves = [
        Curve(funnel.elite.time, funnel.elite.volumes_per_knot, label(funnel), funnel.color, style="marked")
        for funnel in funnels
    ]
    return Panel(f"volume of a knot's\nellipsoid [{volume_unit(config)}]", curves, logarithmic=True)


def draw_over(runs: Sequence[Run], folder: Path, name: str) -> list[Path]:
    """Draws the funnels of one run or several over one another, as the paper does, and their volumes over time.

    The largest lies lowest. Raises UserError if the folder cannot be written.
    """
    config, funnels, pairs = runs[0].config, funnel_views(runs), planes(runs[0].best.x.shape[1])
    with blank((WIDTH, 3.4 * len(pairs) + 2.6)) as figure:
        *panels, below = figure.subplots(len(pairs) + 1, 1, height_ratios=[3.4] * len(pairs) + [2.0])
        for axes, plane in zip(panels, pairs, strict=True):
            draw_shadows(axes, funnels, plane)
            frame(axes, config, plane, window(funnels, plane))
        figure.legend(**shared_legend(panels), loc="outside upper center")
        draw_panel(below, volumes(config, funnels, _short_label))
        below.set_xlabel("time [s]")
        units = f"volumes in {volume_unit(config)}, integrals in {volume_unit(config, 'integral')}"
        figure.legend(handles=below.lines, title=units, title_fontsize=SMALL, loc="outside lower center")
        return written(figure, folder, name)


def draw_shadows(axes: "Axes", funnels: Sequence[FunnelView], plane: tuple[int, int]) -> None:
    """Funnels in their own colors over one another, the one that reaches farthest lowest."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgba
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Curve

    for funnel in sorted(funnels, key=lambda funnel: -float(funnel.elite.volumes_per_knot.max())):
        curves = list(shadow(funnel, plane))
        # One curve of all ellipses is filled once: their shades do not add up where they overlap.
        whole = Curve.make_compound_path(*map(Curve, curves))
        # add_patch would look at every segment for limits that are set anyway.
        axes.add_artist(PathPatch(whole, facecolor=to_rgba(funnel.color, 0.15), lw=0))
        edges = to_rgba(funnel.color, 0.45)
        width = 0.5 if len(curves) <= MANY else 0.25
        axes.add_collection(PolyCollection(curves, facecolors="none", edgecolors=edges, lw=width))
        axes.plot(*funnel.elite.x[:, plane].T, color=funnel.color, label=funnel.label, zorder=3)


def shadow(
    funnel: FunnelView, plane: tuple[int, int], points: int | None = None
) -> Float[np.ndarray, "knots points 2"]:
    """Outlines of a funnel's ellipsoids in a plane."""
    points = points or (181 if len(funnel.elite.time) <= MANY else 91)
    return outlines(funnel.elite.x[:, plane], projections(funnel.elite.S, funnel.elite.rho, plane), points)


def window(funnels: Sequence[FunnelView], plane: tuple[int, int]) -> Float[np.ndarray, "2 2"]:
    """Lower and upper corner of a plane's window: all funnels with a margin."""
    points = np.concatenate([shadow(funnel, plane).reshape(-1, 2) for funnel in funnels])
    low, high = points.min(0), points.max(0)
    return np.stack([low, high]) + 0.04 * np.outer([-1, 1], high - low)


def frame(axes: "Axes", config: Config, plane: tuple[int, int], view: Float[np.ndarray, "2 2"]) -> None:
    """Start, goal, limits, window and labels of a plane."""
    # An open circle, so that small ellipsoids at the start, and the goal where it lies there too, are seen inside it.
    for point, marker, fill, name in (
        (config.start, "o", "none", "start"),
        (config.task.goal, "*", "white", "goal"),
    ):
        position = [[point[i]] for i in plane]
        axes.plot(*position, marker, mfc=fill, mec=BLACK, ms=9, ls="none", label=name, zorder=4)
    for axis, value in visible_limits(config, plane, view):
        (axes.axvline, axes.axhline)[axis](value, color=GRAY, ls="--", lw=1, label="state limit")
    axes.set(xlim=view[:, 0], ylim=view[:, 1])
    states = list(config.plant.states.items())
    axes.set(xlabel=quantity(*states[plane[0]]), ylabel=quantity(*states[plane[1]]))


def _beside(figure: "Figure", run: Run) -> None:
    config, funnels, pairs = run.config, run.funnels, planes(run.best.x.shape[1])
    grid = figure.add_gridspec(len(pairs) + 1, len(funnels), height_ratios=[2.9] * len(pairs) + [2.0])
    colors = _time_colors(max(float(funnel.elite.time[-1]) for funnel in funnels))
    panels = []
    for row, plane in enumerate(pairs):
        view = window(funnels, plane)
        for place, funnel in enumerate(funnels):
            axes = figure.add_subplot(grid[row, place])
            _draw_in_time(axes, funnel, plane, colors)
            frame(axes, config, plane, view)
            if row == 0:
                axes.set_title(_title(config, funnel))
            panels.append(axes)
    figure.colorbar(colors, ax=panels, label="time [s]", pad=0.02, aspect=30 * len(pairs))
    figure.legend(**shared_legend(panels), loc="outside upper center", title=run.absence or None)
    below = figure.add_subplot(grid[-1, :])
    draw_panel(below, volumes(config, funnels, functools.partial(_volumes_label, config)))
    below.set_xlabel("time [s]")
    if len(funnels) == 2:
        first, second = (_known_volumes(funnel) for funnel in funnels)
        ratios = [f"{words(name)} × {value / first[name]:.3g}" for name, value in second.items() if name in first]
        below.set_title(f"{funnels[1].label} over {funnels[0].label}: {', '.join(ratios)}")
    # The figure's legend, not the panel's: its width must not squeeze the panels.
    figure.legend(handles=below.lines, loc="outside lower center")


def _time_colors(duration: float) -> "ScalarMappable":
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    # Without the brightest tenth, which is lost on white paper.
    shades = ListedColormap(colormaps["viridis"](np.linspace(0, 0.9, 256)))
    return ScalarMappable(Normalize(0, duration), shades)


def _draw_in_time(axes: "Axes", funnel: FunnelView, plane: tuple[int, int], colors: "ScalarMappable") -> None:
    from matplotlib.collections import PolyCollection

    shades = colors.to_rgba(funnel.elite.time)
    faces = shades * np.array([1, 1, 1, 0.05])
    axes.add_collection(PolyCollection(list(shadow(funnel, plane)), facecolors=faces, edgecolors=shades, lw=0.6))
    axes.plot(*funnel.elite.x[:, plane].T, color=BLACK, label="nominal motion")


def visible_limits(
    config: Config, plane: tuple[int, int], view: Float[np.ndarray, "2 2"]
) -> Iterator[tuple[int, float]]:
    """The limits on |x_i| that the window shows: on which of the plane's axes, and where."""
    for axis, (i, (low, high)) in enumerate(zip(plane, view.T, strict=True)):
        for value in (-config.task.state_limits[i], config.task.state_limits[i]):
            if low <= value <= high:
                yield axis, value


def _known_volumes(funnel: FunnelView) -> dict[str, float]:
    """Those of the list that its run has stored."""
    return {name: funnel.elite.volumes[name] for name in VOLUMES if name in funnel.elite.volumes}


def _volumes_label(config: Config, funnel: FunnelView) -> str:
    """The volumes with their guarantee."""
    known = _known_volumes(funnel).items()
    volumes = [f"{words(name)} {value:.4g} {volume_unit(config, name)}" for name, value in known]
    return f"{funnel.label}: {', '.join(volumes)}\n{guarantee(funnel.elite.record)}"


def _short_label(funnel: FunnelView) -> str:
    volumes = [f"{words(name)} {value:.3g}" for name, value in _known_volumes(funnel).items()]
    promise = f", ε = {funnel.elite.epsilon:.2g}" if funnel.elite.guarantee == "sampled" else ""
    return f"{funnel.label}: {', '.join(volumes)} ({funnel.elite.guarantee}{promise})"


def _title(config: Config, funnel: FunnelView) -> str:
    record: Mapping[str, Any] = funnel.elite.record
    design = [listed(name, value, config.design_units[name]) for name, value in record["design"].items()]
    weights = [listed(name, value) for name, value in record["weights"].items()]
    return "\n".join([funnel.label, ", ".join(design), ", ".join(weights)])
