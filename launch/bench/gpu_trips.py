"""Trips of the loops of a GPU's program whose number depends on the numbers, measured on a CPU: for gpu_budget.json.

A GPU advances all candidates of a chunk together until the slowest is done, for every starting guess anew; an advance's
line search goes on until its last candidate accepts. Candidates are uniform in the box of the search. `--lanes device`
runs the GPU's own program on the CPU and counts both; `--lanes cpu`, many times faster, counts the advances alone, as
the most iterations of a candidate.
"""

import argparse
import contextlib
from functools import partial
from pathlib import Path
from unittest import mock

from measure import CONFIG

from rtcd_jax.config.load import Config, load
from rtcd_jax.system.devices import prepare_jax


def trips(config: Config, chunk: int, as_on_gpu: bool) -> tuple[list[int], float | None]:
    """Advances of every start, and the mean trials of an advance's line search."""
    import jax
    import jax.numpy as jnp

    from rtcd_jax.genome import decode
    from rtcd_jax.numerics import interior_point
    from rtcd_jax.numerics.interior_point import DEFAULTS, iteration
    from rtcd_jax.numerics.loops import compiled_for
    from rtcd_jax.problem import make_problem
    from rtcd_jax.trajectory import plan

    advances, trials = [], []
    solve, search = interior_point.solve, iteration.line_search

    def counted_solve(control, parameters, guess, allowance):
        found = solve(control, parameters, guess, allowance)
        most = jnp.max(jnp.where(allowance > 0, found.iterations, 0))
        jax.debug.callback(lambda value: advances.append(int(value)), most)
        return found

    def counted_search(model, s, it, slacks, direction, parameters):
        found = search(model, s, it, slacks, direction, parameters)
        backtracked = jnp.log(found.length / direction.longest) / jnp.log(DEFAULTS.backtracking)
        tried = jnp.where(direction.usable & ~it.solved, 1 + jnp.round(backtracked), 0)
        jax.debug.callback(lambda value: trials.append(int(value)), jnp.max(tried))
        return found

    problem = make_problem(config)
    genomes = jax.random.uniform(jax.random.key(0), (chunk, len(problem.free)))
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(interior_point, "solve", counted_solve))
        if as_on_gpu:
            stack.enter_context(compiled_for("cuda"))
            stack.enter_context(mock.patch.object(iteration, "line_search", counted_search))
        jax.block_until_ready(jax.jit(lambda g: plan(problem, jax.vmap(partial(decode, problem))(g)))(genomes))
    jax.effects_barrier()
    return advances, sum(trials) / len(trials) if trials else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIG)
    parser.add_argument("--chunk", type=int, default=4096)
    parser.add_argument("--lanes", choices=("device", "cpu"), default="cpu")
    arguments = parser.parse_args()
    prepare_jax(1)
    advances, trials = trips(load(arguments.config), arguments.chunk, arguments.lanes == "device")
    mean = sum(advances) / len(advances)
    told = "" if trials is None else f"; line search: {trials:.2f} trials an advance"
    print(f"{arguments.config.stem}, chunk {arguments.chunk}: advances of the starts {advances}, mean {mean:g}{told}")


if __name__ == "__main__":
    main()
