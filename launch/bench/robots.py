"""The packaged robots' problems, each by the configuration in which its design and weights are free."""

from pathlib import Path

from rtcd_jax.config.load import load
from rtcd_jax.problem import Problem, make_problem

CONFIGS = Path(__file__).parents[2] / "configs"
ROBOTS = {
    "pendulum": "pendulum_rtcd", "cartpole": "cartpole_rtcd", "acrobot": "acrobot", "pendubot": "pendubot",
    "furuta": "furuta", "reaction_wheel": "reaction_wheel", "double_cartpole": "double_cartpole",
    "acromonk": "acromonk",
}  # fmt: skip
"""Configurations by the robots' names."""


def problem_of(robot: str) -> Problem:
    """The problem of a robot.

    Raises:
        KeyError: no robot has this name.
    """
    return make_problem(load(CONFIGS / f"{ROBOTS[robot]}.yaml"))
