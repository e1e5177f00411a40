"""One stored elite as the controller that a lab runs: every number it looks up, and what the numbers mean."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, final

import jax
import numpy as np
from jaxtyping import Bool, Int

from rtcd_jax.certificate.standing import Standing, certificate_path, standing
from rtcd_jax.elite.elite import Elite, ellipsoid_axes
from rtcd_jax.elite.funnel import FunnelInterpolant
from rtcd_jax.export.proof import ProvedFunnel
from rtcd_jax.export.rate import ControlRate, control_rate
from rtcd_jax.export.robustness import borne
from rtcd_jax.plants import model_of, plant_of
from rtcd_jax.plants.base import Plant
from rtcd_jax.system.errors import UserError

SAMPLED = "V = (x - x*)'S(t)(x - x*) <= rho(t), S cubic Hermite, log rho linear; what was sampled is promised at knots"
PROVED = "|L(t)^-1 (x - x*(t))| <= 1 with the certificate's L, from its start on and after t_N; before it as sampled"


INSTANTS = 10
"""Of an interval, at which S(t) is looked at."""


class Instant(NamedTuple):
    """The loop at one time: x* [n], u* [m], K [m n], and the funnel {x* + axes y : |y| <= 1}, proved or not."""

    x: np.ndarray
    u: np.ndarray
    gain: np.ndarray
    axes: np.ndarray
    proved: bool


@final
@dataclass(frozen=True, eq=False)
class Bundle:
    """An elite with its funnel at every instant, the robot that it is for, and MuJoCo's model of it.

    `joints` [m] says which joint an input drives; `label` names the controller's files and symbols.
    """

    name: str
    label: str
    funnel: FunnelInterpolant
    plant: Plant
    design: Any
    model: Any
    joints: Int[np.ndarray, " m"]
    standing: Standing
    proof: ProvedFunnel | None
    control_rate: ControlRate
    robustness: str = ""
    """What `rtcd disturb` found that it bears, as a list in Markdown; empty where it was not tried."""

    @property
    def elite(self) -> Elite:
        return self.funnel.elite

    @property
    def guarantee(self) -> str:
        """Of the funnel that the monitor evaluates."""
        return "proved" if self.proof else self.elite.guarantee

    @property
    def rates(self) -> np.ndarray:
        """x*' at both ends of every interval: the certificate's, which are the elite's to their rounding."""
        return self.proof.rates if self.proof else self.funnel.loop.rates

    @property
    def angles(self) -> Bool[np.ndarray, " n"]:
        """Which states are angles, and so known only up to whole turns to many encoders."""
        return np.array([unit == "rad" for unit in self.elite.record["units"]["states"].values()])

    def at(self, t: float) -> Instant:
        """The loop at a time t >= 0: u* held, K linear, x* and the funnel's axes; the goal's from t_N on."""
        elite, funnel, dt, now = self.elite, self.funnel, self.elite.time[1], np.array([t])
        x, after = funnel.nominal(now)[0], t >= elite.time[-1]
        k = len(elite.u) if after else min(int(t / dt), len(elite.u) - 1)
        s = 0.0 if after else t / dt - k
        proved = self.proof.at(k + s) if self.proof else None
        axes = ellipsoid_axes(funnel.value(now), funnel.level(now))[0] if proved is None else proved
        if after:
            return Instant(x, np.zeros_like(elite.u_max), elite.K_goal, axes, proved is not None)
        return Instant(x, elite.u[k], funnel.loop.gain(k, s), axes, proved is not None)

    def arrays(self) -> dict[str, np.ndarray]:
        """What the controller's npz holds, SI units."""
        elite = self.elite
        stored = {
            name: getattr(elite, name) for name in ("time", "x", "u", "K", "S", "rho", "K_goal", "x_goal", "u_max")
        }
        rates = {"x_rates": self.rates, "S_rates": self.funnel.value_rates}
        nothing = np.zeros(0), np.zeros((0, 4, *elite.S.shape[1:]))
        begins, axes = (self.proof.begins, self.proof.axes) if self.proof else nothing
        proof = {"proof_begins": begins, "proof_axes": axes}
        return (
            stored
            | rates
            | {"state_limits": elite.state_limits, "input_joints": self.joints}
            | proof
            | {"angles": self.angles, "caught": np.array(elite.caught)}
        )

    def describe(self) -> dict[str, Any]:
        """What the controller's JSON holds: units, signs, limits, control rate, origin, and what is promised."""
        elite, record = self.elite, self.elite.record
        named_states, named_inputs = (record["units"][kind].items() for kind in ("states", "inputs"))
        states = zip(named_states, elite.state_limits, strict=True)
        inputs = zip(named_inputs, elite.u_max, self.joints, strict=True)
        return {
            "plant": elite.plant,
            "elite": self.name,
            "name": self.label,
            "config_hash": record["config_hash"],
            "design": record["design"],
            "parameters": elite.parameters,
            "parameter_units": self.plant.parameter_units,
            "weights": record["weights"],
            "states": [{"name": name, "unit": unit, "limit": limit} for (name, unit), limit in states],
            "inputs": [
                {"name": name, "unit": unit, "limit": limit, "joint": joint} for (name, unit), limit, joint in inputs
            ],
            "convention": self.plant.convention,
            "time": {"unit": "s", "knots": elite.time.size, "dt": elite.time[1], "duration": elite.time[-1]},
            **({"catch": record["catch"]} if elite.caught else {}),
            "control_rate": {
                "unit": "Hz",
                "least": self.control_rate.rate,
                "period": self.control_rate.period,
                "calls_an_interval": self.control_rate.divisor,
                "states": self.control_rate.states,
                "start_radius": self.control_rate.radius,
                "rule": self.control_rate.sentence,
            },
            "monitor": {"guarantee": self.guarantee, "set": PROVED if self.proof else SAMPLED},
            "funnel": {
                "rung": elite.guarantee,
                "epsilon": elite.epsilon,
                "confidence": elite.confidence,
                "volumes": record["volumes"],
                "volume_unit": record["units"]["volume"],
                "between_knots": SAMPLED,
            },
            "certificate": self._certificate(),
        }

    def _certificate(self) -> dict[str, Any] | None:
        """The certificate that goes along, if it proves this elite."""
        if self.proof is None:
            return None
        return {
            "file": "certificate.json",
            "sha256": self.standing.sha256,
            "claim": self.standing.claim,
            "rung": "proved",
            "from": self.standing.start,
            "volumes": self.standing.volumes,
            "check": "rtcd check certificate.json",
        }


def read_bundle(
    folder: Path,
    name: str,
    label: str | None = None,
    show: Callable[[int, int, str], None] = lambda done, of, what: None,
) -> Bundle:
    """The elite `name` ("000", ... or "initial") of a run folder, to be exported as `label`, by default PLANT_NAME.

    `show(done, of, what)` is called with the progress of a long step.

    Raises:
        UserError: it is not there, cannot be read or has no funnel, at the knots or between them; a label that is no
            name in Python and C.
    """
    stored = Elite.read(folder, name)
    elite = stored.of_all_robots()
    label = _label(label or f"{elite.plant}_{name}")
    certificate = standing(folder, name, lambda done, of: show(done, of, "checking the certificate"))
    proof = ProvedFunnel.read(certificate_path(folder, name)) if certificate.proved else None
    funnel = FunnelInterpolant.of(elite)
    if proof is None:
        _require_ellipsoids(funnel)
    with jax.enable_x64(True):
        plant, design = plant_of(elite.robot, elite.parameters, elite.design_units)
    model = model_of(elite.robot, elite.parameters)
    return Bundle(
        name=name,
        label=label,
        funnel=funnel,
        plant=plant,
        design=design,
        model=model,
        joints=model.actuator_trnid[:, 0].copy(),
        standing=certificate,
        proof=proof and proof.of_all_robots(),
        control_rate=control_rate(stored, proof, lambda done, of: show(done, of, "trying control rates")),
        robustness=borne(folder, name),
    )


def _require_ellipsoids(funnel: FunnelInterpolant) -> None:
    """Raises UserError if S(t) is not positive definite somewhere: the monitor's V would mean nothing there."""
    end, intervals = funnel.elite.time[-1], len(funnel.elite.u)
    time = np.linspace(0, end, INSTANTS * intervals + 1)
    bad = time[np.linalg.eigvalsh(funnel.value(time))[:, 0] <= 0]
    if bad.size:
        raise UserError(
            f"the funnel is no ellipsoid at t = {bad[0]:.4g} s, between two knots: the interpolant of S is indefinite "
            f"there; search with more knots than trajectory.knots = {intervals + 1}"
        )


def _label(text: str) -> str:
    """`text` if files, Python's modules and C's symbols can be called so."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,63}", text):
        raise UserError(f"name {text!r}: must be a letter and up to 63 letters, digits and _, as pendulum_000")
    return text
