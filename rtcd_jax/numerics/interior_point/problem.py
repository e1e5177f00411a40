"""What is to be solved, from where, how accurately, and what comes back."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtcd_jax.numerics.keep_out import Set


class Settings(NamedTuple):
    """Tolerances and the constants of the method."""

    lanes: int | None = None  # whole vectors; None: as many as the device wants
    defect_tolerance: float = 1e-9
    dual_tolerance: float = 1e-4  # relative to 1 + max |multiplier|
    complementarity_tolerance: float = 1e-5  # likewise
    barrier_start: float = 0.3
    barrier_floor: float = 1e-8
    barrier_factor: float = 0.2  # kappa_mu, (7)
    barrier_power: float = 1.5  # theta_mu, (7)
    barrier_accuracy: float = 1000.0  # kappa_epsilon of algorithm A-2; their 10 is stricter than a warm filter needs
    boundary_fraction: float = 0.99  # tau_min, (8)
    regularization_start: float = 1.0
    regularization_factor: float = 4.0
    end_weight: float = 1e4  # over the model's curvature: see kkt.py
    trials: int = 3  # few: a lane that backtracks keeps the others waiting, more regularization helps as well
    backtracking: float = 0.4
    filter_size: int = 16


DEFAULTS = Settings()


class ControlProblem(NamedTuple):
    """What to solve. The functions work elementwise on trailing axes.

    `ends(parameters)` are x_0 and x_N, [n] or [n P]; `travel` is the largest distance between them in each state.
    `interval(x [n ..], u [m ..], h, parameters)` is the next x, `running(x, u, parameters)` the cost per time of an
    interval, `rate(x, u, parameters)` the time derivative of x, both of tuples x and u of components. Derivatives are
    taken of one Runge-Kutta step of `rate`, a cheaper integration of the same dynamics. Its error decides how fast the
    iteration contracts (an inexact Newton method) and, to second order, how optimal its end is; defects are always
    measured by `interval`, so that the end is a solution of the accurate dynamics.
    """

    interval: Callable
    rate: Callable
    running: Callable
    ends: Callable
    travel: np.ndarray
    state_limits: np.ndarray
    input_limits: np.ndarray
    step_limits: tuple[float, float]
    keep_out: tuple[Set, ...] = ()


class Guess(NamedTuple):
    """Where a solve starts; the ends of `xs` are overwritten by the pinned states."""

    xs: Float[Array, "N+1 n *P"]
    us: Float[Array, "N m *P"]
    h: Float[Array, "*P"]


class Solution(NamedTuple):
    """`solved` is true where defects, stationarity and complementarity reached their tolerances."""

    us: Float[Array, "N m P"]
    xs: Float[Array, "N+1 n P"]
    h: Float[Array, " P"]
    cost: Float[Array, " P"]
    defect: Float[Array, " P"]
    iterations: Int[Array, " P"]
    solved: Bool[Array, " P"]
