"""The torque-limited pendulum: x = (theta, theta_dot), theta = 0 hanging, pi upright.

theta_ddot = (u - b theta_dot - m g l sin theta) / (m l^2): a point mass on a massless rod (paper, section III).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rtcd_jax.numerics.trigonometry import cos, sin
from rtcd_jax.plants.base import Components, ModelEdits, Plant

_ROD_RADIUS = 0.008  # [m], as drawn in pendulum.xml


@final
class PendulumDesign(eqx.Module):
    """mass [kg] of the bob, length [m] from the pivot to it."""

    mass: Float[Array, "*batch"]
    length: Float[Array, "*batch"]


@final
class Pendulum(Plant):
    """damping [N m s/rad] at the pivot, gravity [m/s^2], torque_limit [N m]."""

    damping: float = 0.1
    gravity: float = 9.81
    torque_limit: float = 2.5

    state_names: ClassVar = ("theta", "theta_dot")
    state_units: ClassVar = ("rad", "rad/s")
    input_names: ClassVar = ("torque",)
    input_units: ClassVar = ("N m",)
    design_units: ClassVar = {"mass": "kg", "length": "m"}
    parameter_units: ClassVar = {"m": "kg", "l": "m", "b": "N m s/rad", "g": "m/s^2", "torque_limit": "N m"}
    convention: ClassVar = (
        "theta = 0 hangs, pi stands upright; seen with the x axis to the right and z up, positive theta, theta_dot and "
        "torque turn counterclockwise, a hanging pendulum towards +x. Not wrapped: a full turn adds 2 pi."
    )
    Design: ClassVar = PendulumDesign
    mjcf: ClassVar = Path(__file__).with_name("pendulum.xml")

    @property
    def input_limit(self) -> tuple[float, ...]:
        return (self.torque_limit,)

    def dynamics(
        self, design: PendulumDesign, x: Float[Array, "2 *batch"] | Components, u: Float[Array, "1 *batch"] | Components
    ) -> Float[Array, "2 *batch"]:
        inertia = design.mass * design.length**2
        weight = design.mass * self.gravity * design.length * sin(x[0])
        return jnp.stack([x[1], (u[0] - self.damping * x[1] - weight) / inertia])

    def energy(self, design: PendulumDesign, x: Float[Array, "2 *batch"]) -> Float[Array, "*batch"]:
        speed = design.length * x[1]
        height = design.length * (1 - cos(x[0]))
        return design.mass * (0.5 * speed**2 + self.gravity * height)

    def parameters(self, design: PendulumDesign) -> dict[str, float]:
        return {
            "m": float(design.mass),
            "l": float(design.length),
            "b": self.damping,
            "g": self.gravity,
            "torque_limit": self.torque_limit,
        }

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, float]) -> tuple["Pendulum", PendulumDesign]:
        plant = cls(parameters["b"], parameters["g"], parameters["torque_limit"])
        return plant, PendulumDesign(jnp.asarray(parameters["m"]), jnp.asarray(parameters["l"]))

    def edit_model(self, design: PendulumDesign) -> ModelEdits:
        bob = _downward(design.length)
        rod_size = jnp.stack([jnp.full_like(design.length, _ROD_RADIUS), design.length / 2, 0 * design.length])
        return {
            "opt.gravity": _downward(jnp.asarray(self.gravity)),
            "body_mass": {"bob": design.mass},
            "body_ipos": {"bob": bob},
            "dof_damping": {"theta": jnp.asarray(self.damping)},
            "geom_pos": {"rod": bob / 2, "bob": bob},
            "geom_size": {"rod": rod_size},
        }


def _downward(length: Float[Array, "*batch"]) -> Float[Array, "3 *batch"]:
    return jnp.stack([jnp.zeros_like(length), jnp.zeros_like(length), -length])
