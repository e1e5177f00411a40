"""What a certificate is about: a robot's equations and its closed loop, in exact numbers."""

from collections.abc import Callable
from typing import Any, NamedTuple


class Plant(NamedTuple):
    """D f = a + b u. `field(parameters, x, sine, cosine)` gives D, a [n] and b [n], for any kind of number."""

    states: tuple[str, ...]
    units: tuple[str, ...]
    input_unit: str
    angle: int
    limit: str
    parameters: tuple[str, ...]
    field: Callable


def _pendulum(p, x, sine, cosine):
    inertia = p["m"] * p["l"] * p["l"]
    drift = x[1] * (-p["b"] / inertia) + sine * (-p["g"] / p["l"])
    return x[0] * 0 + 1, [x[1], drift], [x[0] * 0, x[0] * 0 + 1 / inertia]


def _cartpole(p, x, sine, cosine):
    """M (cart'', theta'') = (tau_1, tau_2) by Cramer's rule, D = det M; M_12 = -Mp lp cos(theta)."""
    moment = p["Mp"] * p["lp"]
    pivot, total = p["inertia_about_com"] + moment * p["lp"], p["Mc"] + p["Mp"]
    tau_1 = x[2] * -p["Beq"] + sine * x[3] * x[3] * -moment
    tau_2 = sine * (moment * p["g"]) + x[3] * -p["Bp"]
    coupling = cosine * moment
    determinant = coupling * coupling * -1 + pivot * total
    drift = [determinant * x[2], determinant * x[3], tau_1 * pivot + coupling * tau_2, coupling * tau_1 + tau_2 * total]
    return determinant, drift, [x[0] * 0, x[0] * 0, x[0] * 0 + pivot, coupling]


PLANTS = {
    "pendulum": Plant(
        ("theta", "theta_dot"),
        ("rad", "rad/s"),
        "N m",
        0,
        "torque_limit",
        ("m", "l", "b", "g", "torque_limit"),
        _pendulum,
    ),
    "cartpole": Plant(
        ("cart", "theta", "cart_dot", "theta_dot"),
        ("m", "rad", "m/s", "rad/s"),
        "N",
        1,
        "force_limit",
        ("Mc", "Mp", "lp", "inertia_about_com", "Beq", "Bp", "g", "force_limit"),
        _cartpole,
    ),
}


class Claim(NamedTuple):
    """The closed loop that the proof is about, in exact numbers."""

    plant: Plant
    parameters: dict[str, Any]
    limit: Any
    bounds: list
    dt: Any
    x: list
    rates: list
    u: list
    K: list
    x_goal: list
    K_goal: list
    start: tuple[int, Any]

    @property
    def n(self) -> int:
        return len(self.x_goal)
