"""Random candidates of five robots: the two that are packaged, and three with two swinging joints in closed form.

x = (q1, q2, q1_dot, q2_dot), zero hangs; M(q) q'' + c(q, q_dot) + g(q) = tau - D q_dot by Cramer's rule.
"""

import abc
from pathlib import Path
from typing import ClassVar, Literal, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import yaml
from jaxtyping import Array, Float

from rtcd_jax.config import load as configuration
from rtcd_jax.numerics.trigonometry import cos, sin
from rtcd_jax.plants.base import Plant
from rtcd_jax.problem import Problem, Variable, make_problem

CONFIGS = Path(__file__).parents[2] / "configs"
GRAVITY = 9.81
POINT_MASS = 0.608
"""At the end of the upper link [kg]: Maywald et al., IROS 2022."""
ARM_MASS, ARM_INERTIA = 0.095, 4.6e-6
"""Of the Qube-Servo 2: the arm, a rod [kg], and rotor and hub [kg m^2]."""


class TwoJoints(Plant):
    """Two hinges and one motor; subclasses give the terms of the equations of motion."""

    limit: float

    state_units: ClassVar = ("rad", "rad", "rad/s", "rad/s")
    input_names: ClassVar = ("torque",)
    input_units: ClassVar = ("N m",)
    parameter_units: ClassVar = {"limit": "N m"}
    convention: ClassVar = "zero hangs"
    mjcf: ClassVar = Path("none")

    @property
    def input_limit(self):
        return (self.limit,)

    @abc.abstractmethod
    def terms(self, design, x, u):
        """M11, M12, M22, and the generalized forces tau - D q_dot - c - g."""

    def dynamics(self, design, x, u):
        m11, m12, m22, f1, f2 = self.terms(design, x, u)
        share = 1 / (m11 * m22 - m12 * m12)
        return jnp.stack([x[2], x[3], share * (m22 * f1 - m12 * f2), share * (m11 * f2 - m12 * f1)])

    def energy(self, design, x):
        m11, m12, m22, *_ = self.terms(design, x, jnp.zeros_like(x[:1]))
        return 0.5 * m11 * x[2] ** 2 + m12 * x[2] * x[3] + 0.5 * m22 * x[3] ** 2 + self.potential(design, x)

    @abc.abstractmethod
    def potential(self, design, x):
        """The potential energy [J]."""

    def parameters(self, design):
        return {"limit": self.limit} | {name: float(value) for name, value in vars(design).items()}

    @classmethod
    def from_parameters(cls, parameters):
        design = {name: jnp.asarray(value) for name, value in parameters.items() if name != "limit"}
        return cls(parameters["limit"]), cls.Design(**design)

    def edit_model(self, design):
        return {}


@final
class Links(eqx.Module):
    """Lengths [m] and the lower point mass [kg]."""

    upper_length: Float[Array, "*batch"]
    lower_length: Float[Array, "*batch"]
    lower_mass: Float[Array, "*batch"]


@final
class DoublePendulum(TwoJoints):
    """Point masses at the ends of two links, the second angle relative to the first."""

    motor: Literal["shoulder", "elbow"] = eqx.field(default="elbow", static=True)

    state_names: ClassVar = ("shoulder", "elbow", "shoulder_dot", "elbow_dot")
    design_units: ClassVar = {"upper_length": "m", "lower_length": "m", "lower_mass": "kg"}
    Design: ClassVar = Links

    def terms(self, design, x, u):
        l1, l2, m2 = design.upper_length, design.lower_length, design.lower_mass
        coupling, lower = m2 * l1 * l2, m2 * l2 * l2
        c, s = coupling * cos(x[1]), coupling * sin(x[1])
        outer = m2 * GRAVITY * l2 * sin(x[0] + x[1])
        inner = (POINT_MASS + m2) * GRAVITY * l1 * sin(x[0])
        f1 = s * x[3] * (2 * x[2] + x[3]) - inner - outer
        f2 = -s * x[2] * x[2] - outer
        f1, f2 = (f1 + u[0], f2) if self.motor == "shoulder" else (f1, f2 + u[0])
        return (POINT_MASS + m2) * l1 * l1 + lower + 2 * c, lower + c, lower, f1, f2

    def potential(self, design, x):
        upper = (POINT_MASS + design.lower_mass) * design.upper_length * cos(x[0])
        return -GRAVITY * (upper + design.lower_mass * design.lower_length * cos(x[0] + x[1]))


@final
class ArmAndRod(eqx.Module):
    """Lengths [m] and the rod's mass [kg]."""

    arm_length: Float[Array, "*batch"]
    rod_length: Float[Array, "*batch"]
    rod_mass: Float[Array, "*batch"]


@final
class Furuta(TwoJoints):
    """A uniform rod that swings about a motor-driven arm turning in the horizontal plane; dampers [N m s/rad]."""

    arm_damping: float = 5e-6
    rod_damping: float = 1e-6

    state_names: ClassVar = ("arm", "rod", "arm_dot", "rod_dot")
    design_units: ClassVar = {"arm_length": "m", "rod_length": "m", "rod_mass": "kg"}
    Design: ClassVar = ArmAndRod

    def terms(self, design, x, u):
        arm, rod, mass = design.arm_length, design.rod_length, design.rod_mass
        s, c = sin(x[1]), cos(x[1])
        swinging, coupling = mass * rod * rod / 3, mass * arm * rod / 2
        about_motor = (ARM_MASS / 3 + mass) * arm * arm + ARM_INERTIA
        f1 = u[0] - self.arm_damping * x[2] - 2 * swinging * s * c * x[2] * x[3] + coupling * s * x[3] * x[3]
        f2 = swinging * s * c * x[2] * x[2] - self.rod_damping * x[3] - mass * GRAVITY * rod / 2 * s
        return about_motor + swinging * s * s, coupling * c, swinging, f1, f2

    def potential(self, design, x):
        return -design.rod_mass * GRAVITY * design.rod_length / 2 * cos(x[1])


Box = tuple[float, float]


def _problem(plant: TwoJoints, goal, state_limits, design: list[Box], q: list[Box], r: Box) -> Problem:
    data = yaml.safe_load(configuration.EXAMPLE)
    data["trajectory"] = {
        "knots": 101, "step": {"min": 0.005, "max": 0.05}, "limit_share": 0.9, "substeps": 2,
        "starts": 2, "max_iterations": 300,
    }  # fmt: skip
    data["funnel"] = {"rollouts": "closed_form"}
    variables = [
        Variable(f"design.{name}", (low + high) / 2, low, high, free=True, logarithmic=False)
        for name, (low, high) in zip(plant.design_units, design, strict=True)
    ]
    for section, boxes in (("q", q), ("r", [r])):
        for i, (low, high) in enumerate(boxes):
            name = f"weights.{section}.{i}"
            variables.append(Variable(name, (low * high) ** 0.5, low, high, free=True, logarithmic=True))
    limits = np.array(state_limits)
    config, ends = configuration.parse(data), (np.zeros(4), np.array(goal))
    return Problem(config, plant, *ends, limits, np.array(plant.input_limit), tuple(variables))


def problem(robot: str) -> Problem:
    """By name: pendulum, cartpole, acrobot, pendubot, furuta.

    Raises:
        KeyError: no robot has this name.
    """
    return ROBOTS[robot]()


def _double_pendulum(motor: Literal["shoulder", "elbow"]) -> Problem:
    return _problem(
        DoublePendulum(6.0, motor),
        goal=[np.pi, 0.0, 0.0, 0.0],
        state_limits=[2 * np.pi, 2 * np.pi, 30.0, 30.0],
        design=[(0.2, 0.4), (0.2, 0.4), (0.2, 1.0)],
        q=[(1.0, 100.0), (1.0, 100.0), (0.1, 10.0), (0.1, 10.0)],
        r=(0.1, 10.0),
    )


def _furuta() -> Problem:
    return _problem(
        Furuta(0.02),
        goal=[0.0, np.pi, 0.0, 0.0],
        state_limits=[2.0, 2 * np.pi, 30.0, 40.0],
        design=[(0.06, 0.12), (0.1, 0.16), (0.015, 0.035)],
        q=[(1.0, 100.0), (1.0, 100.0), (0.01, 1.0), (0.01, 1.0)],
        r=(100.0, 10000.0),
    )


ROBOTS = {
    "pendulum": lambda: make_problem(configuration.load(CONFIGS / "pendulum_rtcd.yaml")),
    "cartpole": lambda: make_problem(configuration.load(CONFIGS / "cartpole_rtcd.yaml")),
    "acrobot": lambda: _double_pendulum("elbow"),
    "pendubot": lambda: _double_pendulum("shoulder"),
    "furuta": _furuta,
}
