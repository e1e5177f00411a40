"""A trajectory with its funnel from outside: a table of knots, as an elite that certificates can be about.

One row a knot after a row of headings, columns by their place: time [s], the states, the input (held until the next
knot; the last one may be nan), rho, and the upper triangle of S row by row: B_k = {(x - x_k)'S_k (x - x_k) <= rho_k}.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rtcd_jax.certificate.check import PLANTS, Plant
from rtcd_jax.certificate.prove.closed_loop import linear
from rtcd_jax.elite.elite import CLAIMED
from rtcd_jax.system.errors import UserError, closest

EVEN = 1e-6
"""Share of an interval by which the knots' times may be off an even grid."""
AT_GOAL = 1e-3
"""How far the last state may be from the equilibrium that it stands for."""


class Outside(NamedTuple):
    """What a file claims of a robot; `goal` is the equilibrium at its last knot."""

    name: str
    parameters: dict[str, float]
    dt: float
    x: Float[np.ndarray, "N+1 n"]
    u: Float[np.ndarray, " N"]
    rho: Float[np.ndarray, " N+1"]
    S: Float[np.ndarray, "N+1 n n"]
    goal: Float[np.ndarray, " n"]

    @property
    def plant(self) -> Plant:
        return PLANTS[self.name]

    @property
    def limit(self) -> float:
        """Largest input."""
        return self.parameters[self.plant.limit]

    @property
    def volumes(self) -> np.ndarray:
        """Of the ellipsoids [N+1]."""
        n = len(self.goal)
        ball = math.pi ** (n / 2) / math.gamma(n / 2 + 1)
        return ball * self.rho ** (n / 2) / np.sqrt(np.linalg.det(self.S))


def read_outside(path: Path, name: str, parameters: Mapping[str, float]) -> Outside:
    """The file's trajectory and funnel.

    Raises:
        UserError: an unknown plant or parameter, or a file that is not as the module says.
    """
    if name not in PLANTS:
        raise UserError(f"--plant = {name!r}: unknown plant; {closest(name, tuple(PLANTS))}")
    plant = PLANTS[name]
    wrong = parameters.keys() ^ set(plant.parameters)
    if wrong:
        names, differ = ", ".join(plant.parameters), ", ".join(sorted(wrong))
        raise UserError(f"--parameters: must be those of the {name}, {names}; differ in {differ}")
    table = _table(path, plant)
    n = len(plant.states)
    times, x, u, rho = table[:, 0], table[:, 1 : n + 1], table[:, n + 1], table[:, n + 2]
    s = np.zeros((len(table), n, n))
    rows, columns = np.triu_indices(n)
    s[:, rows, columns] = s[:, columns, rows] = table[:, n + 3 :]
    dt = (times[-1] - times[0]) / (len(times) - 1)
    if not dt > 0 or np.max(np.abs(np.diff(times) - dt)) > EVEN * dt:
        raise UserError(f"{path}: times must rise evenly, knot by knot")
    for what, holds in (("rho", rho > 0), ("S", np.linalg.eigvalsh(s)[:, 0] > 0)):
        if not np.all(holds):
            raise UserError(f"{path}: {what} of knot {int(np.argmin(holds))} must be positive")
    return Outside(name, dict(parameters), float(dt), x, u[:-1], rho, s, _goal(path, plant, x[-1]))


def _table(path: Path, plant: Plant) -> np.ndarray:
    n = len(plant.states)
    width = n + 3 + n * (n + 1) // 2
    try:
        with path.open(newline="") as file:
            rows = list(csv.reader(file))[1:]
        table = np.array([[float(cell) for cell in row] for row in rows if row])
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise UserError(f"{path}: must be a row of headings and rows of {width} numbers ({error})") from None
    whole = table.ndim == 2 and table.shape[1] == width and len(table) > 1
    if whole:
        table[-1, n + 1] = 0
    if not whole or not np.all(np.isfinite(table)):
        columns = f"time, {', '.join(plant.states)}, input, rho, upper triangle of S"
        raise UserError(f"{path}: must have at least 2 rows of {width} finite numbers: {columns}")
    return table


def _goal(path: Path, plant: Plant, last: np.ndarray) -> np.ndarray:
    """The equilibrium at the last state: at rest, the angle a multiple of pi."""
    goal = last.copy()
    goal[plant.angle] = round(last[plant.angle] / math.pi) * math.pi
    goal[len(goal) // 2 :] = 0
    if np.max(np.abs(goal - last)) > AT_GOAL:
        raise UserError(f"{path}: the last state {last.tolist()} must be at rest, its angle a multiple of pi")
    return goal


class Cost(NamedTuple):
    """The diagonals of the cost that S belongs to, and the limits on the states, infinite for none."""

    q: Float[np.ndarray, " n"]
    r: float
    limits: Float[np.ndarray, " n"]

    @classmethod
    def of(cls, outside: Outside, q: Sequence[float], r: float, limits: Sequence[float]) -> "Cost":
        """Checked; no limits at all are infinite ones.

        Raises:
            UserError: a number that is not positive, or too few or too many.
        """
        n = len(outside.goal)
        limits = limits or (math.inf,) * n
        for name, values in (("q", q), ("state_limits", limits)):
            if len(values) != n or not all(value > 0 for value in values):
                states = ", ".join(outside.plant.states)
                raise UserError(f"--{name} = {' '.join(map(str, values))}: must be {n} numbers > 0 ({states})")
        if not r > 0:
            raise UserError(f"--r = {r}: must be > 0")
        return cls(np.asarray(q), r, np.asarray(limits))


def elite_of(outside: Outside, cost: Cost) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and record as `elites/NNN` has them; the gains are R^-1 B'S, and the goal's those of the last knot."""
    inputs = np.append(outside.u, 0.0)
    gains = [
        linear(outside.plant, outside.parameters, x, u)[1] @ s / cost.r
        for x, u, s in zip(outside.x, inputs, outside.S, strict=True)
    ]
    volumes = outside.volumes
    arrays = {
        "time": outside.dt * np.arange(len(outside.x)), "x": outside.x, "u": outside.u[:, None],
        "K": np.array(gains)[:, None], "S": outside.S, "rho": outside.rho,
        "Q": np.diag(cost.q), "R": np.array([[cost.r]]),
        "K_goal": gains[-1][None], "x_goal": outside.goal, "u_max": np.array([outside.limit]),
        "volumes_per_knot": volumes, "volumes_sum": volumes.sum(), "volumes_inlet": volumes[0],
        "volumes_integral": np.trapezoid(volumes, dx=outside.dt),
    }  # fmt: skip
    record = {
        "plant": outside.name,
        "parameters": outside.parameters,
        "weights": {"q": cost.q, "r": [cost.r]},
        "state_limits": [limit if math.isfinite(limit) else None for limit in cost.limits.tolist()],
        "status": "OK",
        "rung": CLAIMED,
    }
    return {name: np.asarray(array) for name, array in arrays.items()}, record
