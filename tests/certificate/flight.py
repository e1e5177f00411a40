"""A small elite that ends in a catch set: a pendulum in flight, no equilibrium; and one that stands at the upright."""

import numpy as np
from scipy.integrate import solve_ivp

from tests.certificate import swing

HALF_WIDTHS = (0.2, 1.0)
GOAL = np.array([2.0, 2.0])


def elite(goal=GOAL, torques=(1.2, 1.0, 0.7, 0.4), level=1.0, catch=None):
    """Arrays and record; V is 1 on the rim of the catch set, and the last ellipsoid has this level."""
    xs, values = [goal], [np.diag(np.array(HALF_WIDTHS) ** -2.0)]
    for torque in torques[::-1]:
        ends = np.concatenate([xs[0], values[0].ravel()])
        solution = solve_ivp(lambda _, z, u=torque: swing._backward(z, u), (0, swing.DT), ends, rtol=1e-12, atol=1e-12)
        xs.insert(0, solution.y[:2, -1])
        values.insert(0, solution.y[2:, -1].reshape(2, 2))
    gains = np.array([np.linalg.solve(swing.R, swing.linear(x)[1].T @ s) for x, s in zip(xs, values, strict=True)])
    arrays, record = swing.elite(torques)
    arrays |= {
        "x": np.array(xs), "K": gains, "S": np.array(values), "rho": np.full(len(xs), level), "K_goal": gains[-1],
        "x_goal": goal,
    }  # fmt: skip
    arrays["volumes_per_knot"] = np.pi * arrays["rho"] / np.sqrt(np.linalg.det(arrays["S"]))
    return arrays, {**record, "catch": catch or {"half_widths": list(HALF_WIDTHS)}}


def standing():
    """At the upright, whose funnel widens backward: its last ellipsoid lies in its first one."""
    arrays, record = swing.elite((0.0, 0.0, 0.0))
    arrays["rho"] = np.full(4, 1.0)
    arrays["volumes_per_knot"] = np.pi / np.sqrt(np.linalg.det(arrays["S"]))
    return arrays, {**record, "catch": {"reset": "brachiation"}}
