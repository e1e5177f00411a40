"""What predicts robustness? Rank correlations of random candidates' numbers with what they bear in simulation.

Candidates are uniform in the unit box of the search. Of those with a funnel: the volumes and the push margin, nominal
and under the configuration's `uncertainty` (zero where there is no funnel), the least volume of a knot, the input that
the feed-forward leaves, and DIRTREL's l_w (Manchester, Kuindersma, RSS 2017), beside what `rtcd disturb` sees of them.

With `--runs` it tabulates finished runs instead: what each one's best elite bears, by its own record, by `rtcd
tolerance RUN --uncertainty BOX` and by `rtcd disturb RUN`.
"""

import argparse
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from measure import RESULTS, environment, save

from rtcd_jax.system.devices import prepare_jax

CONFIG = Path(__file__).parents[2] / "configs" / "pendulum_robust.yaml"
TARGETS = "largest push", "pushes recovered", "score", "model", "delay", "torque noise", "perturbation", "friction"


def evaluated(config: Path, count: int, seed: int) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Elites by their numbers, of the candidates with a nominal funnel, and their indicators [E] by name."""
    import jax
    import jax.numpy as jnp

    from rtcd_jax.config.load import load
    from rtcd_jax.dirtrel import dirtrel
    from rtcd_jax.elite.elite import Elite
    from rtcd_jax.evaluation import make_evaluate
    from rtcd_jax.problem import make_problem
    from rtcd_jax.run.format import arrays_of, record_of
    from rtcd_jax.system.files import plain
    from rtcd_jax.types import Status
    from rtcd_jax.volume import VOLUMES

    robust = make_problem(load(config))
    nominal = dataclasses.replace(robust, uncertainty=None)
    genomes = jnp.asarray(np.random.default_rng(seed).random((count, len(robust.free))))
    host = {
        name: jax.device_get(jax.jit(make_evaluate(problem))(genomes, jax.random.key(seed)))
        for name, problem in (("nominal", nominal), ("robust", robust))
    }
    inverse_cost = jax.jit(partial(dirtrel, nominal))
    rows = np.flatnonzero(host["nominal"].status == Status.OK)
    elites, indicators = {}, {f"{kind} {name}": [] for kind in host for name in VOLUMES}
    indicators |= {name: [] for name in ("least volume of a knot", "spare input", "1 / DIRTREL's l_w")}
    for row in rows:
        one = jax.tree.map(lambda leaf, row=row: leaf[row], host["nominal"])
        elite = Elite.of(arrays_of(nominal, one), plain(record_of(nominal, one)))
        elites[str(row)] = elite
        for kind, evaluation in host.items():
            for name in VOLUMES:
                indicators[f"{kind} {name}"].append(evaluation.volumes[name][row])
        indicators["least volume of a knot"].append(elite.volumes_per_knot.min())
        indicators["spare input"].append(1 - np.mean(np.abs(elite.u) / elite.u_max))
        indicators["1 / DIRTREL's l_w"].append(float(inverse_cost(one.candidate, one.funnel.policy)))
    return elites, {name: np.array(values) for name, values in indicators.items()}


def simulated(elites: Mapping[str, Any], seed: int) -> dict[str, np.ndarray]:
    """What `rtcd disturb` sees of them [E], by `TARGETS`."""
    from rtcd_jax.analysis.disturb.comparison import Meter, comparison_of, run
    from rtcd_jax.analysis.disturb.experiments import impulse, robustness
    from rtcd_jax.system.console import Console

    comparison = comparison_of(dict(elites), None)
    meter = Meter(Console(), 3000 * len(elites))

    def simulate(rollouts, experiment, settles):
        return run(comparison, rollouts, seed, experiment, meter, settles)

    pushes, robust = impulse(comparison, simulate)["summary"], robustness(comparison, seed, simulate)["summary"]
    found = {
        "largest push": [pushes[name]["largest_at_all_times"] for name in elites],
        "pushes recovered": [pushes[name]["recovered"] for name in elites],
    }
    found |= {target: [robust[name][target] for name in elites] for target in TARGETS[2:]}
    return {name: np.array(values) for name, values in found.items()}


def correlations(indicators: Mapping[str, np.ndarray], targets: Mapping[str, np.ndarray]) -> Iterator[dict[str, Any]]:
    """Spearman's, an indicator a row; None where one of the two is constant."""
    from scipy.stats import spearmanr

    for name, values in indicators.items():
        pairs = {target: (values, truth) for target, truth in targets.items()}
        constant = {target for target, pair in pairs.items() if any(np.ptp(each) == 0 for each in pair)}
        row = {t: None if t in constant else float(spearmanr(*pair).statistic) for t, pair in pairs.items()}
        yield {"indicator": name, **row}


def shown(correlation: float | None) -> str:
    return "-" if correlation is None else f"{correlation:.2f}"


COLUMNS = (
    "sum", "integral", "inlet", "geometric mean", "push margin", "largest factor", "largest push", "pushes recovered",
    "model", "score",
)  # fmt: skip


def borne(run: Path, name: str) -> dict[str, float | None]:
    """What a run's records say of its elite `name` ("000" or "initial"), by `COLUMNS`; None where one is missing."""
    from rtcd_jax.elite.elite import Elite
    from rtcd_jax.system.files import read_json

    def stored(*path: str) -> dict[str, Any]:
        file = run.joinpath(*path)
        return read_json(file, "remove it") if file.is_file() else {}

    elite, who = Elite.read(run, name), "initial" if name == "initial" else "best"
    rows = stored("tolerance", f"{name}.json").get("rows", [])
    whole = next((row for row in rows if row["name"] == "whole box" and row["guarantee"] == "sampled"), {})
    push, robust = (stored("disturbance", f"{each}.json").get("summary", {}) for each in ("impulse", "robustness"))
    push, robust = push.get(who, {}), robust.get(who, {})
    numbers = [elite.volumes.get(each) for each in ("sum", "integral", "inlet", "geometric_mean", "push")]
    numbers += [whole.get("factor"), push.get("largest_at_all_times"), push.get("recovered")]
    return dict(zip(COLUMNS, [*numbers, robust.get("model"), robust.get("score")], strict=True))


def tabulated(runs: Sequence[str]) -> str:
    """Markdown, a run a row: `TITLE=RUN` or `RUN`, with `:initial` behind it for the initial candidate."""
    rows = [["run", *COLUMNS], ["---"] * (len(COLUMNS) + 1)]
    for each in runs:
        title, _, path = each.rpartition("=")
        path, _, name = path.partition(":")
        row = borne(Path(path), name or "000")
        rows.append([title or path, *("-" if value is None else f"{value:.3g}" for value in row.values())])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIG, help="its box, and its uncertainty")
    parser.add_argument("--candidates", type=int, default=48)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    parser.add_argument("--runs", nargs="+", metavar="[TITLE=]RUN[:initial]", help="finished runs to be tabulated")
    arguments = parser.parse_args()
    if arguments.runs:
        print(tabulated(arguments.runs))
        return
    prepare_jax(1)
    elites, indicators = evaluated(arguments.config, arguments.candidates, arguments.seed)
    borne = int(np.sum(indicators["robust sum"] > 0))
    print(f"{len(elites)} of {arguments.candidates} candidates have a funnel, {borne} under the uncertainty")
    rows = list(correlations(indicators, simulated(elites, arguments.seed)))
    print(f"{'rank correlation with':26}" + "".join(f"{target:>17}" for target in TARGETS))
    for row in rows:
        print(f"{row['indicator']:26}" + "".join(f"{shown(row[target]):>17}" for target in TARGETS))
    record = {"environment": environment("jax", "numpy"), "config": arguments.config.name, "candidates": len(elites)}
    record |= {"under_uncertainty": borne, "rows": rows}
    print(save(f"robustness_{arguments.config.stem}.json", record, arguments.results))


if __name__ == "__main__":
    main()
