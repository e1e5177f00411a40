"""The swing-up of rtcd_jax/trajectory.py in plain scalars, for solvers that read no JAX: dynamics, interval, cost.

Written a second time on purpose: that both are one problem is checked along rtcd_jax's solutions.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from rtcd_jax.config.plants import PackagedPlant
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate

SAME = 1e-8
"""Largest difference of cost (relative) and dynamics of one problem, written twice."""

Scalars = Sequence[Any]
"""Numbers of whatever library, which has sin and cos of them, as numpy and CasADi have."""


class Motion(NamedTuple):
    """A motion on the grid, of rtcd_jax's solution or starting guess."""

    xs: np.ndarray
    us: np.ndarray
    h: float


@dataclass(frozen=True)
class Solved:
    """One problem's answer: whether the solver says solved, its cost, largest defect and iterations."""

    solved: bool
    cost: float
    defect: float
    iterations: int


def numbers_of(candidate: Candidate) -> np.ndarray:
    """Design, diagonal of Q, diagonal of R of one candidate."""
    leaves = (*jax.tree.leaves(candidate.design), candidate.q, candidate.r)
    return np.concatenate([np.atleast_1d(leaf) for leaf in leaves])


def pendulum(library, plant: PackagedPlant, design: Scalars, x: Scalars, u: Scalars) -> list:
    """The pendulum by hand; the design is mass and length."""
    mass, length = design
    torque = u[0] - plant.damping * x[1] - mass * plant.gravity * length * library.sin(x[0])
    return [x[1], torque / (mass * length**2)]


def cartpole(library, plant: PackagedPlant, design: Scalars, x: Scalars, u: Scalars) -> list:
    """The cart-pole by hand, with the pole a uniform rod; the design is length to its center and mass."""
    length, mass = design
    moment, inertia = mass * length, 4 / 3 * mass * length**2
    s, c = library.sin(x[1]), library.cos(x[1])
    # [Mc + Mp, -m l c; -m l c, J] (cart'', theta'') = (push, turn)
    push = u[0] - plant.cart_damping * x[2] - moment * s * x[3] ** 2
    turn = moment * plant.gravity * s - plant.pivot_damping * x[3]
    determinant = (plant.cart_mass + mass) * inertia - (moment * c) ** 2
    cart = (inertia * push + moment * c * turn) / determinant
    pole = ((plant.cart_mass + mass) * turn + moment * c * push) / determinant
    return [x[2], x[3], cart, pole]


def dynamics(problem: Problem, library) -> Callable[[Scalars, Scalars, Scalars], list]:
    """The rate of the state, of (design, x, u), by a library's sin and cos; ValueError for a robot that is not here."""
    plant: Any = problem.config.plant
    if plant.name == "pendulum":
        return lambda design, x, u: pendulum(library, plant, design, x, u)
    if plant.name == "cartpole" and plant.inertia == "rod":
        return lambda design, x, u: cartpole(library, plant, design, x, u)
    raise ValueError(f"plant.name = {problem.config.plant.name!r}; must be 'pendulum' or 'cartpole' with inertia: rod")


class Interval(NamedTuple):
    """The next state, and the interval's share of the cost."""

    end: list
    cost: Any


def interval(problem: Problem, library, x: Scalars, u: Scalars, h: Any, numbers: Scalars) -> Interval:
    """One interval of RK4 steps with the input held, for the candidate of these numbers."""
    settings, n = problem.config.trajectory, problem.plant.n
    dims = len(problem.plant.design_units)
    design, q, r = numbers[:dims], numbers[dims : dims + n], numbers[dims + n :]
    rate = partial(dynamics(problem, library), design)
    end, step = list(x), h / settings.substeps

    def moved(time, slopes):
        return [value + time * slope for value, slope in zip(end, slopes, strict=True)]

    for _ in range(settings.substeps):
        k1 = rate(end, u)
        k2 = rate(moved(step / 2, k1), u)
        k3 = rate(moved(step / 2, k2), u)
        k4 = rate(moved(step, k3), u)
        end = moved(step / 6, [a + 2 * b + 2 * c + d for a, b, c, d in zip(k1, k2, k3, k4, strict=True)])
    states = sum(weight * (value - goal) ** 2 for weight, value, goal in zip(q, x, problem.goal, strict=True))
    inputs = sum(weight * value**2 for weight, value in zip(r, u, strict=True))
    return Interval(end, h * (0.5 * (states + inputs) + settings.time_weight))
