"""`rtcd replay`: was a measured motion inside the funnel? V/rho of every sample, and how much of the motion they cover.

What lies between two samples is covered if it is no longer than the nominal's interval at that time: nobody knows what
happened in a longer one.
"""

import csv
import dataclasses
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Bool, Float

from rtcd_jax.analysis.replay.measured import Measured, jumps, read_measured, unwrapped
from rtcd_jax.analysis.report.canvas import BLACK, GRAY, LIGHT, WIDTH, blank, shared_legend, written
from rtcd_jax.analysis.report.funnels import draw_plane
from rtcd_jax.analysis.report.plane import plane_of
from rtcd_jax.analysis.report.reading import BLUE, VERMILION, FunnelView
from rtcd_jax.analysis.report.shapes import planes
from rtcd_jax.config.load import Config
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import FunnelInterpolant
from rtcd_jax.elite.records import elite_name, read_config
from rtcd_jax.system.console import Console
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder, replace, replace_json

LEAST = 1e-4
"""V/rho that the figure still tells from zero."""
LEAST_SAMPLES = 2
EVEN = 1e-6
"""Share of an interval by which samples as far apart as knots may miss it."""


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
    def held(self) -> bool:
        return bool(self.inside.all())

    @property
    def covered(self) -> float:
        """Time of the nominal motion [s] that lies between samples no farther apart than its knots."""
        time, knots = self.measured.time, self.elite.time
        at = np.clip(np.searchsorted(knots, time[:-1], side="right") - 1, 0, len(knots) - 2)
        near = np.diff(time) <= (1 + EVEN) * np.diff(knots)[at]
        return float(np.diff(np.clip(time, 0, knots[-1]))[near].sum())

    @property
    def complete(self) -> bool:
        """Whether all of the nominal motion is covered, but for an interval at most."""
        return self.elite.time[-1] - self.covered <= (1 + EVEN) * np.diff(self.elite.time).max()

    def sample(self, k: int) -> dict[str, Any]:
        """One sample as JSON stores it."""
        state = dict(zip(self.measured.states, self.measured.x[k], strict=True))
        return {"time": self.measured.time[k], "V/rho": self.ratio[k], "state": state}

    def as_record(self) -> dict[str, Any]:
        """As JSON stores it: `closest` is the sample with the smallest margin 1 - V/rho."""
        first = None if self.held else self.sample(int(np.argmin(self.inside)))
        return {
            "elite": self.name,
            "columns": {name: column.heading for name, column in self.measured.columns.items()},
            "samples": len(self.ratio),
            "inside": self.held,
            "share_inside": float(self.inside.mean()),
            "covered": self.covered,
            "share_covered": self.covered / float(self.elite.time[-1]),
            "first_exit": first,
            "closest": self.sample(int(self.ratio.argmax())),
            "smallest_margin": 1 - float(self.ratio.max()),
            "rung": self.elite.guarantee,
            "config_hash": self.elite.record.get("config_hash"),
        }


def replay_run(
    folder: Path,
    file: Path,
    which: int | str,
    console: Console,
    columns: Sequence[str] = (),
    start: float | None = None,
    unwrap: bool = False,
) -> bool:
    """Replays a measured file against the funnel of an elite, or of "initial"; False if a sample was outside.

    Writes `replay/NAME_ELITE.csv`, `.json`, `.png` and `.pdf`, NAME that of the measured file. `columns` and `start`
    are those of `read_measured`; `unwrap` takes whole turns out of the angles.

    Raises:
        UserError: no run folder, no such elite, a file that is no measured motion, or a folder that cannot be written.
    """
    config = read_config(folder)
    name, elite = elite_name(which), Elite.read(folder, which).of_all_robots()
    states, funnel = config.plant.states, FunnelInterpolant.of(elite)
    measured = read_measured(file, states, columns, start)
    _check_time(file, measured, float(elite.time[-1]))
    if elite.caught:
        measured = _until(measured, float(elite.time[-1]))
    if unwrap:
        measured = unwrapped(measured, states, funnel.nominal(measured.time[:1])[0])
    replay = Replay(measured, funnel.ratio(measured.time, measured.x), name, elite)
    results, stem = folder / "replay", f"{file.stem}_{name}"
    make_folder(results)
    replace(results / f"{stem}.csv", _table(replay).encode())
    replace_json(results / f"{stem}.json", {"file": str(file), **replay.as_record()})
    _draw(config, FunnelView(f"funnel of {name}", VERMILION, elite), replay, results, stem)
    taken = ", ".join(f"{state} from {column}" for state, column in measured.columns.items())
    for line in [f"columns: {taken}", *measured.notes, *jumps(measured, states), *_summary(replay)]:
        console.message(line)
    console.message(f"V/rho of every sample, and its figure: {results / stem}.csv, .json, .png, .pdf")
    return replay.held


def _until(measured: Measured, end: float) -> Measured:
    """What was measured up to the catch: of the time after it the funnel says nothing."""
    before = measured.time <= end
    if before.all():
        return measured
    note = f"{np.sum(~before)} samples after the catch at {end:.4g} s left out"
    return dataclasses.replace(
        measured, time=measured.time[before], x=measured.x[before], notes=(*measured.notes, note)
    )


def _check_time(file: Path, measured: Measured, end: float) -> None:
    first = float(measured.time[0])
    if not 0 <= first < end:
        raise UserError(
            f"{file}: time begins at {first:g} s: must begin in [0, {end:.4g}), the motion's time; t = 0 is its start, "
            "--start T says at which time of the file that is"
        )
    samples = int(np.sum(measured.time <= end))
    if samples < LEAST_SAMPLES:
        raise UserError(
            f"{file} has {samples} sample of the motion, which takes {end:.4g} s: must have {LEAST_SAMPLES} at least"
        )


def _summary(replay: Replay) -> list[str]:
    record, time, end = replay.as_record(), replay.measured.time, float(replay.elite.time[-1])
    lines = [
        f"{record['samples']} samples, t = {time[0]:.4g} to {time[-1]:.4g} s, of the motion's {end:.4g} s they cover "
        f"{record['share_covered']:.1%}; the funnel of {record['elite']} ({record['rung']})"
    ]
    if replay.held:
        whole = f"inside the funnel {'all the way' if replay.complete else 'at every sample'}"
        lines.append(f"{whole}; smallest margin 1 - V/rho = {record['smallest_margin']:.3g}")
        lines.append(f"closest to its boundary {_at(record['closest'])}")
        if not replay.complete:
            lines.append(f"nothing is known of the other {1 - record['share_covered']:.1%} of the motion")
        return lines
    lines.append(f"OUTSIDE the funnel, first {_at(record['first_exit'])}")
    return [*lines, f"farthest outside {_at(record['closest'])}; {record['share_inside']:.1%} of the samples inside"]


def _at(sample: Mapping[str, Any]) -> str:
    state = ", ".join(f"{name} = {value:.4g}" for name, value in sample["state"].items())
    return f"at t = {sample['time']:.4g} s: V/rho = {sample['V/rho']:.4g}, {state}"


def _table(replay: Replay) -> str:
    """The samples with V/rho and 1 where inside."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["time", *replay.measured.states, "V/rho", "inside"])
    rows = np.column_stack([replay.measured.time, replay.measured.x, replay.ratio]).tolist()
    writer.writerows([*map(repr, row), int(row[-1] <= 1)] for row in rows)
    return text.getvalue()


def _draw(config: Config, funnel: FunnelView, replay: Replay, folder: Path, name: str) -> None:
    pairs = planes(replay.measured.x.shape[1])
    with blank((WIDTH, 3.2 * len(pairs) + 2.2)) as figure:
        *panels, ratio = figure.subplots(len(pairs) + 1, 1, height_ratios=[3.2] * len(pairs) + [2.2])
        for axes, pair in zip(panels, pairs, strict=True):
            draw_plane(axes, plane_of(config, [funnel], pair, motion=replay.measured.x))
            motion = replay.measured.x[:, pair]
            axes.plot(*motion.T, color=BLUE, label="measured", zorder=4)
            axes.plot(*motion[~replay.inside].T, ".", ms=4, color=BLACK, label="outside", zorder=5)
        figure.legend(**shared_legend(panels), loc="outside upper center")
        ratio.semilogy(replay.measured.time, np.maximum(replay.ratio, LEAST), color=BLUE)
        ratio.axhline(1, color=BLACK, lw=1, ls="--")
        ratio.axvline(float(funnel.elite.time[-1]), color=GRAY, lw=1, ls=":")
        ratio.set(xlabel="time [s]", ylabel="V/ρ [-]")
        ratio.grid(axis="y", lw=0.4, color=LIGHT)
        written(figure, folder, name)
