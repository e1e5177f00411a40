"""The folder of one task in a run for several: it reads as a finished run for this task alone."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rtcd_jax.config.load import Config, config_hash, dump
from rtcd_jax.elite.records import INITIAL, TASKS, Arrays, Record, mark_of, read_generations, write_elite
from rtcd_jax.run.folder import write_elites
from rtcd_jax.system.files import make_folder, plain, read_json, replace, replace_json
from rtcd_jax.types import Status

_RESTORE = "restore it, or make the run again"


def store_task(
    run: Path, name: str, config: Config, own: Callable[[np.ndarray], np.ndarray],
    elites: Sequence[tuple[Arrays, Record]], initial: tuple[Arrays, Record],
) -> None:  # fmt: skip
    """Writes `run`/tasks/NAME: mark, configuration, provenance, the search as this task saw it, its candidates; `own`
    is what of a genome is its own.
    """
    folder = run / TASKS / name
    make_folder(folder)
    replace_json(folder / "format.json", mark_of(config, name))
    replace(folder / "config.yaml", dump(config).encode())
    provenance = read_json(run / "provenance.json", _RESTORE)
    replace_json(folder / "provenance.json", provenance | {"config_hash": config_hash(config)})
    lines = (json.dumps(plain(line), allow_nan=False) for line in generations_of(read_generations(run), name, own))
    replace(folder / "generations.jsonl", "".join(f"{line}\n" for line in lines).encode())
    write_elites(folder, elites)
    write_elite(folder, INITIAL, *initial)


def generations_of(
    generations: Sequence[Mapping[str, Any]], task: str, of_task: Callable[[np.ndarray], np.ndarray]
) -> Iterator[dict[str, Any]]:
    """A run's generations as one task saw them: its own volumes, statuses and shares; those of the best candidates are
    of the ones that are best over all tasks.
    """
    best_so_far = None
    for line in generations:
        own, objective = line["tasks"][task], line["objective"]
        volumes, ranked = own["volumes"][objective], None
        if line["best"] is not None:
            ranked = line["volumes"][objective].index(line["best"])
            if line["best"] == line["best_so_far"]:
                best_so_far = volumes[ranked]
        statuses, known = np.array(own["statuses"]), [volume for volume in volumes if volume is not None]
        counts = {status.name: count for status in Status if (count := int(np.sum(statuses == status)))}
        yield (
            {key: value for key, value in line.items() if key != "tasks"}
            | own
            | {
                "genomes": of_task(np.array(line["genomes"])),
                "best": None if ranked is None else volumes[ranked],
                "median": float(np.median(known)) if known else None,
                "best_so_far": best_so_far,
                "feasible": len(known) / len(volumes),
                "counts": counts,
            }
        )
