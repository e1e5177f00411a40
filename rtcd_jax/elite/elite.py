"""One elite as the run folder stores it: all that the verification knows of a funnel."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from rtcd_jax.system.errors import UserError


@final
@dataclass(frozen=True)
class Elite:
    """A funnel, what it controls and what it promises; arrays as in `elites/NNN.npz`, SI units.

    Promised with `confidence`: a state, uniform in its ellipsoid B_k = {x : V_k(x) <= rho_k}, fails with a
    probability of at most `epsilon`.

    Raises:
        UserError: shapes that do not belong together, or no funnel: a level or an S that is not positive.
    """

    plant: str
    parameters: Mapping[str, float]
    epsilon: float
    confidence: float
    time: Float[np.ndarray, " knots"]
    x: Float[np.ndarray, "knots n"]
    u: Float[np.ndarray, "intervals m"]
    K: Float[np.ndarray, "knots m n"]
    S: Float[np.ndarray, "knots n n"]
    rho: Float[np.ndarray, " knots"]
    K_goal: Float[np.ndarray, "m n"]
    x_goal: Float[np.ndarray, " n"]
    u_max: Float[np.ndarray, " m"]
    state_limits: Float[np.ndarray, " n"]

    def __post_init__(self):
        knots, n, m = self.time.size, self.x_goal.size, self.u_max.size
        shapes = {
            "time": (knots,), "x": (knots, n), "u": (knots - 1, m), "K": (knots, m, n), "S": (knots, n, n),
            "rho": (knots,), "K_goal": (m, n), "x_goal": (n,), "u_max": (m,), "state_limits": (n,),
        }  # fmt: skip
        wrong = [f"{name} {getattr(self, name).shape}" for name in shapes if getattr(self, name).shape != shapes[name]]
        if wrong:
            raise UserError(
                f"an elite with {knots} knots, {n} states and {m} inputs cannot have {', '.join(wrong)}: must be "
                + ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            )
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
        told = {name: record.get(name) for name in ("plant", "parameters", "epsilon", "confidence")}
        found = {**arrays, **told, "state_limits": record.get("state_limits")}
        missing = [name for name in cls.__dataclass_fields__ if found.get(name) is None]
        if missing:
            raise UserError(f"the elite lacks {', '.join(missing)}")
        limits = [math.inf if limit is None else limit for limit in found["state_limits"]]
        numbers = {name: np.asarray(found[name], float) for name in arrays.keys() & cls.__dataclass_fields__.keys()}
        return cls(**{**told, **numbers, "state_limits": np.asarray(limits, float)})

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
        # S = L L' makes V = |L' (x - x_k)|^2, so that x - x_k = sqrt(rho) L^-T y with |y| <= 1
        axes = np.sqrt(self.rho)[:, None, None] * np.linalg.inv(np.linalg.cholesky(self.S))
        return self.x[knots] + np.einsum("sji,sj->si", axes[knots], ball)


def _quadratic(weight: np.ndarray, error: np.ndarray) -> np.ndarray:
    return np.einsum("si,ij,sj->s", error, weight, error)
