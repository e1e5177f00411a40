"""A small elite of the cart-pole without JAX: into the upright, with its LQR; the equations written apart."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

from tests.certificate.swing import PROMISE

PARAMETERS = {
    "Mc": 1.0731266, "Mp": 0.227, "lp": 0.1778, "inertia_about_com": 0.00239204, "Beq": 5.4, "Bp": 0.0024, "g": 9.81,
    "force_limit": 6.0,
}  # fmt: skip
Q, R = np.diag([20.0, 3.0, 1.0, 1.0]), np.array([[0.5]])
DT = 0.02


def rate(x, u, p=PARAMETERS):
    """M(theta) (cart'', theta'') = tau, solved state by state."""
    lever, pivot = p["Mp"] * p["lp"], p["inertia_about_com"] + p["Mp"] * p["lp"] ** 2
    coupling = -lever * np.cos(x[1])
    mass = np.array([[np.full_like(coupling, p["Mc"] + p["Mp"]), coupling], [coupling, np.full_like(coupling, pivot)]])
    tau = np.array(
        [
            u - p["Beq"] * x[2] - lever * np.sin(x[1]) * x[3] ** 2,
            p["g"] * lever * np.sin(x[1]) - p["Bp"] * x[3],
        ]
    )
    accelerations = np.linalg.solve(np.moveaxis(mass, (0, 1), (-2, -1)), np.moveaxis(tau, 0, -1)[..., None])[..., 0]
    return np.concatenate([x[2:], np.moveaxis(accelerations, -1, 0)])


def linear(x, u):
    step = 1e-6
    a = np.stack([(rate(x + step * e, u) - rate(x - step * e, u)) / (2 * step) for e in np.eye(4)], axis=1)
    return a, ((rate(x, u + step) - rate(x, u - step)) / (2 * step))[:, None]


def elite(forces=(5.9, 1.0)):
    """Arrays and record; the motion is found backward from the upright, and saturates in its first interval."""
    goal = np.zeros(4)
    xs, values = [goal], [solve_continuous_are(*linear(goal, 0.0), Q, R)]
    for force in forces[::-1]:
        ends = np.concatenate([xs[0], values[0].ravel()])
        solution = solve_ivp(lambda _, z, u=force: _backward(z, u), (0, DT), ends, rtol=1e-10, atol=1e-10)
        xs.insert(0, solution.y[:4, -1])
        values.insert(0, solution.y[4:, -1].reshape(4, 4))
    inputs = [*forces, 0.0]
    gains = [np.linalg.solve(R, linear(x, u)[1].T @ s) for x, u, s in zip(xs, inputs, values, strict=True)]
    knots = len(xs)
    arrays = {
        "time": DT * np.arange(knots), "x": np.array(xs), "u": np.array(forces)[:, None], "K": np.array(gains),
        "S": np.array(values), "rho": np.full(knots, 0.3), "Q": Q, "R": R, "K_goal": gains[-1], "x_goal": goal,
        "u_max": np.array([6.0]),
    }  # fmt: skip
    arrays["volumes_per_knot"] = np.pi**2 / 2 * arrays["rho"] ** 2 / np.sqrt(np.linalg.det(arrays["S"]))
    return arrays, {"plant": "cartpole", "parameters": PARAMETERS, "state_limits": [0.3, None, None, None], **PROMISE}


def _backward(z, force):
    x, s = z[:4], z[4:].reshape(4, 4)
    a, b = linear(x, force)
    growth = a.T @ s + s @ a - s @ b @ np.linalg.solve(R, b.T @ s) + Q
    return -np.concatenate([rate(x, force), -growth.ravel()])
