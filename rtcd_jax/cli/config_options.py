"""The tree of a configuration as tyro's options: one for each key, its unit and range in the help."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

from pydantic.fields import FieldInfo
from tyro.constructors import StructConstructorSpec, StructFieldSpec, StructTypeInfo

from rtcd_jax.config.load import Config
from rtcd_jax.config.schema import UNIT, Variable
from rtcd_jax.config.settings import Settings, bounds, unit


@dataclass(frozen=True)
class Branch:
    """A node of the tree of options: tyro parses its fields, `collect` gathers their values in a plain container."""

    fields: tuple[StructFieldSpec, ...]
    collect: Callable[..., Any] = dict


def plain(info: StructTypeInfo) -> StructConstructorSpec | None:
    if isinstance(info.default, Branch):
        return StructConstructorSpec(info.default.collect, info.default.fields)
    return None


def config_branch(config: Config) -> Branch:
    plant = config.plant
    design = {name: _section(variable, plant.design[name]) for name, variable in config.design.items()}
    weights = {"q": _list(config.weights.q, plant.states), "r": _list(config.weights.r, plant.inputs)}
    task = _section(config.task, ", ".join(plant.states.values()))
    options = type(config.policy).model_fields
    searched = {name: _section(option, unit(options[name])) for name, option in config.policy.variables().items()}
    policy = _section(config.policy, branches=searched)
    branches = {"task": task, "design": _group(design), "weights": _group(weights), "policy": policy}
    return _section(config, branches=branches)


def _list(weights: Sequence[Variable], units: Mapping[str, str]) -> Branch:
    pairs = zip(weights, units.values(), strict=True)
    branches = {str(i): _section(weight, f"1/(s ({unit})^2)") for i, (weight, unit) in enumerate(pairs)}
    return Branch(_group(branches).fields, lambda **values: tuple(values.values()))


def _group(branches: Mapping[str, Branch]) -> Branch:
    return Branch(tuple(StructFieldSpec(name, Branch, branch) for name, branch in branches.items()))


def _section(settings: Settings, unit: str = "", branches: Mapping[str, Branch] | None = None) -> Branch:
    """One option for each field, a branch for each section in it; `unit` replaces the placeholder in their help."""
    ready = branches or {}
    fields = []
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if name in ready or isinstance(value, Settings):
            fields.append(StructFieldSpec(name, Branch, ready.get(name) or _section(value, unit), field.description))
        else:
            kind = float if isinstance(value, float) else cast(type, field.annotation)
            fields.append(StructFieldSpec(name, kind, value, _help(field, unit)))
    return Branch(tuple(fields))


def _help(field: FieldInfo, unit: str) -> str:
    text = str(field.description).replace(UNIT, unit)
    limits = bounds(field)
    return f"{text} ({limits})" if limits else text
