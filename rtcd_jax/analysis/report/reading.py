"""A finished run as reports show it: everything that its folder holds, checked once and given names."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from rtcd_jax.certificate.standing import certificate_path, standing
from rtcd_jax.config.load import Config
from rtcd_jax.elite.elite import Elite, initial_and_best
from rtcd_jax.elite.records import (
    INITIAL,
    elite_folder,
    elite_names,
    read_config,
    read_elite,
    read_generations,
)
from rtcd_jax.system.console import Console, each_second, silent
from rtcd_jax.system.errors import UserError, printable
from rtcd_jax.system.files import read_json, reading
from rtcd_jax.volume import LATER, VOLUMES

# Okabe and Ito's colors: distinct in all kinds of color vision.
BLUE, VERMILION = "#0072B2", "#D55E00"
COLORS = (VERMILION, "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Of compared runs, in turn."""
INITIALS = (BLUE, "#5F6B7A", "#8C6D31", "#7A5195")
"""Of their initial candidates, where they differ."""

_ADVICE = "remove it, or make it again"
AUDIT = "audit.json"
"""In the folders that `rtcd audit` makes."""

_OF_A_GENERATION = (
    "index", "evaluations", "objective", "best", "median", "best_so_far", "feasible", "counts", "sigma", "restarts",
    "genomes", "volumes",
)  # fmt: skip

_NUMBER = int | float | None
_ANY_KEY = "*"
_PLAIN = str | int | float | None
_START = dict.fromkeys(("time", "commit", "devices", "device", "precision", "system"), _PLAIN)
_PROVENANCE = {
    "config_hash": str | None, "starts": [{**_START, "seconds": int | float, "versions": {_ANY_KEY: _PLAIN}}],
}  # fmt: skip
_COUNTS = dict.fromkeys(("left_funnel", "left_limits", "missed_goal", "rate", "rate_lower", "rate_upper"), _NUMBER)
_VERIFICATION = {
    "states": _NUMBER, "epsilon": _NUMBER, "confidence": _NUMBER, "witnesses": {_ANY_KEY: _COUNTS},
}  # fmt: skip
_DISTURBANCE = {"summary": {}}
_TOLERATED = {"name": str, "unit": str, "half_width": _NUMBER, "factor": _NUMBER, "borne": _NUMBER, "guarantee": str}
_TOLERANCE = {"rows": [{**_TOLERATED, "volumes": {_ANY_KEY: _NUMBER}}]}


@final
@dataclass(frozen=True)
class FunnelView:
    """A funnel as it is drawn; `label` and `color` are its own in all panels."""

    label: str
    color: str
    elite: Elite


@final
@dataclass(frozen=True)
class Experiment:
    """`disturbance/NAME.json` and the figures NAME*.png beside it."""

    name: str
    summary: Mapping[str, Any]
    pictures: tuple[Path, ...]


@final
@dataclass(frozen=True)
class Tolerance:
    """`tolerance/NNN.json`: the largest factor of each uncertainty that the elite bears, and its figure."""

    elite: str
    rows: Sequence[Mapping[str, Any]]
    pictures: tuple[Path, ...]


@final
@dataclass(frozen=True)
class Certificate:
    """What is shown of an elite's funnel, from `start` [s] on, by an effort of `seconds`, beside what was sampled.

    `guarantee` is "proved" only where the checker accepts the stored file for the stored elite; it is None, and
    `shown` empty, where the file shows nothing of this elite: `verdict` says so in a word, `reason` in a sentence.
    """

    guarantee: str | None
    verdict: str
    reason: str = ""
    start: float = 0.0
    intervals: int = 0
    seconds: float = 0.0
    sampled: Mapping[str, float] = field(default_factory=dict)
    shown: Mapping[str, float] = field(default_factory=dict)


@final
@dataclass(frozen=True)
class Run:
    """A run folder. `initial` is None where the initial candidate has no funnel, and `absence` says why.

    `figures` is the folder that they are drawn into; an `audited` funnel is external; `labels` are those of the initial
    and of the best funnel, and `color` is the best one's.
    """

    path: Path
    figures: Path
    name: str
    config: Config
    best: Elite
    initial: Elite | None
    absence: str
    generations: Sequence[Mapping[str, Any]]
    elites: Mapping[str, Mapping[str, Any]]
    certificates: Mapping[str, Certificate]
    verification: Mapping[str, Mapping[str, Any]]
    experiments: Sequence[Experiment]
    tolerances: Sequence[Tolerance]
    provenance: Mapping[str, Any]
    audited: bool = False
    labels: tuple[str, str] = ("initial", "best")
    color: str = VERMILION

    @property
    def funnels(self) -> list[FunnelView]:
        """The initial one, if there is one, and the best."""
        best = FunnelView(self.labels[1], self.color, self.best)
        return [best] if self.initial is None else [FunnelView(self.labels[0], BLUE, self.initial), best]

    @property
    def seconds(self) -> float | None:
        """Wall time of all starts [s], None where one was not recorded."""
        spent = [start.get("seconds") for start in self.provenance.get("starts", ())]
        return sum(spent) if spent and None not in spent else None


def read_run(path: Path, console: Console | None = None) -> Run:
    """Everything that a finished run left in its folder; its certificates are checked, and `console` shows how far.

    Raises:
        UserError: no run folder, no elites yet, an elite without a funnel or with something missing, or a file that
            cannot be read.
    """
    config = read_config(path)
    funnels, absence = initial_and_best(path)
    for name, elite in funnels.items():
        _require_shown(name, elite)
    return Run(
        path=path,
        figures=path / "figures",
        name=path.resolve().name,
        config=config,
        best=funnels["best"],
        initial=funnels.get(INITIAL),
        absence=absence,
        generations=read_search(path),
        elites={name: read_elite(elite_folder(path, name), name)[1] for name in elite_names(path)},
        certificates=dict(_certificates(path, console or silent())),
        verification={
            file.stem: _shaped(file, _VERIFICATION) for file in sorted((path / "verification").glob("*.json"))
        },
        experiments=tuple(_experiments(path / "disturbance")),
        tolerances=tuple(
            Tolerance(file.stem, _shaped(file, _TOLERANCE).get("rows", ()), (file.with_suffix(".png"),))
            for file in sorted((path / "tolerance").glob("*.json"))
        ),
        provenance=_shaped(path / "provenance.json", _PROVENANCE),
        audited=(path / AUDIT).is_file(),
    )


def _require_shown(name: str, elite: Elite) -> None:
    """Raises UserError where something is missing that reports tell of a candidate."""
    missing = [f"volumes_{volume}" for volume in VOLUMES if volume not in elite.volumes and volume not in LATER]
    missing += [key for key in ("design", "weights") if key not in elite.record]
    if missing:
        raise UserError(f"the {name} candidate lacks {', '.join(missing)}")


def read_search(path: Path) -> list[dict[str, Any]]:
    """The generations of a run; none of an audited funnel, which nobody searched, and where their lines are lost."""
    generations = read_generations(path) if (path / "generations.jsonl").is_file() else []
    for number, record in enumerate(generations, 1):
        missing = [name for name in _OF_A_GENERATION if name not in record]
        if missing:
            raise UserError(f"{path / 'generations.jsonl'}, line {number} lacks {', '.join(missing)}")
    return generations


def compared(runs: Sequence[Run]) -> list[Run]:
    """The runs with a name and a color of their own each.

    Raises UserError for runs of different robots.
    """
    robots = {run.config.plant.name: run.path for run in runs}
    if len(robots) > 1:
        origins = " and ".join(f"{path} of the {robot}" for robot, path in robots.items())
        raise UserError(f"runs of one robot can be compared, but there is {origins}")
    names = [run.name for run in runs]
    named: list[Run] = []
    for index, run in enumerate(runs):
        name = run.name if names.count(run.name) == 1 else str(run.path)
        color = COLORS[index % len(COLORS)]
        named.append(replace(run, name=name, labels=(f"{name}, initial", name), color=color))
    return named


def funnel_views(runs: Sequence[Run]) -> list[FunnelView]:
    """The funnels that are drawn over one another; an initial candidate that runs have in common is drawn once."""
    initials: list[FunnelView] = []
    for run in runs:
        for initial in run.funnels[:-1]:
            if not any(_same(initial.elite, other.elite) for other in initials):
                initials.append(initial)
    if len(initials) == 1:
        initials = [replace(initials[0], label="initial")]
    colors = itertools.cycle(INITIALS)
    return [*(replace(initial, color=next(colors)) for initial in initials), *(run.funnels[-1] for run in runs)]


def _same(first: Elite, second: Elite) -> bool:
    """Whether two funnels are one candidate's: the same motion and values, however their levels were sampled."""
    return first.x.shape == second.x.shape and np.allclose(first.x, second.x) and np.allclose(first.S, second.S)


def _certificates(path: Path, console: Console) -> Iterator[tuple[str, Certificate]]:
    """What `rtcd certify` left, by elite, as far as the files still bear it out."""
    summary, show = path / "certificates" / "summary.json", each_second(console)
    for name, written in _json(summary).items():
        if written is None:
            yield name, Certificate(None, "not found", "no goal region could be shown")
            continue
        what = f"checking {certificate_path(path, name)}  interval"
        proof = standing(path, name, lambda done, total, what=what: show(done, total, what))
        with reading(summary, _ADVICE):
            beside = {"seconds": float(written["seconds"]), "sampled": _numbers(written["sampled"])}
            if proof.proved:
                shown = {"start": proof.start, "intervals": proof.intervals, "shown": proof.volumes}
                yield name, Certificate("proved", proof.verdict, **beside, **shown)
            elif proof.verdict == "refused" and written["rung"] == "certified":  # in floating-point numbers, no more
                shown = {"start": float(written["start"]), "intervals": int(written["intervals"])}
                shown |= {"shown": _numbers(written["found"])}
                yield name, Certificate("certified", proof.verdict, proof.reason, **beside, **shown)
            else:
                yield name, Certificate(None, proof.verdict, proof.reason, **beside)


def _numbers(written: Mapping[str, Any]) -> dict[str, float]:
    return {str(key): float(value) for key, value in written.items()}


def _experiments(folder: Path) -> list[Experiment]:
    return [
        Experiment(
            file.stem, _shaped(file, _DISTURBANCE).get("summary", {}), tuple(sorted(folder.glob(f"{file.stem}*.png")))
        )
        for file in sorted(folder.glob("*.json"))
    ]


def _shaped(path: Path, shape: Mapping[str, Any]) -> dict[str, Any]:
    """The file's content, nothing where there is no file. Raises UserError where a value is not of the shape's kind."""
    stored = _json(path)
    for place in _misfits(stored, shape):
        raise UserError(f"cannot read {path}: {printable(place)} is of another kind than a run writes; {_ADVICE}")
    return stored


def _misfits(value: Any, shape: Any, place: str = "") -> Iterator[str]:
    """Where a value is of another kind: a shape is a mapping of keys to shapes, a list of one shape, or types."""
    if isinstance(shape, Mapping):
        if not isinstance(value, Mapping):
            yield place
            return
        for key, inner in value.items():
            if key in shape or _ANY_KEY in shape:
                yield from _misfits(inner, shape.get(key, shape.get(_ANY_KEY)), f"{place}.{key}".lstrip("."))
    elif isinstance(shape, list):
        if not isinstance(value, list):
            yield place
            return
        for index, inner in enumerate(value):
            yield from _misfits(inner, shape[0], f"{place}[{index}]")
    elif not isinstance(value, shape):
        yield place


def _json(path: Path) -> dict[str, Any]:
    """The file's content, nothing where there is no file. Raises UserError if it is damaged."""
    return read_json(path, _ADVICE) if path.is_file() else {}
