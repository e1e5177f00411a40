"""Independent simulators of a plant: dynamics and integrators that share nothing with the search."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple, final

import numpy as np

from rtcd_jax.elite.closed_loop import Dynamics, March, dormand_prince, fastest_rate, fastest_rate_of_goal, runge_kutta
from rtcd_jax.elite.elite import Elite
from rtcd_jax.system.errors import UserError

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
    """All that can simulate this elite's plant, `states` at most at once.

    Raises:
        ValueError: an unknown plant.
    """
    from rtcd_jax.plants.mjx import CpuDynamics, model_of

    interval = float(np.min(np.diff(elite.time)))
    columns = elite.x_goal.size + elite.u_max.size
    mujoco = CpuDynamics(model_of(elite.plant, elite.parameters), max(states, 2 * columns))
    step = min(interval / STEPS, STEP_OF_FASTEST / fastest_rate(elite, mujoco))
    slow_step = STEP_OF_FASTEST / fastest_rate_of_goal(elite, mujoco)
    yield Simulator("C MuJoCo", mujoco, runge_kutta(mujoco, step), runge_kutta(mujoco, slow_step))
    if elite.plant in CLOSED_FORMS:
        closed_form = CLOSED_FORMS[elite.plant](elite.parameters)
        march = dormand_prince(closed_form, interval / 4, RELATIVE, ABSOLUTE)
        yield Simulator("closed form", closed_form, march, march)


def simulator_of(elite: Elite, name: str, states: int) -> Simulator:
    """The one of that name."""
    return next(simulator for simulator in simulators_of(elite, states) if simulator.name == name)


def dynamics_of(elite: Elite) -> Dynamics:
    """The plant's closed form, or C MuJoCo where there is none.

    Raises:
        UserError: the elite's parameters lack one that the closed form needs.
    """
    if elite.plant in CLOSED_FORMS:
        closed_form = CLOSED_FORMS[elite.plant](elite.parameters)
        try:
            closed_form(elite.x[:1], elite.u[:1])
        except KeyError as missing:
            raise UserError(f"the elite's parameters lack {missing}") from None
        return closed_form
    from rtcd_jax.plants.mjx import CpuDynamics, model_of

    columns = elite.x_goal.size + elite.u_max.size
    return CpuDynamics(model_of(elite.plant, elite.parameters), 2 * columns * len(elite.time))


def _pendulum(p: Mapping[str, float]) -> Dynamics:
    def f(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        torque = u[:, 0] - p["b"] * x[:, 1] - p["m"] * p["g"] * p["l"] * np.sin(x[:, 0])
        return np.column_stack([x[:, 1], torque / (p["m"] * p["l"] ** 2)])

    return f


def _cartpole(p: Mapping[str, float]) -> Dynamics:
    """Lagrange's equations M(theta) (cart_ddot, theta_ddot) = tau by Cramer's rule.

    T = Mc/2 cart_dot^2 + Mp/2 |(cart_dot - lp cos(theta) theta_dot, -lp sin(theta) theta_dot)|^2 + I/2 theta_dot^2,
    U = Mp g lp cos(theta)
    """

    def f(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        _, theta, speed, rate = x.T
        m11, m22 = p["Mc"] + p["Mp"], p["inertia_about_com"] + p["Mp"] * p["lp"] ** 2
        m12 = -p["Mp"] * p["lp"] * np.cos(theta)
        tau1 = u[:, 0] - p["Beq"] * speed - p["Mp"] * p["lp"] * np.sin(theta) * rate**2
        tau2 = p["Mp"] * p["lp"] * p["g"] * np.sin(theta) - p["Bp"] * rate
        determinant = m11 * m22 - m12**2
        cart = (m22 * tau1 - m12 * tau2) / determinant
        return np.column_stack([speed, rate, cart, (m11 * tau2 - m12 * tau1) / determinant])

    return f


CLOSED_FORMS: dict[str, Callable[[Mapping[str, float]], Dynamics]] = {"pendulum": _pendulum, "cartpole": _cartpole}
"""By plant: its physical numbers -> dynamics. A plant that is not here has one simulator, C MuJoCo."""
