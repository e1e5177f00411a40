"""A search where others look on: every generation's numbers for TensorBoard, or for Weights & Biases offline.

What is written is made anew from generations.jsonl at every start: a run that was stopped and cut back to its last
checkpoint shows every generation once. The packages are optional extras.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from rtcd_jax.elite.records import read_generations

Kind = Literal["tensorboard", "wandb"]
Show = Callable[[Mapping[str, Any]], None]
"""Takes a generation as generations.jsonl has it."""
VOLUMES = ("best_so_far", "best", "median")


@contextlib.contextmanager
def log(kind: Kind | None, folder: Path) -> Iterator[Show]:
    """What takes the generations of the run in `folder`, those that it has first; it does nothing without a `kind`."""
    if kind is None:
        yield lambda record: None
        return
    with _WRITERS[kind](folder) as write:

        def show(record: Mapping[str, Any]) -> None:
            write(int(record["index"]), numbers(record))

        for record in read_generations(folder) if (folder / "generations.jsonl").is_file() else ():
            show(record)
        yield show


def numbers(record: Mapping[str, Any]) -> dict[str, float]:
    """The curves of a generation by their names: volumes of the searched kind, shares in %, step size, evaluations.

    A volume that no candidate has is left out.
    """
    objective, counts = record["objective"], record["counts"]
    curves = {f"{objective}/{name}": record[name] for name in VOLUMES}
    curves |= {f"candidates_percent/{name}": 100 * count / sum(counts.values()) for name, count in counts.items()}
    curves |= {f"search/{name}": record[name] for name in ("sigma", "evaluations", "restarts")}
    return {name: float(value) for name, value in curves.items() if value is not None and value == value}


@contextlib.contextmanager
def _tensorboard(folder: Path) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """`tensorboard --logdir FOLDER/tensorboard` shows it; what an earlier start wrote is replaced."""
    from tensorboardX import SummaryWriter  # pyright: ignore[reportMissingImports]

    place = folder / "tensorboard"
    for old in place.glob("events.out.tfevents.*"):
        old.unlink()
    with SummaryWriter(str(place)) as writer:

        def write(step: int, curves: Mapping[str, float]) -> None:
            for name, value in curves.items():
                writer.add_scalar(name, value, step)
            writer.flush()

        yield write


@contextlib.contextmanager
def _wandb(folder: Path) -> Iterator[Callable[[int, Mapping[str, float]], None]]:
    """Nothing leaves the machine: `wandb sync FOLDER/wandb/offline-run-…` uploads it, one such folder a start."""
    import wandb  # pyright: ignore[reportMissingImports]

    settings = wandb.Settings(mode="offline", silent=True)
    run = wandb.init(project="rtcd_jax", name=folder.resolve().name, dir=str(folder), settings=settings)
    try:
        yield lambda step, curves: run.log(dict(curves), step=step)
    finally:
        run.finish()


_WRITERS: Mapping[Kind, Callable[[Path], Any]] = {"tensorboard": _tensorboard, "wandb": _wandb}
