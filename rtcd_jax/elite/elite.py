"""One stored elite in numpy: its motion, its controller, its funnel and what is promised; all verbs read it here."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from rtcd_jax.config.plants import PlantConfig, stored_plant
from rtcd_jax.elite.records import INITIAL, elite_folder, elite_name, read_elite, require_elites, require_one_task
from rtcd_jax.numerics.keep_out import Set, sets_of
from rtcd_jax.system.errors import UserError, printable

CLAIMED = "claimed"
"""The guarantee of a funnel that somebody else states, below *sampled*."""


class NoFunnel(UserError):
    """A stored candidate has no funnel; `status` says why."""

    def __init__(self, where: Path, status: str):
        super().__init__(f"{where} has no funnel ({status})")
        self.status = status


OPTIONAL = ("pushes", "S_rates", "center_offsets")
"""Arrays that not every elite has."""
UNBOUNDED = ("state_limits", "pushes")
"""Arrays that may have infinity in them: pushes of a motor that moves nothing."""

LEAST_LEFT = 1e-6
"""Share of a radius that stands for nothing, where the robots' own motions are farther apart than their ellipsoids."""

LARGEST = 1e12
"""Of a robot's and a controller's numbers, in SI units."""


@final
@dataclass(frozen=True, eq=False)
class Elite:
    """A funnel, what it controls and what it promises; arrays as in `elites/NNN.npz`, SI units.

    Promised with `confidence`: a state, uniform in its ellipsoid B_k = {x : V_k(x) <= rho_k}, fails with a
    probability of at most `epsilon`. `guarantee` says on what ground; a claimed funnel promises that no state fails.
    `volumes` are the funnel's, by name, `pushes` the largest impulse on each input at each knot that leaves x* + B J in
    the funnel (None in files that lack it), `S_rates` are S' at both ends of every interval where S is no Riccati
    equation's, `center_offsets` the largest sqrt(V_k) of the robots' own motions where the ellipsoids are about these,
    and `record` is all of `NNN.json`.

    Raises:
        UserError: shapes that do not belong together, or no funnel: a level or an S that is not positive.
    """

    plant: str
    parameters: Mapping[str, float]
    guarantee: str
    epsilon: float
    confidence: float
    time: Float[np.ndarray, " knots"]
    x: Float[np.ndarray, "knots n"]
    u: Float[np.ndarray, "intervals m"]
    K: Float[np.ndarray, "knots m n"]
    S: Float[np.ndarray, "knots n n"]
    rho: Float[np.ndarray, " knots"]
    Q: Float[np.ndarray, "n n"]
    R: Float[np.ndarray, "m m"]
    K_goal: Float[np.ndarray, "m n"]
    x_goal: Float[np.ndarray, " n"]
    u_max: Float[np.ndarray, " m"]
    state_limits: Float[np.ndarray, " n"]
    volumes_per_knot: Float[np.ndarray, " knots"]
    volumes: Mapping[str, float] = field(default_factory=dict)
    pushes: Float[np.ndarray, "knots m"] | None = None
    record: Mapping[str, Any] = field(default_factory=dict)
    S_rates: Float[np.ndarray, "intervals 2 n n"] | None = None
    center_offsets: Float[np.ndarray, " knots"] | None = None

    def __post_init__(self):
        knots, n, m = self.time.size, self.x_goal.size, self.u_max.size
        shapes = {
            "time": (knots,), "x": (knots, n), "u": (knots - 1, m), "K": (knots, m, n), "S": (knots, n, n),
            "rho": (knots,), "Q": (n, n), "R": (m, m), "K_goal": (m, n), "x_goal": (n,), "u_max": (m,),
            "state_limits": (n,), "volumes_per_knot": (knots,),
        }  # fmt: skip
        if self.pushes is not None:
            shapes["pushes"] = (knots, m)
        if self.S_rates is not None:
            shapes["S_rates"] = knots - 1, 2, n, n
        if self.center_offsets is not None:
            shapes["center_offsets"] = (knots,)
        wrong = [f"{name} {getattr(self, name).shape}" for name in shapes if getattr(self, name).shape != shapes[name]]
        if wrong:
            raise UserError(
                f"an elite with {knots} knots, {n} states and {m} inputs cannot have {', '.join(wrong)}: must be "
                + ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            )
        arrays = {name: getattr(self, name) for name in shapes}
        allowed = {name: ~np.isnan(a) if name in UNBOUNDED else np.isfinite(a) for name, a in arrays.items()}
        if wild := [name for name, each in allowed.items() if not each.all()]:
            raise UserError(f"the elite has numbers in {', '.join(wild)} that are not finite")
        if not np.all(np.linalg.eigvalsh(self.R) > 0):
            raise UserError("the elite's R is not positive definite")
        if not np.all(self.rho > 0):
            empty = int(np.argmin(self.rho > 0))
            raise UserError(f"the elite has no funnel: rho[{empty}] = {self.rho[empty]:g}: must be > 0")
        if not np.all(np.linalg.eigvalsh(self.S) > 0):
            raise UserError("the elite has no funnel: an S is not positive definite")

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> "Elite":
        """An elite from its stored arrays and record; null among the state limits means no limit.

        Raises:
            UserError: something is missing, or as the class.
        """
        _require_kinds(record)
        promise = {"epsilon": 0.0, "confidence": 1.0} if record.get("rung") == CLAIMED else {}
        named = {name: record.get(name, promise.get(name)) for name in ("plant", "parameters", "epsilon", "confidence")}
        named["guarantee"] = record.get("rung")
        numbers = {name: np.asarray(arrays[name], float) for name in arrays.keys() & cls.__dataclass_fields__.keys()}
        limits = record.get("state_limits")
        if limits is not None:
            numbers["state_limits"] = np.array([math.inf if limit is None else limit for limit in limits], float)
        volumes = {
            name.removeprefix("volumes_"): float(array)
            for name, array in arrays.items()
            if name.startswith("volumes_") and not array.ndim
        }
        fields: dict[str, Any] = {**named, **numbers, "volumes": volumes, "record": record}
        stored = {"guarantee": "rung"}  # the field's key in NNN.json
        needed = [name for name in cls.__dataclass_fields__ if name not in OPTIONAL]
        missing = [stored.get(name, name) for name in needed if fields.get(name) is None]
        if missing:
            raise UserError(f"the elite lacks {', '.join(missing)}")
        return cls(**fields)

    @classmethod
    def read(cls, run: Path, which: int | str) -> "Elite":
        """An elite of a run folder, by its number or its name "000", "001", …, or its candidate "initial".

        Raises:
            NoFunnel: that candidate has none.
            UserError: no run folder, a search that is not finished, no such elite (the error has those that are
                there), a run for several tasks instead of the folder of one, damaged files, or as `of`.
        """
        name, there = elite_name(which), require_elites(run)
        require_one_task(run)
        if name != INITIAL and name not in there:
            raise UserError(f"{run} has no elite {name}; there are {', '.join(there)}")
        folder = elite_folder(run, name)
        arrays, record = read_elite(folder, name)
        if record.get("status") != "OK":
            raise NoFunnel(folder / name, str(record.get("status")))
        try:
            return cls.of(arrays, record)
        except UserError as error:
            raise UserError(f"{folder / name}: {error}") from None

    @property
    def robot(self) -> PlantConfig:
        """The robot that it is for, all but its parameters.

        Raises:
            UserError: no such robot.
        """
        return stored_plant(self.plant, self.record.get("robot"))

    @cached_property
    def keep_out(self) -> tuple[Set, ...]:
        """Sets of states that the motions keep out of."""
        return sets_of(self.record.get("keep_out", ()), np.stack([self.x[0], self.x_goal]))

    @property
    def caught(self) -> bool:
        """Whether the motion ends in a catch set, the last ellipsoid: then nothing is said of the time after it."""
        return "catch" in self.record

    @property
    def design_units(self) -> Mapping[str, str]:
        """Of the design by name."""
        return self.record.get("units", {}).get("design", {})

    @property
    def policy(self) -> Mapping[str, float]:
        """The policy's options by name; what is absent is as in the configuration's defaults."""
        return self.record.get("policy", {})

    def of_all_robots(self) -> "Elite":
        """The same with the ellipsoids about x* that lie in the funnel of every robot of the uncertainty."""
        if self.center_offsets is None:
            return self
        left = 1 - self.center_offsets / np.sqrt(self.rho)
        return replace(self, rho=self.rho * np.maximum(left, LEAST_LEFT) ** 2)

    def value(self, k: int, x: Float[np.ndarray, "states n"]) -> Float[np.ndarray, " states"]:
        """V_k(x) = (x - x_k)' S_k (x - x_k)."""
        return _quadratic(self.S[k], x - self.x[k])

    def value_of_goal(self, x: Float[np.ndarray, "states n"]) -> Float[np.ndarray, " states"]:
        """V of the goal's LQR, whose value matrix is the last S."""
        return _quadratic(self.S[-1], x - self.x_goal)

    def sample(
        self, states: int, random: np.random.Generator
    ) -> tuple[Int[np.ndarray, " states"], Float[np.ndarray, "states n"]]:
        """Knots, ascending and as even as `states` allows, and uniform states of their ellipsoids."""
        knots = np.sort(np.arange(states) % self.time.size)
        return knots, self.points(knots, random)

    def points(self, knots: Int[np.ndarray, " states"], random: np.random.Generator) -> Float[np.ndarray, "states n"]:
        """A uniform state of each of the `knots`' ellipsoids."""
        n = self.x_goal.size
        direction = random.normal(size=(len(knots), n))
        radius = random.uniform(size=(len(knots), 1)) ** (1 / n)
        ball = radius * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        return self.x[knots] + np.einsum("sij,sj->si", ellipsoid_axes(self.S, self.rho)[knots], ball)


def initial_and_best(run: Path) -> tuple[dict[str, Elite], str]:
    """A run folder's initial candidate and its best elite, as "initial" and "best"; why the former is absent, if it is.

    Raises UserError as `Elite.read`.
    """
    best = {"best": Elite.read(run, 0)}
    if not (elite_folder(run, INITIAL) / f"{INITIAL}.json").is_file():
        return best, "no initial candidate was stored"
    try:
        return {INITIAL: Elite.read(run, INITIAL), **best}, ""
    except NoFunnel as error:
        return best, f"the initial candidate has no funnel ({error.status})"


def ellipsoid_axes(S: Float[np.ndarray, "... n n"], rho: Float[np.ndarray, "..."]) -> Float[np.ndarray, "... n n"]:
    """A with {x'S x <= rho} = {A y : |y| <= 1}."""
    # S = L L' makes x'S x = |L'x|^2, so that x = sqrt(rho) L^-T y
    return np.sqrt(rho)[..., None, None] * np.swapaxes(np.linalg.inv(np.linalg.cholesky(S)), -2, -1)


def _quadratic(weight: np.ndarray, error: np.ndarray) -> np.ndarray:
    return np.einsum("si,ij,sj->s", error, weight, error)


def _is_measurable(value: Any) -> bool:
    """Whether it is a number that a robot or its controller can have: its products do not overflow."""
    return isinstance(value, float | int) and abs(value) <= LARGEST


def _require_kinds(record: Mapping[str, Any]) -> None:
    """Raises UserError where a value of `NNN.json` is of another kind than a run writes."""
    kinds = {"plant": str, "robot": Mapping, "parameters": Mapping, "policy": Mapping, "state_limits": list,
             "epsilon": float | int, "confidence": float | int}  # fmt: skip
    stored = {key: value for key in kinds if (value := record.get(key)) is not None}
    wrong = [key for key, value in stored.items() if not isinstance(value, kinds[key])]
    for key in {"parameters", "policy"} & stored.keys() - set(wrong):
        wrong += [f"{key}.{name}" for name, value in stored[key].items() if not _is_measurable(value)]
    if not wrong and not all(
        limit is None or isinstance(limit, float | int) for limit in stored.get("state_limits", ())
    ):
        wrong.append("state_limits")
    if wrong:
        raise UserError(
            f"the elite's {', '.join(map(printable, wrong))} cannot be read: of another kind or size than a run writes"
        )
