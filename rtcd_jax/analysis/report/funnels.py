"""Print figures of funnels: side by side in time's colors, over one another, and their levels over time."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from rtcd_jax.analysis.report.canvas import BLACK, GRAY, LIGHT, SMALL, WIDTH, blank, written
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


def draw_levels(run: Run) -> list[Path]:
    """Draws rho and the volume of every knot over time; the files written. UserError as `draw_funnels`."""
    with blank((WIDTH, 4.6)) as figure:
        levels, volumes = figure.subplots(2, 1, sharex=True)
        for funnel in run.funnels:
            elite = funnel.elite
            for axes, values in ((levels, elite.rho), (volumes, elite.volumes_per_knot)):
                axes.semilogy(elite.time, values, ".-", ms=4, color=funnel.color, label=funnel.label)
        levels.set_ylabel("level ρ of V [-]")
        volumes.set(xlabel="time [s]", ylabel=f"volume [{volume_unit(run.config)}]")
        for axes in (levels, volumes):
            axes.grid(axis="y", lw=0.4, color=LIGHT)
        figure.legend(handles=levels.lines, title=guarantee(run.best.record), ncols=2, loc="outside upper center")
        return written(figure, run.figures, "levels")


def draw_over(runs: Sequence[Run], folder: Path, name: str) -> list[Path]:
    """Draws the funnels of one run or several over one another, as the paper does, and their volumes over time.

    The largest lies lowest. Raises UserError if the folder cannot be written.
    """
    config, funnels, pairs = runs[0].config, funnel_views(runs), planes(runs[0].best.x.shape[1])
    with blank((WIDTH, 3.4 * len(pairs) + 2.6)) as figure:
        *panels, volumes = figure.subplots(len(pairs) + 1, 1, height_ratios=[3.4] * len(pairs) + [2.0])
        for axes, plane in zip(panels, pairs, strict=True):
            draw_shadows(axes, funnels, plane)
            frame(axes, config, plane, window(funnels, plane))
        figure.legend(**told_once(panels), loc="outside upper center")
        for funnel in funnels:
            time, values = funnel.elite.time, funnel.elite.volumes_per_knot
            volumes.semilogy(time, values, color=funnel.color, label=_short_label(funnel))
        volumes.set(xlabel="time [s]", ylabel=f"volume of a knot's\nellipsoid [{volume_unit(config)}]")
        volumes.grid(axis="y", lw=0.4, color=LIGHT)
        units = f"volumes in {volume_unit(config)}, integrals in {volume_unit(config, 'integral')}"
        figure.legend(handles=volumes.lines, title=units, title_fontsize=SMALL, loc="outside lower center")
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
        (config.task.start, "o", "none", "start"),
        (config.task.goal, "*", "white", "goal"),
    ):
        position = [[point[i]] for i in plane]
        axes.plot(*position, marker, mfc=fill, mec=BLACK, ms=9, ls="none", label=name, zorder=4)
    _draw_limits(axes, [config.task.state_limits[i] for i in plane], view)
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
    figure.legend(**told_once(panels), loc="outside upper center", title=run.absence or None)
    volumes = figure.add_subplot(grid[-1, :])
    _draw_volumes(volumes, config, funnels)
    # The figure's legend, not the panel's: its width must not squeeze the panels.
    figure.legend(handles=volumes.lines, loc="outside lower center")


def told_once(panels: Sequence["Axes"]) -> dict[str, Any]:
    """The entries of a legend for all that the panels have in common, in one row where they fit."""
    entries = (zip(*axes.get_legend_handles_labels(), strict=True) for axes in panels)
    handles = {label: handle for pairs in entries for handle, label in pairs}
    columns = len(handles) if len(handles) <= 6 else 4
    return {"handles": list(handles.values()), "labels": list(handles), "ncols": columns}


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


def _draw_limits(axes: "Axes", limits: Sequence[float], view: np.ndarray) -> None:
    """Dashed lines at the limits on |x_i| that the window shows."""
    for lines, limit, (low, high) in zip((axes.axvline, axes.axhline), limits, view.T, strict=True):
        for value in (-limit, limit):
            if low <= value <= high:
                lines(value, color=GRAY, ls="--", lw=1, label="state limit")


def _draw_volumes(axes: "Axes", config: Config, funnels: Sequence[FunnelView]) -> None:
    for funnel in funnels:
        time, values = funnel.elite.time, funnel.elite.volumes_per_knot
        axes.semilogy(time, values, ".-", ms=4, color=funnel.color, label=_volumes_label(config, funnel))
    axes.set(xlabel="time [s]", ylabel=f"volume of a knot's\nellipsoid [{volume_unit(config)}]")
    axes.grid(axis="y", lw=0.4, color=LIGHT)
    if len(funnels) == 2:
        first, second = funnels
        ratios = [f"{words(name)} × {second.elite.volumes[name] / first.elite.volumes[name]:.3g}" for name in VOLUMES]
        axes.set_title(f"{second.label} over {first.label}: {', '.join(ratios)}")


def _volumes_label(config: Config, funnel: FunnelView) -> str:
    """The four volumes with their guarantee."""
    volumes = [f"{words(name)} {funnel.elite.volumes[name]:.4g} {volume_unit(config, name)}" for name in VOLUMES]
    return f"{funnel.label}: {', '.join(volumes)}\n{guarantee(funnel.elite.record)}"


def _short_label(funnel: FunnelView) -> str:
    volumes = [f"{words(name)} {funnel.elite.volumes[name]:.3g}" for name in VOLUMES]
    promise = f", ε = {funnel.elite.epsilon:.2g}" if funnel.elite.guarantee == "sampled" else ""
    return f"{funnel.label}: {', '.join(volumes)} ({funnel.elite.guarantee}{promise})"


def _title(config: Config, funnel: FunnelView) -> str:
    record: Mapping[str, Any] = funnel.elite.record
    design = [listed(name, value, config.plant.design[name]) for name, value in record["design"].items()]
    weights = [listed(name, value) for name, value in record["weights"].items()]
    return "\n".join([funnel.label, ", ".join(design), ", ".join(weights)])
