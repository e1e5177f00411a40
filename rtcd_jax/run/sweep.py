"""One YAML, many runs: a `sweep` section of dotted keys and their values, and a table of their results.

    sweep:
      product:                          # every combination of
        search.seed: [0, 1, 2]
        search.objective: [sum, inlet]
      zip:                              # with the first values of all, the second of all, …
        trajectory.knots: [51, 101]
        funnel.steps: [5, 3]

Every case has a run folder of its own, named by its number and its values.
"""

import copy
import csv
import io
import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from rtcd_jax.config.load import Config, parse, read_yaml
from rtcd_jax.system.console import table
from rtcd_jax.system.errors import ConfigError, Problem, UserError, closest
from rtcd_jax.system.files import make_folder, read_json, reading, replace
from rtcd_jax.volume import VOLUMES

TABLE = "table.csv"
WAYS = ("product", "zip")
MOST_CASES = 10_000
_RESTORE = "restore it, or make the run again"


@final
@dataclass(frozen=True)
class Case:
    """One run of a sweep: its number, the values it sets by dotted keys, and where it runs."""

    number: int
    values: Mapping[str, Any]
    config: Config
    folder: Path


def read_cases(path: Path, folder: Path) -> list[Case]:
    """The cases of a YAML file with a `sweep` section; their run folders lie in `folder`.

    Raises:
        UserError: no such section, or one that is wrong; `ConfigError` with all errors of the first wrong case.
    """
    data = read_yaml(path)
    if not isinstance(data, dict) or "sweep" not in data:
        raise UserError(f"{path} has no sweep section; `rtcd optimize {path}` makes its one run")
    section = data.pop("sweep")
    problems = list(_problems(section))
    if problems:
        raise ConfigError(problems, str(path))
    cases = []
    for number, values in enumerate(_combinations(section)):
        name = _name(number, values)
        config = parse(_with_values(data, values, path), f"{path}, case {name}")
        cases.append(Case(number, values, config, folder / name))
    return cases


def _problems(section: Any) -> Iterator[Problem]:
    if not isinstance(section, dict) or not section:
        yield Problem(("sweep",), f"must be a mapping with {' or '.join(WAYS)}", section)
        return
    for way, keys in section.items():
        if way not in WAYS:
            yield Problem(("sweep", way), f"unknown key; {closest(way, WAYS)}", keys)
        elif not isinstance(keys, dict) or not keys:
            yield Problem(("sweep", way), "must be a mapping of dotted keys to lists of values", keys)
        else:
            for key, values in keys.items():
                if not isinstance(values, list) or not values:
                    yield Problem(("sweep", way, key), "must be a list of values", values)
    lengths = {key: len(values) for key, values in _of(section, "zip").items() if isinstance(values, list)}
    if len(set(lengths.values())) > 1:
        yield Problem(("sweep", "zip"), "all lists must be of one length", lengths)
    cases = math.prod(len(values) for values in _of(section, "product").values() if isinstance(values, list))
    cases *= max(lengths.values(), default=1)
    if cases > MOST_CASES:
        yield Problem(("sweep",), f"makes {cases} runs, must make {MOST_CASES} at most")
    twice = _of(section, "product").keys() & _of(section, "zip").keys()
    if twice:
        yield Problem(("sweep",), "a key stands in product or in zip, not in both", sorted(twice))


def _of(section: Mapping[str, Any], way: str) -> dict[str, list]:
    keys = section.get(way)
    return keys if isinstance(keys, dict) else {}


def _combinations(section: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    product, zipped = _of(section, "product"), _of(section, "zip")
    rows = list(zip(*zipped.values(), strict=True)) if zipped else [()]
    for values in itertools.product(*product.values()):
        for row in rows:
            yield dict(zip([*product, *zipped], [*values, *row], strict=True))


def _with_values(data: Mapping[str, Any], values: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The configuration with its values set; sections that the file leaves to the defaults are made."""
    changed: dict[str, Any] = copy.deepcopy(dict(data))
    for key, value in values.items():
        *parents, last = key.split(".")
        place: Any = changed
        try:
            for parent in parents:
                place = place[int(parent)] if isinstance(place, list) else place.setdefault(parent, {})
            place[int(last) if isinstance(place, list) else last] = value
        except (AttributeError, IndexError, TypeError, ValueError):
            text = "leads to no place in the file: names of sections and numbers of list entries, joined by dots"
            raise ConfigError([Problem(("sweep", key), text)], str(path)) from None
    return changed


def _name(number: int, values: Mapping[str, Any]) -> str:
    short = {key: key.rpartition(".")[2] for key in values}
    keys = short if len(set(short.values())) == len(short) else {key: key for key in values}
    parts = (f"{keys[key]}={value}" for key, value in values.items())
    return "_".join([f"{number:03d}", *(re.sub(r"[^\w.=+-]+", "-", part).strip("-") for part in parts)])


def show(cases: Sequence[Case]) -> str:
    """A table of the cases: their values, how far they are, and the sampled volume that they maximize, of their
    initial and of their best candidate."""
    rows = [_row(case) for case in cases]
    headings = ("case", *cases[0].values, "generations", "initial", "best", "ratio")
    cells = [_cells(case, row) for case, row in zip(cases, rows, strict=True)]
    return table(headings, cells, "volumes are sampled")


def store(cases: Sequence[Case], folder: Path) -> Path:
    """All volumes of each case as `table.csv` in the folder; the file."""
    rows = [_row(case) for case in cases]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    make_folder(folder)
    replace(folder / TABLE, text.getvalue().encode())
    return folder / TABLE


def _cells(case: Case, row: Mapping[str, Any]) -> list[str]:
    objective = case.config.search.objective
    numbers = (row[f"initial_{objective}"], row[f"best_{objective}"], row["ratio"])
    shown = ("" if number is None else f"{number:.5g}" for number in numbers)
    return [str(case.number), *map(str, case.values.values()), row["generations"], *shown]


def _row(case: Case) -> dict[str, Any]:
    initial, best = (_volumes(case.folder, name) for name in ("initial", "000"))
    objective = case.config.search.objective
    names = dict.fromkeys((*VOLUMES, objective))
    ratio = best[objective] / initial[objective] if best and initial and initial[objective] > 0 else None
    return {
        "case": case.number,
        **case.values,
        "generations": f"{_generations(case.folder)}/{case.config.search.generations}",
        "rung": "sampled" if best else None,
        **{f"initial_{name}": initial.get(name) for name in names},
        **{f"best_{name}": best.get(name) for name in names},
        "ratio": ratio,
        "run": case.folder.name,
    }


def _generations(folder: Path) -> int:
    """How many are done, by the last complete line: earlier ones may be lost."""
    path = folder / "generations.jsonl"
    lines = path.read_bytes().splitlines(keepends=True) if path.is_file() else []
    complete = [line for line in lines[-2:] if line.endswith(b"\n")]
    with reading(path, _RESTORE):
        return int(json.loads(complete[-1])["index"]) + 1 if complete else 0


def _volumes(folder: Path, name: str) -> dict[str, float]:
    from rtcd_jax.elite.records import elite_folder

    record = elite_folder(folder, name) / f"{name}.json"
    with reading(record, _RESTORE):
        return read_json(record, _RESTORE)["volumes"] if record.is_file() else {}
