"""Print figures of funnels: side by side in time's colors, over one another, and their levels over time."""

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

import numpy as np

from rtcd_jax.analysis.report.canvas import BLACK, GRAY, SMALL, WIDTH, blank, draw_panel, shared_legend, written
from rtcd_jax.analysis.report.charts import Chart, Curve, Panel
from rtcd_jax.analysis.report.plane import Plane, Shadow, plane_of
from rtcd_jax.analysis.report.reading import FunnelView, Run, funnel_views
from rtcd_jax.analysis.report.shapes import planes
from rtcd_jax.analysis.report.words import guarantee, listed, quantity, volume_unit, words
from rtcd_jax.config.load import Config
from rtcd_jax.volume import VOLUMES

LINE, TITLE = 120, 100
"""Characters of a line that fit into a figure, of a legend and of a title."""

TUBE_POINTS = 41
"""Of an ellipse's outline in a funnel over time."""

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure


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


def draw_tubes(run: Run) -> list[Path]:
    """Draws the funnels over time, one picture for every plane of a coordinate and its velocity; the files written.

    Raises:
        UserError: a folder that cannot be written.
    """
    config, funnels, pairs = run.config, run.funnels, planes(run.best.x.shape[1])
    with blank((WIDTH, 3.8 * len(pairs))) as figure:
        for place, pair in enumerate(pairs, 1):
            axes = figure.add_subplot(len(pairs), 1, place, projection="3d")
            plane = plane_of(config, funnels, pair, TUBE_POINTS)
            for shadow in plane.shadows:
                time = np.broadcast_to(shadow.funnel.elite.time[:, None], shadow.outlines.shape[:2])
                look = {"color": shadow.funnel.color, "alpha": 0.25, "lw": 0, "rcount": 60, "ccount": TUBE_POINTS}
                axes.plot_surface(time, *np.moveaxis(shadow.outlines, 2, 0), **look)
                axes.plot(time[:, 0], *shadow.motion.T, color=shadow.funnel.color, label=shadow.funnel.label)
            horizontal, vertical = itertools.starmap(quantity, plane.states)
            axes.set(xlabel="time [s]", ylabel=horizontal, zlabel=vertical)
            axes.view_init(elev=20, azim=-65)
            axes.set_box_aspect((2, 1, 1))
            axes.locator_params(nbins=5)
        figure.legend(**shared_legend(figure.axes), loc="outside upper center")
        return written(figure, run.figures, "tube")


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
        for axes, pair in zip(panels, pairs, strict=True):
            draw_plane(axes, plane_of(config, funnels, pair))
        figure.legend(**shared_legend(panels), loc="outside upper center")
        draw_panel(below, volumes(config, funnels, _short_label))
        below.set_xlabel("time [s]")
        units = f"volumes in {volume_unit(config)}, integrals in {volume_unit(config, 'integral')}"
        figure.legend(handles=below.lines, title=units, title_fontsize=SMALL, loc="outside lower center")
        return written(figure, folder, name)


def draw_plane(axes: "Axes", plane: Plane) -> None:
    """Funnels in their own colors over one another, the largest lowest, with start, goal, limits and labels."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_rgba
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Curve

    for shadow in plane.shadows:
        color = shadow.funnel.color
        # One curve of all ellipses is filled once: their shades do not add up where they overlap.
        whole = Curve.make_compound_path(*map(Curve, shadow.outlines))
        # add_patch would look at every segment for limits that are set anyway.
        axes.add_artist(PathPatch(whole, facecolor=to_rgba(color, 0.15), lw=0))
        width = 0.25 if shadow.fine else 0.5
        edges = {"facecolors": "none", "edgecolors": to_rgba(color, 0.45), "lw": width}
        axes.add_collection(PolyCollection(list(shadow.outlines), **edges))
        axes.plot(*shadow.motion.T, color=color, label=shadow.funnel.label, zorder=3)
    _frame(axes, plane)


def _frame(axes: "Axes", plane: Plane) -> None:
    """Start, goal, limits, window and labels of a plane."""
    # An open circle, so that small ellipsoids at the start, and the goal where it lies there too, are seen inside it.
    for (x, y), marker, face, name in ((plane.start, "o", "none", "start"), (plane.goal, "*", "white", "goal")):
        axes.plot([x], [y], marker, mfc=face, mec=BLACK, ms=9, ls="none", label=name, zorder=4)
    for axis, value in plane.visible_limits:
        (axes.axvline, axes.axhline)[axis](value, color=GRAY, ls="--", lw=1, label="state limit")
    for polygon in plane.kept_out:
        axes.fill(*polygon.T, color=GRAY, alpha=0.3, lw=0, label="to keep out of", zorder=0.5)
    horizontal, vertical = itertools.starmap(quantity, plane.states)
    axes.set(xlim=plane.window[:, 0], ylim=plane.window[:, 1], xlabel=horizontal, ylabel=vertical)


def _beside(figure: "Figure", run: Run) -> None:
    config, funnels, pairs = run.config, run.funnels, planes(run.best.x.shape[1])
    grid = figure.add_gridspec(len(pairs) + 1, len(funnels), height_ratios=[2.9] * len(pairs) + [2.0])
    colors = _time_colors(max(float(funnel.elite.time[-1]) for funnel in funnels))
    panels = []
    for row, pair in enumerate(pairs):
        plane = plane_of(config, funnels, pair)
        shadows = {shadow.funnel.label: shadow for shadow in plane.shadows}
        for place, funnel in enumerate(funnels):
            axes = figure.add_subplot(grid[row, place])
            _draw_in_time(axes, shadows[funnel.label], colors)
            _frame(axes, plane)
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
        below.set_title(fill(f"{funnels[1].label} over {funnels[0].label}: {', '.join(ratios)}", TITLE))
    # The figure's legend, not the panel's: its width must not squeeze the panels.
    figure.legend(handles=below.lines, loc="outside lower center")


def _time_colors(duration: float) -> "ScalarMappable":
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    # Without the brightest tenth, which is lost on white paper.
    shades = ListedColormap(colormaps["viridis"](np.linspace(0, 0.9, 256)))
    return ScalarMappable(Normalize(0, duration), shades)


def _draw_in_time(axes: "Axes", shadow: Shadow, colors: "ScalarMappable") -> None:
    from matplotlib.collections import PolyCollection

    shades = colors.to_rgba(shadow.funnel.elite.time)
    faces = shades * np.array([1, 1, 1, 0.05])
    axes.add_collection(PolyCollection(list(shadow.outlines), facecolors=faces, edgecolors=shades, lw=0.6))
    axes.plot(*shadow.motion.T, color=BLACK, label="nominal motion")


def _known_volumes(funnel: FunnelView) -> dict[str, float]:
    """Those of the list that its run has stored."""
    return {name: funnel.elite.volumes[name] for name in VOLUMES if name in funnel.elite.volumes}


def _volumes_label(config: Config, funnel: FunnelView) -> str:
    """The volumes with their guarantee."""
    known = _known_volumes(funnel).items()
    volumes = [f"{words(name)} {value:.4g} {volume_unit(config, name)}" for name, value in known]
    line = fill(f"{funnel.label}: {', '.join(volumes)}", LINE)
    return f"{line}\n{guarantee(funnel.elite.record)}"


def _short_label(funnel: FunnelView) -> str:
    volumes = [f"{words(name)} {value:.3g}" for name, value in _known_volumes(funnel).items()]
    promise = f", ε = {funnel.elite.epsilon:.2g}" if funnel.elite.guarantee == "sampled" else ""
    return fill(f"{funnel.label}: {', '.join(volumes)} ({funnel.elite.guarantee}{promise})", LINE)


def _title(config: Config, funnel: FunnelView) -> str:
    record: Mapping[str, Any] = funnel.elite.record
    design = [listed(name, value, config.design_units[name]) for name, value in record["design"].items()]
    weights = [listed(name, value) for name, value in record["weights"].items()]
    return "\n".join([funnel.label, *(fill(", ".join(each), TITLE // 2) for each in (design, weights))])
