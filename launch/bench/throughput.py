"""Candidates per second of rtcd_jax's whole pipeline, and its memory, against the size of the population.

Every population runs in a process of its own, so that its peak memory is its own. Compilation is timed apart.
"""

import argparse
import multiprocessing
from dataclasses import asdict
from pathlib import Path
from statistics import median

from measure import CONFIG, RESULTS, Measured, environment, measure_pipeline, save

MEGABYTE = 2**20


def summary(measured: Measured) -> dict[str, float]:
    """Rates of the median call, their spread over the calls, and memory for one candidate."""
    size = measured.population
    rates = [size / call.wall for call in measured.calls]
    return {
        "candidates_per_second": size / median(call.wall for call in measured.calls),
        "candidates_per_second_min": min(rates),
        "candidates_per_second_max": max(rates),
        "cpu_ms_per_candidate": 1e3 * median(call.cpu for call in measured.calls) / size,
        "temporaries_kb_per_candidate": measured.temporaries / size / 1024,
        "resident_growth_kb_per_candidate": (measured.resident_peak - measured.resident_before) / size / 1024,
    }


def print_table(runs: list[Measured]) -> None:
    print(
        f"{'population':>10} {'compile':>9} {'candidates/s':>13} {'min .. max':>19} {'CPU/candidate':>14} "
        f"{'temporaries':>12} {'peak RSS':>10} {'funnels':>8}"
    )
    for run in runs:
        row = summary(run)
        spread = f"{row['candidates_per_second_min']:.1f} .. {row['candidates_per_second_max']:.1f}"
        print(
            f"{run.population:>10} {run.compilation.wall:>7.1f} s {row['candidates_per_second']:>13.1f} {spread:>19} "
            f"{row['cpu_ms_per_candidate']:>11.2f} ms {run.temporaries / MEGABYTE:>9.1f} MB "
            f"{run.resident_peak / MEGABYTE:>7.0f} MB {run.with_funnel:>8.1%}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIG)
    parser.add_argument("--populations", type=int, nargs="+", default=[1, 64, 1024])
    parser.add_argument("--repeats", type=int, default=5, help="timed calls of each population")
    parser.add_argument("--rollouts", choices=("closed_form", "mjx", "mixed"), help="instead of the configuration's")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as fresh:
        jobs = [
            (arguments.config, population, arguments.repeats, arguments.rollouts)
            for population in arguments.populations
        ]
        runs = fresh.starmap(measure_pipeline, jobs, chunksize=1)
    print_table(runs)
    record = {
        "config": arguments.config.name,
        "rollouts": arguments.rollouts,
        **environment("jax", "jaxlib"),
        "runs": [asdict(run) | summary(run) for run in runs],
    }
    print(f"written: {save('throughput.json', record, arguments.results)}")


if __name__ == "__main__":
    main()
