"""A small elite without JAX: a pendulum's motion into the upright, with its LQR, as `elites/NNN.npz` stores it."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

PARAMETERS = {"m": 0.6, "l": 0.4, "b": 0.1, "g": 9.81, "torque_limit": 2.5}
UPRIGHT = np.array([np.pi, 0.0])
Q, R = np.diag([4.0, 8.0]), np.array([[10.0]])
DT = 0.05
PROMISE = {"rung": "sampled", "epsilon": 0.01, "confidence": 0.99}


def rate(x, u, p=PARAMETERS):
    """Written apart from the package: m l^2 theta'' = u - b theta' - m g l sin(theta)."""
    torque = u - p["b"] * x[1] - p["m"] * p["g"] * p["l"] * np.sin(x[0])
    return np.stack([x[1], torque / (p["m"] * p["l"] ** 2)])


def linear(x):
    p = PARAMETERS
    inertia = p["m"] * p["l"] ** 2
    slope = -p["g"] / p["l"] * np.cos(x[0])
    return np.array([[0, 1], [slope, -p["b"] / inertia]]), np.array([[0], [1 / inertia]])


def elite(torques=(1.2, 1.0, 0.7, 0.4)):
    """Arrays and record; the motion is found backward from the upright, so that it ends there exactly."""
    xs, values = [UPRIGHT], [solve_continuous_are(*linear(UPRIGHT), Q, R)]
    for torque in torques[::-1]:
        ends = np.concatenate([xs[0], values[0].ravel()])
        solution = solve_ivp(lambda _, z, u=torque: _backward(z, u), (0, DT), ends, rtol=1e-12, atol=1e-12)
        xs.insert(0, solution.y[:2, -1])
        values.insert(0, solution.y[2:, -1].reshape(2, 2))
    gains = np.array([np.linalg.solve(R, linear(x)[1].T @ s) for x, s in zip(xs, values, strict=True)])
    knots = len(xs)
    arrays = {
        "time": DT * np.arange(knots), "x": np.array(xs), "u": np.array(torques)[:, None], "K": gains,
        "S": np.array(values), "rho": np.full(knots, 20.0), "Q": Q, "R": R, "K_goal": gains[-1], "x_goal": UPRIGHT,
        "u_max": np.array([2.5]),
    }  # fmt: skip
    determinants = np.linalg.det(arrays["S"])
    arrays["volumes_per_knot"] = np.pi * arrays["rho"] / np.sqrt(determinants)
    return arrays, {"plant": "pendulum", "parameters": PARAMETERS, "state_limits": [6.283185307179586, 7.0], **PROMISE}


def _backward(z, torque):
    x, s = z[:2], z[2:].reshape(2, 2)
    a, b = linear(x)
    growth = a.T @ s + s @ a - s @ b @ np.linalg.solve(R, b.T @ s) + Q
    return -np.concatenate([rate(x, torque), -growth.ravel()])
