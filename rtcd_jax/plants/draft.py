"""A configuration to begin with, written from an MJCF: what was understood, and every number that could be a design."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import itertools
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from rtcd_jax.config.mjcf import NotMjcf, read_names, read_text
from rtcd_jax.config.plants import MjcfPlant
from rtcd_jax.config.robot import FIELDS
from rtcd_jax.plants.model import CpuDynamics, compiled
from rtcd_jax.system.errors import UserError

AT_REST = 1e-6
"""Largest acceleration of an equilibrium [1/s^2]."""
MOST_CORNERS = 4096
SPEED = 30.0
"""Limit on velocities that the draft begins with."""


def draft(path: Path) -> str:
    """The YAML of an experiment with the robot of an MJCF, which is to lie beside it.

    Raises:
        UserError: the MJCF cannot be read, or is no robot of hinges and slides with smooth dynamics.
    """
    try:
        text = read_text(path)
        names = read_names(text)
    except NotMjcf as error:
        raise UserError(f"{path}: {error}") from None
    try:
        model = compiled(text)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    limits = {motor.name: {"limit": motor.limit or 1.0} for motor in names.motors}
    plant = MjcfPlant.model_validate({"name": "draft", "mjcf": path.name, "xml": text, "inputs": limits})
    start, goal = _ends(model)
    states, hinges = plant.states, [joint.hinge for joint in names.joints]
    bounds = [*("2*pi" if hinge else "1.0" for hinge in hinges), *(f"{SPEED:g}" for _ in hinges)]
    lines = [
        f"# {path.name}: {', '.join(f'{name} [{unit}]' for name, unit in states.items())}; "
        f"{', '.join(f'{name} [{unit}]' for name, unit in plant.input_units.items())}.",
        "# Made by `rtcd new`; `rtcd optimize` with --dry says what is understood of it.",
        "plant:",
        f"  mjcf: {path.name}",
        "  inputs:",
        *(
            f"    {motor.name}: {{limit: {motor.limit or 1.0:g}}}"
            f"   # [{motor.joint.units[2]}]{'' if motor.limit else ' the MJCF has no ctrlrange: say the limit'}"
            for motor in names.motors
        ),
        "  # The MJCF's numbers. What is to be a design becomes arithmetic of its name, as `mass: my_mass`, and the",
        "  # name an entry of `design`; all else may be left away.",
        "  # set:",
        *(f"  #   {line}" for line in _numbers(model)),
        "",
        "task:",
        f"  start: [{', '.join((*map(_angle, start), *('0' for _ in hinges)))}]   # {', '.join(states.values())}",
        f"  goal: [{', '.join((*map(_angle, goal), *('0' for _ in hinges)))}]",
        f"  state_limits: [{', '.join(bounds)}]   # or .inf",
        "",
        "# One design for several tasks: each is as `task`, but for what it says itself.",
        "# tasks: {unloaded: {}, loaded: {plant: {my_mass: my_mass + 0.1}}}",
        "",
        "design: {}",
        "  # my_mass: {initial: 1.0, min: 0.5, max: 2.0, unit: kg}",
        "",
        "weights:   # diagonals of Q and R",
        "  q:",
        *("    - {initial: 10, min: 1, max: 100}" for _ in hinges),
        *("    - {initial: 1, min: 0.1, max: 10}" for _ in hinges),
        "  r:",
        *("    - {initial: 1, min: 0.1, max: 10}" for _ in names.motors),
        "",
        "trajectory: {knots: 101, step: {min: 0.005, max: 0.05}, substeps: 2, starts: 2, limit_share: 0.9}",
        "policy:",
        "  input_weight: {initial: 1, min: 0.01, max: 100}",
        "  authority: {initial: 0.5, min: 0.05, max: 1}",
        "  discount: {initial: 0.5, min: 0, max: 4}",
        "search: {population: 64, generations: 30}",
    ]
    return "\n".join(lines) + "\n"


def _ends(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """The equilibria of least and of greatest potential energy with every hinge at 0 or pi and slides at 0."""
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    places = [(0.0, np.pi) if int(kind) == hinge else (0.0,) for kind in model.jnt_type]
    corners = list(map(np.array, itertools.islice(itertools.product(*places), MOST_CORNERS)))
    x = np.concatenate([np.array(corners), np.zeros((len(corners), model.nv))], axis=1)
    rates = CpuDynamics(model, len(x))(x, np.zeros((len(x), model.nu)))
    resting = [corner for corner, rate in zip(corners, rates, strict=True) if np.max(np.abs(rate)) <= AT_REST]
    if len(resting) < 2:
        resting = corners[:1] * 2
    data = mujoco.MjData(model)

    def energy(corner: np.ndarray) -> float:
        data.qpos[:] = corner
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_energyPos(model, data)
        return round(float(data.energy[0]), 9)

    return min(resting, key=energy), max(resting, key=energy)


def _numbers(model: mujoco.MjModel) -> Iterator[str]:
    """Every number that `set` may edit, but the drawing's."""
    for kind, count in ("body", model.nbody), ("joint", model.njnt), ("motor", model.nu):
        for index in range(count):
            name = getattr(model, {"motor": "actuator"}.get(kind, kind))(index).name
            if not name or name == "world":
                continue
            row = {}
            for field, (attribute, size) in FIELDS[kind].items():
                at = model.jnt_dofadr[index] if attribute.startswith("dof_") else index
                values = np.ravel(getattr(model, attribute)[at])[:size]
                row[field] = f"{values[0]:g}" if size == 1 else f"[{', '.join(f'{v:g}' for v in values)}]"
            yield f"{kind}.{name}: {{{', '.join(f'{field}: {text}' for field, text in row.items())}}}"


def _angle(value: float) -> str:
    return "pi" if value else "0"
