"""Does the MJCF say what the equations of motion say? Asked of numbers, so that no feature of MuJoCo needs a rule.

C MuJoCo is asked twice for every design: compiled anew for it, as `verify`, `animate` and exports have it, and with
only the design's own edits in the compiled model, as MJX has it. MJX itself would have to be
compiled for some seconds first; what it does not support at all, its own converter refuses by name.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from rtcd_jax.plants.base import Plant
from rtcd_jax.plants.mjx import MjxStepper, compile_model, edited_model
from rtcd_jax.plants.model import CpuDynamics, recompiled
from rtcd_jax.plants.robot import MjcfPlant
from rtcd_jax.system.errors import UserError

TOLERANCE = 1e-6
"""Of an acceleration, relative to 1 + the largest of the same state."""


def require_agreement(
    plant: Plant, designs: Sequence[eqx.Module], x: Float[np.ndarray, "states n"], u: Float[np.ndarray, "states m"]
) -> None:
    """Nothing, if C MuJoCo accelerates every design at every state as the closed form does.

    Raises:
        UserError: the MJCF cannot be used, or names design, state, input and both accelerations.
    """
    with jax.enable_x64(True):
        closed_form = jax.jit(jax.vmap(plant.dynamics, in_axes=(None, 0, 0)))
        expected = [np.asarray(closed_form(design, x, u)) for design in designs]
    try:
        MjxStepper(plant)
        pairs = [(_compiled_anew(plant, design), edited_model(plant, design)) for design in designs]
    except (ValueError, NotImplementedError) as error:
        raise UserError(f"the MJCF of {type(plant).__name__}: {' '.join(str(error).split())}") from None
    for design, rates, models in zip(designs, expected, pairs, strict=True):
        for model in models:
            _compare(plant, design, x, u, rates, CpuDynamics(model, len(x))(x, u))


def _compiled_anew(plant: Plant, design: eqx.Module):
    if not isinstance(plant, MjcfPlant):
        return compile_model(plant, design)
    values = {name: float(value) for name, value in (vars(plant) | vars(design)).items()}
    return recompiled(plant.robot, plant.robot.complete(values))


def _compare(plant: Plant, design: eqx.Module, x, u, rates, by_mujoco) -> None:
    error = np.max(np.abs(by_mujoco - rates) / (1 + np.max(np.abs(rates), 1, keepdims=True)), 1)
    worst = int(np.argmax(np.where(np.isfinite(error), error, np.inf)))
    if error[worst] <= TOLERANCE:
        return
    half = plant.n // 2
    raise UserError(
        f"the MJCF of {type(plant).__name__} moves otherwise than its equations: at "
        f"{_named(plant.design_units, vars(design).values())}, {_named(plant.state_names, x[worst])}, "
        f"{_named(plant.input_names, u[worst])} MuJoCo's accelerations are {_listed(by_mujoco[worst, half:])}, "
        f"the equations' {_listed(rates[worst, half:])}"
    )


def _named(names, values) -> str:
    return ", ".join(f"{name} = {float(value):.6g}" for name, value in zip(names, values, strict=True))


def _listed(values) -> str:
    return f"({', '.join(f'{value:.9g}' for value in values)})"
