"""`rtcd replay`: was a measured run inside the funnel? V/rho of every sample, by the funnel between its knots."""

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, final

import numpy as np
from jaxtyping import Bool, Float

from rtcd_jax.analysis.replay.measured import Measured, jumps, read_measured
from rtcd_jax.analysis.report.canvas import BLACK, GRAY, LIGHT, WIDTH, blank, written
from rtcd_jax.analysis.report.funnels import draw_shadows, frame, told_once, window
from rtcd_jax.analysis.report.reading import BLUE, VERMILION, FunnelView
from rtcd_jax.analysis.report.shapes import planes
from rtcd_jax.config.load import Config
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import FunnelInterpolant
from rtcd_jax.elite.records import elite_name, read_config
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder, replace, replace_json

LEAST = 1e-4
"""V/rho that the figure still tells from zero."""


class Console(Protocol):
    def message(self, text: str, /) -> None: ...


@final
@dataclass(frozen=True)
class Replay:
    """A measured motion with V/rho of every sample; inside means at most 1."""

    measured: Measured
    ratio: Float[np.ndarray, " T"]
    name: str
    elite: Elite

    @property
    def inside(self) -> Bool[np.ndarray, " T"]:
        return self.ratio <= 1

    @property
    def kept(self) -> bool:
        return bool(self.inside.all())

    def sample(self, k: int) -> dict[str, Any]:
        """One sample as JSON stores it."""
        state = dict(zip(self.measured.columns[1:], self.measured.x[k], strict=True))
        return {"time": self.measured.time[k], "V/rho": self.ratio[k], "state": state}

    def told(self) -> dict[str, Any]:
        """As JSON stores it: `closest` is the sample with the smallest margin 1 - V/rho."""
        first = None if self.kept else self.sample(int(np.argmin(self.inside)))
        return {
            "elite": self.name,
            "samples": len(self.ratio),
            "inside": self.kept,
            "share_inside": float(self.inside.mean()),
            "first_exit": first,
            "closest": self.sample(int(self.ratio.argmax())),
            "smallest_margin": 1 - float(self.ratio.max()),
            "rung": self.elite.guarantee,
            "config_hash": self.elite.record.get("config_hash"),
        }


def replay_run(folder: Path, file: Path, which: int | str, console: Console) -> bool:
    """Replays a measured file against the funnel of an elite, or of the candidate "initial"; True if it stayed inside.

    Writes `replay/NAME_ELITE.csv`, `.json`, `.png` and `.pdf`, NAME that of the measured file.

    Raises:
        UserError: no run folder, no such elite, a file that is no measured motion, or a folder that cannot be written.
    """
    config = read_config(folder)
    name, elite = elite_name(which), Elite.read(folder, which)
    measured = read_measured(file, elite.x_goal.size)
    _check_time(file, measured, float(elite.time[-1]))
    ratio = FunnelInterpolant.of(elite).ratio(measured.time, measured.x)
    replay = Replay(measured, ratio, name, elite)
    results, stem = folder / "replay", f"{file.stem}_{name}"
    make_folder(results)
    replace(results / f"{stem}.csv", _table(replay).encode())
    replace_json(results / f"{stem}.json", {"file": str(file), **replay.told()})
    _draw(config, FunnelView(f"funnel of {name}", VERMILION, elite), replay, results, stem)
    for line in [*jumps(measured, list(config.plant.states.values())), *_summary(replay)]:
        console.message(line)
    console.message(f"V/rho of every sample, and its figure: {results / stem}.csv, .json, .png, .pdf")
    return replay.kept


def _check_time(file: Path, measured: Measured, end: float) -> None:
    first = float(measured.time[0])
    if not 0 <= first < end:
        raise UserError(
            f"{file}: time begins at {first:g} s: must begin in [0, {end:.4g}), the motion's time; t = 0 is its start"
        )


def _summary(replay: Replay) -> list[str]:
    told, time = replay.told(), replay.measured.time
    whose = f"the funnel of {told['elite']} ({told['rung']})"
    lines = [f"{told['samples']} samples, t = {time[0]:.4g} to {time[-1]:.4g} s, {whose}"]
    if replay.kept:
        lines.append(f"inside the funnel all the way; smallest margin 1 - V/rho = {told['smallest_margin']:.3g}")
        return [*lines, f"closest to its boundary {_at(told['closest'])}"]
    lines.append(f"OUTSIDE the funnel, first {_at(told['first_exit'])}")
    return [*lines, f"farthest outside {_at(told['closest'])}; {told['share_inside']:.1%} of the samples inside"]


def _at(sample: Mapping[str, Any]) -> str:
    state = ", ".join(f"{name} = {value:.4g}" for name, value in sample["state"].items())
    return f"at t = {sample['time']:.4g} s: V/rho = {sample['V/rho']:.4g}, {state}"


def _table(replay: Replay) -> str:
    """The samples with V/rho and 1 where inside."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*replay.measured.columns, "V/rho", "inside"])
    rows = np.column_stack([replay.measured.time, replay.measured.x, replay.ratio]).tolist()
    writer.writerows([*map(repr, row), int(row[-1] <= 1)] for row in rows)
    return text.getvalue()


def _draw(config: Config, funnel: FunnelView, replay: Replay, folder: Path, name: str) -> None:
    pairs = planes(replay.measured.x.shape[1])
    with blank((WIDTH, 3.2 * len(pairs) + 2.2)) as figure:
        *panels, ratio = figure.subplots(len(pairs) + 1, 1, height_ratios=[3.2] * len(pairs) + [2.2])
        for axes, plane in zip(panels, pairs, strict=True):
            draw_shadows(axes, [funnel], plane)
            motion = replay.measured.x[:, plane]
            axes.plot(*motion.T, color=BLUE, label="measured", zorder=4)
            axes.plot(*motion[~replay.inside].T, ".", ms=4, color=BLACK, label="outside", zorder=5)
            low, high = window([funnel], plane)
            view = np.stack([np.minimum(low, motion.min(0)), np.maximum(high, motion.max(0))])
            frame(axes, config, plane, view)
        figure.legend(**told_once(panels), loc="outside upper center")
        ratio.semilogy(replay.measured.time, np.maximum(replay.ratio, LEAST), color=BLUE)
        ratio.axhline(1, color=BLACK, lw=1, ls="--")
        ratio.axvline(float(funnel.elite.time[-1]), color=GRAY, lw=1, ls=":")
        ratio.set(xlabel="time [s]", ylabel="V/ρ [-]")
        ratio.grid(axis="y", lw=0.4, color=LIGHT)
        written(figure, folder, name)
