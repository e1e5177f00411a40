"""Robots from MJCFs: the equations of motion in closed form, and the model's own numbers for MuJoCo.

    robot (config.robot) --derive--> Laurent polynomials --emit--> elementwise program (JAX, numpy)
                         --edits---> the compiled model's rows (MJX), or a specification that is compiled anew

Whatever the robot's `set` says with a name in it is a symbol of the equations, once for each different expression;
what it says in numbers is edited into the model before they are derived.
"""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

from collections.abc import Callable, Mapping
from functools import cache
from math import prod
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rtcd_jax.config.robot import OPTION, Edit, Robot, value_of
from rtcd_jax.plants.emit import Program, emit
from rtcd_jax.plants.lagrange import Entry, Equations, derive
from rtcd_jax.plants.laurent import Laurent
from rtcd_jax.plants.model import row_of, with_numbers
from rtcd_jax.system.errors import UserError


class ClosedForm(NamedTuple):
    """A robot's equations; `symbols` are the values [S] that the program's and the energy's symbols stand for."""

    equations: Equations
    program: Program
    symbols: tuple[str, ...]

    def lump(self, values: Mapping[str, Any]) -> list[Any]:
        """What the accelerations need of a design, from its complete numbers by name."""
        return self.program.lump([value_of(symbol, values) for symbol in self.symbols])

    def motors(self, values: Mapping[str, Any]) -> list[list[Any]]:
        """Force or torque on every joint for one unit of every input [joints][inputs]."""
        symbols, nv = [value_of(symbol, values) for symbol in self.symbols], len(self.equations.angles)

        def number(gear: Laurent) -> Any:
            terms = gear.terms.items()
            return sum(c.real * prod(s**e for s, e in zip(symbols, powers[nv:], strict=True)) for powers, c in terms)

        return [[number(gear) for gear in row] for row in self.equations.motors]


@cache
def closed_form(robot: Robot) -> ClosedForm:
    """The equations of a robot.

    Raises:
        UserError: the MJCF is no robot of hinges and slides with smooth dynamics.
    """
    try:
        model = with_numbers(robot)
        _require_names(robot, model)
        return _closed_form(robot, model)
    except UserError as error:
        raise UserError(f"{robot.name}: {error}") from None


def _closed_form(robot: Robot, model: Any) -> ClosedForm:
    symbols: dict[str, int] = {}
    entries: dict[Entry, int] = {}
    for edit in robot.edits:
        if edit.kind == "geom":
            continue
        for component, value in enumerate(edit.values):
            if isinstance(value, str):
                entries[_entry(model, edit, component)] = symbols.setdefault(value, len(symbols))
    equations = derive(model, entries)
    return ClosedForm(equations, emit(equations, len(symbols)), tuple(symbols))


def dynamics(robot: Robot, parameters: Mapping[str, float]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """x [S n], u [S m] -> x' [S n] in numpy, of the robot with these parameters.

    Raises:
        UserError: a parameter is missing.
    """
    form, nv = closed_form(robot), len(robot.joints)
    lumped = form.lump(robot.numbers(parameters))

    def f(x: Float[np.ndarray, "S n"], u: Float[np.ndarray, "S m"]) -> Float[np.ndarray, "S n"]:
        q, v = x.T[:nv], x.T[nv:]
        rates = form.program.accelerations(lumped, q, v, u.T, np.sin, np.cos)
        return np.stack([*v, *(np.broadcast_to(rate, x.shape[:1]) for rate in rates)], axis=1)

    return f


def _entry(model: Any, edit: Edit, component: int) -> Entry:
    if edit.kind == OPTION:
        return Entry(edit.attribute, component)
    row = row_of(model, edit.attribute, edit.object)
    scalar = len(edit.values) == 1 and edit.kind != "motor"
    return Entry(edit.attribute, row, None if scalar else component)


def _require_names(robot: Robot, model: Any) -> None:
    """MuJoCo's joints and motors are those that were read from the text."""
    for kind, read, count in (
        ("joint", [joint.name for joint in robot.joints], model.njnt),
        ("actuator", [name for name, _ in robot.inputs], model.nu),
    ):
        found = [getattr(model, kind)(i).name for i in range(count)]
        if read != found:
            raise UserError(f"its {kind}s are {', '.join(found)} to MuJoCo, and {', '.join(read)} in its text")
