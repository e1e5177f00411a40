"""Does a funnel keep its promise? Fresh random states before witnesses that share nothing with the search.

States are uniform in the ellipsoids of all knots, evenly spread over them, not only in the first. A state fails if it
leaves the funnel at a later knot, leaves the state limits, or does not settle at the goal. Two witnesses judge the
same states, each with dynamics and integrator of its own:

    C MuJoCo       accelerations of the compiled MJCF, fixed Runge-Kutta steps
    closed form    written here in numpy, apart from the plants'; scipy's adaptive RK45
"""

import io
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple, Protocol, final

import numpy as np
from jaxtyping import Float, Int
from rich.box import SIMPLE
from rich.console import Console as Terminal
from rich.table import Table
from scipy.stats import beta

from rtcd_jax.errors import UserError
from rtcd_jax.files import replace_json, writing
from rtcd_jax.storage import elite_names, read_elite
from rtcd_jax.verify.elite import Elite
from rtcd_jax.verify.simulate import (
    Dynamics,
    March,
    Outcome,
    dormand_prince,
    fastest_rate,
    runge_kutta,
    simulate,
)

STEPS = 20
"""Fixed steps in an interval, at least."""
STEP_OF_FASTEST = 0.25
"""Longest fixed step in time constants of the loop's fastest mode."""
RELATIVE, ABSOLUTE = 1e-8, 1e-9
"""Tolerances of RK45 for every state."""
STACKED = 1000
"""States that RK45 takes as one: all of them wait whenever one crosses its input limit."""


class Console(Protocol):
    def message(self, text: str, /) -> None: ...


@final
@dataclass(frozen=True)
class Verification:
    """What each witness saw of the same states; `knots` says in which ellipsoid a state started."""

    knots: Int[np.ndarray, " states"]
    states: Float[np.ndarray, "states n"]
    outcomes: Mapping[str, Outcome]
    epsilon: float
    confidence: float
    seed: int

    def failures(self, witness: str) -> int:
        return int(self.outcomes[witness].failed.sum())

    def interval(self, witness: str) -> tuple[float, float]:
        """Clopper-Pearson bounds of the failure probability, each with the promise's confidence."""
        return clopper_pearson(self.failures(witness), len(self.knots), self.confidence)

    def keeps(self, witness: str) -> bool:
        """False if the failures refute the promise: then even the lower bound exceeds epsilon."""
        return self.interval(witness)[0] <= self.epsilon

    @property
    def kept(self) -> bool:
        return all(map(self.keeps, self.outcomes))

    @property
    def disagreements(self) -> int:
        """States on which the witnesses' verdicts differ."""
        failed = np.stack([outcome.failed for outcome in self.outcomes.values()])
        return int(np.sum(failed.any(axis=0) & ~failed.all(axis=0)))

    def record(self) -> dict[str, Any]:
        """As JSON stores it."""
        return {
            "states": len(self.knots),
            "seed": self.seed,
            "epsilon": self.epsilon,
            "confidence": self.confidence,
            "kept": self.kept,
            "disagreements": self.disagreements,
            "witnesses": {witness: self._record_of(witness) for witness in self.outcomes},
        }

    def _record_of(self, witness: str) -> dict[str, Any]:
        outcome = self.outcomes[witness]
        lower, upper = self.interval(witness)
        return {
            "left_funnel": outcome.left_funnel.sum(),
            "left_limits": outcome.left_limits.sum(),
            "missed_goal": outcome.missed_goal.sum(),
            "failures": self.failures(witness),
            "rate": self.failures(witness) / len(self.knots),
            "rate_lower": lower,
            "rate_upper": upper,
            "kept": self.keeps(witness),
            "failures_per_knot": np.bincount(self.knots[outcome.failed], minlength=self.knots[-1] + 1),
        }


def clopper_pearson(failures: int, trials: int, confidence: float) -> tuple[float, float]:
    """Exact lower and upper bounds of a probability, each of which holds with `confidence` (one-sided)."""
    lower = beta.ppf(1 - confidence, failures, trials - failures + 1) if failures else 0.0
    upper = beta.ppf(confidence, failures + 1, trials - failures) if failures < trials else 1.0
    return float(lower), float(upper)


def verify_funnel(elite: Elite, states: int = 1000, seed: int = 0) -> Verification:
    """Puts `states` fresh states of the funnel before every witness that knows the plant.

    Raises:
        UserError: fewer states than knots, or a goal that its own LQR does not hold.
        ValueError: an unknown plant.
    """
    if states < len(elite.time):
        raise UserError(f"states = {states}: must be at least {len(elite.time)}, one for each knot's ellipsoid")
    knots, x = elite.sample(states, np.random.default_rng(seed))
    outcomes = {witness.name: _seen_by(witness, elite, knots, x) for witness in witnesses(elite, states)}
    return Verification(knots, x, outcomes, elite.epsilon, elite.confidence, seed)


@final
class Witness(NamedTuple):
    """Someone who simulates a plant, best with about `chunk` states at a time."""

    name: str
    dynamics: Dynamics
    march: March
    chunk: int


def _seen_by(witness: Witness, elite: Elite, knots: np.ndarray, x: np.ndarray) -> Outcome:
    """Interleaved chunks, so that each has states of every knot."""
    chunks = -(-len(x) // witness.chunk)
    outcomes = [
        simulate(elite, witness.dynamics, witness.march, knots[chunk::chunks], x[chunk::chunks])
        for chunk in range(chunks)
    ]
    merged = {field.name: np.zeros(len(x), bool) for field in fields(Outcome)}
    for name, seen in merged.items():
        for chunk, outcome in enumerate(outcomes):
            seen[chunk::chunks] = getattr(outcome, name)
    return Outcome(**merged)


def witnesses(elite: Elite, states: int) -> Iterator[Witness]:
    """Everyone who can simulate this elite's plant, `states` at most."""
    from rtcd_jax.plants.mjx import CpuDynamics, model_of

    interval = float(np.min(np.diff(elite.time)))
    columns = elite.x_goal.size + elite.u_max.size
    mujoco = CpuDynamics(model_of(elite.plant, elite.parameters), max(states, columns, 2))
    step = min(interval / STEPS, STEP_OF_FASTEST / fastest_rate(elite, mujoco))
    yield Witness("C MuJoCo", mujoco, runge_kutta(mujoco, step), chunk=states)
    if elite.plant in CLOSED_FORMS:
        closed_form = CLOSED_FORMS[elite.plant](elite.parameters)
        march = dormand_prince(closed_form, interval / 4, RELATIVE, ABSOLUTE)
        yield Witness("closed form", closed_form, march, STACKED)


def _pendulum(p: Mapping[str, float]) -> Dynamics:
    def f(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        torque = u[:, 0] - p["b"] * x[:, 1] - p["m"] * p["g"] * p["l"] * np.sin(x[:, 0])
        return np.column_stack([x[:, 1], torque / (p["m"] * p["l"] ** 2)])

    return f


def _cartpole(p: Mapping[str, float]) -> Dynamics:
    """Lagrange's equations M(theta) (cart_ddot, theta_ddot) = tau by Cramer's rule.

    T = Mc/2 cart_dot^2 + Mp/2 |(cart_dot - lp cos(theta) theta_dot, -lp sin(theta) theta_dot)|^2 + I/2 theta_dot^2,
    U = Mp g lp cos(theta)
    """

    def f(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        _, theta, speed, rate = x.T
        m11, m22 = p["Mc"] + p["Mp"], p["inertia_about_com"] + p["Mp"] * p["lp"] ** 2
        m12 = -p["Mp"] * p["lp"] * np.cos(theta)
        tau1 = u[:, 0] - p["Beq"] * speed - p["Mp"] * p["lp"] * np.sin(theta) * rate**2
        tau2 = p["Mp"] * p["lp"] * p["g"] * np.sin(theta) - p["Bp"] * rate
        determinant = m11 * m22 - m12**2
        cart = (m22 * tau1 - m12 * tau2) / determinant
        return np.column_stack([speed, rate, cart, (m11 * tau2 - m12 * tau1) / determinant])

    return f


CLOSED_FORMS: dict[str, Callable[[Mapping[str, float]], Dynamics]] = {"pendulum": _pendulum, "cartpole": _cartpole}
"""By plant: its physical numbers -> dynamics. A plant that is not here has one witness, C MuJoCo."""


def verify_run(folder: Path, states: int, seed: int, console: Console) -> bool:
    """Verifies a run's best elite and its initial candidate; True if no promise was refuted.

    Stores `verification/000.json` and `verification/initial.json`. An initial candidate without a funnel is reported
    instead.

    Raises:
        UserError: no run folder, a run without elites, or a folder that cannot be read.
    """
    if not folder.is_dir():
        raise UserError(f"{folder} is no run folder: it does not exist")
    if not elite_names(folder):
        raise UserError(f"{folder} has no elites yet: finish the run first, by the command that began it")
    results = folder / "verification"
    with writing(results):
        results.mkdir(exist_ok=True)
    verifications = {}
    for name, place in (("000", folder / "elites"), ("initial", folder)):
        arrays, record = read_elite(place, name)
        if record["status"] != "OK":
            console.message(f"{name}: nothing to verify, it has no funnel ({record['status']})")
            continue
        verifications[name] = verify_funnel(Elite.of(arrays, record), states, seed)
        replace_json(results / f"{name}.json", verifications[name].record())
    if verifications:
        console.message(_table(verifications))
    return all(verification.kept for verification in verifications.values())


def _table(verifications: Mapping[str, Verification]) -> str:
    table = Table(box=SIMPLE, title="fresh random states of the funnels (promise: sampled rung)")
    for heading in (
        "funnel", "witness", "states", "left funnel", "left limits", "missed goal", "failure rate", "promised", "",
    ):  # fmt: skip
        table.add_column(heading, justify="left" if heading in ("funnel", "witness", "") else "right")
    for name, verification in verifications.items():
        for witness, outcome in verification.outcomes.items():
            states = len(verification.knots)
            lower, upper = verification.interval(witness)
            table.add_row(
                name,
                witness,
                f"{states}",
                f"{outcome.left_funnel.sum()}",
                f"{outcome.left_limits.sum()}",
                f"{outcome.missed_goal.sum()}",
                f"{verification.failures(witness) / states:.2g} [{lower:.2g}, {upper:.2g}]",
                f"{verification.epsilon:g} ({verification.confidence:g})",
                "kept" if verification.keeps(witness) else "BROKEN",
            )
    text = io.StringIO()
    Terminal(file=text, width=132).print(table)
    return text.getvalue().rstrip()
