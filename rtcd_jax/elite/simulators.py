"""Independent simulators of a plant: C MuJoCo's dynamics and integrators that share nothing with the search."""

from collections.abc import Iterator
from typing import NamedTuple, final

import numpy as np

from rtcd_jax import plants
from rtcd_jax.elite.closed_loop import Dynamics, March, dormand_prince, fastest_rate, fastest_rate_of_goal, runge_kutta
from rtcd_jax.elite.elite import Elite

STEPS = 4
"""Fixed steps in an interval, at least."""
STEP_OF_FASTEST = 0.1
"""Longest fixed step in time constants of the loop's fastest mode."""
RELATIVE, ABSOLUTE = 1e-8, 1e-9
"""Tolerances of RK45 for every state."""


@final
class Simulator(NamedTuple):
    """Dynamics of a plant with its integrators: `march` along the trajectory, `settle` at the goal."""

    name: str
    dynamics: Dynamics
    march: March
    settle: March


def simulators_of(elite: Elite, states: int) -> Iterator[Simulator]:
    """All that can simulate this elite's plant, `states` at most at once: C MuJoCo's accelerations, by fixed steps of
    Runge-Kutta and by the steps that RK45's own error asks for.

    Raises:
        UserError: an unknown plant.
    """
    interval = float(np.min(np.diff(elite.time)))
    columns = elite.x_goal.size + elite.u_max.size
    mujoco = mujoco_of(elite, max(states, 2 * columns))
    step = min(interval / STEPS, STEP_OF_FASTEST / fastest_rate(elite, mujoco))
    slow_step = STEP_OF_FASTEST / fastest_rate_of_goal(elite, mujoco)
    yield Simulator("C MuJoCo", mujoco, runge_kutta(mujoco, step), runge_kutta(mujoco, slow_step))
    march = dormand_prince(mujoco, interval / 4, RELATIVE, ABSOLUTE)
    yield Simulator("RK45", mujoco, march, march)


def simulator_of(elite: Elite, name: str, states: int) -> Simulator:
    """The one of that name."""
    return next(simulator for simulator in simulators_of(elite, states) if simulator.name == name)


def dynamics_of(elite: Elite) -> Dynamics:
    """The plant's closed form, or C MuJoCo where there is none.

    Raises:
        UserError: an unknown plant, or the elite's parameters lack one.
    """
    columns = elite.x_goal.size + elite.u_max.size
    return plants.dynamics_of(elite.robot, elite.parameters, 2 * columns * len(elite.time))


def mujoco_of(elite: Elite, states: int) -> Dynamics:
    """C MuJoCo's accelerations of the elite's robot, of `states` at most at once."""
    from rtcd_jax.plants.model import CpuDynamics  # mujoco takes seconds to import

    return CpuDynamics(plants.model_of(elite.robot, elite.parameters), states)
