"""The tree of a configuration as options: one for each key, its unit and range in the help."""

from collections.abc import Mapping, Sequence

from tyro.constructors import StructFieldSpec

from rtcd_jax.cli.options import Branch, section
from rtcd_jax.config.load import Config
from rtcd_jax.config.schema import Variable
from rtcd_jax.config.settings import Settings, unit


def config_branch(config: Config) -> Branch:
    """The options of every key of `config`, whose values are the defaults."""
    plant = config.plant
    design = {name: _section(variable, plant.design[name]) for name, variable in config.design.items()}
    weights = {"q": _list(config.weights.q, plant.states), "r": _list(config.weights.r, plant.inputs)}
    task = _section(config.task, ", ".join(plant.states.values()))
    options = type(config.policy).model_fields
    searched = {name: _section(option, unit(options[name])) for name, option in config.policy.variables().items()}
    policy = _section(config.policy, branches=searched)
    branches = {"task": task, "design": _group(design), "weights": _group(weights), "policy": policy}
    return _section(config, branches=branches)


def _section(settings: Settings, unit: str = "", branches: Mapping[str, Branch] | None = None) -> Branch:
    return section(type(settings), vars(settings), unit, branches)


def _list(weights: Sequence[Variable], units: Mapping[str, str]) -> Branch:
    pairs = zip(weights, units.values(), strict=True)
    branches = {str(i): _section(weight, f"1/(s ({unit})^2)") for i, (weight, unit) in enumerate(pairs)}
    return Branch(_group(branches).fields, lambda **values: tuple(values.values()))


def _group(branches: Mapping[str, Branch]) -> Branch:
    return Branch(tuple(StructFieldSpec(name, Branch, branch) for name, branch in branches.items()))
