"""What the benchmarks share: the clock's surroundings, rtcd_jax's compiled pipeline, its timing, a JSON file."""

import datetime
import json
import os
import platform
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, NoReturn

from rtcd_jax.analysis.scale.clock import Timed, peak_memory, timed
from rtcd_jax.config.load import Config, load
from rtcd_jax.system.devices import prepare_jax
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder

RESULTS = Path(__file__).parent / "results"
CONFIG = Path(__file__).parents[2] / "configs" / "pendulum_rtcd.yaml"


def environment(*packages: str) -> dict[str, Any]:
    """Date, processor, load and versions, without which a time means nothing."""
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "cpu": cpu_model(),
        "cores": os.cpu_count(),
        "load_1min": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "versions": {name: metadata.version(name) for name in packages},
    }


def cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return platform.processor() or platform.machine()
    return next(line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line)


def save(name: str, record: dict[str, Any], folder: Path = RESULTS) -> Path:
    make_folder(folder)
    path = folder / name
    path.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return path


def as_script(main: Callable[[], int | None]) -> NoReturn:
    """Ends with main's exit code, or with a line about what it was given."""
    try:
        sys.exit(main())
    except UserError as error:
        sys.exit(str(error))


@dataclass(frozen=True)
class Measured:
    """rtcd_jax's pipeline for one population: compilation, repeated calls on fresh genomes, memory [bytes]."""

    population: int
    device: str
    compilation: Timed
    calls: tuple[Timed, ...]
    with_funnel: float
    temporaries: int
    resident_before: int
    resident_peak: int


def measure_pipeline(config: Path | Config, population: int, repeats: int, rollouts: str | None = None) -> Measured:
    """Compile the evaluation of `population` genomes once, then time `repeats` calls, each with other genomes.

    `rollouts` takes the place of the configuration's `funnel.rollouts`.
    Genomes are uniform in the unit box of the search. `with_funnel` is the share of candidates whose status is OK.
    """
    prepare_jax(1)
    import jax

    from rtcd_jax.evaluation import make_evaluate
    from rtcd_jax.problem import make_problem
    from rtcd_jax.types import Status

    settings = load(config) if isinstance(config, Path) else config
    if rollouts is not None:
        funnel = settings.funnel.model_copy(update={"rollouts": rollouts})
        settings = settings.model_copy(update={"funnel": funnel})
    evaluate = jax.jit(make_evaluate(make_problem(settings)))
    shape = population, sum(variable.free for variable in settings.variables().values())
    genomes = [jax.random.uniform(jax.random.key(i), shape) for i in range(repeats + 1)]
    key = jax.random.key(repeats + 1)
    compiled, compilation = timed(lambda: evaluate.lower(genomes[0], key).compile())
    resident = peak_memory()
    jax.block_until_ready(compiled(genomes[0], key))  # the first call pays for the allocation
    calls, feasible = [], 0
    for batch in genomes[1:]:
        evaluations, call = timed(lambda batch=batch: jax.block_until_ready(compiled(batch, key)))
        calls.append(call)
        feasible += int((evaluations.status == Status.OK).sum())
    return Measured(
        population=population,
        device=jax.devices()[0].device_kind,
        compilation=compilation,
        calls=tuple(calls),
        with_funnel=feasible / (repeats * population),
        temporaries=compiled.memory_analysis().temp_size_in_bytes,
        resident_before=resident,
        resident_peak=peak_memory(),
    )
