"""Small elites of any packaged robot without JAX: into its goal, with the LQR of its configuration's weights."""

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

from rtcd_jax.config.load import load
from rtcd_jax.config.plants import PLANTS
from rtcd_jax.config.robot import value_of
from rtcd_jax.plants import dynamics_of
from tests.certificate.swing import PROMISE
from tests.paths import CONFIGS


def parameters_of(name, **changed):
    """The robot's stored parameters with the design of its configuration; and the motor's limit."""
    config, robot = load(next(CONFIGS.glob(f"{name}*.yaml"))), PLANTS[name]().robot()
    values = PLANTS[name]().values() | {key: each.initial for key, each in config.design.items()} | changed
    return {key: float(value) for key, value in robot.parameters(values).items()}, value_of(robot.limits[0], values)


def elite(name, inputs=(0.3, 0.1), dt=0.02, q=None, r=None, **changed):
    """Arrays and record; the motion is found backward from the goal, `inputs` are shares of the limit."""
    config, (parameters, limit) = load(next(CONFIGS.glob(f"{name}*.yaml"))), parameters_of(name, **changed)
    weights = [each.initial for each in config.weights.q] if q is None else q
    Q = np.diag(np.array(weights, float))
    R = np.array([[float(config.weights.r[0].initial if r is None else r)]])
    f, n = dynamics_of(PLANTS[name](), parameters, 100), len(Q)

    def linear(x, u):
        step = 1e-6
        ends = np.concatenate([x + step * np.eye(n), x - step * np.eye(n)])
        rates, held = f(ends, np.full((2 * n, 1), u)), f(np.stack([x, x]), np.array([[u + step], [u - step]]))
        return (rates[:n] - rates[n:]).T / (2 * step), (held[:1] - held[1:]).T / (2 * step)

    def backward(z, u):
        x, s = z[:n], z[n:].reshape(n, n)
        a, b = linear(x, u)
        growth = a.T @ s + s @ a - s @ b @ np.linalg.solve(R, b.T @ s) + Q
        return -np.concatenate([f(x[None], np.array([[u]]))[0], -growth.ravel()])

    goal, forces = np.array(config.task.goal, float), [share * limit for share in inputs]
    xs, values = [goal], [solve_continuous_are(*linear(goal, 0.0), Q, R)]
    for force in forces[::-1]:
        ends = np.concatenate([xs[0], values[0].ravel()])
        solution = solve_ivp(lambda _, z, u=force: backward(z, u), (0, dt), ends, rtol=1e-10, atol=1e-10)
        xs.insert(0, solution.y[:n, -1])
        values.insert(0, (solution.y[n:, -1].reshape(n, n) + solution.y[n:, -1].reshape(n, n).T) / 2)
    gains = [np.linalg.solve(R, linear(x, u)[1].T @ s) for x, u, s in zip(xs, [*forces, 0.0], values, strict=True)]
    knots = len(xs)
    arrays = {
        "time": dt * np.arange(knots), "x": np.array(xs), "u": np.array(forces)[:, None], "K": np.array(gains),
        "S": np.array(values), "rho": np.full(knots, 1.0), "Q": Q, "R": R, "K_goal": gains[-1], "x_goal": goal,
        "u_max": np.array([limit]),
    }  # fmt: skip
    half = n // 2
    arrays["volumes_per_knot"] = np.pi**half / half * np.linalg.det(arrays["S"]) ** -0.5
    limits = [None if np.isinf(each) else float(each) for each in config.task.state_limits]
    return arrays, {"plant": name, "parameters": parameters, "state_limits": limits, **PROMISE}
