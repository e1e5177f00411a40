"""The torque-limited pendulum: x = (theta, theta_dot), theta = 0 hanging, pi upright.

theta_ddot = (u - b theta_dot - m g l sin theta) / (m l^2): a point mass on a massless rod (paper, section III).
"""

from pathlib import Path
from typing import ClassVar, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rtcd_jax.plants.base import Plant


@final
class PendulumDesign(eqx.Module):
    """mass [kg] of the bob, length [m] from the pivot to it."""

    mass: Float[Array, ""]
    length: Float[Array, ""]


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
    Design: ClassVar = PendulumDesign
    mjcf: ClassVar = Path(__file__).with_name("pendulum.xml")

    @property
    def input_limit(self) -> tuple[float, ...]:
        return (self.torque_limit,)

    def dynamics(self, design: PendulumDesign, x: Float[Array, "2"], u: Float[Array, "1"]) -> Float[Array, "2"]:
        inertia = design.mass * design.length**2
        weight = design.mass * self.gravity * design.length * jnp.sin(x[0])
        return jnp.stack([x[1], (u[0] - self.damping * x[1] - weight) / inertia])

    def energy(self, design: PendulumDesign, x: Float[Array, "2"]) -> Float[Array, ""]:
        speed = design.length * x[1]
        height = design.length * (1 - jnp.cos(x[0]))
        return design.mass * (0.5 * speed**2 + self.gravity * height)

    def parameters(self, design: PendulumDesign) -> dict[str, float]:
        return {
            "m": float(design.mass),
            "l": float(design.length),
            "b": self.damping,
            "g": self.gravity,
            "torque_limit": self.torque_limit,
        }

    def edit_model(self, model, design: PendulumDesign) -> dict[str, Float[Array, " ..."]]:
        raise NotImplementedError
