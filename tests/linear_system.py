"""A linear robot whose funnels are known: x' = A x + B u with the error's motion in closed form.

Away from the input's limit the error from a nominal motion obeys e' = (A - B K) e with the constant gain K of the LQR,
V = e' S e with its value matrix; both are the same along every motion.
"""

from typing import ClassVar, final

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import yaml

from rtcd_jax.config import load as configuration
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.plants.base import Plant
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Policy, Trajectory

A = np.array([[0.0, 1.0], [4.0, 0.0]])
B = np.array([[0.0], [1.0]])
Q, R = np.diag([3.0, 1.0]), np.array([[0.5]])
S = scipy.linalg.solve_continuous_are(A, B, Q, R)
K = np.linalg.solve(R, B.T @ S)
CLOSED = A - B @ K
UNBOUNDED = 1e9


@final
class Nothing(eqx.Module):
    """The design of a robot that has none."""


class Equations(Plant):
    """A robot that is its equations alone: no design, no MJCF, one force."""

    limit: float

    input_names: ClassVar = ("force",)
    input_units: ClassVar = ("N",)
    design_units: ClassVar = {}
    Design: ClassVar = Nothing
    xml: ClassVar = ""

    def input_limits(self, design):
        return (self.limit,)

    def motor_speeds(self, design, x):
        return x[1:2]

    def parameters(self, design):
        return {"limit": self.limit}

    @classmethod
    def from_parameters(cls, parameters):
        return cls(limit=parameters["limit"]), Nothing()

    def edit_model(self, design):
        return {}


@final
class Unstable(Equations):
    """x1'' = 4 x1 + u: an inverted pendulum about the upright."""

    limit: float = UNBOUNDED

    state_names: ClassVar = ("position", "speed")
    state_units: ClassVar = ("m", "m/s")

    def dynamics(self, design, x, u):
        return jnp.stack([x[1], 4 * x[0] + u[0]])


def problem_of(state_limits, limit=UNBOUNDED, intervals=10, **funnel) -> Problem:
    """The linear robot in these boxes, its goal the origin."""
    data = yaml.safe_load(configuration.EXAMPLE)
    data["trajectory"] = {"knots": intervals + 1}
    sampling = {"rollouts": "closed_form", "directions": 48, "steps": 8, "trials": 64}
    data["funnel"] = sampling | funnel
    plant = Unstable(limit)
    limits = np.array(state_limits, float)
    return Problem(configuration.parse(data), plant, np.zeros(2), np.zeros(2), limits, ())


def candidate() -> Candidate:
    return Candidate(Nothing(), jnp.diag(jnp.asarray(Q)), jnp.diag(jnp.asarray(R)))


def policy(us, dt: float) -> Policy:
    """The LQR along the motion that ends at the origin under the inputs `us` [N]."""
    forward = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, 3))]]) * dt)
    xs = [np.zeros(2)]
    for u in us[::-1]:
        xs.append(np.linalg.solve(forward[:2, :2], xs[-1] - forward[:2, 2] * u))
    knots, zero = len(us) + 1, jnp.zeros((), jnp.int32)
    motion = Trajectory(
        us=jnp.asarray(us, float)[:, None],
        xs=jnp.asarray(np.array(xs[::-1])),
        dt=jnp.asarray(dt),
        cost=jnp.zeros(()),
        defect=jnp.zeros(()),
        iterations=zero,
        status=zero,
    )
    return Policy(motion, jnp.tile(jnp.asarray(K), (knots, 1, 1)), jnp.tile(jnp.asarray(S), (knots, 1, 1)), zero)


def ellipsoids(policy: Policy) -> Ellipsoids:
    return Ellipsoids.about(policy.trajectory.xs.T, jnp.moveaxis(policy.values, 0, -1))


def levels(policy: Policy, state_limits, last: float, checks: int, margin: float) -> np.ndarray:
    """The levels [N+1] by linear algebra, of which each gives away a `margin`: B_k is carried into B_{k+1}, within the
    boxes at `checks` times an interval. `last` is the last level.
    """
    xs, h = np.asarray(policy.trajectory.xs), float(policy.trajectory.dt)
    forced = np.block([[A, B], [np.zeros((1, 3))]])
    found = [last]
    for k in reversed(range(len(xs) - 1)):
        radius = np.sqrt(found[-1] / decay(h))
        for time in h * np.arange(checks + 1) / checks:
            nominal = scipy.linalg.expm(forced * time)[:2] @ np.append(xs[k], policy.trajectory.us[k, 0])
            flow = scipy.linalg.expm(CLOSED * time)
            reach = np.sqrt(np.diag(flow @ np.linalg.solve(S, flow.T)))
            radius = min(radius, np.min((np.asarray(state_limits) - np.abs(nominal)) / reach))
        found.append((1 - margin) * max(radius, 0.0) ** 2)
    return np.array(found[::-1])


def decay(duration: float) -> float:
    """The largest ratio of V after and before `duration`."""
    end = scipy.linalg.expm(CLOSED * duration)
    return float(scipy.linalg.eigvalsh(end.T @ S @ end, S)[-1])
