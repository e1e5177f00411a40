"""Every test of this folder that takes `robot` runs on every packaged robot."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rtcd_jax.config.load import load
from rtcd_jax.config.plants import PLANTS
from rtcd_jax.plants import model_of
from rtcd_jax.plants.base import Plant
from rtcd_jax.plants.mjx import MjxStepper
from tests.paths import CONFIGS
from tests.plants.robots import packaged

STATES = 32


QUICK = "cartpole"
"""The robot that MJX is compiled for in the fast suite; for the others it takes minutes."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What compiles MJX for another robot is slow."""
    for item in items:
        callspec = getattr(item, "callspec", None)
        if item.path.name == "test_mjx.py" and callspec and callspec.params.get("robot", QUICK) != QUICK:
            item.add_marker(pytest.mark.slow)


class Robot(NamedTuple):
    """A plant with constants that differ from its MJCF's, `STATES` random designs, states and inputs."""

    name: str
    plant: Plant
    designs: eqx.Module
    x: jax.Array
    u: jax.Array

    def design(self, index: int) -> eqx.Module:
        return jax.tree.map(lambda leaf: leaf[index], self.designs)

    def recompiled(self, index: int) -> mujoco.MjModel:
        """The model of design `index`, edited as a specification and compiled from scratch."""
        return model_of(PLANTS[self.name](), self.plant.parameters(self.design(index)))


def _random_robot(name: str) -> Robot:
    """Constants a tenth beside their defaults, designs within a third of what its configuration begins with."""
    random = np.random.default_rng(0)
    constants = {key: value * random.uniform(0.9, 1.1) + 1e-3 for key, value in PLANTS[name]().values().items()}
    plant = packaged(name, **constants)
    design = load(next(CONFIGS.glob(f"{name}*.yaml"))).design
    fields = {key: jnp.asarray(variable.initial * random.uniform(0.7, 1.3, STATES)) for key, variable in design.items()}
    robot = plant.Design(**fields)
    x = jnp.asarray(random.uniform(-4, 4, (STATES, plant.n)))
    u = jnp.asarray(random.uniform(-1, 1, (STATES, plant.m)) * np.asarray(plant.input_limits(robot)))
    return Robot(name, plant, robot, x, u)


@pytest.fixture(scope="session", params=PLANTS)
def robot(request) -> Robot:
    return _random_robot(request.param)


@pytest.fixture(scope="session")
def mjx_step(robot) -> Callable:
    """The MJX step compiled over a batch of designs, states and inputs."""
    return jax.jit(jax.vmap(MjxStepper(robot.plant).step, in_axes=(0, 0, 0, None)))
