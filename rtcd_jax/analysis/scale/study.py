"""`rtcd scale`: a grid of points, stored as they are measured, a table and figures."""

import csv
import io
import json
import os
import platform
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rtcd_jax.analysis.scale.figures import draw
from rtcd_jax.config.load import Config, config_hash
from rtcd_jax.system.console import Clock, Console, Progress, duration, table
from rtcd_jax.system.files import make_folder, plain, replace
from rtcd_jax.system.journal import Journal

POINTS, TABLE = "points.jsonl", "table.csv"
OUT_OF_MEMORY = "out of memory"
_MEMORY_WORDS = ("RESOURCE_EXHAUSTED", "Out of memory", "MemoryError", "bad_alloc")
_KILLED = -9

Point = Mapping[str, Any]


def study(
    path: Path, config: Config, populations: Sequence[int], devices: Sequence[int], repeats: int, folder: Path,
    console: Console,
) -> None:  # fmt: skip
    """Measures every population on every number of devices; leaves points, table and figures in the folder.

    Points that are there already, of the same configuration on a machine of the same name, are not measured again. One
    that fails says why in its row, and the others go on.
    """
    mark = {"config_hash": config_hash(config), "machine": platform.node(), "repeats": repeats}
    make_folder(folder)
    journal = Journal(folder / POINTS)
    measured = {
        (point["population"], point["devices"]): point
        for point in journal.lines
        if point.items() >= mark.items() and "failed" not in point
    }
    grid = [(population, count) for population in sorted(set(populations)) for count in sorted(set(devices))]
    clock = Clock()
    for index, (population, count) in enumerate(grid):
        if (population, count) not in measured:
            console.message(f"population {population}, {count} devices: a process of its own, which compiles first")
            point = mark | {"load": os.getloadavg()[0]}
            with console.waiting("compiling and measuring"):
                point |= _measured(path, population, count, repeats)
            journal.append(plain(point))
            measured[population, count] = point
        done, total = index + 1, len(grid)
        text = f"point {done}/{total}: {_sentence(measured[population, count])}  elapsed {duration(clock.elapsed)}"
        console.progress(Progress(done, total, text))
    rows = [row_of(measured[place]) for place in grid]
    _write_table(folder / TABLE, rows)
    pictures = draw(rows, folder)
    console.message(_table(rows))
    console.message(f"{folder / TABLE}, {', '.join(path.name for path in pictures)}")


def _measured(path: Path, population: int, devices: int, repeats: int) -> dict[str, Any]:
    """The point, or what it failed by."""
    words = [str(word) for word in (path, population, devices, repeats)]
    done = subprocess.run(
        [sys.executable, "-m", "rtcd_jax.analysis.scale.point", *words], capture_output=True, text=True, check=False
    )
    if done.returncode == 0:
        return json.loads(done.stdout.splitlines()[-1])
    errors = done.stderr.strip().splitlines()
    exhausted = done.returncode == _KILLED or any(word in done.stderr for word in _MEMORY_WORDS)
    why = OUT_OF_MEMORY if exhausted else (errors[-1] if errors else f"exit code {done.returncode}")
    return {"population": population, "devices": devices, "failed": why}


def row_of(point: Point) -> dict[str, Any]:
    """What the table says of a point: medians over its generations, the spread of its rate.

    `overhead` is the share of a generation that is not the evaluation: CMA-ES, archive, lines, and the checkpoint,
    which is due once in `checkpoint.seconds`.
    """
    row = {"population": point["population"], "devices": point["devices"], "failed": point.get("failed", "")}
    if row["failed"]:
        return row
    population, walls = point["population"], point["generations"]
    wall = statistics.median(walls)
    checkpoint = point["checkpoint"] * min(1.0, wall / max(point["checkpoint_every"], 1e-9))
    search, lines = (statistics.median(point[name]) for name in ("search", "lines"))
    return row | {
        "device": point["kind"],
        "chunk": point["chunk"],
        "candidates_per_s": population / wall,
        "candidates_per_s_min": population / max(walls),
        "candidates_per_s_max": population / min(walls),
        "cpu_ms_per_candidate": 1e3 * statistics.median(point["cpu"]) / population,
        "device_ms_per_candidate": 1e3 * wall * point["devices"] / population,
        "compilation_s": point["compilation"],
        "generation_s": wall,
        "evaluation_s": statistics.median(point["evaluation"]),
        "search_s": search,
        "lines_s": lines,
        "checkpoint_s": checkpoint,
        "overhead": (search + lines + checkpoint) / (wall + checkpoint),
        "feasible": point["feasible"],
        "peak_memory_mb": point["peak_memory"] / 2**20,
        "peak_device_memory_mb": point["peak_device_memory"] and point["peak_device_memory"] / 2**20,
    }


def efficiencies(rows: Sequence[Point]) -> dict[tuple[int, int], float]:
    """Strong scaling: rate over that of the fewest devices at the same population, by the ratio of the devices."""
    rates = {(row["population"], row["devices"]): row["candidates_per_s"] for row in rows if not row["failed"]}
    shares = {}
    for (population, devices), rate in rates.items():
        fewest = min(count for size, count in rates if size == population)
        shares[population, devices] = rate / rates[population, fewest] * fewest / devices
    return shares


def _sentence(point: Point) -> str:
    row = row_of(point)
    head = f"population {row['population']}, {row['devices']} devices: "
    return head + (row["failed"] or f"{row['candidates_per_s']:.4g} candidates/s")


def _write_table(path: Path, rows: Sequence[Point]) -> None:
    text = io.StringIO()
    columns = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(text, list(columns), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    replace(path, text.getvalue().encode())


def _table(rows: Sequence[Point]) -> str:
    headings = (
        "population", "devices", "candidates/s", "min .. max", "device ms", "CPU ms", "efficiency", "overhead",
        "compilation", "memory",
    )  # fmt: skip
    shares = efficiencies(rows)
    return table(headings, (_cells(row, shares) for row in rows))


def _cells(row: Point, shares: Mapping[tuple[int, int], float]) -> list[str]:
    place = row["population"], row["devices"]
    if row["failed"]:
        return [*map(str, place), row["failed"]]
    return [
        *map(str, place),
        f"{row['candidates_per_s']:.4g}",
        f"{row['candidates_per_s_min']:.4g} .. {row['candidates_per_s_max']:.4g}",
        f"{row['device_ms_per_candidate']:.3g}",
        f"{row['cpu_ms_per_candidate']:.3g}",
        f"{shares[place]:.2f}",
        f"{row['overhead']:.1%}",
        f"{row['compilation_s']:.1f} s",
        f"{row['peak_memory_mb']:.0f} MB",
    ]
