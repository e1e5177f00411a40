"""An audited funnel as a run folder, which every verb that reads runs reads: its configuration, and its elites."""

from pathlib import Path
from typing import Any

from rtcd_jax.certificate.audit.external import Cost, ExternalFunnel, elite_of
from rtcd_jax.config import load as configuration
from rtcd_jax.config.load import Config
from rtcd_jax.elite.records import FORMAT, INITIAL, VERSION, write_elite
from rtcd_jax.system.files import make_folder, replace, replace_json

AROUND = 10.0
"""Factor to each side of a weight's box: `rtcd optimize OUT/config.yaml` would search there."""


def config_of(external: ExternalFunnel, cost: Cost) -> Config:
    """The experiment whose initial candidate the funnel is: its design, and weights to be searched around its own.

    Raises UserError as `configuration.parse`.
    """
    robot = external.robot
    pinned = {
        name: {"initial": value, "min": value, "max": value, "pinned": True} for name, value in robot.design.items()
    }
    units = {name: {"unit": unit} for name, unit in robot.units.items() if unit}
    return configuration.parse(
        {
            "plant": robot.plant.model_dump(mode="json"),
            "task": {
                "start": external.x[0].tolist(),
                "goal": external.goal.tolist(),
                "state_limits": cost.limits.tolist(),
            },
            "design": {name: pinned[name] | units.get(name, {}) for name in pinned},
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
