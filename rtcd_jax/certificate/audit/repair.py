"""A motion that is no solution of the dynamics, mended: the nearest one that is, and its own TVLQR.

    minimize  sum |u - u_given|^2 / F^2 + sum |(x - x_given) / scale|^2
    such that x_{k+1} = Phi(x_k, u_k),  x_0 and x_N the given ends,  |u| <= F,  |x| <= the limits,

with Phi the flow over an interval under a held input. Solved by sequential quadratic programs: Phi is linearized about
the last iterate, the objective is quadratic already.
"""

# pyright: reportAttributeAccessIssue=false
# (clarabel ships no types for its native module.)

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

from rtcd_jax.certificate.audit.external import Cost, Outside
from rtcd_jax.certificate.prove.closed_loop import linear, rate
from rtcd_jax.elite.closed_loop import runge_kutta_step
from rtcd_jax.elite.funnel import riccati_rate
from rtcd_jax.numerics.hermite import cubic_hermite
from rtcd_jax.system.errors import UserError

SUBSTEPS = 20
"""Runge-Kutta steps of Phi."""
MENDED = 1e-11
"""Largest defect [state units] of a mended motion."""
ROUNDS = 100
INSIDE = 0.999
"""Share of the limits that a mended motion may use."""
SMALLEST = 1e-3
"""Smallest scale of a state, for one that hardly moves."""


class Flow(NamedTuple):
    """Phi at every interval [N n], and its derivatives by the state [N n n] and the input [N n]."""

    end: np.ndarray
    by_state: np.ndarray
    by_input: np.ndarray


def flow(outside: Outside, x: np.ndarray, u: np.ndarray) -> Flow:
    """Phi from the states x [N n] under the inputs u [N], with derivatives by complex steps."""
    n, step = x.shape[1], 1e-30
    seeds = np.concatenate([1j * step * np.eye(n + 1), np.zeros((1, n + 1))])
    state = x.T[:, :, None] + seeds.T[:n, None, :]
    held = u[:, None] + seeds.T[n, None, :]
    h = outside.dt / SUBSTEPS
    for _ in range(SUBSTEPS):
        state = runge_kutta_step(lambda _, x: rate(outside.plant, outside.parameters, x, held), state, h)
    slopes = np.imag(state[:, :, :-1]) / step
    return Flow(np.real(state[:, :, -1]).T, np.moveaxis(slopes[:, :, :n], 0, 1), slopes[:, :, n].T)


def defects(outside: Outside) -> np.ndarray:
    """x_{k+1} - Phi(x_k, u_k) [N n] of the given motion."""
    return outside.x[1:] - flow(outside, outside.x[:-1], outside.u).end


def repaired(outside: Outside, cost: Cost) -> Outside:
    """The nearest motion that solves the dynamics, with S of its own TVLQR and levels that keep the volumes.

    Raises:
        UserError: none was found.
    """
    x, u = outside.x.copy(), outside.u.copy()
    x[-1] = outside.goal
    for _ in range(ROUNDS):
        now = flow(outside, x[:-1], u)
        if np.max(np.abs(x[1:] - now.end)) < MENDED and np.max(np.abs(u)) <= outside.limit:
            mended = outside._replace(x=x, u=u)
            values = tracking_values(mended, cost)
            return mended._replace(S=values, rho=_levels(outside, values))
        x, u = _nearest(outside, x, u, now, cost.limits)
    raise UserError("no motion near the given one solves the dynamics between its ends and within the limits")


def _levels(outside: Outside, values: np.ndarray) -> np.ndarray:
    """With which the ellipsoids of other shapes have the given volumes."""
    n = len(outside.goal)
    return outside.rho * (np.linalg.det(values) / np.linalg.det(outside.S)) ** (1 / n)


def _nearest(
    outside: Outside, x: np.ndarray, u: np.ndarray, now: Flow, limits: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One quadratic program for all knots and inputs, Phi linearized about x [N+1 n] and u [N]."""
    import clarabel

    rows, offset = _linearized(x, u, now)
    knots, n = x.shape
    scale = np.maximum(np.max(np.abs(outside.x), axis=0), SMALLEST)
    weights = np.concatenate([np.tile(scale**-2, knots), np.full(len(u), outside.limit**-2)])
    given = np.concatenate([outside.x.ravel(), outside.u])
    room = np.full_like(x, np.inf)
    room[1:-1] = INSIDE * limits
    bounds = np.concatenate([room.ravel(), np.full(len(u), INSIDE * outside.limit)])
    bounded = sp.identity(len(bounds), format="csr")[np.isfinite(bounds)]
    finite = bounds[np.isfinite(bounds)]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    solution = clarabel.DefaultSolver(
        sp.diags(weights, format="csc"),
        -weights * given,
        sp.vstack([rows, bounded, -bounded], format="csc"),
        np.concatenate([offset, finite, finite]),
        [clarabel.ZeroConeT(len(offset)), clarabel.NonnegativeConeT(2 * len(finite))],
        settings,
    ).solve()
    if str(solution.status) not in ("Solved", "AlmostSolved"):
        raise UserError(
            f"no motion between the given ends and within the limits solves the dynamics: {solution.status}"
        )
    z = np.asarray(solution.x)
    return np.concatenate([x[:1], z[n : x.size - n].reshape(-1, n), x[-1:]]), z[x.size :]


def _linearized(x: np.ndarray, u: np.ndarray, now: Flow) -> tuple[Any, np.ndarray]:
    """Sparse rows and right sides of x_{k+1} - A_k x_k - B_k u_k = Phi_k - A_k x_k^0 - B_k u_k^0, and of the ends."""
    knots, n = x.shape
    ends = sp.identity(x.size, format="csr")[[*range(n), *range(x.size - n, x.size)]]
    states = sp.kron(sp.eye(knots - 1, knots, k=1), sp.identity(n)) - sp.block_diag(now.by_state) @ sp.kron(
        sp.eye(knots - 1, knots), sp.identity(n)
    )
    inputs = sp.block_diag([-b[:, None] for b in now.by_input])
    rows = sp.bmat([[states, inputs], [ends, None]], format="csc")
    right = now.end - np.einsum("kij,kj->ki", now.by_state, x[:-1]) - now.by_input * u[:, None]
    return rows, np.concatenate([right.ravel(), x[0], x[-1]])


def tracking_values(outside: Outside, cost: Cost) -> np.ndarray:
    """S [N+1 n n] of the time-varying LQR along the motion, backward from the goal's own."""
    plant, parameters = outside.plant, outside.parameters
    (a, b), q, r, n = linear(plant, parameters, outside.goal, 0.0), np.diag(cost.q), cost.r, len(outside.goal)
    values = [solve_continuous_are(a, b[:, None], q, [[r]])]
    for k in range(len(outside.u) - 1, -1, -1):
        ends, u = outside.x[k : k + 2], outside.u[k]
        rates = [rate(plant, parameters, x, u) for x in ends]

        def backward(t: float, flat: np.ndarray, ends=ends, u=u, rates=rates) -> np.ndarray:
            x = cubic_hermite(1 - t / outside.dt, outside.dt, ends[0], rates[0], ends[1], rates[1])
            a, b = linear(plant, parameters, x, u)
            return -riccati_rate(flat.reshape(n, n), a, b[:, None], q, np.array([r])).ravel()

        found = solve_ivp(backward, (0, outside.dt), values[0].ravel(), method="LSODA", rtol=1e-9, atol=1e-9)
        values.insert(0, found.y[:, -1].reshape(n, n))
    return np.array([(s + s.T) / 2 for s in values])
