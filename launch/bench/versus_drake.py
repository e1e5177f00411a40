"""CPU seconds per pendulum candidate: the classical pipeline written with Drake, beside rtcd_jax, in the same run.

The classical side evaluates the config's initial candidate, the paper's two optima and random candidates of the
config's box, one by one in one thread; a candidate that fails counts with the time until then. rtcd_jax evaluates a
population of random candidates of the same box, compilation apart. CPU time is that of all threads.
"""

import argparse
import os
from dataclasses import asdict
from pathlib import Path
from statistics import fmean, median

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy loads its BLAS: the classical side has one thread

import classical
import numpy as np
from measure import CONFIG, RESULTS, environment, measure_pipeline, save

from rtcd_jax.config.load import Config, load

# mass [kg], length [m], diagonal of Q, R: Girlanda et al., section III
PAPER = {
    "paper RTC": (0.7, 0.4, 9.50228149856, 1.19799233059, 1.63899990462),
    "paper RTC-D": (0.6078624798988952, 0.40117256711300914, 9.981383224646017, 1.0005008747137005, 3.3867989083644128),
}


def candidates(config: Config, count: int) -> dict[str, classical.Candidate]:
    """The config's initial candidate, the paper's two optima, and `count` random ones, weights on a log scale."""
    variables = config.variables()
    rows = {"initial": tuple(variable.initial for variable in variables.values())} | PAPER
    low, high = np.array([(variable.min, variable.max) for variable in variables.values()]).T
    is_weight = np.array([key.startswith("weights.") for key in variables])
    for i, unit in enumerate(np.random.default_rng(0).random((count, len(variables)))):
        rows[f"random {i}"] = tuple(np.where(is_weight, low * (high / low) ** unit, low + unit * (high - low)).tolist())
    return {
        name: classical.Candidate(mass, length, (q_angle, q_rate), r, config)
        for name, (mass, length, q_angle, q_rate, r) in rows.items()
    }


def ours(config: Path, population: int, repeats: int) -> dict:
    """CPU seconds per candidate of rtcd_jax's whole pipeline, the median of `repeats` calls; compilation apart."""
    measured = measure_pipeline(config, population, repeats)
    return {"cpu_s_per_candidate": median(call.cpu for call in measured.calls) / population} | asdict(measured)


def print_classical(records: dict[str, dict]) -> None:
    print(f"{'candidate':<12} {'trajectory':>11} {'LQR':>8} {'funnel':>8} {'total':>8}   [CPU s]")
    for name, record in records.items():
        seconds = (f"{record['cpu_s'].get(step, 0.0):.3f}" for step in ("trajectory", "lqr", "funnel", "total"))
        outcome = (
            record.get("failure") or f"sum of areas {record['sum_of_areas']:.1f}, inlet {record['inlet_area']:.4f}"
        )
        print("{:<12} {:>11} {:>8} {:>8} {:>8}   {}".format(name, *seconds, outcome))


def parse_arguments() -> tuple[argparse.Namespace, Config]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIG, help="a pendulum's experiment")
    parser.add_argument("--candidates", type=int, default=8, help="random ones, beside the initial and the paper's two")
    parser.add_argument("--population", type=int, default=1024, help="candidates that rtcd_jax evaluates at once")
    parser.add_argument("--repeats", type=int, default=5, help="timed calls of rtcd_jax")
    parser.add_argument("--cost", choices=classical.COSTS, default="integral", help="of the classical trajectory")
    parser.add_argument("--only", choices=("classical", "ours"), help="run one half")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    config = load(arguments.config)
    if config.plant.name != "pendulum":
        parser.error(f"--config {arguments.config}: plant.name = {config.plant.name!r}; must be 'pendulum'")
    return arguments, config


def main() -> None:
    arguments, config = parse_arguments()
    record: dict = {"config": arguments.config.name, "cost": arguments.cost, **environment("drake", "numpy", "jax")}
    if arguments.only != "ours":
        chosen = candidates(config, arguments.candidates)
        record["classical"] = {name: classical.evaluate(one, arguments.cost) for name, one in chosen.items()}
        print_classical(record["classical"])
        record["classical_cpu_s"] = fmean(one["cpu_s"]["total"] for one in record["classical"].values())
        print(f"classical: {record['classical_cpu_s']:.3f} CPU s per candidate, mean of {len(chosen)}")
    if arguments.only != "classical":
        record["ours"] = ours(arguments.config, arguments.population, arguments.repeats)
        record["ours_cpu_s"] = record["ours"]["cpu_s_per_candidate"]
        print(f"rtcd_jax: {record['ours_cpu_s']:.6f} CPU s per candidate, population {arguments.population}")
    if arguments.only is None:
        record["ratio"] = record["classical_cpu_s"] / record["ours_cpu_s"]
        print(f"ratio of CPU time per candidate: {record['ratio']:.0f}")
    name = "_".join(filter(None, ("versus_drake", arguments.cost, arguments.only)))
    print(f"written: {save(name + '.json', record, arguments.results)}")


if __name__ == "__main__":
    main()
