"""The files of a run folder, each by itself: what is read and written here needs neither JAX nor orbax.

    format.json                the mark of a run folder and its format's version
    config.yaml                the resolved configuration
    generations.jsonl          one line a generation
    initial.npz, initial.json  the configuration's initial candidate
    elites/NNN.npz, NNN.json   the best candidates, 000 first

Of a run for several tasks the elites and the initial candidate have here what the tasks have in common, and each task
has a folder tasks/NAME, which reads as a run for this task alone; its mark says so, and both are of version 2.

Numbers that are not finite are stored as null.
"""

import hashlib
import io
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtcd_jax.config import load as configuration
from rtcd_jax.config.load import Config
from rtcd_jax.system.errors import UserError, printable
from rtcd_jax.system.files import read_json, reading, replace, replace_json

FORMAT = "rtcd_jax run"
VERSION = 1
SEVERAL = 2
"""The version of a run for several tasks, and of their folders."""
TASKS = "tasks"
"""The folder of the tasks' own."""
INITIAL = "initial"
"""Name of the configuration's candidate beside the elites "000", "001", …."""
_RESTORE = "restore it, or make the run again"

Arrays = Mapping[str, np.ndarray]
Record = Mapping[str, Any]


def elite_name(which: int | str) -> str:
    """ "007" for 7; a name stays as it is."""
    return which if isinstance(which, str) else f"{which:03d}"


def elite_folder(run: Path, name: str) -> Path:
    """Where in a run folder the files of the elite "000", "001", … or of the candidate "initial" lie."""
    return run if name == INITIAL else run / "elites"


def elite_digests(run: Path, name: str) -> list[str]:
    """The SHA-256 of an elite's two files: what was made of it holds as long as these are the same."""
    files = [elite_folder(run, name) / f"{name}.{suffix}" for suffix in ("npz", "json")]
    return [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]


def write_elite(folder: Path, name: str, arrays: Arrays, record: Record) -> None:
    """Writes NAME.npz, then NAME.json; equal contents give equal bytes.

    Raises TypeError for an array or a value that other programs could not read.
    """
    for key, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiub":
            raise TypeError(f"{name}.npz: {key} must be a numpy array of numbers, got {type(array).__name__}")
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    replace(folder / f"{name}.npz", file.getvalue())
    replace_json(folder / f"{name}.json", record)


def read_elite(folder: Path, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the record of `folder`/NAME.

    Raises:
        UserError: it is not there (the error has the names that are), or one of its files is damaged.
    """
    paths = [folder / f"{name}.{suffix}" for suffix in ("npz", "json")]
    if not all(path.is_file() for path in paths):
        there = ", ".join(sorted(path.stem for path in folder.glob("*.npz"))) or "nothing"
        raise UserError(f"{folder} has no {name}.npz with its {name}.json; there is {there}")
    with reading(paths[0], _RESTORE), paths[0].open("rb") as file, np.load(file, allow_pickle=False) as stored:
        arrays = dict(stored)
    words = [name for name, array in arrays.items() if not np.issubdtype(array.dtype, np.number)]
    if words:
        raise UserError(f"cannot read {paths[0]}: {printable(', '.join(words))} must be numbers; {_RESTORE}")
    record = read_json(paths[1], _RESTORE)
    if not record:
        raise UserError(f"{paths[1]} says nothing of its elite; {_RESTORE}")
    return arrays, record


def elite_names(path: Path) -> list[str]:
    """Names of the elites in a run folder, best first."""
    return sorted((file.stem for file in (path / "elites").glob("*.json") if file.stem.isdecimal()), key=int)


def require_elites(path: Path) -> list[str]:
    """`elite_names` of a run folder. Raises UserError if it is none, or its search is not finished."""
    names = elite_names(path)
    if not names:
        _require_run(path)
        raise UserError(f"{path} has no elites yet: finish the run first, by the command that began it")
    return names


def task_folders(path: Path) -> list[Path]:
    """Of a finished run: the folders of its tasks, in the configuration's order, or its own where there is one task.

    Raises UserError as `require_elites`, and where a task's folder is missing.
    """
    require_elites(path)
    mark = _mark(path)
    if mark.get("version") != SEVERAL or "task" in mark:
        return [path]
    folders = [path / TASKS / name for name in read_config(path).tasks]
    for folder in folders:
        _require_run(folder)
    return folders


def require_one_task(path: Path) -> None:
    """Raises UserError if the folder is that of a run for several tasks; the error names those that are meant."""
    folders = task_folders(path)
    if folders != [path]:
        raise UserError(f"{path} is for several tasks: say which, {' or '.join(map(str, folders))}")


def require_held_goal(path: Path, verb: str) -> None:
    """Raises UserError if the motions of a run end in a catch set, after which `verb` would go on; elites without a run
    have none.
    """
    if (path / "format.json").is_file() and read_config(path).task.caught:
        raise UserError(
            f"{path} ends in a catch set (task.catch): rtcd {verb} needs a goal that is held after the motion"
        )


def is_cycle(path: Path) -> bool:
    """Whether the folder is that of a run for several tasks, each of which ends where the next one begins."""
    return task_folders(path) != [path] and read_config(path).task.catch.cyclic


def resets_in_words(record: Record) -> Iterator[str]:
    """Of what a cycle of tasks has in common: where each reset leads, and its worst state."""
    for name, reset in record.get("reset", {}).items():
        level = math.inf if reset["largest_level"] is None else reset["largest_level"]
        words = (
            f"reset of {name} into {reset['into']}: the largest V/rho in the first ellipsoid there is {level:.3g}, of "
            f"{reset['samples']} samples of the last one here, and as many on its rim"
        )
        if "worst" in reset:
            before, after = (_listed(reset["worst"][side]) for side in ("before", "after"))
            words += f"; {'it leaves the cycle' if level > 1 else 'it goes'} from {before} to {after}"
        yield words


def windows_in_words(record: Record) -> Iterator[str]:
    """How far the points with a window are from their places at the goal in the last ellipsoid."""
    for name, window in record.get("window", {}).items():
        yield (
            f"{name}: at most {window['farthest']:.3g} m from its place at the goal in the last ellipsoid (window "
            f"{window['size']:g} m)"
        )


def _listed(state: Sequence[float | None]) -> str:
    return f"({', '.join('?' if value is None else f'{value:.4g}' for value in state)})"


def task_of(path: Path) -> str:
    """The task whose folder this is, in a run for several; empty for a run of its own."""
    return str(_mark(path).get("task", ""))


def mark_of(config: Config, task: str = "") -> Record:
    """What format.json says of a run with this configuration or, in a run for several tasks, of a task's folder."""
    if task:
        return {"format": FORMAT, "version": SEVERAL, "task": task}
    return {"format": FORMAT, "version": SEVERAL if len(config.tasks) > 1 else VERSION}


def _mark(path: Path) -> dict[str, Any]:
    """What format.json says; nothing where there is none, as beside single elites."""
    file = path / "format.json"
    return read_json(file, "choose another folder") if file.is_file() else {}


def read_config(path: Path) -> Config:
    """The configuration of a run. Raises UserError if the folder is no run folder that this version reads."""
    _require_run(path)
    require_format(path)
    return stored_config(path)


def _require_run(path: Path) -> None:
    if not (path / "format.json").is_file():
        raise UserError(f"{path} is no run folder: it has no format.json")


def read_generations(path: Path) -> list[dict[str, Any]]:
    """The generations of a run, null for what was not finite; a torn last line is left out.

    Raises UserError, with the line, if another one is damaged.
    """
    lines = path / "generations.jsonl"
    generations = []
    with reading(lines, _RESTORE), lines.open("rb") as file:
        for number, line in enumerate(file, 1):
            if line.endswith(b"\n"):
                with reading(Path(f"{lines}, line {number}"), _RESTORE):
                    generations.append(dict(json.loads(line)))
    return generations


def require_format(path: Path) -> None:
    """Raises UserError if the folder's mark is not that of this version."""
    file, mark = path / "format.json", _mark(path)
    name, version = mark.get("format"), mark.get("version")
    if name != FORMAT or version not in (VERSION, SEVERAL):
        raise UserError(
            f"{file} says {name!r}, version {version!r}, but this rtcd_jax reads {FORMAT!r}, version {VERSION} or "
            f"{SEVERAL}: "
            "go on with the version in provenance.json, or choose another folder"
        )


def stored_config(path: Path) -> Config:
    """The configuration in a folder whose mark was checked. Raises UserError if it is damaged."""
    file = path / "config.yaml"
    with reading(file, _RESTORE):
        return configuration.parse_yaml(file.read_bytes(), str(file))
