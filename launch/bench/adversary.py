"""What a box of uncertainty costs a search: CPU time of a candidate under all of it, and under each part, over nominal.

    python launch/bench/adversary.py [--config configs/pendulum_robust.yaml] [--candidates 64]

Candidates are random, near the middle of the unit box. Compilation is apart; the least of four runs counts.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from measure import RESULTS, environment, save

from rtcd_jax.system.devices import prepare_jax

CONFIG = Path(__file__).parents[2] / "configs" / "pendulum_robust.yaml"
PARTS = "input", "input_limit", "age", "plant", "design"
REPEATS, SPREAD = 4, 0.2


def milliseconds(config: dict, count: int) -> float:
    """Of the CPU, for one of `count` candidates at once."""
    import jax
    import jax.numpy as jnp

    from rtcd_jax.config.load import parse
    from rtcd_jax.evaluation import make_evaluate
    from rtcd_jax.problem import make_problem

    problem = make_problem(parse(config))
    drawn = 0.5 + SPREAD * np.random.default_rng(0).normal(size=(count, len(problem.free)))
    genomes, key = jnp.asarray(np.clip(drawn, 0, 1)), jax.random.key(0)
    evaluate = jax.jit(make_evaluate(problem)).lower(genomes, key).compile()
    laps = []
    for _ in range(REPEATS):
        began = time.process_time()
        jax.block_until_ready(evaluate(genomes, key))
        laps.append(time.process_time() - began)
    return 1e3 * min(laps) / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=CONFIG)
    parser.add_argument("--candidates", type=int, default=64)
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    prepare_jax(1)
    from rtcd_jax.config.load import load, resolved

    config = resolved(load(options.config))
    box = config.pop("uncertainty")
    found = {"none": milliseconds(config, options.candidates)}
    boxes = {name: {name: box[name]} for name in PARTS if box[name]} | {"all": box}
    print("| uncertain | CPU ms a candidate | over none |\n|---|---|---|")
    print(f"| nothing | {found['none']:.2f} | 1 |")
    for name, part in boxes.items():
        found[name] = milliseconds(config | {"uncertainty": part}, options.candidates)
        print(f"| {name} | {found[name]:.2f} | {found[name] / found['none']:.2f} |", flush=True)
    record = {"environment": environment("jax", "numpy"), "config": options.config.name, "milliseconds": found}
    print(save(f"adversary_{options.config.stem}.json", record, options.results))


if __name__ == "__main__":
    main()
