"""`rtcd disturb`: the paper's experiments in simulation, the initial candidate beside the best one.

off_nominal   success shares from uniform states of the first ellipsoids (the paper's simulation test)
impulse       a push during the motion, over its time and size (the paper's hardware test)
push_margin   the largest sudden push that the funnel contains at each time, beside the largest one recovered from
robustness    model errors, noise, delay, slow motors, low control rates, perturbations, and a score
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rtcd_jax.analysis.disturb.comparison import Comparison, Meter, motions, read_comparison, run
from rtcd_jax.analysis.disturb.experiments import (
    FACTORS,
    KICKS,
    SIZES,
    TIMES,
    impulse,
    off_nominal,
    perturbations,
    push_margin,
    robustness,
)
from rtcd_jax.analysis.disturb.figures import draw_disturbance
from rtcd_jax.analysis.disturb.scenarios import Outcome, Rollouts
from rtcd_jax.elite.records import require_elites, require_held_goal
from rtcd_jax.system.console import Console
from rtcd_jax.system.devices import require_devices
from rtcd_jax.system.files import make_folder, replace_json


def disturb_run(folder: Path, states: int, seed: int, console: Console) -> None:
    """Runs all experiments; stores `disturbance/{off_nominal,impulse,push_margin,robustness}.json` and their figures.

    Raises:
        UserError: no run folder, a run without elites, one whose motions end in a catch set, a folder that cannot be
            read or written, or other devices than JAX_PLATFORMS or Slurm says.
    """
    require_devices()
    require_elites(folder)
    require_held_goal(folder, "disturb")
    comparison = read_comparison(folder, console)
    place = folder / "disturbance"
    make_folder(place)
    meter = Meter(console, _all_motions(comparison, states))

    def simulate(rollouts: Rollouts, experiment: str, settles: bool) -> Outcome:
        return run(comparison, rollouts, seed, experiment, meter, settles)

    records = {
        "off_nominal": off_nominal(comparison, states, seed, simulate),
        "impulse": impulse(comparison, simulate),
        "push_margin": push_margin(comparison, simulate),
        "robustness": robustness(comparison, seed, simulate),
    }
    of_run = {"config_hash": comparison.config_hash, "plant": comparison.elites[0].plant}
    for name, record in records.items():
        replace_json(place / f"{name}.json", of_run | record)
    pictures = draw_disturbance(folder)
    for line in _summary(comparison, records):
        console.message(line)
    console.message(f"{len(records)} records and {len(pictures)} figures in {place}")


def _all_motions(comparison: Comparison, states: int) -> int:
    loops = len(comparison.names)
    robust = sum(len(perturbation.levels) * perturbation.repeats for perturbation in perturbations(comparison))
    pushes = loops * TIMES * SIZES, loops * TIMES * KICKS * 2
    return sum(map(motions, (len(FACTORS) * loops**2 * states, *pushes, loops * robust)))


def _summary(comparison: Comparison, records: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    off, push, sudden, robust = (
        records[name]["summary"] for name in ("off_nominal", "impulse", "push_margin", "robustness")
    )
    heading = "".join(f"{name:>12}" for name in comparison.names)
    yield f"{'arrived from (sampled)':30}{heading}"
    for place, shares in off.items():
        yield f"  {place:28}" + "".join(f"{shares[name]:12.1%}" for name in comparison.names)
    yield f"{'pushes':30}{heading}"
    yield f"{'  recovered':30}" + "".join(f"{push[name]['recovered']:12.1%}" for name in comparison.names)
    unit = f"[{comparison.plant.input_units[0]} s]"
    for what, summary, key in (
        ("all tolerated up to", push, "largest_at_all_times"),
        ("sudden ones up to", sudden, "tolerated_at_all_times"),
        ("inside the funnel", sudden, "push_margin"),
    ):
        yield f"{f'  {what} {unit}':30}" + "".join(f"{summary[name][key]:12.3g}" for name in comparison.names)
    yield f"{'robustness':30}{heading}"
    for criterion in robust[comparison.names[0]]:
        shares = "".join(f"{robust[name][criterion]:12.1%}" for name in comparison.names)
        yield f"  {criterion:28}{shares}"
