"""A motion that is no solution of the dynamics, projected onto them: the nearest one that is, and its own TVLQR.

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

from rtcd_jax.certificate.audit.external import Cost, ExternalFunnel
from rtcd_jax.elite.closed_loop import runge_kutta_step
from rtcd_jax.elite.funnel import riccati_rate
from rtcd_jax.numerics.hermite import cubic_hermite
from rtcd_jax.system.errors import UserError

SUBSTEPS = 20
"""Runge-Kutta steps of Phi."""
EXACT = 1e-11
"""Largest defect [state units] of a projected motion."""
ROUNDS = 100
INSIDE = 0.999
"""Share of the limits that a projected motion may use."""
SMALLEST = 1e-3
"""Smallest scale of a state, for one that hardly moves."""


class Flow(NamedTuple):
    """Phi at every interval [N n], and its derivatives by the state [N n n] and the input [N n]."""

    end: np.ndarray
    by_state: np.ndarray
    by_input: np.ndarray


def flow(external: ExternalFunnel, x: np.ndarray, u: np.ndarray) -> Flow:
    """Phi from the states x [N n] under the inputs u [N], with derivatives by complex steps."""
    n, step = x.shape[1], 1e-30
    seeds = np.concatenate([1j * step * np.eye(n + 1), np.zeros((1, n + 1))])
    state = x.T[:, :, None] + seeds.T[:n, None, :]
    held = u[:, None] + seeds.T[n, None, :]
    h = external.dt / SUBSTEPS
    for _ in range(SUBSTEPS):
        state = runge_kutta_step(lambda _, x: external.rate(x, held), state, h)
    slopes = np.imag(state[:, :, :-1]) / step
    return Flow(np.real(state[:, :, -1]).T, np.moveaxis(slopes[:, :, :n], 0, 1), slopes[:, :, n].T)


def defects(external: ExternalFunnel) -> np.ndarray:
    """x_{k+1} - Phi(x_k, u_k) [N n] of the given motion."""
    return external.x[1:] - flow(external, external.x[:-1], external.u).end


def with_fitting_inputs(external: ExternalFunnel) -> tuple[ExternalFunnel, dict[str, float]]:
    """The motion under the file's inputs as written (row k until knot k+1) or moved by one knot, whichever fits it.

    Beside it the misfit of both: the largest defect in shares of the states' largest values. Moved are inputs whose row
    k holds until knot k, as some tools write them; they are taken only where they fit twice as well.
    """
    rows = {"as written": external.inputs[:-1], "moved by one knot": external.inputs[1:]}
    scale = np.maximum(np.max(np.abs(external.x), axis=0), SMALLEST)
    misfits = {
        name: float(np.max(np.abs(defects(external._replace(u=u))) / scale))
        for name, u in rows.items()
        if np.all(np.isfinite(u))
    }
    name = min(misfits, key=lambda name: misfits[name] * (2 if name == "moved by one knot" else 1))
    return external._replace(u=rows[name]), misfits


def projected(external: ExternalFunnel, cost: Cost) -> ExternalFunnel:
    """The nearest motion that solves the dynamics, with S of its own TVLQR and levels that keep the volumes.

    Raises:
        UserError: there is none.
    """
    x, u = external.x.copy(), external.u.copy()
    x[-1] = external.goal
    for _ in range(ROUNDS):
        now = flow(external, x[:-1], u)
        if not np.all(np.isfinite(now.by_state)):
            raise UserError("the motion leaves all numbers within one interval: are the units those of the plant?")
        if np.max(np.abs(x[1:] - now.end)) < EXACT and np.max(np.abs(u)) <= external.limit:
            moved = external._replace(x=x, u=u)
            values = tracking_values(moved, cost)
            ratios = np.linalg.det(values) / np.linalg.det(external.S)
            levels = external.rho * ratios ** (1 / len(external.goal))  # of the given volumes
            return moved._replace(S=values, rho=levels)
        x, u = _nearest(external, x, u, now, cost.limits)
    raise UserError("no motion near the given one solves the dynamics between its ends and within the limits")


def _nearest(
    external: ExternalFunnel, x: np.ndarray, u: np.ndarray, now: Flow, limits: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One quadratic program for all knots and inputs, Phi linearized about x [N+1 n] and u [N]."""
    import clarabel

    rows, offset = _linearized(x, u, now)
    knots, n = x.shape
    scale = np.maximum(np.max(np.abs(external.x), axis=0), SMALLEST)
    weights = np.concatenate([np.tile(scale**-2, knots), np.full(len(u), external.limit**-2)])
    given = np.concatenate([external.x.ravel(), external.u])
    limit_of = np.full_like(x, np.inf)
    limit_of[1:-1] = INSIDE * limits
    bounds = np.concatenate([limit_of.ravel(), np.full(len(u), INSIDE * external.limit)])
    bounded = sp.csr_matrix(sp.identity(len(bounds)))[np.isfinite(bounds)]
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
    ends = sp.csr_matrix(sp.identity(x.size))[[*range(n), *range(x.size - n, x.size)]]
    states = sp.kron(sp.eye(knots - 1, knots, k=1), sp.identity(n)) - sp.block_diag(now.by_state) @ sp.kron(
        sp.eye(knots - 1, knots), sp.identity(n)
    )
    inputs = sp.block_diag([-b[:, None] for b in now.by_input])
    rows = sp.bmat([[states, inputs], [ends, None]], format="csc")
    right = now.end - np.einsum("kij,kj->ki", now.by_state, x[:-1]) - now.by_input * u[:, None]
    return rows, np.concatenate([right.ravel(), x[0], x[-1]])


def tracking_values(external: ExternalFunnel, cost: Cost) -> np.ndarray:
    """S [N+1 n n] of the time-varying LQR along the motion, backward from the goal's own."""
    (a, b), q, r, n = external.linear(external.goal, 0.0), np.diag(cost.q), cost.r, len(external.goal)
    values = [solve_continuous_are(a, b[:, None], q, [[r]])]
    for k in range(len(external.u) - 1, -1, -1):
        ends, u = external.x[k : k + 2], external.u[k]
        rates = [external.rate(x, u) for x in ends]

        def backward(t: float, flat: np.ndarray, ends=ends, u=u, rates=rates) -> np.ndarray:
            x = cubic_hermite(1 - t / external.dt, external.dt, ends[0], rates[0], ends[1], rates[1])
            a, b = external.linear(x, u)
            return -riccati_rate(flat.reshape(n, n), a, b[:, None], q, np.array([r])).ravel()

        solution = solve_ivp(backward, (0, external.dt), values[0].ravel(), method="LSODA", rtol=1e-9, atol=1e-9)
        values.insert(0, solution.y[:, -1].reshape(n, n))
    return np.array([(s + s.T) / 2 for s in values])
