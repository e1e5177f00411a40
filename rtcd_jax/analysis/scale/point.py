"""One point of a scaling study, in a process of its own:

    python -m rtcd_jax.analysis.scale.point CONFIG POPULATION DEVICES REPEATS

Whole generations as a run makes them: asked for, evaluated, told, written. The last line is JSON. On a CPU the process
keeps to as many cores as it has devices, so that each device is a core. Wall times are [s], memory is [bytes].
"""

import json
import os
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

from rtcd_jax.system.devices import prepare_jax


def main(config: str, population: str, devices: str, repeats: str) -> None:
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(devices)])
    prepare_jax(int(devices))
    print(json.dumps(measure(Path(config), int(population), int(devices), int(repeats))))


def measure(path: Path, population: int, devices: int, repeats: int) -> dict[str, Any]:
    """Times of `repeats` generations after the first one, which compiles."""
    import jax

    from rtcd_jax.analysis.scale.clock import peak_memory, timed
    from rtcd_jax.config.load import load
    from rtcd_jax.evaluation import device_chunk, make_evaluate
    from rtcd_jax.genome import initial_genome
    from rtcd_jax.problem import make_problem
    from rtcd_jax.run.folder import RunFolder
    from rtcd_jax.run.sharding import ShardedEvaluate
    from rtcd_jax.search import search
    from rtcd_jax.system.cluster import Cluster

    config = load(path)
    settings = config.search.model_copy(update={"population": population, "mode": "joint"})
    config = config.model_copy(update={"search": settings})
    problem, cluster = make_problem(config), Cluster.of(devices)
    chunk = device_chunk(problem, -(-population // devices), cluster.memory)
    evaluate_sharded, evaluations = ShardedEvaluate(make_evaluate(problem), cluster, chunk), []

    def evaluate(genomes, key):
        evaluation, took = timed(lambda: evaluate_sharded(genomes, key))
        evaluations.append(took)
        return evaluation

    plan = search.Plan(settings, config.elites, tuple(initial_genome(problem).tolist()), problem.design_dims)
    state = search.start(plan, evaluate_sharded.example(len(problem.free)))
    steps, writes = [], []
    with tempfile.TemporaryDirectory() as folder, RunFolder.open(Path(folder) / "run", config, cluster) as run:
        for _ in range(repeats + 1):
            (state, generation), step = timed(lambda state=state: search.step(plan, evaluate, state))
            _, write = timed(lambda generation=generation: run.append(generation.record()))
            steps.append(step)
            writes.append(write)
        run.save(state, repeats)
        _, save = timed(lambda: run.save(state, repeats + 1))
    walls = [step.wall + write.wall for step, write in zip(steps[1:], writes[1:], strict=True)]
    evaluated = [took.wall for took in evaluations[1:]]
    device = jax.devices()[0]
    memory = (device.memory_stats() or {}).get("peak_bytes_in_use")
    return {
        "population": population,
        "devices": devices,
        "kind": device.device_kind,
        "chunk": chunk,
        "compilation": max(0.0, steps[0].wall - statistics.median(walls)),
        "generations": walls,
        "evaluation": evaluated,
        "search": [step.wall - took for step, took in zip(steps[1:], evaluated, strict=True)],
        "lines": [write.wall for write in writes[1:]],
        "checkpoint": save.wall,
        "checkpoint_every": config.checkpoint.seconds,
        "cpu": [step.cpu for step in steps[1:]],
        "feasible": generation.feasible,
        "peak_memory": peak_memory(),
        "peak_device_memory": memory,
    }


if __name__ == "__main__":
    main(*sys.argv[1:])
