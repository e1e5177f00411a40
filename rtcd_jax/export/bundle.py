"""One stored elite as the controller that a lab runs: every number it looks up, and what the numbers mean."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, final

import jax
import numpy as np
from jaxtyping import Int

from rtcd_jax.elite.closed_loop import fastest_rate
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import FunnelInterpolant
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
    """The loop at one time: x* [n], u* [m], K [m n], S [n n] and rho []."""

    x: np.ndarray
    u: np.ndarray
    gain: np.ndarray
    value: np.ndarray
    level: float


@final
@dataclass(frozen=True, eq=False)
class Bundle:
    """An elite with its funnel at every instant, the robot that it is for, and MuJoCo's model of it.

    `joints` [m] says which joint an input drives.
    """

    name: str
    funnel: FunnelInterpolant
    certificate: Mapping[str, Any] | None
    plant: Plant
    design: Any
    model: Any
    joints: Int[np.ndarray, " m"]

    @property
    def elite(self) -> Elite:
        return self.funnel.elite

    def at(self, t: float) -> Instant:
        """The loop at a time t >= 0: u* held, K linear, x*, S, rho as the funnel has them; the goal's from t_N on."""
        elite, funnel, dt, now = self.elite, self.funnel, self.elite.time[1], np.array([t])
        x, value, level = funnel.nominal(now)[0], funnel.value(now)[0], float(funnel.level(now)[0])
        if t >= elite.time[-1]:
            return Instant(x, np.zeros_like(elite.u_max), elite.K_goal, value, level)
        k = min(int(t / dt), len(elite.u) - 1)
        return Instant(x, elite.u[k], funnel.loop.gain(k, t / dt - k), value, level)

    def arrays(self) -> dict[str, np.ndarray]:
        """What `controller.npz` holds, SI units."""
        elite = self.elite
        kept = {name: getattr(elite, name) for name in ("time", "x", "u", "K", "S", "rho", "K_goal", "x_goal", "u_max")}
        rates = {"x_rates": self.funnel.loop.rates, "S_rates": self.funnel.value_rates}
        return kept | rates | {"state_limits": elite.state_limits, "input_joints": self.joints}

    def describe(self) -> dict[str, Any]:
        """What `controller.json` holds: units, signs, limits, control rate, origin, and what is promised."""
        elite, record = self.elite, self.elite.record
        named_states, named_inputs = (record["units"][kind].items() for kind in ("states", "inputs"))
        states = zip(named_states, elite.state_limits, strict=True)
        inputs = zip(named_inputs, elite.u_max, self.joints, strict=True)
        return {
            "plant": elite.plant,
            "elite": self.name,
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


def read_bundle(folder: Path, name: str) -> Bundle:
    """The elite `name` ("000", ... or "initial") of a run folder.

    Raises:
        UserError: it is not there, cannot be read or has no funnel.
    """
    elite = Elite.read(folder, name)
    with jax.enable_x64(True):
        plant, design = plant_class(elite.plant).from_parameters(elite.parameters)
    model = model_of(elite.plant, elite.parameters)
    return Bundle(
        name=name,
        funnel=FunnelInterpolant.of(elite),
        certificate=_certificate(folder, name, elite),
        plant=plant,
        design=design,
        model=model,
        joints=model.actuator_trnid[:, 0].copy(),
    )


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
