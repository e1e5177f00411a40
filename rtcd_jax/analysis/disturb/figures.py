"""`disturbance/NAME.png` and `.pdf`: the results of `rtcd disturb`, the initial candidate beside the best one."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rtcd_jax.analysis.report.canvas import GRAY, LIGHT, SMALL, WIDTH, blank, logarithmic, written
from rtcd_jax.analysis.report.words import words
from rtcd_jax.system.files import read_json

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LOST, RECOVERED = "#E69F00", "#56B4E9"
COLORS = {"initial": "#0072B2", "best": "#D55E00"}
"""Told apart by all kinds of color vision."""
_STRIP = 0.42
"""Height of a strip of the robustness figure [in]."""
_TICKS = 10
"""Labels of a strip, about."""


def draw_disturbance(folder: Path) -> list[Path]:
    """The figures of `disturbance/*.json` in a run folder; the files written.

    Raises:
        UserError: a record that is not there, or a folder that cannot be written.
    """
    place = folder / "disturbance"
    drawn = []
    for name, draw, size in (
        ("off_nominal", _off_nominal, (WIDTH, 3.0)),
        ("impulse", _impulse, (WIDTH, 3.2)),
        ("push_margin", _push_margin, (WIDTH, 2.6)),
        ("robustness", _robustness, None),
    ):
        record = read_json(place / f"{name}.json", "make it by `rtcd disturb`")
        with blank(size or (WIDTH, 0.9 + _STRIP * 1.75 * len(record["troubles"]))) as figure:
            draw(figure, record)
            drawn += written(figure, place, name)
    return drawn


def _off_nominal(figure: "Figure", record: Mapping[str, Any]) -> None:
    summary, factors = record["summary"], record["factors"]
    rows = list(summary.items())
    groups = [rows[first : first + len(factors)] for first in range(0, len(rows), len(factors))]
    panels = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
    for axes, group in zip(panels, groups, strict=True):
        controllers = [name for name in group[0][1] if not name.endswith((" lower", " upper"))]
        for index, name in enumerate(controllers):
            share, lower, upper = (
                np.array([entry[key] for _, entry in group]) for key in (name, f"{name} lower", f"{name} upper")
            )
            places = np.arange(len(factors)) + 0.06 * (2 * index - 1)
            axes.errorbar(places, share, yerr=[share - lower, upper - share], marker="o", markersize=3, capsize=2,
                          label=f"{name} controller", color=COLORS[name])  # fmt: skip
        axes.set_title(f"states of the {group[0][0].rpartition(' x ')[0]}")
        axes.set_xticks(np.arange(len(factors)), [f"× {factor}" for factor in factors])
        axes.set_xlabel("enlarged")
    panels[0].set_ylim(-0.03, 1.03)
    panels[0].set_ylabel(f"arrived, of {record['states']}")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)


def _impulse(figure: "Figure", record: Mapping[str, Any]) -> None:
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    recovered = record["recovered"]
    impulses = np.array(record["impulses"])
    panels = figure.subplots(1, len(recovered), sharey=True, squeeze=False)[0]
    for axes, (name, cells) in zip(panels, recovered.items(), strict=True):
        times = np.array(record["times"][name])
        colors = ListedColormap([LOST, RECOVERED])
        axes.pcolormesh(times, impulses, np.array(cells, float).T, cmap=colors, vmin=0, vmax=1)
        axes.set_title(f"{name}: {record['summary'][name]['recovered']:.0%} recovered")
        axes.set_xlabel("time of the push [s]")
    panels[0].set_ylabel(f"impulse [{record['impulse_unit']}]")
    handles = [Patch(color=color, label=label) for color, label in ((RECOVERED, "recovered"), (LOST, "lost"))]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)


def _push_margin(figure: "Figure", record: Mapping[str, Any]) -> None:
    axes = figure.subplots()
    for name, times in record["times"].items():
        tolerated = np.array(record["tolerated"][name])
        axes.plot(times, record["inside_funnel"][name], color=COLORS[name], label=f"{name}: inside the funnel")
        axes.plot(
            times, np.where(tolerated > 0, tolerated, np.nan), ".", color=COLORS[name], label=f"{name}: recovered from"
        )
    logarithmic(axes)
    axes.set_xlabel("time of the push [s]")
    axes.set_ylabel(f"sudden push\n[{record['impulse_unit']}]")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=2)


def _robustness(figure: "Figure", record: Mapping[str, Any]) -> None:
    # By the best candidate's success: what fails first comes first.
    perturbations = sorted(record["troubles"], key=lambda each: np.mean(list(each["success"].values())[-1]))
    panels = figure.subplots(len(perturbations), 1, squeeze=False)[:, 0]
    for axes, perturbation in zip(panels, perturbations, strict=True):
        _strip(axes, perturbation)
    scores = ", ".join(f"{name} {criteria['score']:.0%}" for name, criteria in record["summary"].items())
    figure.suptitle(f"share of successes at each level (dark: all), what fails first above; score {scores}", fontsize=9)


def _strip(axes: "Axes", perturbation: Mapping[str, Any]) -> None:
    """A row of cells for each controller over the levels of one perturbation."""
    from matplotlib.colors import LinearSegmentedColormap

    shades = LinearSegmentedColormap.from_list("success", [LIGHT, COLORS["initial"]])
    levels, success = perturbation["levels"], perturbation["success"]
    cells = np.array(list(success.values()), float)
    axes.pcolormesh(np.arange(len(levels) + 1), np.arange(len(cells) + 1), cells, cmap=shades, vmin=0, vmax=1)
    axes.pcolormesh(
        np.arange(len(levels) + 1), np.arange(len(cells) + 1), cells, facecolor="none", edgecolor="white", lw=0.4
    )
    axes.invert_yaxis()
    axes.set_yticks(np.arange(len(cells)) + 0.5, list(success), fontsize=SMALL - 1)
    shown = np.arange(0, len(levels), max(1, (len(levels) - 1) // _TICKS))
    axes.set_xticks(shown + 0.5, _ticks(perturbation, [levels[i] for i in shown]), fontsize=SMALL - 1)
    axes.tick_params(length=0)
    title = f"{words(perturbation['name'])} [{perturbation['unit']}]"
    axes.set_title(title, loc="left", fontsize=SMALL, color=GRAY, pad=2)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _ticks(perturbation: Mapping[str, Any], levels: Sequence[float]) -> list[str]:
    if perturbation["unit"] == "relative":
        return [f"{level:+.0%}" if round(level, 6) else "0%" for level in levels]
    return [f"{level:g}" for level in np.round(levels, 6).tolist()]
