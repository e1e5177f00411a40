"""Trajectories of random candidates, robot by robot: shares solved, iterations, CPU time, compilation.

The candidates are uniform in the unit box of the search, from seeds that were used for no choice in the optimizer.
"""

import argparse
from functools import partial
from pathlib import Path

import numpy as np
from measure import RESULTS, environment, save
from robots import ROBOTS, problem_of

from rtcd_jax.analysis.scale.clock import timed
from rtcd_jax.system.devices import prepare_jax

SEED = 20261129


def measure(robot: str, count: int, seed: int) -> dict[str, float | str]:
    """`plan` on `count` random candidates; iterations are those of the kept start of the candidates that are solved."""
    import jax
    import jax.numpy as jnp

    from rtcd_jax.genome import decode
    from rtcd_jax.trajectory import plan
    from rtcd_jax.types import Status

    problem = problem_of(robot)
    genomes = jnp.asarray(np.random.default_rng(seed).random((count, len(problem.free))))
    candidates = jax.vmap(partial(decode, problem))(genomes)
    compiled, compilation = timed(lambda: jax.jit(partial(plan, problem)).lower(candidates).compile())
    trajectories, call = timed(lambda: jax.block_until_ready(compiled(candidates)))
    solved = np.asarray(trajectories.status) == Status.OK
    iterations = np.asarray(trajectories.iterations)[solved]
    median, most = np.quantile(iterations, [0.5, 0.9])
    return {
        "robot": robot,
        "starts": problem.config.trajectory.starts,
        "solved": int(solved.sum()),
        "iterations_median": float(median),
        "iterations_p90": float(most),
        "cost_median": float(np.median(np.asarray(trajectories.cost)[solved])),
        "cpu_ms_per_candidate": 1e3 * call.cpu / count,
        "compilation_cpu_s": compilation.cpu,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", nargs="+", choices=tuple(ROBOTS), default=tuple(ROBOTS))
    parser.add_argument("--candidates", type=int, default=1024)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    prepare_jax(1, cache="")  # a kept program would not be compiled
    rows = []
    print("robot      starts        solved  iterations, p90       cost  CPU ms  compiles")
    for robot in arguments.robots:
        row = measure(robot, arguments.candidates, arguments.seed)
        print(
            f"{row['robot']:10} {row['starts']:6} {row['solved']:>5} of {arguments.candidates:<5}"
            f"{row['iterations_median']:10.0f} {row['iterations_p90']:6.0f} {row['cost_median']:10.2f} "
            f"{row['cpu_ms_per_candidate']:7.1f} {row['compilation_cpu_s']:7.0f} s",
            flush=True,
        )
        rows.append(row)
    record = {"candidates": arguments.candidates, "seed": arguments.seed, **environment("jax", "jaxlib"), "rows": rows}
    print(f"written: {save('trajectories.json', record, arguments.results)}")


if __name__ == "__main__":
    main()
