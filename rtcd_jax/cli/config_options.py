"""The tree of a configuration as options: one for each key, its unit and range in the help."""

from collections.abc import Mapping, Sequence

from tyro.constructors import StructFieldSpec

from rtcd_jax.cli.options import Branch, section
from rtcd_jax.config.load import Config
from rtcd_jax.config.plants import MjcfPlant, PackagedPlant, PlantConfig
from rtcd_jax.config.schema import TaskChanges, Variable
from rtcd_jax.config.settings import Settings, unit


def config_branch(config: Config) -> Branch:
    """The options of every key of `config`, whose values are the defaults."""
    plant = config.plant
    design = {name: _section(config.design[name], unit) for name, unit in config.design_units.items()}
    weights = {"q": _list(config.weights.q, plant.states), "r": _list(config.weights.r, plant.input_units)}
    task = _section(config.task, ", ".join(plant.states.values()))
    options = type(config.policy).model_fields
    searched = {name: _section(option, unit(options[name])) for name, option in config.policy.variables().items()}
    policy = _section(config.policy, branches=searched)
    branches = {"task": task, "design": _group(design), "weights": _group(weights), "policy": policy}
    if not isinstance(plant, PackagedPlant):
        branches["plant"] = _own_plant(plant)
    if config.tasks:
        branches["tasks"] = _group({name: _of_task(changes, plant) for name, changes in config.tasks.items()})
    whole = _section(config, branches=branches)
    return whole if config.tasks else Branch(tuple(field for field in whole.fields if field.name != "tasks"))


def _of_task(changes: TaskChanges, plant: PlantConfig) -> Branch:
    """A task's ends; what it changes of the robot is the file's."""
    branch, kept = _section(changes, ", ".join(plant.states.values())), {"plant": changes.plant}
    return Branch(tuple(field for field in branch.fields if field.name != "plant"), lambda **own: own | kept)


def _own_plant(plant: PlantConfig) -> Branch:
    """The constants of a robot of one's own; all else of it is the file's."""
    stated = plant.model_dump(mode="json")
    if isinstance(plant, MjcfPlant):
        units = plant.robot().units
        fields = [
            StructFieldSpec(name, float, value, f"constant of {plant.mjcf} [{units[name] or '-'}]")
            for name, value in plant.values().items()
        ]
        return Branch(tuple(fields), lambda **values: plant.with_parameters(values).model_dump(mode="json"))
    fields = [StructFieldSpec(name, float, value, "constant") for name, value in stated["constants"].items()]
    return Branch(tuple(fields), lambda **values: stated | {"constants": values})


def _section(settings: Settings, unit: str = "", branches: Mapping[str, Branch] | None = None) -> Branch:
    branch = section(type(settings), vars(settings), unit, branches)
    if not isinstance(settings, Variable):
        return branch
    kept = {key: settings.unit for key in ("unit",) if settings.unit}  # the unit is no option
    fields = tuple(field for field in branch.fields if field.name != "unit")
    return Branch(fields, lambda **values: values | kept)


def _list(weights: Sequence[Variable], units: Mapping[str, str]) -> Branch:
    pairs = zip(weights, units.values(), strict=True)
    branches = {str(i): _section(weight, f"1/(s ({unit})^2)") for i, (weight, unit) in enumerate(pairs)}
    return Branch(_group(branches).fields, lambda **values: tuple(values.values()))


def _group(branches: Mapping[str, Branch]) -> Branch:
    return Branch(tuple(StructFieldSpec(name, Branch, branch) for name, branch in branches.items()))
