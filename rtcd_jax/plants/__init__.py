"""Robots: what the search simulates (`Plant`), and what the verbs after it do in numpy and C MuJoCo.

JAX and MuJoCo are imported where they are needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rtcd_jax.config.plants import PlantConfig, PythonPlant, RobotPlant

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from rtcd_jax.plants.base import Plant


def make_plant(config: PlantConfig, units: Mapping[str, str]) -> Plant:
    """The robot that a configuration's section describes; `units` are those of its design.

    Raises:
        UserError: its MJCF is no robot of hinges and slides with smooth dynamics.
    """
    if isinstance(config, PythonPlant):
        return config.plant()(**config.constants)
    assert isinstance(config, RobotPlant)
    from rtcd_jax.plants.robot import plant_class

    return plant_class(config.robot(units))(**config.values())


def plant_of(config: PlantConfig, parameters: Mapping[str, float], units: Mapping[str, str]) -> tuple[Plant, Any]:
    """The robot and the design whose stored parameters these are.

    Raises:
        UserError: no such robot, or a parameter is missing.
    """
    if isinstance(config, PythonPlant):
        return config.plant().from_parameters(parameters)
    assert isinstance(config, RobotPlant)
    from rtcd_jax.plants.robot import plant_class

    return plant_class(config.with_parameters(parameters).robot(units)).from_parameters(parameters)


def model_of(config: PlantConfig, parameters: Mapping[str, float]) -> Any:
    """C MuJoCo's model of the robot with these parameters, compiled from its edited specification.

    Raises:
        UserError: no such robot, or a parameter is missing.
    """
    if isinstance(config, PythonPlant):
        import jax

        from rtcd_jax.plants.mjx import compile_model

        with jax.enable_x64(True):
            return compile_model(*plant_of(config, parameters, {}))
    assert isinstance(config, RobotPlant)
    from rtcd_jax.plants.model import recompiled

    robot = config.robot()
    return recompiled(robot, robot.numbers(parameters))


def dynamics_of(config: PlantConfig, parameters: Mapping[str, float], states: int) -> Callable[..., np.ndarray]:
    """x [S n], u [S m] -> x' [S n] in numpy: the closed form, or C MuJoCo for at most `states` where there is none.

    Raises:
        UserError: no such robot, or a parameter is missing.
    """
    if isinstance(config, RobotPlant):
        from rtcd_jax.plants.mjcf import dynamics

        return dynamics(config.robot(), parameters)
    from rtcd_jax.plants.model import CpuDynamics

    return CpuDynamics(model_of(config, parameters), states)
