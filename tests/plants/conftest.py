"""Every test of this folder that takes `robot` runs on every robot; a new one is a line in ROBOTS."""
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

from rtcd_jax.plants import PLANTS, plant_class
from rtcd_jax.plants.base import Plant
from rtcd_jax.plants.mjx import MjxStepper

STATES = 32


def _redesign_pendulum(spec: mujoco.MjSpec, parameters: dict[str, float]) -> None:
    length = parameters["l"]
    spec.option.gravity = [0, 0, -parameters["g"]]
    body = spec.body("bob")
    body.mass, body.ipos = parameters["m"], [0, 0, -length]
    spec.joint("theta").damping[0] = parameters["b"]
    spec.geom("bob").pos = [0, 0, -length]
    spec.geom("rod").pos = [0, 0, -length / 2]
    spec.geom("rod").size = [spec.geom("rod").size[0], length / 2, 0]


def _redesign_cartpole(spec: mujoco.MjSpec, parameters: dict[str, float]) -> None:
    center, inertia = [0, 0, parameters["lp"]], parameters["inertia_about_com"]
    spec.option.gravity = [0, 0, -parameters["g"]]
    spec.body("cart").mass = parameters["Mc"]
    pole = spec.body("pole")
    pole.mass, pole.ipos, pole.inertia = parameters["Mp"], center, [inertia, inertia, pole.inertia[2]]
    spec.joint("cart").damping[0] = parameters["Beq"]
    spec.joint("theta").damping[0] = parameters["Bp"]
    spec.geom("pole").pos = center
    spec.geom("pole").size = [spec.geom("pole").size[0], parameters["lp"], 0]


class Row(NamedTuple):
    constants: dict[str, float]
    lowest: dict[str, float]
    highest: dict[str, float]
    redesign: Callable[[mujoco.MjSpec, dict[str, float]], None]


ROBOTS = {
    "pendulum": Row(
        {"damping": 0.13, "gravity": 9.7},
        {"mass": 0.6, "length": 0.4},
        {"mass": 0.8, "length": 0.6},
        _redesign_pendulum,
    ),
    "cartpole": Row(
        {"cart_mass": 1.1, "cart_damping": 5.2, "pivot_damping": 0.003, "gravity": 9.7},
        {"pole_length": 0.1778, "pole_mass": 0.127},
        {"pole_length": 0.3, "pole_mass": 0.3},
        _redesign_cartpole,
    ),
}


class Robot(NamedTuple):
    """A plant with constants that differ from its MJCF's, `STATES` random designs, states and inputs."""

    plant: Plant
    designs: eqx.Module
    x: jax.Array
    u: jax.Array
    redesign: Callable[[mujoco.MjSpec, dict[str, float]], None]

    def design(self, index: int) -> eqx.Module:
        return jax.tree.map(lambda leaf: leaf[index], self.designs)

    def recompiled(self, index: int) -> mujoco.MjModel:
        """The model of design `index`, edited as a specification and compiled from scratch."""
        spec = mujoco.MjSpec.from_file(str(self.plant.mjcf))
        self.redesign(spec, self.plant.parameters(self.design(index)))
        return spec.compile()


def _random_robot(name: str) -> Robot:
    row = ROBOTS[name]
    random = np.random.default_rng(0)
    plant = plant_class(name)(**row.constants)
    fields = {key: jnp.asarray(random.uniform(row.lowest[key], row.highest[key], STATES)) for key in row.lowest}
    x = jnp.asarray(random.uniform(-4, 4, (STATES, plant.n)))
    u = jnp.asarray(random.uniform(-1, 1, (STATES, plant.m)) * np.asarray(plant.input_limit))
    return Robot(plant, plant.Design(**fields), x, u, row.redesign)


@pytest.fixture(scope="session", params=PLANTS)
def robot(request) -> Robot:
    return _random_robot(request.param)


@pytest.fixture(scope="session")
def mjx_step(robot) -> Callable:
    """The MJX step compiled over a batch of designs, states and inputs."""
    return jax.jit(jax.vmap(MjxStepper(robot.plant).step, in_axes=(0, 0, 0, None)))
