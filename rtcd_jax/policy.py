"""Trajectory -> Policy: the time-varying LQR about it.

S solves -S' = A'S + S A - S B R^-1 B' S + Q backward along (x*, u*), from the value matrix of the goal's own
infinite-horizon LQR with the same Q and R; K = R^-1 B' S (paper, section II-C). The whole closed loop thereby has one
value function that continues through t_N. Where the motion ends in a catch set {x : (x - goal)'C(x - goal) <= 1}
instead, the value matrix there is catch_weight C, and t_N is the end.

The policy options, the configuration's or the search's, may make the controller leave authority: A becomes A + alpha I,
and R becomes w R / max(1 - |u*| / u_max, authority)^2 with the interval's own u*. The defaults, alpha = 0 and
w = authority = 1, change nothing.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rtcd_jax.numerics import riccati
from rtcd_jax.numerics.batched import mm, transpose
from rtcd_jax.numerics.derivatives import jacobian
from rtcd_jax.numerics.hermite import cubic_hermite
from rtcd_jax.numerics.loops import packed_scan
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Policy, Status, Trajectory, first_failure
from rtcd_jax.window import catch_shape

DOUBLINGS = 8
"""At most 2^8 short intervals a substep resolve a closed loop of 1000 poles a second at h = 0.1 s."""


class Nominal(NamedTuple):
    """The nominal motion, interval by interval, as the cubic Hermite interpolant of its knots."""

    dt: Float[Array, ""]
    inputs: Float[Array, "m intervals"]
    starts: Float[Array, "n intervals"]
    start_rates: Float[Array, "n intervals"]
    ends: Float[Array, "n intervals"]
    end_rates: Float[Array, "n intervals"]

    def at(self, shares: Float[Array | np.ndarray, " times"]) -> Float[Array, "n intervals times"]:
        """x* at fractions of every interval."""
        ends = (self.starts, self.start_rates, self.ends, self.end_rates)
        return cubic_hermite(jnp.asarray(shares, self.dt.dtype), self.dt, *(leaf[:, :, None] for leaf in ends))


def nominal(problem: Problem, candidate: Candidate, trajectory: Trajectory) -> Nominal:
    """The motion that the controller tracks."""
    us, xs = trajectory.us.T, trajectory.xs.T
    rate = partial(problem.plant.dynamics, candidate.design)
    starts, ends = xs[:, :-1], xs[:, 1:]
    return Nominal(trajectory.dt, us, starts, rate(starts, us), ends, rate(ends, us))


def linearize(
    problem: Problem, candidate: Candidate, x: Float[Array, "n *batch"], u: Float[Array, "m *batch"]
) -> tuple[Float[Array, "n n *batch"], Float[Array, "n m *batch"]]:
    """A and B of the dynamics at x, u."""
    n = problem.plant.n

    def dynamics(z):
        return problem.plant.dynamics(candidate.design, z[:n], z[n:])

    both = jacobian(dynamics, jnp.concatenate([x, u]))
    return both[:, :n], both[:, n:]


def inputs_at_knots(problem: Problem, trajectory: Trajectory) -> Float[Array, "m knots"]:
    """u* of the interval that begins at each knot: at the last one that of rest or, in a catch set, the last held."""
    last = jnp.zeros_like(trajectory.us[:1]) if not problem.caught else trajectory.us[-1:]
    return jnp.concatenate([trajectory.us, last]).T


def input_jumps(problem: Problem, candidate: Candidate, trajectory: Trajectory) -> Float[Array, "knots n m"]:
    """B at the knots: by how much the state jumps for a unit impulse on each input [1/(input's unit s)]."""
    _, b = linearize(problem, candidate, trajectory.xs.T, inputs_at_knots(problem, trajectory))
    return jnp.moveaxis(b, -1, 0)


def riccati_intervals(problem: Problem, candidate: Candidate, trajectory: Trajectory) -> riccati.Interval:
    """The flow of the controller's Riccati equation over every interval, which is the leading axis."""
    substeps = problem.config.trajectory.substeps
    motion = nominal(problem, candidate, trajectory)
    middles = (np.arange(substeps) + 0.5) / substeps
    xs = motion.at(middles)
    weights = input_weights(problem, candidate, motion.inputs)
    us = jnp.broadcast_to(motion.inputs[:, :, None], (problem.plant.m, *xs.shape[1:]))
    pieces = _interval(problem, candidate, xs, us, weights[:, :, None], trajectory.dt / substeps)
    whole = jax.tree.map(lambda leaf: leaf[..., 0], pieces)
    for piece in range(1, substeps):
        whole = riccati.compose(whole, jax.tree.map(lambda leaf, piece=piece: leaf[..., piece], pieces))
    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0), whole)


def stabilize(
    problem: Problem, candidate: Candidate, trajectory: Trajectory, last: Float[Array, "n n"] | None = None
) -> Policy:
    """The LQR about a trajectory; RICCATI_INDEFINITE if a value matrix lost positive definiteness.

    `last` is S at t_N where the candidate's cycle says it.
    """
    stages = riccati_intervals(problem, candidate, trajectory)
    last, reached = final_value(problem, candidate) if last is None else (last, jnp.asarray(True))

    def backward(carry, interval):
        value, definite = riccati.propagate(interval, carry[0])
        carry = value, carry[1] & definite
        return carry, value

    (_, definite), values = packed_scan(backward, (last, reached), stages, reverse=True)
    values = jnp.concatenate([values, last[None]])
    inputs = inputs_at_knots(problem, trajectory)
    weights = input_weights(problem, candidate, inputs)
    _, b = linearize(problem, candidate, trajectory.xs.T, inputs)
    gains = mm(transpose(b) / weights[:, None], jnp.moveaxis(values, 0, -1))
    status = jnp.where(definite, Status.OK, Status.RICCATI_INDEFINITE)
    return Policy(trajectory, jnp.moveaxis(gains, -1, 0), values, first_failure(trajectory.status, status))


def value_rates(problem: Problem, candidate: Candidate, policy: Policy) -> Float[Array, "intervals 2 n n"]:
    """S' at both ends of every interval: the policy's own, or -(A'S + S A - S B R^-1 B' S + Q)."""
    if policy.value_rates is not None:
        return policy.value_rates
    xs, us = policy.trajectory.xs.T, policy.trajectory.us.T
    values = jnp.moveaxis(policy.values, 0, -1)
    states, s = (jnp.stack([each[..., :-1], each[..., 1:]], -1) for each in (xs, values))
    inputs = jnp.broadcast_to(us[..., None], (*us.shape, 2))
    a, b = _discounted(problem, candidate, *linearize(problem, candidate, states, inputs))
    gain = mm(s, b)
    square = mm(gain / input_weights(problem, candidate, inputs)[None], transpose(gain))
    q = jnp.diag(candidate.q)[:, :, None, None]
    return jnp.moveaxis(square - mm(transpose(a), s) - mm(s, a) - q, (2, 3), (0, 1))


def final_value(problem: Problem, candidate: Candidate) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """S of the goal's infinite-horizon LQR, and whether it exists; that of the catch set where there is one."""
    if problem.caught and problem.reset is None:
        return catch_weight(problem, candidate) * catch_shape(problem, candidate), jnp.asarray(True)
    goal = jnp.asarray(problem.goal, candidate.q.dtype)
    rest = jnp.zeros(problem.plant.m, goal.dtype)
    a, b = _discounted(problem, candidate, *linearize(problem, candidate, goal, rest))
    weights = input_weights(problem, candidate, rest)
    return riccati.infinite_horizon(a, _spread(b, weights), jnp.diag(candidate.q))


def options(problem: Problem, candidate: Candidate) -> dict[str, Any]:
    """The policy's options by name: the candidate's, or else the configuration's."""
    return problem.config.policy.initial() | candidate.policy


def catch_weight(problem: Problem, candidate: Candidate) -> Float[Array, ""]:
    """V on the boundary of the catch set: the candidate's, or else the configuration's."""
    known: Any = problem.config.policy.catch_weight
    return jnp.asarray(candidate.policy.get("catch_weight", known), candidate.q.dtype)


def input_weights(problem: Problem, candidate: Candidate, us: Float[Array, "m *batch"]) -> Float[Array, "m *batch"]:
    """The diagonal of the controller's R where the feed-forward is `us`."""
    policy, behind = options(problem, candidate), (1,) * (us.ndim - 1)
    limits = jnp.asarray(problem.input_limits(candidate.design), us.dtype).reshape(-1, *behind)
    left = jnp.maximum(1 - jnp.abs(us) / limits, policy["authority"])
    return policy["input_weight"] * candidate.r.reshape(-1, *behind) / left**2


def _interval(problem: Problem, candidate: Candidate, xs, us, weights, duration) -> riccati.Interval:
    a, b = _discounted(problem, candidate, *linearize(problem, candidate, xs, us))
    cost = jnp.broadcast_to(jnp.diag(candidate.q)[:, :, None, None], a.shape)
    system = a, _spread(b, weights), cost, duration
    return riccati.constant_interval(*system, riccati.enough_doublings(*system, DOUBLINGS))


def _discounted(problem: Problem, candidate: Candidate, a, b):
    """A + alpha I, and B."""
    identity = jnp.eye(a.shape[0], dtype=a.dtype).reshape(a.shape[0], -1, *(1,) * (a.ndim - 2))
    return a + options(problem, candidate)["discount"] * identity, b


def _spread(b, weights):
    """B R^-1 B' for the diagonal of R [m ...]."""
    return mm(b / weights[None], transpose(b))
