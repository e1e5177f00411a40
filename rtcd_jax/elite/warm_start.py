"""A configuration that begins with the best candidate of a former run."""

from pathlib import Path
from typing import Any

from rtcd_jax.config.load import Config, parse, resolved
from rtcd_jax.elite.records import read_config, read_elite, require_elites
from rtcd_jax.system.errors import UserError


def begun_from(config: Config, run: Path) -> Config:
    """`config` with its free variables' initial values those of the run's best elite, moved into their boxes.

    Raises:
        UserError: no finished run, or one of another robot.
    """
    plant = read_config(run).plant.name
    if plant != config.plant.name:
        raise UserError(f"--from {run}: is a run of the {plant}, and the configuration is of the {config.plant.name}")
    _, record = read_elite(run / "elites", require_elites(run)[0])
    if not config.shares_all:
        text = "is not for search.share = design: the weights of all tasks have one initial value"
        raise UserError(f"--from {run}: {text}")
    data = resolved(config)
    for name, variable in config.variables().items():
        if variable.free:
            section, *keys = name.split(".")
            known = _known(record, section, keys, run)
            _place(data, section, keys)["initial"] = min(max(known, variable.min), variable.max)
    return parse(data)


def _place(tree: Any, section: str, keys: list[str]) -> Any:
    for key in (section, *keys):
        tree = tree[int(key)] if isinstance(tree, list) else tree[key]
    return tree


def _known(record: Any, section: str, keys: list[str], run: Path) -> float:
    try:
        return float(_place(record, section, keys))
    except (KeyError, IndexError, TypeError, ValueError):
        raise UserError(f"--from {run}: its best elite does not say its {'.'.join((section, *keys))}") from None
