"""The paper's candidates under rtcd_jax's own estimator, as thorough as for the elites of a run.

    python launch/bench/published.py [pendulum | cartpole | off_the_rail]

Prints the four volumes (sampled) of the initial candidate and of the published optima, each with its ratio to the
initial one's, and the largest knot's share of the sum: what the best of a run has to be compared with. Off the rail
the cart-pole's nominal motion stays on it and its funnel does not, as in the paper; two candidates more, the best of a
search on the rail and a corner of the weights' box, show what the rail costs.
"""

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp

from rtcd_jax.system.devices import prepare_jax

CONFIGS = Path(__file__).parents[2] / "configs"
CANDIDATES = {  # the design variables, then the diagonals of Q and R (paper, table I and the authors' results)
    "pendulum": {
        "initial": (0.7, 0.4, 10.0, 1.0, 0.1),
        "paper RTC": (0.7, 0.4, 9.50228149856, 1.19799233059, 1.63899990462),
        "paper RTC-D": (0.6078624798988952, 0.40117256711300914, 9.981383224646017, 1.0005008747137005, 3.38679890836),
    },
    "cartpole": {
        "initial": (0.1778, 0.227, 10.0, 10.0, 1.0, 1.0, 10.0),
        "paper RTC": (0.1778, 0.227, 10.9115773954839, 12.574189978778616, 1.0, 1.0, 6.091846874535788),
    },
}
CANDIDATES["off_the_rail"] = CANDIDATES["cartpole"] | {
    "RTC on the rail": (0.1778, 0.227, 19.34430056820924, 18.47011136549989, 1.0, 1.0, 5.008315360712838),
    "a corner": (0.1778, 0.227, 1.0, 20.0, 1.0, 1.0, 5.0),
}
FAR = 2.0
"""[m]: the funnels' own extent along the rail."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robot", nargs="?", choices=CANDIDATES, default="pendulum")
    robot = parser.parse_args().robot
    prepare_jax(1)
    from rtcd_jax.config.load import load
    from rtcd_jax.evaluation import elite_budget, elite_key, make_evaluate
    from rtcd_jax.genome import encode
    from rtcd_jax.problem import make_problem
    from rtcd_jax.volume import VOLUMES

    config = off_the_rail(load(_config("cartpole"))) if robot == "off_the_rail" else load(_config(robot))
    problem = make_problem(config)
    evaluate = jax.jit(make_evaluate(problem, elite_budget))
    found = {}
    for name, values in CANDIDATES[robot].items():
        genome = jnp.asarray(encode(problem, values))
        found[name] = jax.tree.map(lambda leaf: leaf[0], evaluate(genome[None], elite_key()))
    print(f"{'volume (sampled)':16}" + "".join(f"{name:>24}" for name in found))
    for name in VOLUMES:
        values = [float(evaluation.volumes[name]) for evaluation in found.values()]
        print(f"{name:16}" + "".join(f"{value:14.5g} x{value / values[0]:8.2f}" for value in values))
    shares = [float(evaluation.volumes.per_knot.max() / evaluation.volumes["sum"]) for evaluation in found.values()]
    print(f"{'largest knot':16}" + "".join(f"{share:24.1%}" for share in shares))


def _config(robot: str) -> Path:
    return CONFIGS / f"{robot}_rtcd.yaml"


def off_the_rail(config):
    """The cart-pole's configuration with the same nominal motions and a rail that no funnel reaches."""
    rail, *rest = config.task.state_limits
    task = config.task.model_copy(update={"state_limits": (FAR, *rest)})
    share = config.trajectory.limit_share * rail / FAR
    return config.model_copy(
        update={"task": task, "trajectory": config.trajectory.model_copy(update={"limit_share": share})}
    )


if __name__ == "__main__":
    main()
