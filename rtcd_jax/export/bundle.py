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
from jaxtyping import Float, Int

from rtcd_jax.errors import UserError
from rtcd_jax.numerics.hermite import cubic_hermite
from rtcd_jax.plants import plant_class
from rtcd_jax.plants.base import Plant
from rtcd_jax.plants.mjx import CpuDynamics, model_of
from rtcd_jax.storage import read_elite
from rtcd_jax.verify.elite import Elite
from rtcd_jax.verify.simulate import fastest_rate

HOLD = 0.1
"""Longest time for which the input may be held, in time constants of the loop's fastest mode."""
RULE = f"the input is held for at most {HOLD:g} time constants of the loop's fastest mode"
RATES = 50.0
"""Control rates are multiples of this [Hz]."""


class Instant(NamedTuple):
    """The loop at one time: x* [n], u* [m], K [m n], and E [n n] with {e : e' E^-1 e <= 1} the funnel's section."""

    x: np.ndarray
    u: np.ndarray
    gain: np.ndarray
    shape: np.ndarray


@final
@dataclass(frozen=True, eq=False)
class Bundle:
    """An elite with the slopes of x*(t), the robot that it is for, and MuJoCo's model of it.

    `rates` [N 2 n] are x*' at both ends of every interval; `joints` [m] says which joint an input drives.
    """

    name: str
    elite: Elite
    record: Mapping[str, Any]
    certificate: Mapping[str, Any] | None
    plant: Plant
    design: Any
    model: Any
    rates: Float[np.ndarray, "N 2 n"]
    volumes: Float[np.ndarray, " knots"]
    joints: Int[np.ndarray, " m"]

    @property
    def shapes(self) -> Float[np.ndarray, "knots n n"]:
        """E_k = rho_k S_k^-1: the ellipsoids are {e : e' E_k^-1 e <= 1}."""
        return self.elite.rho[:, None, None] * np.linalg.inv(self.elite.S)

    def at(self, t: float) -> Instant:
        """The loop at a time t >= 0, x* by cubic Hermite interpolation, K and E linear; the goal's from t_N on.

        Of the shapes that could be interpolated, E = rho S^-1 follows the motions: a state on the boundary at a knot
        stays within 2 % of it until the next one, where a linear S would call it outside by up to a factor of 3.
        """
        elite, dt, shapes = self.elite, self.elite.time[1], self.shapes
        if t >= elite.time[-1]:
            return Instant(elite.x_goal, np.zeros_like(elite.u_max), elite.K_goal, shapes[-1])
        k = min(int(t / dt), len(elite.u) - 1)
        s = t / dt - k
        x = cubic_hermite(s, dt, elite.x[k], self.rates[k, 0], elite.x[k + 1], self.rates[k, 1])
        gain, shape = ((1 - s) * a[k] + s * a[k + 1] for a in (elite.K, shapes))
        return Instant(x, elite.u[k], gain, shape)

    def arrays(self) -> dict[str, np.ndarray]:
        """What `controller.npz` holds, SI units."""
        elite = self.elite
        kept = {name: getattr(elite, name) for name in ("time", "x", "u", "K", "S", "rho", "K_goal", "x_goal", "u_max")}
        more = {"x_rates": self.rates, "E": self.shapes, "state_limits": elite.state_limits}
        return kept | more | {"input_joints": self.joints}

    def describe(self) -> dict[str, Any]:
        """What `controller.json` holds: units, signs, limits, control rate, origin, and what is promised."""
        elite, record = self.elite, self.record
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
                "rung": record["rung"],
                "epsilon": elite.epsilon,
                "confidence": elite.confidence,
                "volumes": record["volumes"],
                "volume_unit": record["units"]["volume"],
                "between_knots": "(x - x*)' E(t)^-1 (x - x*) <= 1, E linear between rho_k S_k^-1; promised at knots",
            },
            "certificate": self.certificate,
        }


def read_bundle(folder: Path, name: str) -> Bundle:
    """The elite `name` ("000", ... or "initial") of a run folder.

    Raises:
        UserError: it is not there, cannot be read or has no funnel.
    """
    arrays, record = read_elite(folder if name == "initial" else folder / "elites", name)
    if record.get("status") != "OK":
        raise UserError(f"{name} has no funnel to export ({record.get('status')}); choose another elite")
    elite = Elite.of(arrays, record)
    with jax.enable_x64(True):
        plant, design = plant_class(elite.plant).from_parameters(elite.parameters)
        rate = jax.vmap(lambda x, u: plant.dynamics(design, x, u))
        rates = np.stack([np.asarray(rate(ends, elite.u)) for ends in (elite.x[:-1], elite.x[1:])], axis=1)
    model = model_of(elite.plant, elite.parameters)
    joints = model.actuator_trnid[:, 0].copy()
    return Bundle(
        name,
        elite,
        record,
        _certificate(folder, name, elite),
        plant,
        design,
        model,
        rates,
        arrays["volumes_per_knot"],
        joints,
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
