"""Funnels about every robot's own motion, where the uncertain parameters are constant in time.

Under one controller, which knows nothing of the parameters p, every robot follows another motion c_p(t) from x*(0).
With `uncertainty.center: moving` the funnel of robot p is c_p(t_k) + {y : y'S_k y <= rho_k}: shapes and levels are
common to all robots, and so is the first ellipsoid. The levels are such that each corner of the box, and the nominal
robot, is carried from its ellipsoid into its next one, and at t_N into the goal's region; held-out samples are robots
from inside the box as well, each about its own motion.
"""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtcd_jax import rollout
from rtcd_jax.adversary import Constant, Scales, Worst
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Uncertainty


class Robots(NamedTuple):
    """Robots with constant parameters, on the leading axis: the nominal one and the corners of a box.

    `shifts` are the own motions less x*(t), where a rollout's stages are.
    """

    scales: Scales
    centers: Float[Array, "R n knots"]
    shifts: Float[Array, "R steps 3 n intervals"]

    @classmethod
    def of(
        cls,
        problem: Problem,
        candidate: Candidate,
        tracking: rollout.TrackingData,
        nominal: Float[Array, "n knots"],
        uncertainty: Uncertainty,
    ) -> "Robots":
        """Those of the uncertainty's parameters; `nominal` is x* at the knots."""
        signs = np.array([np.zeros(len(uncertainty.parameters)), *corners(len(uncertainty.parameters))])
        widths = uncertainty.parameters.items()
        scales = {name: 1 + width * sign for (name, width), sign in zip(widths, signs.T, strict=True)}
        alone = rollout.closed_form(problem.plant, Constant(problem.plant, scales))
        start = jnp.broadcast_to(nominal[:, :1], (problem.plant.n, len(signs)))

        def onward(x, k):
            ends, _ = rollout.roll_intervals(problem, candidate, tracking.part(k + np.arange(1)), x[:, None], alone)
            return ends[:, 0], ends[:, 0]

        _, later = jax.lax.scan(onward, start, jnp.arange(nominal.shape[1] - 1))
        knots = jnp.concatenate([start[None], later])  # [knots n R]
        steps = tracking.states.shape[0]
        shifts = rollout.linear_in_intervals(knots - nominal.T[..., None], steps)
        return cls(scales, jnp.transpose(knots, (2, 1, 0)), jnp.moveaxis(shifts, 3, 0))


def corners(parameters: int) -> list[tuple[int, ...]]:
    """Signs at the corners of a box."""
    return list(itertools.product((-1, 1), repeat=parameters))


def for_each(robots: Robots | None, f: Callable, *arguments: Any) -> Any:
    """f(robot, arguments) of all robots on a leading axis, which the arguments have as well; f(None, ...) without."""
    return f(None, *arguments) if robots is None else jax.vmap(f)(robots, *arguments)


def facing(dynamics: rollout.Dynamics, robot: Robots | None) -> rollout.Dynamics:
    """With the adversary of one robot."""
    if robot is None:
        return dynamics
    return dynamics._replace(opponent=cast(Worst, dynamics.opponent).of_robot(robot.scales))
