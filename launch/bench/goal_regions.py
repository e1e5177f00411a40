"""Goal regions of the packaged robots: the level up to which V falls in samples, and the one that is proved exactly.

    python launch/bench/goal_regions.py [ROBOT…]

The design, the weights and the limits are those that a robot's configuration begins with, V and the controller are its
LQR's. Volumes in the product of the states' units; CPU-seconds of one thread.
"""

import math
import os
import sys
import time
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = "1"

import numpy as np
from scipy.linalg import solve_continuous_are

from rtcd_jax.certificate import check
from rtcd_jax.certificate.prove.closed_loop import Loop, claim_of, double, with_digests
from rtcd_jax.certificate.prove.field import linear
from rtcd_jax.certificate.prove.goal import goal_region
from rtcd_jax.certificate.prove.levels import goal_level, unit_directions
from rtcd_jax.certificate.prove.robot import claimed_robot
from rtcd_jax.config.load import load
from rtcd_jax.config.plants import RobotPlant
from rtcd_jax.config.robot import value_of
from rtcd_jax.elite.elite import Elite

CONFIGS = Path(__file__).parents[2] / "configs"
ROBOTS = ("acrobot", "pendubot", "furuta", "reaction_wheel")


def regulated(name: str) -> Elite:
    """The robot at its goal for one interval, under its LQR."""
    config: Any = load(CONFIGS / f"{name}.yaml")
    assert isinstance(config.plant, RobotPlant)
    robot, values = config.plant.robot(), config.plant.values()
    values |= {key: variable.initial for key, variable in config.design.items()}
    goal, n = np.array(config.task.goal, float), len(config.task.goal)
    q, r = np.diag([weight.initial for weight in config.weights.q]), np.array([[config.weights.r[0].initial]])
    arrays = {
        "time": np.array([0.0, 0.01]), "x": np.array([goal] * 2), "u": np.zeros((1, 1)), "K": np.zeros((2, 1, n)),
        "S": np.array([np.eye(n)] * 2), "rho": np.ones(2), "Q": q, "R": r, "K_goal": np.zeros((1, n)), "x_goal": goal,
        "u_max": np.array([value_of(robot.limits[0], values)]), "volumes_per_knot": np.ones(2),
    }  # fmt: skip
    limits = [None if np.isinf(limit) else limit for limit in config.task.state_limits]
    record = {
        "plant": robot.name, "parameters": robot.parameters(values), "state_limits": limits, "rung": "sampled",
        "epsilon": 1.0, "confidence": 0.0,
    }  # fmt: skip
    claimed = claimed_robot(Elite.of(arrays, record))
    a, b = linear(claimed.description, claimed.numbers, goal, 0.0)
    s = solve_continuous_are(a, b[:, None], q, r)
    gain = (b @ s / r[0, 0])[None]
    return Elite.of(arrays | {"S": np.array([s] * 2), "K": np.array([gain] * 2), "K_goal": gain}, record)


def ball(n: int) -> float:
    """The unit ball's volume."""
    return math.pi ** (n / 2) / math.gamma(n / 2 + 1)


def row(name: str) -> str:
    elite = regulated(name)
    told = {**claim_of(elite), "start": [0, double(0.0)], "push": double(0.0)}
    claim = check.read_claim(check.Node("claim", with_digests(told)))
    loop, n = Loop(claim, elite), claim.n
    began = time.process_time()
    most = goal_level(loop, unit_directions(n))
    sampled, began = time.process_time() - began, time.process_time()
    region = goal_region(claim, loop, exact=True)
    proving = time.process_time() - began
    widths = np.sqrt(most * np.diag(np.linalg.inv(elite.S[-1])))
    shown = ", ".join(f"{width:.3g}" for width in widths)

    def volume(rho: float) -> str:
        return f"{ball(n) * rho ** (n / 2) / np.sqrt(np.linalg.det(elite.S[-1])):.4g}"

    proved = f"{region.rho / most:.3f} | {volume(region.rho)}" if region else "none | none"
    return f"| {name} | {shown} | {volume(most)} | {proved} | {sampled:.1f} | {proving:.1f} |"


if __name__ == "__main__":
    print("| robot | half widths | volume, sampled | level proved, share | volume, proved | sampling, s | proving, s |")
    print("|---|---|---|---|---|---|---|")
    for name in sys.argv[1:] or ROBOTS:
        print(row(name), flush=True)
