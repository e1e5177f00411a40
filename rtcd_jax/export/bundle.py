"""One stored elite as the controller that a lab runs: every number it looks up, and what the numbers mean."""

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, final

import jax
import numpy as np
from jaxtyping import Int

from rtcd_jax.elite.closed_loop import fastest_rate
from rtcd_jax.elite.elite import Elite, ellipsoid_axes
from rtcd_jax.elite.funnel import FunnelInterpolant
from rtcd_jax.export.proof import ProvedFunnel
from rtcd_jax.plants import plant_class
from rtcd_jax.plants.base import Plant
from rtcd_jax.plants.mjx import CpuDynamics, model_of
from rtcd_jax.system.errors import UserError

HOLD = 0.1
"""Longest time for which the input may be held, in time constants of the loop's fastest mode."""
RULE = f"the input is held for at most {HOLD:g} time constants of the loop's fastest mode"
BETWEEN_KNOTS = "V = (x - x*)'S(t)(x - x*), S cubic Hermite, log rho linear; what was sampled is promised at knots"
RATES = 50.0
"""Control rates are multiples of this [Hz]."""


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
    certificate: Mapping[str, Any] | None
    plant: Plant
    design: Any
    model: Any
    joints: Int[np.ndarray, " m"]
    proof: ProvedFunnel

    @property
    def elite(self) -> Elite:
        return self.funnel.elite

    def at(self, t: float) -> Instant:
        """The loop at a time t >= 0: u* held, K linear, x* and the funnel's axes; the goal's from t_N on."""
        elite, funnel, dt, now = self.elite, self.funnel, self.elite.time[1], np.array([t])
        x, after = funnel.nominal(now)[0], t >= elite.time[-1]
        k = len(elite.u) if after else min(int(t / dt), len(elite.u) - 1)
        s = 0.0 if after else t / dt - k
        proved = self.proof.at(k + s)
        axes = ellipsoid_axes(funnel.value(now), funnel.level(now))[0] if proved is None else proved
        if after:
            return Instant(x, np.zeros_like(elite.u_max), elite.K_goal, axes, proved is not None)
        return Instant(x, elite.u[k], funnel.loop.gain(k, s), axes, proved is not None)

    def arrays(self) -> dict[str, np.ndarray]:
        """What the controller's npz holds, SI units."""
        elite = self.elite
        kept = {name: getattr(elite, name) for name in ("time", "x", "u", "K", "S", "rho", "K_goal", "x_goal", "u_max")}
        more = {"x_rates": self.funnel.loop.rates, "S_rates": self.funnel.value_rates}
        proof = {"proof_begins": self.proof.begins, "proof_axes": self.proof.axes}
        return kept | more | {"state_limits": elite.state_limits, "input_joints": self.joints} | proof

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
            "control_rate": {"unit": "Hz", "least": least_rate(self), "rule": RULE},
            "funnel": {
                "rung": elite.guarantee,
                "epsilon": elite.epsilon,
                "confidence": elite.confidence,
                "volumes": record["volumes"],
                "volume_unit": record["units"]["volume"],
                "between_knots": BETWEEN_KNOTS,
            },
            "certificate": self.certificate,
        }


def read_bundle(folder: Path, name: str, label: str | None = None) -> Bundle:
    """The elite `name` ("000", ... or "initial") of a run folder, to be exported as `label`, by default PLANT_NAME.

    Raises:
        UserError: it is not there, cannot be read or has no funnel; a label that is no name in Python and C.
    """
    elite = Elite.read(folder, name)
    with jax.enable_x64(True):
        plant, design = plant_class(elite.plant).from_parameters(elite.parameters)
    model = model_of(elite.plant, elite.parameters)
    return Bundle(
        name=name,
        label=_label(label or f"{elite.plant}_{name}"),
        funnel=FunnelInterpolant.of(elite),
        certificate=_certificate(folder, name, elite),
        plant=plant,
        design=design,
        model=model,
        joints=model.actuator_trnid[:, 0].copy(),
        proof=ProvedFunnel.none(elite.x_goal.size),
    )


def _label(text: str) -> str:
    """`text` if files, Python's modules and C's symbols can be called so."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,63}", text):
        raise UserError(f"name {text!r}: must be a letter and up to 63 letters, digits and _, as pendulum_000")
    return text


def least_rate(bundle: Bundle) -> float:
    """A control rate [Hz] at which holding the input is a small matter: `HOLD` of the fastest mode's time constant."""
    columns = bundle.elite.x_goal.size + bundle.elite.u_max.size
    fastest = fastest_rate(bundle.elite, CpuDynamics(bundle.model, columns))
    return RATES * math.ceil(fastest / HOLD / RATES)


def certificate_path(folder: Path, name: str) -> Path:
    """Where a run folder keeps the certificate of an elite."""
    return folder / "certificates" / f"{name}.json"


def _certificate(folder: Path, name: str, elite: Elite) -> dict[str, Any] | None:
    """File, digest and rung of the elite's certificate; None if the run has none for this very controller."""
    path = certificate_path(folder, name)
    if not path.is_file():
        return None
    try:
        content = path.read_bytes()
        claim = json.loads(content)["claim"]
        same = all(np.array_equal(_exact(claim[key]), getattr(elite, key).ravel()) for key in ("x", "u", "K", "K_goal"))
        summary_path = path.with_name("summary.json")
        summary = json.loads(summary_path.read_bytes()) if summary_path.is_file() else {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"cannot read {path}: {error!r}; prove it again by `rtcd certify {folder}`") from error
    if not same:
        return None
    shown = summary.get(name) or {}
    return {
        "file": "certificate.json",
        "sha256": hashlib.sha256(content).hexdigest(),
        "rung": shown.get("rung"),
        "from": shown.get("start"),
        "check": "rtcd check certificate.json",
    }


def _exact(rows: Any) -> np.ndarray:
    """A certificate's hexadecimal doubles as numbers, row by row."""
    return np.array([float.fromhex(number) for number in np.ravel(rows).tolist()])
