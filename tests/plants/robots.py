"""The packaged robots with other constants, and their equations as they were once written by hand."""

from collections.abc import Callable, Mapping

import jax.numpy as jnp
import numpy as np

from rtcd_jax.config.plants import PLANTS
from rtcd_jax.plants import make_plant
from rtcd_jax.plants.base import Plant

MEASURED_INERTIA = 0.004359984
Dynamics = Callable[[np.ndarray, np.ndarray], np.ndarray]


def packaged(name: str, **constants) -> Plant:
    """A packaged robot."""
    return make_plant(PLANTS[name].model_validate({"name": name, **constants}), {})


def design(name: str, **values: float):
    """A design of a packaged robot."""
    return packaged(name).Design(**{key: jnp.asarray(value) for key, value in values.items()})


def pendulum(p: Mapping[str, float]) -> Dynamics:
    """theta_ddot = (u - b theta_dot - m g l sin theta) / (m l^2)."""

    def f(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        torque = u[:, 0] - p["b"] * x[:, 1] - p["m"] * p["g"] * p["l"] * np.sin(x[:, 0])
        return np.column_stack([x[:, 1], torque / (p["m"] * p["l"] ** 2)])

    return f


def cartpole(p: Mapping[str, float]) -> Dynamics:
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


BY_HAND: dict[str, Callable[[Mapping[str, float]], Dynamics]] = {"pendulum": pendulum, "cartpole": cartpole}


def _pendulum_energy(p: Mapping[str, float]) -> Callable[[np.ndarray], float]:
    return lambda x: p["m"] * (0.5 * (p["l"] * x[1]) ** 2 + p["g"] * p["l"] * (1 - np.cos(x[0])))


def _cartpole_energy(p: Mapping[str, float]) -> Callable[[np.ndarray], float]:
    moment, inertia = p["Mp"] * p["lp"], p["inertia_about_com"] + p["Mp"] * p["lp"] ** 2

    def energy(x: np.ndarray) -> float:
        moving = 0.5 * (p["Mc"] + p["Mp"]) * x[2] ** 2 - moment * np.cos(x[1]) * x[2] * x[3]
        return moving + 0.5 * inertia * x[3] ** 2 + moment * p["g"] * (1 + np.cos(x[1]))

    return energy


ENERGIES = {"pendulum": _pendulum_energy, "cartpole": _cartpole_energy}
"""Of a state, by plant and parameters [J]."""
