"""`rtcd list`, `rtcd show`, `rtcd diff`: what run folders hold, in the terminal. Needs no JAX."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from rtcd_jax.analysis.report.reading import Run, read_run
from rtcd_jax.analysis.report.tables import Cell, candidate, gains, verdict
from rtcd_jax.analysis.report.words import duration, guarantee, listed, ratio, volume_unit, words
from rtcd_jax.certificate.standing import open_cycle
from rtcd_jax.config.load import Config, differences
from rtcd_jax.elite.records import (
    INITIAL,
    elite_names,
    read_config,
    read_elite,
    read_generations,
    resets_in_words,
    task_folders,
    windows_in_words,
)
from rtcd_jax.system.console import Console, table
from rtcd_jax.system.errors import UserError
from rtcd_jax.volume import VOLUMES

DEPTH = 3
"""Folders below the given one that are looked into for runs."""
HEADS = ("run", "robot", "objective", "generations", "best", "x initial", "guarantee", "verified", "bears")


@final
@dataclass(frozen=True)
class Course:
    """How far a run is: its generations of those asked for, and whether its elites are stored."""

    config: Config
    done: int
    complete: bool

    @classmethod
    def of(cls, path: Path) -> "Course":
        """Raises UserError if it is no run folder that this version reads, or a file of it is damaged."""
        config = read_config(path)
        lines = read_generations(path) if (path / "generations.jsonl").is_file() else []
        complete = bool(elite_names(path)) and (path / "initial.json").is_file()
        return cls(config, len(lines), complete)

    @property
    def generations(self) -> str:
        return f"{self.done}/{self.config.search.generations}"


def runs_below(folder: Path) -> list[Path]:
    """The run folders at most `DEPTH` folders below, in alphabetical order; the folder itself may be one."""
    levels = ["/".join([*["*"] * depth, "format.json"]) for depth in range(DEPTH + 1)]
    return sorted(mark.parent for level in levels for mark in folder.glob(level))


def list_runs(folder: Path, console: Console) -> str:
    """A table of all runs below a folder; below it a line for each that cannot be read."""
    found = runs_below(folder)
    if not found:
        raise UserError(f"{folder} has no run folder in it; `rtcd optimize CONFIG` makes one in checkpoints/")
    rows, damaged = [], []
    for path in found:
        name = str(path.relative_to(folder)) if path != folder else str(path)
        try:
            rows.append((name, *_row(path, console)))
        except UserError as error:
            damaged.append(f"{name} cannot be read: {error}")
    return "\n".join([table(HEADS, rows, left={"run", "robot", "objective", "bears"}), *damaged])


def _row(path: Path, console: Console) -> tuple[str, ...]:
    course = Course.of(path)
    objective, bears = course.config.search.objective, course.config.uncertainty.in_words(course.config.plant)
    about = (course.config.plant.name, words(objective), course.generations)
    if not course.complete:
        return (*about, "", "", "not finished", "", bears)
    if len(course.config.tasks) > 1:
        initial, best = _over_tasks(path, objective)
        gain = ratio(best, initial)
        tasks = f"{len(course.config.tasks)} tasks, below"
        return (*about, f"{best:.4g}", "" if gain is None else f"{gain:.3g}", "sampled", tasks, bears)
    run = read_run(path, console)
    gain = ratio(run.best.volumes[objective], run.initial.volumes[objective]) if run.initial else None
    best, times = f"{run.best.volumes[objective]:.4g}", "" if gain is None else f"{gain:.3g}"
    return (*about, best, times, _shown(run), verdict(run) or "", bears)


def _over_tasks(path: Path, volume: str) -> tuple[float, float]:
    """Over the tasks of a run for several: that of the initial and of the best candidate."""
    records = read_elite(path, INITIAL)[1], read_elite(path / "elites", elite_names(path)[0])[1]
    first, last = (float(record["volumes"][volume]) for record in records)
    return first, last


def _shown(run: Run) -> str:
    """The best elite's guarantee, the certificate's where it shows something."""
    certificate = run.certificates.get("000")
    return certificate.guarantee if certificate and certificate.guarantee else run.best.guarantee


def show_run(path: Path, console: Console) -> Iterator[str]:
    """What a run is, how far, its best candidate and volumes, what is proved, verified and tried, what it bears."""
    course = Course.of(path)
    search, bears = course.config.search, course.config.uncertainty.in_words(course.config.plant)
    yield (
        f"{path}: {course.config.plant.name}, {course.config.trajectory.knots} knots, {search.mode} search for the "
        f"largest {words(search.objective)}, seed {search.seed}"
    )
    yield f"generations: {course.generations} of {search.population} candidates"
    yield f"bears: {bears}"
    task = course.config.task
    if task.caught:
        within = task.catch.in_words(course.config.plant.states)
        yield f"ends in a catch set: {within}; of the time after it nothing is said"
    if not course.complete:
        yield "not finished: the command that began it goes on"
        return
    if len(course.config.tasks) > 1:
        first, last = _over_tasks(path, search.objective)
        over = f"{words(search.over_tasks)} over {len(course.config.tasks)} tasks"
        yield f"{words(search.objective)}, {over}: initial {first:.4g}, best {last:.4g} (sampled)"
        name = elite_names(path)[0]
        yield from resets_in_words(read_elite(path / "elites", name)[1])
        for folder in task_folders(path):
            yield f"task {folder.name}:"
            yield from show_run(folder, console)
        if task.catch.cyclic:
            why = open_cycle(path, name)
            yield f"cycle: none proved, {why}; rtcd certify {path}" if why else "cycle: proved"
        return
    run = read_run(path, console)
    if run.seconds is not None:
        yield f"time: {duration(run.seconds)}"
    yield f"best: {candidate(run)}"
    if run.absence:
        yield run.absence
    yield from windows_in_words(run.best.record)
    volumes = gains([run])
    yield table(
        volumes.heads,
        ([_cell(cell) for cell in row] for row in volumes.rows),
        left={"volume", "unit", "time", "guarantee"},
    )
    yield f"guarantee: {guarantee(run.best.record)}"
    certificate = run.certificates.get("000")
    if certificate is None:
        yield f"proof: none yet; rtcd certify {path}"
    elif certificate.guarantee is None:
        yield f"proof: none, certificate {certificate.verdict}: {certificate.reason}"
    else:
        yield f"proof: {certificate.guarantee} from {certificate.start:.4g} s on, {certificate.intervals} intervals"
    yield f"verification: {verdict(run) or f'none yet; rtcd verify {path}'}"
    tried = ", ".join(words(experiment.name) for experiment in run.experiments)
    if not task.caught:
        yield f"disturbance: {tried or f'none yet; rtcd disturb {path}'}"


def _cell(value: Cell) -> str:
    return value if isinstance(value, str) else "" if value is None else f"{value:.4g}"


def diff_runs(first: Path, second: Path, console: Console) -> Iterator[str]:
    """In which keys two runs' configurations differ, in which versions, and their best candidates side by side."""
    courses = [Course.of(path) for path in (first, second)]
    heads = ("", str(first), str(second))
    keys = differences(courses[0].config, courses[1].config)
    if keys:
        rows = [(key, *("" if value is None else str(value) for value in pair)) for key, pair in keys.items()]
        yield table(("configuration", *heads[1:]), rows, left={"configuration"})
    else:
        yield "equal configurations"
    if not all(course.complete for course in courses):
        for path, course in zip(heads[1:], courses, strict=True):
            yield f"{path}: {course.generations} generations, {'complete' if course.complete else 'not finished'}"
        return
    runs = [read_run(path, console) for path in (first, second)]
    yield table(heads, _beside(runs), left={""})


def _beside(runs: Sequence[Run]) -> Iterator[tuple[str, str, str]]:
    def row(name: str, values: Iterable[str]) -> tuple[str, str, str]:
        first, second = values
        return name, first, second

    for section in ("design", "weights", "policy"):
        records: list[Mapping[str, Any]] = [run.best.record[section] for run in runs]
        for name in dict.fromkeys([*records[0], *records[1]]):
            cells = (listed("", record[name]).removeprefix(" = ") if name in record else "" for record in records)
            yield row(words(name), cells)
    for name in (name for name in VOLUMES if all(name in run.best.volumes for run in runs)):
        units = [volume_unit(run.config, name) for run in runs]
        unit = f" [{units[0]}]" if units[0] == units[1] else ""
        yield row(f"{words(name)}{unit}", (f"{run.best.volumes[name]:.4g}" for run in runs))
        before = [run.initial.volumes.get(name, 0.0) if run.initial else 0.0 for run in runs]
        gained = [ratio(run.best.volumes[name], first) for run, first in zip(runs, before, strict=True)]
        yield row(f"{words(name)} x initial", ("" if gain is None else f"{gain:.3g}" for gain in gained))
    yield row("guarantee", map(_shown, runs))
    yield row("verification", (verdict(run) or "none yet" for run in runs))
    commits = [str((run.provenance.get("starts") or [{}])[-1].get("commit")) for run in runs]
    yield row("commit of the last start", commits)
