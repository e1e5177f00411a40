"""The run folder as a run holds it: locked, with all that it needs to go on after a kill at any moment.

Beside the files of records.py, process 0 writes

    provenance.json            versions, device, commit and working time of every start of the run
    state/                     checkpoints of the search, the latest two
    state.sha256               the digest of each of their files, as `sha256sum -c` reads them

Every file but the JSON lines is replaced as a whole; the lines are cut back to the checkpoint at a resume. Orbax and
JAX are imported where states are kept.
"""

import contextlib
import hashlib
import itertools
import json
import os
import re
import time
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar, cast, final

import numpy as np

from rtcd_jax.config import load as configuration
from rtcd_jax.config.load import Config
from rtcd_jax.elite.records import (
    INITIAL,
    Arrays,
    Record,
    elite_names,
    mark_of,
    require_format,
    stored_config,
    task_of,
    write_elite,
)
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import (
    held,
    make_folder,
    plain,
    read_json,
    reading,
    replace,
    replace_json,
    require_own_folder,
    sync,
    writing,
)
from rtcd_jax.system.provenance import provenance
from rtcd_jax.volume import LATER

if TYPE_CHECKING:
    from rtcd_jax.system.cluster import Cluster

KEPT_STATES = 2
_LOCK = ".lock"
_DIGEST = re.compile(r"^([0-9a-f]{64})  (state/\d+/.+)$", re.MULTILINE)
_FORGET = "restore it, or remove it: the run then goes on without its history"

State = TypeVar("State")


@final
class RunFolder:
    """A run folder that this run alone may write. A context manager: leaving it frees the folder.

    All processes of a run open it and call its methods alike: process 0 writes, states are saved by all together.
    Every method raises UserError, naming the path, where the folder cannot be written.
    """

    def __init__(
        self, path: Path, seconds: float, cluster: "Cluster", checkpointer: Any, held: contextlib.ExitStack,
        notes: list[str],
    ):  # fmt: skip
        self.path = path
        self.notes = notes
        """What was damaged and is mended, for the user to read."""
        self._seconds = seconds
        self._cluster = cluster
        self._checkpointer = checkpointer
        self._held = held
        self._begun = self._saved = time.monotonic()

    @classmethod
    def open(cls, path: Path, config: Config, cluster: "Cluster | None" = None) -> Self:
        """The folder of a new run, or of the one that `config` began: then `restore` gives the state to go on from.

        Without a `cluster` it is that of this process' devices.

        Raises UserError if the folder holds something else, a run of another configuration (every differing key with
        both values) or of another format, if another run works on it, or if the processes were not started alike.
        """
        if cluster is None:
            from rtcd_jax.system.cluster import Cluster

            cluster = Cluster.of()
        cluster.require_alike("configuration", configuration.config_hash(config))
        notes: list[str] = []
        with contextlib.ExitStack() as stack:
            cluster.on_first(lambda: stack.enter_context(_prepared(path, config, notes)))
            checkpointer = stack.enter_context(_checkpoints(path / "state"))
            return cls(path, config.checkpoint.seconds, cluster, checkpointer, stack.pop_all(), notes)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the folder for other processes."""
        self._held.close()

    @property
    def _state_path(self) -> Path:
        return self.path / "state"

    @property
    def _digests_path(self) -> Path:
        return self.path / "state.sha256"

    @property
    def _lines_path(self) -> Path:
        return self.path / "generations.jsonl"

    def restore(self, state: State) -> State:
        """The latest saved state, or `state` if there is none; later lines of generations.jsonl are cut off.

        Where that state is damaged, or lines before it are lost, it is the latest whole one with all its lines, where
        there is none, the latest whole one without them; later ones are moved into `state.damaged`. `state` is that of
        a search that has not begun: its arrays say the shapes. Raises UserError, and moves nothing, if no saved state
        fits them.
        """
        saved = sorted(self._checkpointer.checkpoints, key=lambda each: each.step, reverse=True)
        steps = [checkpoint.step for checkpoint in saved]
        held = self._cluster.on_first(lambda: {line.index for line in _lines(self._lines_path)}) or set()
        missing = self._cluster.agreed(np.array([len(set(range(step)) - held) for step in steps], int))
        shapes = self._cluster.replicated(state)
        lost = [f"{self._lines_path} lacks {missing[k]} of the {step} lines before {saved[k].path}"
                for k, step in enumerate(steps)]  # fmt: skip
        names = [f"{checkpoint.step}" for checkpoint in saved]
        seen = self._cluster.on_first(lambda: self._unchanged(names)) or [True] * len(names)
        unchanged = self._cluster.agreed(np.array(seen, bool))
        refused: dict[int, str] = {}
        for k in sorted(range(len(saved)), key=lambda k: missing[k] > 0):
            try:
                if not unchanged[k]:
                    raise _no_state(saved[k])
                loaded = _load(self._checkpointer, saved[k], shapes)
            except UserError as error:
                refused[k] = str(error)
                continue
            reasons = ([refused.get(0, lost[0])] if k else []) + ([lost[k]] if missing[k] else [])
            if reasons:
                self.notes.append(f"{'; '.join(reasons)}; going on with the state of generation {steps[k]}")
            if k:
                self._cluster.on_first(partial(self._set_aside, saved[:k]))
                self._checkpointer.reload()
            self._cluster.on_first(partial(self._cut, steps[k]))
            return loaded
        if saved:
            raise UserError(refused[0])
        self._cluster.on_first(lambda: self._cut(0))
        return state

    def _set_aside(self, checkpoints: Iterable[Any]) -> None:
        folder = self.path / "state.damaged"
        with writing(folder):
            folder.mkdir(exist_ok=True)
            for checkpoint in checkpoints:
                place = folder / f"{checkpoint.step}"
                number = itertools.count(1)
                while place.exists():
                    place = folder / f"{checkpoint.step}.{next(number)}"
                (self._state_path / f"{checkpoint.step}").rename(place)
        self._write_digests(self._noted_digests())  # a later state of the same name is another one

    def append(self, record: Record) -> None:
        """Adds a generation to generations.jsonl."""
        line = json.dumps(plain(record), allow_nan=False) + "\n"
        self._cluster.on_first(lambda: self._append(line.encode()))

    def _append(self, line: bytes) -> None:
        with writing(self._lines_path), self._lines_path.open("ab") as file:
            file.write(line)

    def save_if_due(self, state: Any, generation: int) -> bool:
        """Saves if `checkpoint.seconds` have passed since the last save; says whether it did."""
        due = bool(self._cluster.agreed(np.asarray(time.monotonic() - self._saved >= self._seconds)))
        if due:
            self.save(state, generation)
        return due

    def save(self, state: Any, generation: int) -> None:
        """Keeps the state after `generation` generations, all of them appended before; waits until it is on disk."""
        self._cluster.on_first(lambda: sync(self._lines_path))
        latest = self._checkpointer.latest
        if latest is None or latest.step != generation:
            # tensorstore tells of a full disk by ValueError.
            with writing(self._state_path, (OSError, ValueError)), self._cluster.linked():
                self._checkpointer.save(generation, self._cluster.replicated(state), force=True)
            self._cluster.on_first(lambda: self._note_digests(f"{generation}"))
        self._cluster.on_first(self.tell_time)
        self._saved = time.monotonic()

    def _note_digests(self, name: str) -> None:
        """Adds those of the state of this name."""
        kept = {path: digest for path, digest in self._noted_digests().items() if path.parts[1] != name}
        self._write_digests({**kept, **self._digests(name)})

    def _write_digests(self, noted: dict[Path, str]) -> None:
        """Those of the states that are there."""
        lines = [f"{digest}  {path}\n" for path, digest in noted.items() if (self._state_path / path.parts[1]).exists()]
        replace(self._digests_path, "".join(lines).encode())

    def _unchanged(self, names: Iterable[str]) -> list[bool]:
        """Whether each of these states is as it was saved; True where no digests are noted, as older versions did."""
        noted: dict[str, dict[Path, str]] = {}
        for path, digest in self._noted_digests().items():
            noted.setdefault(path.parts[1], {})[path] = digest
        return [name not in noted or noted[name] == self._digests(name) for name in names]

    def _noted_digests(self) -> dict[Path, str]:
        """By the files' paths in the run folder; a damaged line is none."""
        with reading(self._digests_path, "remove it"):
            content = self._digests_path.read_text(errors="replace") if self._digests_path.exists() else ""
        return {Path(path): digest for digest, path in _DIGEST.findall(content)}

    def _digests(self, name: str) -> dict[Path, str]:
        state = self._state_path / name
        with reading(state, _FORGET):
            files = [file for file in sorted(state.rglob("*")) if file.is_file()]
            return {file.relative_to(self.path): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}

    def tell_time(self) -> None:
        """Notes in provenance.json how long this start has worked [s]; a kill leaves what the latest save noted.

        For process 0.
        """
        file = self.path / "provenance.json"
        record = read_json(file, _FORGET)
        record["starts"][-1]["seconds"] = round(time.monotonic() - self._begun, 1)
        replace_json(file, record)

    def write_initial(self, arrays: Arrays, record: Record) -> None:
        """The configuration's initial candidate, in the elites' format."""
        write_elite(self.path, INITIAL, arrays, record)

    def write_elites(self, elites: Iterable[tuple[Arrays, Record]]) -> None:
        """All elites, best first; those that were stored beyond their number are removed."""
        write_elites(self.path, elites)

    def _cut(self, generations: int) -> None:
        """Leaves the complete lines of the first `generations` alone."""
        earlier = [line for line in _lines(self._lines_path) if line.index < generations]
        end = sum(line.length for line in earlier)
        if not earlier or end == earlier[-1].start + earlier[-1].length:  # nothing else between them
            with writing(self._lines_path):
                os.truncate(self._lines_path, end)
            return
        with reading(self._lines_path, _FORGET):
            content = self._lines_path.read_bytes()
        replace(self._lines_path, b"".join(content[line.start : line.start + line.length] for line in earlier))


def write_elites(path: Path, elites: Iterable[tuple[Arrays, Record]]) -> None:
    """All elites of a run or a task, best first; those that were stored beyond their number are removed."""
    folder = path / "elites"
    make_folder(folder)
    written = set()
    for index, (arrays, record) in enumerate(elites):
        written.add(f"{index:03d}")
        write_elite(folder, f"{index:03d}", arrays, record)
    with writing(folder):
        for name in set(elite_names(path)) - written:
            (folder / f"{name}.json").unlink()
            (folder / f"{name}.npz").unlink(missing_ok=True)


class _Line(NamedTuple):
    """Of generations.jsonl: the generation, and the bytes that it takes."""

    index: int
    start: int
    length: int


def _lines(path: Path) -> list[_Line]:
    """The file's complete lines; torn and damaged ones are left out."""
    lines, start = [], 0
    with reading(path, _FORGET), path.open("rb") as file:
        for line in file:
            with contextlib.suppress(ValueError, RecursionError):
                record = json.loads(line)
                if isinstance(record, dict) and type(record.get("index")) is int and line.endswith(b"\n"):
                    lines.append(_Line(record["index"], start, len(line)))
            start += len(line)
    return lines


@contextlib.contextmanager
def _prepared(path: Path, config: Config, notes: list[str]) -> Iterator[None]:
    """The folder, made or recognized, locked and clean; `notes` gets what was mended."""
    _mend_mark(path, notes)
    require_own_folder(path, "a run", (path / "format.json").is_file(), {_LOCK})
    make_folder(path)
    with locked(path):
        with writing(path):
            for leftover in path.rglob(".*.tmp"):
                leftover.unlink()
        _claim(path, config)
        _add_start(path, config)
        with writing(path):
            (path / "generations.jsonl").touch()
        yield


def _mend_mark(path: Path, notes: list[str]) -> None:
    """Writes format.json again where it is lost or damaged and all else says that this is a run folder."""
    mark = path / "format.json"
    try:
        read_json(mark, "")
        return
    except UserError:
        others = (path / "config.yaml", path / "provenance.json", path / "generations.jsonl")
        if not all(file.is_file() for file in others) or (mark.exists() and not mark.is_file()):
            return
    config = stored_config(path)
    if "config_hash" in read_json(path / "provenance.json", _FORGET):
        replace_json(mark, mark_of(config))
        notes.append(f"{mark} was lost or damaged, and is written again")


def _claim(path: Path, config: Config) -> None:
    """Writes format.json and config.yaml, or checks those that are there. format.json first: it marks the folder."""
    if not (path / "format.json").is_file():
        replace_json(path / "format.json", mark_of(config))
    require_format(path)
    if task_of(path):
        raise UserError(f"{path} is a task of the run {path.parent.parent}, whose command goes on with it")
    if not (path / "config.yaml").is_file():
        _require_hash(path, configuration.config_hash(config))
        replace(path / "config.yaml", configuration.dump(config).encode())
    changed = configuration.differences(stored_config(path), config)
    if changed:
        keys = [f"  {key}: {old!r} in the folder, {new!r} now" for key, (old, new) in changed.items()]
        head = f"{path} holds a run with another configuration; choose another folder, or set back"
        raise UserError("\n".join([head, *keys]))


def _require_hash(path: Path, mine: str) -> None:
    """Refuses another configuration where config.yaml is lost, by the hashes that other files carry."""
    for file in (path / "provenance.json", path / "initial.json", *sorted((path / "elites").glob("*.json"))):
        theirs = read_json(file, _FORGET).get("config_hash", mine) if file.is_file() else mine
        if theirs != mine:
            raise UserError(
                f"{path} has lost its config.yaml, and {file.name} is of another configuration ({theirs}, this one is "
                f"{mine}); restore config.yaml, give the run's own configuration, or choose another folder"
            )


def _add_start(path: Path, config: Config) -> None:
    file = path / "provenance.json"
    with reading(file, _FORGET):
        starts = list(read_json(file, _FORGET)["starts"]) if file.is_file() else []
    replace_json(file, {"config_hash": configuration.config_hash(config), "starts": [*starts, provenance()]})


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Holds the folder for this process; the system frees it when the process ends, however it ends."""
    with held(path / _LOCK, f"{path}", "wait for it or choose another folder"):
        yield


@contextlib.contextmanager
def _checkpoints(path: Path) -> Iterator[Any]:
    """Orbax's checkpointer; closing it waits for its threads, and tells again of a save that failed."""
    from orbax.checkpoint import v1 as ocp

    kinds = (OSError, ValueError, RecursionError)
    with writing(path, kinds):
        checkpointer = ocp.training.Checkpointer(
            str(path.absolute()),
            preservation_policy=cast(Any, ocp.training.preservation_policies.LatestN(KEPT_STATES)),
            cleanup_tmp_directories=True,
        )
    try:
        yield checkpointer
    finally:
        with writing(path, kinds):
            checkpointer.close()


def _load(checkpointer: Any, checkpoint: Any, state: State) -> State:
    """`state` with the arrays of the same names in the checkpoint.

    Older versions knew fewer volumes, which are NaN till the elites are evaluated again at a search's end, and fewer
    statuses. Anything else that is lacking or of another shape or kind is refused.
    """
    import jax
    import jax.numpy as jnp

    everywhere = jax.tree.leaves(state)[0].sharding
    name_of = partial(jax.tree_util.keystr, simple=True, separator=".")

    def old(path: Any, leaf: Any) -> Any:
        name = name_of(path)
        if name not in by_name and name.rpartition(".")[2] in LATER:
            return jnp.full_like(leaf, np.nan)
        # A loaded array is bound to its devices; a fresh one moves to where the evaluations are.
        array = np.asarray(by_name[name].addressable_data(0))
        if name == "counts":
            array = np.pad(array, (0, len(leaf) - len(array)))
        if (array.shape, array.dtype) != (leaf.shape, leaf.dtype):
            raise ValueError(name)
        return jnp.asarray(array)

    try:
        # Asked for other shapes than the stored ones, Orbax begins to read, and leaves threads and coroutines behind.
        stored = checkpointer.metadata(checkpoint.step).metadata
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=everywhere), stored)
        loaded = jax.tree_util.tree_leaves_with_path(checkpointer.load(checkpoint.step, shapes))
        by_name = {name_of(path): leaf for path, leaf in loaded}
        return jax.tree_util.tree_map_with_path(old, state)
    except (KeyError, ValueError, OSError, RecursionError) as error:
        raise _no_state(checkpoint) from error


def _no_state(checkpoint: Any) -> UserError:
    return UserError(
        f"{checkpoint.path} is no state of this search: it is damaged, or another version or precision wrote it; "
        "go on with what provenance.json names, or choose another folder"
    )
