"""What a box of uncertainty costs a search: CPU time of a candidate under all of it, and under each part, over nominal.

    python launch/bench/adversary.py [--config configs/pendulum_robust.yaml] [--candidates 64]

Candidates are uniform in the unit box of the search. Compilation is apart; the least of four calls counts.
"""

import argparse
from pathlib import Path
from typing import Any

from measure import RESULTS, as_script, environment, measure_pipeline, save

from rtcd_jax.config.load import load, parse, resolved
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder

CONFIG = Path(__file__).parents[2] / "configs" / "pendulum_robust.yaml"
PARTS = "input", "input_limit", "age", "plant", "design"
REPEATS = 4


def milliseconds(config: dict[str, Any], count: int) -> float:
    """Of the CPU, for one of `count` candidates at once."""
    measured = measure_pipeline(parse(config), count, REPEATS)
    return 1e3 * min(call.cpu for call in measured.calls) / count


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=CONFIG)
    parser.add_argument("--candidates", type=int, default=64)
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    stated = load(options.config)
    if stated.uncertainty.empty:
        raise UserError(f"{options.config}: states no uncertainty")
    make_folder(options.results)  # before minutes of work that could not be written
    config = resolved(stated)
    box = config.pop("uncertainty")
    boxes = {"nothing": {}} | {name: {name: box[name]} for name in PARTS if box[name]} | {"all": box}
    found: dict[str, float] = {}
    print("| uncertain | CPU ms a candidate | over none |\n|---|---|---|")
    for name, part in boxes.items():
        found[name] = milliseconds(config | {"uncertainty": part}, options.candidates)
        print(f"| {name} | {found[name]:.2f} | {found[name] / found['nothing']:.2f} |", flush=True)
    record = {"environment": environment("jax", "numpy"), "config": options.config.name, "milliseconds": found}
    print(save(f"adversary_{options.config.stem}.json", record, options.results))


if __name__ == "__main__":
    as_script(main)
