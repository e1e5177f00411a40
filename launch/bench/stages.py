"""Where the time goes: compilation and CPU time of every stage of the pipeline, and the optimizer's iterations.

Stages are compiled and timed one by one, each on the results of the one before; CPU seconds are those of all threads.
"""

import argparse
from pathlib import Path

import numpy as np
from measure import CONFIG, RESULTS, environment, save

from rtcd_jax.system.devices import prepare_jax


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIG)
    parser.add_argument("--population", type=int, default=128)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    prepare_jax(1)
    from pipeline_stages import stages

    from rtcd_jax.config.load import load

    rows = []
    print(f"{'stage':30}{'compilation [s]':>16}{'CPU ms a candidate':>20}")
    for name, compilation, cpu, iterations in stages(load(arguments.config), arguments.population):
        print(f"{name:30}{compilation:16.1f}{cpu:20.3f}", flush=True)
        rows.append({"stage": name, "compilation_s": compilation, "cpu_ms_per_candidate": cpu})
        if iterations is not None:
            rows[-1]["iterations_in_bins_of_10"] = np.bincount(iterations // 10).tolist()
            median, most = np.quantile(iterations, [0.5, 0.9])
            print(f"  iterations: median {median:.0f}, 90 % below {most:.0f}, {iterations.max()} at most")
            print("  in bins of 10:", *rows[-1]["iterations_in_bins_of_10"])
    record = {"config": arguments.config.name, "population": arguments.population, **environment("jax", "jaxlib")}
    path = save(f"stages_{arguments.config.stem}.json", record | {"stages": rows}, arguments.results)
    print(f"written: {path}")


if __name__ == "__main__":
    main()
