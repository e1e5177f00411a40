"""The outcomes of a funnel's held-out states in independent simulators, and whether they refute its promise."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, final

import numpy as np
from jaxtyping import Float, Int

from rtcd_jax.elite.closed_loop import Outcome, simulate
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.simulators import simulator_of, simulators_of
from rtcd_jax.numerics.proportion import clopper_pearson
from rtcd_jax.system.errors import UserError

CHUNK = 1000
"""States simulated together: RK45 takes them as one, and all wait whenever one crosses its input limit."""


@final
@dataclass(frozen=True)
class Verification:
    """Each simulator's outcomes of the same states; `knots` says in which ellipsoid a state started."""

    knots: Int[np.ndarray, " states"]
    states: Float[np.ndarray, "states n"]
    outcomes: Mapping[str, Outcome]
    epsilon: float
    confidence: float
    seed: int

    def failures(self, simulator: str) -> int:
        return int(self.outcomes[simulator].failed.sum())

    def interval(self, simulator: str) -> tuple[float, float]:
        """Clopper-Pearson bounds of the failure probability, each with the promise's confidence."""
        return clopper_pearson(self.failures(simulator), len(self.knots), self.confidence)

    def refutes(self, simulator: str) -> bool:
        """Whether the failures refute the promise: then even the lower bound exceeds epsilon."""
        return self.interval(simulator)[0] > self.epsilon

    @property
    def refuted(self) -> bool:
        return any(map(self.refutes, self.outcomes))

    @property
    def disagreements(self) -> int:
        """States on which the simulators' verdicts differ."""
        failed = np.stack([outcome.failed for outcome in self.outcomes.values()])
        return int(np.sum(failed.any(axis=0) & ~failed.all(axis=0)))

    def record(self) -> dict[str, Any]:
        """As JSON stores it."""
        return {
            "states": len(self.knots),
            "seed": self.seed,
            "epsilon": self.epsilon,
            "confidence": self.confidence,
            "kept": not self.refuted,
            "disagreements": self.disagreements,
            "witnesses": {simulator: self._record_of(simulator) for simulator in self.outcomes},
        }

    def _record_of(self, simulator: str) -> dict[str, Any]:
        outcome = self.outcomes[simulator]
        lower, upper = self.interval(simulator)
        return {
            "left_funnel": outcome.left_funnel.sum(),
            "left_limits": outcome.left_limits.sum(),
            "missed_goal": outcome.missed_goal.sum(),
            "failures": self.failures(simulator),
            "rate": self.failures(simulator) / len(self.knots),
            "rate_lower": lower,
            "rate_upper": upper,
            "kept": not self.refutes(simulator),
            "failures_per_knot": np.bincount(self.knots[outcome.failed], minlength=self.knots[-1] + 1),
        }


@final
@dataclass(frozen=True)
class Trial:
    """A funnel, the held-out states that it is verified with, and how these are cut into chunks.

    Every chunk has states of every knot, and is the same whoever simulates it, and when.

    Raises:
        UserError: fewer states than knots.
    """

    elite: Elite
    states: int
    seed: int

    def __post_init__(self):
        if self.states < len(self.elite.time):
            knots = len(self.elite.time)
            raise UserError(f"states = {self.states}: must be at least {knots}, one for each knot's ellipsoid")

    @property
    def chunks(self) -> int:
        return -(-self.states // CHUNK)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the simulators."""
        return tuple(simulator.name for simulator in simulators_of(self.elite, 2))

    def sample(self) -> tuple[Int[np.ndarray, " states"], Float[np.ndarray, "states n"]]:
        """Knots, ascending, and uniform states of their ellipsoids."""
        return self.elite.sample(self.states, np.random.default_rng(self.seed))

    def outcome(self, name: str, chunk: int) -> Outcome:
        """One simulator's outcome of one chunk.

        Raises:
            UserError: a goal that its own LQR does not hold.
        """
        knots, x = (drawn[chunk :: self.chunks] for drawn in self.sample())
        simulator = simulator_of(self.elite, name, len(x))
        return simulate(self.elite, simulator.dynamics, simulator.march, knots, x, simulator.settle)

    def verification(self, outcomes: Mapping[tuple[str, int], Outcome]) -> Verification:
        """All chunks' outcomes, by simulator and chunk, put together."""
        merged = {name: self._merged(name, outcomes) for name in dict.fromkeys(name for name, _ in outcomes)}
        return Verification(*self.sample(), merged, self.elite.epsilon, self.elite.confidence, self.seed)

    def _merged(self, name: str, outcomes: Mapping[tuple[str, int], Outcome]) -> Outcome:
        whole = {field.name: np.zeros(self.states, bool) for field in fields(Outcome)}
        for field, flags in whole.items():
            for chunk in range(self.chunks):
                flags[chunk :: self.chunks] = getattr(outcomes[name, chunk], field)
        return Outcome(**whole)
