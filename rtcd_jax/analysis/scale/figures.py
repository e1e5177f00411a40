"""The figures of a scaling study, as PNG and PDF."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from rtcd_jax.analysis.report.canvas import blank, written

Rows = Sequence[Mapping[str, Any]]


def draw(rows: Rows, folder: Path) -> list[Path]:
    """`scaling.png` and `.pdf`: rate and cost against the population, strong and weak scaling with their ideals,
    compilation and memory, and the shares of a generation. Points that failed are left out."""
    measured = [row for row in rows if not row["failed"]]
    if not measured:
        return []
    panels: list[Callable[[Axes, Rows], None]] = [_rate, _cost, _strong, _weak, _memory, _shares]
    with blank((13, 7.5)) as figure:
        for axis, panel in zip(figure.subplots(2, 3).flat, panels, strict=True):
            panel(axis, measured)
        return written(figure, folder, "scaling")


def _by(rows: Rows, name: str) -> dict[int, list[Mapping[str, Any]]]:
    return {value: [row for row in rows if row[name] == value] for value in sorted({row[name] for row in rows})}


def _many(devices: int) -> str:
    return f"{devices} device{'s' if devices > 1 else ''}"


def _labels(axis: Axes, title: str, x: str, y: str) -> None:
    axis.set(title=title, xlabel=x, ylabel=y)
    axis.grid(alpha=0.3)
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize="small")


def _rate(axis: Axes, rows: Rows) -> None:
    for devices, part in _by(rows, "devices").items():
        rates = [row["candidates_per_s"] for row in part]
        low = [rate - row["candidates_per_s_min"] for rate, row in zip(rates, part, strict=True)]
        high = [row["candidates_per_s_max"] - rate for rate, row in zip(rates, part, strict=True)]
        axis.errorbar(
            [row["population"] for row in part], rates, [low, high], marker="o", capsize=3, label=_many(devices)
        )
    axis.set_xscale("log", base=2)
    _labels(axis, "rate (median, least and most)", "population", "candidates/s")


def _cost(axis: Axes, rows: Rows) -> None:
    for devices, part in _by(rows, "devices").items():
        sizes = [row["population"] for row in part]
        axis.plot(sizes, [row["device_ms_per_candidate"] for row in part], "o-", label=f"device time, {_many(devices)}")
        axis.plot(sizes, [row["cpu_ms_per_candidate"] for row in part], "x--", label=f"CPU time, {_many(devices)}")
    axis.set_xscale("log", base=2)
    axis.set_ylim(bottom=0)
    _labels(axis, "cost of a candidate", "population", "ms a candidate")


def _strong(axis: Axes, rows: Rows) -> None:
    counts = sorted({row["devices"] for row in rows})
    for population, part in _by(rows, "population").items():
        first = min(part, key=lambda row: row["devices"])
        speedups = [row["candidates_per_s"] / first["candidates_per_s"] * first["devices"] for row in part]
        axis.plot([row["devices"] for row in part], speedups, "o-", label=f"population {population}")
    axis.plot(counts, counts, "k:", label="ideal")
    axis.set_xticks(counts)
    _labels(axis, "strong scaling", "devices", "speed-up")


def _weak(axis: Axes, rows: Rows) -> None:
    shares: dict[float, list[Mapping[str, Any]]] = {}
    for row in rows:
        shares.setdefault(row["population"] / row["devices"], []).append(row)
    for share, part in sorted(shares.items()):
        if len(part) > 1:
            first = min(part, key=lambda row: row["devices"])
            efficiencies = [first["generation_s"] / row["generation_s"] for row in part]
            axis.plot([row["devices"] for row in part], efficiencies, "o-", label=f"{share:g} candidates a device")
    axis.axhline(1, color="k", linestyle=":", label="ideal")
    axis.set_xticks(sorted({row["devices"] for row in rows}))
    axis.set_ylim(0, 1.15)
    _labels(axis, "weak scaling", "devices", "efficiency")


def _memory(axis: Axes, rows: Rows) -> None:
    sizes = [row["population"] for row in rows]
    axis.plot(sizes, [row["peak_memory_mb"] for row in rows], "o", label="resident memory [MB]")
    if all(row["peak_device_memory_mb"] for row in rows):
        axis.plot(sizes, [row["peak_device_memory_mb"] for row in rows], "s", label="a device's memory [MB]")
    axis.set_xscale("log", base=2)
    axis.set_ylim(bottom=0)
    beside = axis.twinx()
    beside.plot(sizes, [row["compilation_s"] for row in rows], "^", color="tab:red")
    beside.set_ylabel("compilation [s]", color="tab:red")
    beside.set_ylim(bottom=0)
    _labels(axis, "memory and compilation", "population", "MB")


def _shares(axis: Axes, rows: Rows) -> None:
    names = [f"{row['population']}\non {row['devices']}" for row in rows]
    bottom = [0.0] * len(rows)
    parts = (
        ("evaluation_s", "evaluation"),
        ("search_s", "CMA-ES, archive"),
        ("lines_s", "lines"),
        ("checkpoint_s", "checkpoint"),
    )
    for key, label in parts:
        shares = [row[key] / (row["generation_s"] + row["checkpoint_s"]) for row in rows]
        axis.bar(names, shares, bottom=bottom, label=label)
        bottom = [low + share for low, share in zip(bottom, shares, strict=True)]
    _labels(axis, "shares of a generation", "population and devices", "share")
