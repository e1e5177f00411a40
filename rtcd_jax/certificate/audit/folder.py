"""An audited funnel as a run folder, which every verb that reads runs reads: its configuration, and its elites."""

import math
from pathlib import Path
from typing import Any

from rtcd_jax.certificate.audit.external import Cost, ExternalFunnel, elite_of
from rtcd_jax.config import load as configuration
from rtcd_jax.config.load import Config
from rtcd_jax.elite.records import FORMAT, INITIAL, VERSION, write_elite
from rtcd_jax.system.files import make_folder, replace, replace_json

AROUND = 10.0
"""Factor to each side of a weight's box: `rtcd optimize OUT/config.yaml` would search there."""
ROD = 1 / 3
"""A uniform rod's moment of inertia about its center of mass in Mp lp^2, lp half its length."""


def config_of(external: ExternalFunnel, cost: Cost) -> Config:
    """The experiment whose initial candidate the funnel is: its design, and weights to be searched around its own.

    Raises UserError as `configuration.parse`.
    """
    plant, design = _robot(external.name, external.parameters)
    return configuration.parse(
        {
            "plant": plant,
            "task": {
                "start": external.x[0].tolist(),
                "goal": external.goal.tolist(),
                "state_limits": cost.limits.tolist(),
            },
            "design": {
                name: {"initial": value, "min": value, "max": value, "pinned": True} for name, value in design.items()
            },
            "weights": {"q": [_searched(value) for value in cost.q.tolist()], "r": [_searched(cost.r)]},
            "trajectory": {"knots": len(external.x), "step": {"min": external.dt, "max": external.dt}},
        },
        "the audit's configuration",
    )


def write_folder(out: Path, config: Config, given: ExternalFunnel, solution: ExternalFunnel, cost: Cost) -> None:
    """Writes the run folder: elite 000 is `solution`, 001 and the initial candidate are `given`."""
    design = {name: variable.initial for name, variable in config.design.items()}
    replace_json(out / "format.json", {"format": FORMAT, "version": VERSION})
    replace(out / "config.yaml", configuration.dump(config).encode())
    make_folder(out / "elites")
    for folder, name, external in (
        (out / "elites", "000", solution),
        (out / "elites", "001", given),
        (out, INITIAL, given),
    ):
        arrays, record = elite_of(external, cost)
        more = {
            "design": design,
            "policy": config.policy.initial(),
            "units": units(config),
            "duration": float(arrays["time"][-1]),
            "config_hash": configuration.config_hash(config),
        }
        write_elite(folder, name, arrays, record | more)


def units(config: Config) -> dict[str, Any]:
    """Units as a run's records have them."""
    plant = config.plant
    volume = " ".join(plant.states.values())
    return {
        "states": plant.states,
        "inputs": plant.input_units,
        "design": config.design_units,
        "time": "s",
        "volume": volume,
    }


def _searched(value: float) -> dict[str, Any]:
    return {"initial": value, "min": value / AROUND, "max": value * AROUND}


def _robot(name: str, p: dict[str, float]) -> tuple[dict[str, Any], dict[str, float]]:
    """The plant's section and its design, from the parameters of its equations."""
    if name == "pendulum":
        constants = {"damping": p["b"], "gravity": p["g"], "torque_limit": p["torque_limit"]}
        return {"name": name} | constants, {"mass": p["m"], "length": p["l"]}
    rod = math.isclose(p["inertia_about_com"], ROD * p["Mp"] * p["lp"] ** 2, rel_tol=1e-6)
    constants = {
        "cart_mass": p["Mc"], "cart_damping": p["Beq"], "pivot_damping": p["Bp"], "gravity": p["g"],
        "force_limit": p["force_limit"], "inertia": "rod" if rod else "measured",
    }  # fmt: skip
    return {"name": name} | constants, {"pole_length": p["lp"], "pole_mass": p["Mp"]}
