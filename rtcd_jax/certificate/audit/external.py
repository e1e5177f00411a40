"""External funnels: somebody's trajectory with its funnel, from tables, as an elite that certificates can be about.

One table has a row a knot under a row of headings, columns by their place: time [s], the states, the input (held until
the next knot; the last one may be nan), rho, and the upper triangle of S row by row: B_k = {(x - x_k)'S_k (x - x_k) <=
rho_k}. Or two files: a trajectory with the first of these columns, and rho with all of S, a knot a column or a row.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rtcd_jax.certificate.prove.field import linear, rate
from rtcd_jax.certificate.prove.robot import ClaimedRobot, robot_of
from rtcd_jax.config.load import load
from rtcd_jax.config.plants import PLANTS, PackagedPlant, RobotPlant
from rtcd_jax.elite.elite import CLAIMED
from rtcd_jax.system.delimited import number_or_nan, read_table, shown
from rtcd_jax.system.errors import UserError, closest, printable
from rtcd_jax.volume import VOLUMES, Knots, largest_pushes

EVEN = 1e-6
"""Share of an interval by which the knots' times may be off an even grid."""
SYMMETRIC = 0.05
"""Share of its largest entry by which S may be asymmetric, as integrated ones are; V has its symmetric part only."""
SMALLEST, LARGEST = 1e-12, 1e12
"""Ends of the numbers that a robot, a cost or a table may have [SI units]."""
CONFIDENCE = 0.99
"""With which a verification must refute a claim, which is that no state fails."""
AT_GOAL = 1e-3
"""How far the last state may be from the equilibrium that it stands for."""


class ExternalRobot(NamedTuple):
    """A robot of one motor: what a claim says of it, its configuration, stored parameters, and its design's units."""

    claimed: ClaimedRobot
    plant: RobotPlant
    parameters: dict[str, float]
    units: Mapping[str, str]

    @property
    def design(self) -> dict[str, float]:
        """By the configuration's names."""
        return {named.name: self.parameters[named.symbol] for named in self.plant.robot(self.units).design}

    @property
    def record(self) -> dict[str, Any]:
        """What an elite's record says of it."""
        own = {} if self.plant.name in PLANTS else {"robot": self.plant.model_dump(mode="json")}
        return {"plant": self.plant.name, **own, "parameters": self.parameters}


class ExternalFunnel(NamedTuple):
    """What files claim of a robot; `goal` is the equilibrium at its last knot, `inputs` the file's own, one a knot."""

    robot: ExternalRobot
    dt: float
    x: Float[np.ndarray, "N+1 n"]
    u: Float[np.ndarray, " N"]
    rho: Float[np.ndarray, " N+1"]
    S: Float[np.ndarray, "N+1 n n"]
    goal: Float[np.ndarray, " n"]
    inputs: Float[np.ndarray, " N+1"]

    @property
    def states(self) -> tuple[str, ...]:
        return self.robot.claimed.description.states

    @property
    def limit(self) -> float:
        """Largest input."""
        return self.robot.claimed.limit

    def rate(self, x: np.ndarray, u: Any) -> np.ndarray:
        """x' [n ...] at the states x [n ...]."""
        return rate(self.robot.claimed.description, self.robot.claimed.numbers, x, u)

    def linear(self, x: np.ndarray, u: float) -> tuple[np.ndarray, np.ndarray]:
        """A [n n] and B [n] at x [n]."""
        return linear(self.robot.claimed.description, self.robot.claimed.numbers, x, u)

    @property
    def volumes(self) -> np.ndarray:
        """Of the ellipsoids [N+1]."""
        n = len(self.goal)
        ball = math.pi ** (n / 2) / math.gamma(n / 2 + 1)
        return ball * self.rho ** (n / 2) / np.sqrt(np.linalg.det(self.S))


def read_external(path: Path, name: str, parameters: Mapping[str, float], funnel: Path | None = None) -> ExternalFunnel:
    """The trajectory and funnel of one table, or of a trajectory and a `funnel` file; `name` as `robot_named` has it.

    Raises:
        UserError: an unknown robot or parameter, a number out of its range, or files that are not as the module says.
    """
    robot = robot_named(name, parameters)
    states = robot.claimed.description.states
    n = len(states)
    columns = f"time, {', '.join(states)}, input"
    if funnel is None:
        entries = n * (n + 1) // 2
        table = _numbers(path, n + 3 + entries, f"{columns}, rho, upper triangle of S", last=n + 1)
        rho, s = table[:, n + 2], np.zeros((len(table), n, n))
        rows, places = np.triu_indices(n)
        s[:, rows, places] = s[:, places, rows] = table[:, n + 3 :]
    else:
        table = _numbers(path, n + 2, columns, last=n + 1)
        rho, s = _levels_and_values(funnel, len(table), n)
    times, x, inputs = table[:, 0], table[:, 1 : n + 1], table[:, n + 1]
    dt = (times[-1] - times[0]) / (len(times) - 1)
    if not dt > 0 or np.max(np.abs(np.diff(times) - dt)) > EVEN * dt:
        raise UserError(f"{path}: times must rise evenly, knot by knot")
    for what, holds in (("rho", rho > 0), ("S", np.linalg.eigvalsh(s)[:, 0] > 0)):
        if not np.all(holds):
            raise UserError(f"{funnel or path}: {what} of knot {int(np.argmin(holds))} must be positive")
    external = ExternalFunnel(robot, float(dt), x, inputs[:-1], rho, s, _goal(path, robot, x[-1]), inputs)
    with np.errstate(all="ignore"):
        sizes = np.isfinite(external.volumes) & (external.volumes > 0)
    if not np.all(sizes):
        raise UserError(f"{funnel or path}: the volume of knot {int(np.argmin(sizes))} is beyond all numbers")
    return external


def robot_named(name: str, parameters: Mapping[str, float]) -> ExternalRobot:
    """A packaged robot by its name, or that of a configuration's file, with these parameters by their stored names.

    A packaged one needs all of them; of a file's, constants that are left out are the file's.

    Raises:
        UserError: none of that name, a wrong parameter, or a robot of which there is no claim.
    """
    if name in PLANTS:
        plant, units = PLANTS[name](), {}
    elif name.endswith((".yaml", ".yml")):
        config = load(Path(name))
        plant, units = config.plant, config.design_units
    else:
        raise UserError(
            f"--plant = {name!r}: unknown plant; {closest(name, tuple(PLANTS))}; or a configuration, FILE.yaml"
        )
    if not isinstance(plant, RobotPlant):
        raise UserError(f"--plant = {name!r}: its equations are a Python class's; a proof needs those of an MJCF")
    given = _required(plant, units, parameters)
    plant = plant.with_parameters(given)
    return ExternalRobot(robot_of(plant, given, units), plant, given, units)


def _required(plant: RobotPlant, units: Mapping[str, str], parameters: Mapping[str, float]) -> dict[str, float]:
    """The parameters that are given, with constants of the file's that are not."""
    robot, packaged = plant.robot(units), plant.packaged.constants if isinstance(plant, PackagedPlant) else None
    constants = {named.symbol: plant.values()[named.name] for named in robot.constants} if packaged is None else {}
    named = (*robot.design, *robot.constants, *((each for each, _ in robot.derived) if packaged is not None else ()))
    known, given = [each.symbol for each in named], {**constants, **parameters}
    if wrong := given.keys() ^ set(known):
        differ = ", ".join(sorted(printable(key, 30) for key in wrong))
        raise UserError(f"--parameters: must be those of the {plant.name}, {', '.join(known)}; differ in {differ}")
    for each in named:
        value = given[each.symbol]
        if packaged is None:
            least, holds = f"-{LARGEST:g}", abs(value) <= LARGEST
        else:
            may_be_zero = each.name in packaged and packaged[each.name].min == 0
            least = f"0, or {SMALLEST:g}" if may_be_zero else f"{SMALLEST:g}"
            holds = SMALLEST <= value <= LARGEST or (may_be_zero and value == 0)
        if not holds:
            raise UserError(f"--parameters {each.symbol}={value}: must be a number from {least} to {LARGEST:g}")
    return {name: given[name] for name in known}


def _numbers(path: Path, width: int, columns: str, last: int | None = None) -> np.ndarray:
    """The rows of `width` numbers; the last row's cell at place `last` may hold none, and is nan then."""
    table = _matrix(path, f"a table of the columns {columns}", last)
    if table.shape[1] != width or len(table) < 2:
        shape = f"{len(table)} of {table.shape[1]}"
        raise UserError(f"{path}: must have at least 2 rows of {width} finite numbers: {columns}; it has {shape}")
    return table


def _matrix(path: Path, what: str, last: int | None = None) -> np.ndarray:
    """All numbers of a table, whatever stands above them."""
    rows = list(read_table(path, what).rows)
    if not rows:
        raise UserError(f"{path} has no rows of numbers: must be {what}")
    width = len(rows[0][1])
    numbers = np.full((len(rows), width), math.nan)
    for k, (line, cells) in enumerate(rows):
        if len(cells) != width:
            raise UserError(f"{path}, line {line} has {len(cells)} cells, the first row {width}: must be {what}")
        for place, cell in enumerate(cells):
            value = number_or_nan(cell)
            numbers[k, place] = value
            if not abs(value) <= LARGEST and not (k == len(rows) - 1 and place == last and not cell.strip("naNA")):
                raise UserError(
                    f"{path}, line {line}, cell {place + 1} = {shown(cell)}: must be a finite number, of at most "
                    f"{LARGEST:g} in size; the file must be {what}"
                )
    return numbers


def _levels_and_values(path: Path, knots: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """rho [knots] and S [knots n n] of a file with a knot a column, or a knot a row: rho, then S row by row."""
    table = _matrix(path, f"a funnel file: rho and the {n * n} entries of S of every knot")
    size = 1 + n * n
    candidates = []
    for numbers in (table.T, table):  # where both fit, the one whose S is symmetric, else a knot a column
        if numbers.shape == (knots, size):
            s = numbers[:, 1:].reshape(knots, n, n)
            asymmetry = np.max(np.abs(s - np.swapaxes(s, 1, 2))) / max(np.max(np.abs(s)), SMALLEST)
            candidates.append((asymmetry, numbers[:, 0], (s + np.swapaxes(s, 1, 2)) / 2))
    if candidates:
        asymmetry, rho, s = min(candidates, key=lambda each: each[0] > EVEN)
        if asymmetry <= SYMMETRIC:
            return rho, s
        raise UserError(f"{path}: an S is not symmetric, by {asymmetry:.1%} of the largest entry")
    raise UserError(
        f"{path} has {table.shape[0]} rows of {table.shape[1]} numbers: must have {size} rows (rho, S row by row) of "
        f"{knots} numbers, one for each knot of the trajectory, or {knots} rows of {size}"
    )


def _goal(path: Path, robot: ExternalRobot, last: np.ndarray) -> np.ndarray:
    """The equilibrium at the last state: at rest, the angle a multiple of pi."""
    goal = last.copy()
    for i in robot.claimed.description.hinges:
        goal[i] = round(last[i] / math.pi) * math.pi
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
    def of(cls, external: ExternalFunnel, q: Sequence[float], r: float, limits: Sequence[float]) -> "Cost":
        """Checked; no limits at all are infinite ones.

        Raises:
            UserError: a number that is not positive, or too few or too many.
        """
        n = len(external.goal)
        limits = limits or (math.inf,) * n
        for name, values in (("q", q), ("state_limits", limits)):
            if len(values) != n or not all(
                SMALLEST <= value <= (LARGEST if name == "q" else math.inf) for value in values
            ):
                states = ", ".join(external.states)
                raise UserError(f"--{name} = {' '.join(map(str, values))}: must be {n} numbers > 0 ({states})")
        if not SMALLEST <= r <= LARGEST:
            raise UserError(f"--r = {r}: must be > 0 and at most {LARGEST:g}")
        return cls(np.asarray(q), r, np.asarray(limits))


def elite_of(external: ExternalFunnel, cost: Cost) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and record as `elites/NNN` has them; the gains are R^-1 B'S, and the goal's those of the last knot."""
    inputs = np.append(external.u, 0.0)
    jumps = np.array([external.linear(x, u)[1] for x, u in zip(external.x, inputs, strict=True)])
    gains = [b @ s / cost.r for b, s in zip(jumps, external.S, strict=True)]
    volumes, pushes = external.volumes, largest_pushes(external.S, external.rho, jumps[:, :, None])
    at = Knots(volumes, np.log(volumes), pushes, external.dt)
    named = {name: volume.of(at) for name, volume in VOLUMES.items()}
    arrays = {
        "time": external.dt * np.arange(len(external.x)), "x": external.x, "u": external.u[:, None],
        "K": np.array(gains)[:, None], "S": external.S, "rho": external.rho,
        "Q": np.diag(cost.q), "R": np.array([[cost.r]]),
        "K_goal": gains[-1][None], "x_goal": external.goal, "u_max": np.array([external.limit]),
        "volumes_per_knot": volumes, "pushes": pushes, **{f"volumes_{name}": value for name, value in named.items()},
    }  # fmt: skip
    record = {
        **external.robot.record,
        "weights": {"q": cost.q, "r": [cost.r]},
        "state_limits": [limit if math.isfinite(limit) else None for limit in cost.limits.tolist()],
        "status": "OK",
        "rung": CLAIMED,
        "epsilon": 0.0,
        "confidence": CONFIDENCE,
        "volumes": {
            **{name: float(value) for name, value in named.items()},
            "share_of_largest_knot": float(volumes.max() / volumes.sum()),
        },
    }
    return {name: np.asarray(array) for name, array in arrays.items()}, record
