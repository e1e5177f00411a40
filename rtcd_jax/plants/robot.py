"""A robot that an MJCF describes, as a `Plant`: one class for each robot, its constants the fields."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, cast

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from rtcd_jax.config.robot import OPTION, Robot, Value, value_of
from rtcd_jax.numerics.trigonometry import cos, sin
from rtcd_jax.plants.base import Components, ModelEdits, Plant
from rtcd_jax.plants.mjcf import closed_form
from rtcd_jax.plants.model import LEAST_INERTIA

GEAR = 6
"""Numbers of a motor's gear in MuJoCo; those of a joint's are in the first."""


class MjcfPlant(Plant):
    """Base of the classes that `plant_class` makes."""

    robot: ClassVar[Robot]

    def input_limits(self, design: eqx.Module) -> tuple[float | Float[Array, "*batch"], ...]:
        return tuple(value_of(limit, vars(self) | vars(design)) for limit in self.robot.limits)

    def dynamics(
        self, design: eqx.Module, x: Float[Array, "n *batch"] | Components, u: Float[Array, "m *batch"] | Components
    ) -> Float[Array, "n *batch"]:
        return jnp.stack(self.rates(self.lumped(design), x, u))

    def lumped(self, design: eqx.Module) -> PyTree:
        return closed_form(self.robot).lump(self._numbers(design))

    def rates(
        self, numbers: PyTree, x: Float[Array, "n *batch"] | Components, u: Float[Array, "m *batch"] | Components
    ) -> Components:
        form, nv = closed_form(self.robot), len(self.robot.joints)
        q, v = x[:nv], x[nv:]
        rates = (*v, *form.program.accelerations(numbers, q, v, u, sin, cos))
        shape = jnp.broadcast_shapes(*map(jnp.shape, rates))
        return tuple(jnp.broadcast_to(jnp.asarray(rate, x[0].dtype), shape) for rate in rates)

    def motor_speeds(self, design: eqx.Module, x: Float[Array, "n *batch"]) -> Float[Array, "m *batch"]:
        form, nv = closed_form(self.robot), len(self.robot.joints)
        gears = form.motors(self._numbers(design))
        return jnp.stack([sum(row[i] * x[nv + joint] for joint, row in enumerate(gears)) for i in range(self.m)])

    def parameters(self, design: eqx.Module) -> dict[str, float]:
        values = self.robot.parameters(vars(self) | vars(design))
        return {symbol: float(value) for symbol, value in values.items()}

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, float]) -> tuple[Plant, eqx.Module]:
        values = cls.robot.values(parameters)
        design = {named.name: jnp.asarray(float(values.pop(named.name))) for named in cls.robot.design}
        return cls(**values), cls.Design(**design)

    def edit_model(self, design: eqx.Module) -> ModelEdits:
        numbers, edits = self._numbers(design), {}
        for edit in self.robot.edits:
            row = _row(edit.values, numbers)
            if edit.kind == OPTION:
                edits[f"opt.{edit.attribute}"] = row
                continue
            if edit.field == "inertia":
                row = jnp.maximum(row, LEAST_INERTIA)
            if edit.kind == "motor":
                row = jnp.concatenate([row, jnp.zeros(GEAR - 1, row.dtype)])
            edits.setdefault(edit.attribute, {})[edit.object] = row[0] if row.shape == (1,) else row
        return edits

    def _numbers(self, design: eqx.Module) -> dict[str, Any]:
        return self.robot.complete(vars(self) | vars(design))


@cache
def plant_class(robot: Robot) -> type[MjcfPlant]:
    """The class of a robot; its instances differ in their constants.

    Raises:
        UserError: the MJCF is no robot of hinges and slides with smooth dynamics.
    """
    closed_form(robot)
    named = robot.name.title().replace("_", "")
    design = _module(f"{named}Design", eqx.Module, [each.name for each in robot.design], Array, {})
    attributes = {
        "robot": robot,
        "xml": robot.xml,
        "state_names": tuple(robot.states),
        "state_units": tuple(robot.states.values()),
        "input_names": tuple(name for name, _ in robot.inputs),
        "input_units": tuple(unit for _, unit in robot.inputs),
        "design_units": {each.name: each.unit for each in robot.design},
        "parameter_units": robot.units,
        "convention": robot.convention,
        "Design": design,
    }
    plant = _module(named, MjcfPlant, [each.name for each in robot.constants], float, attributes)
    return cast(type[MjcfPlant], plant)


def _module(name: str, base: type, fields: Sequence[str], kind: Any, attributes: Mapping[str, Any]) -> type:
    namespace = {"__annotations__": dict.fromkeys(fields, kind), "__module__": __name__, **attributes}
    return type(base)(name, (base,), namespace)


def _row(values: Sequence[Value], numbers: Mapping[str, Any]) -> Float[Array, "k *batch"]:
    found = [jnp.asarray(value_of(value, numbers), float) for value in values]
    return jnp.stack(jnp.broadcast_arrays(*found))
