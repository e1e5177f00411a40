"""The experiment: one YAML as a frozen model of sections. Knows no JAX.

`load` reads a file, `parse` a mapping; both raise `ConfigError` with everything that is wrong at once.
"""

import hashlib
import inspect
import itertools
import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import yaml
from pydantic import (
    Field,
    PlainValidator,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
    model_serializer,
)

from rtcd_jax.config import mjcf, yaml12
from rtcd_jax.config.arithmetic import arithmetic
from rtcd_jax.config.plants import PackagedPlant, PlantConfig, read_plant
from rtcd_jax.config.robot import Value, needs, value_of
from rtcd_jax.config.schema import (
    CheckpointConfig,
    ElitesConfig,
    FunnelConfig,
    PolicyConfig,
    SearchConfig,
    TaskChanges,
    TaskConfig,
    TrajectoryConfig,
    UncertaintyConfig,
    Variable,
    WeightsConfig,
)
from rtcd_jax.config.settings import Settings, problems_of, refusal
from rtcd_jax.system.errors import ConfigError, Problem, closest, printable
from rtcd_jax.volume import GOAL

EXAMPLE = """\
plant: {name: pendulum}
task: {start: [0, 0], goal: [3.141592653589793, 0], state_limits: [6.283185307179586, 7]}
design: {mass: {initial: 0.7, min: 0.6, max: 0.8}, length: {initial: 0.4, min: 0.4, max: 0.6}}
weights:
  q: [{initial: 10, min: 1, max: 10}, {initial: 1, min: 1, max: 10}]
  r: [{initial: 0.1, min: 0.001, max: 10}]
"""
"""The shortest complete YAML: the paper's pendulum with the default settings."""

SMALLEST_DESIGN, SMALLEST_WEIGHT = 1e-6, 1e-9
MOST_CORNERS = 5
"""Numbers of a box whose corners are followed one by one."""

LATER_KEYS = (
    ("uncertainty", "center"),
    ("uncertainty",),
    ("search", "at_least"),
    ("search", "refine"),
    ("search", "patience"),
    ("search", "over_tasks"),
    ("search", "share"),
    ("trajectory", "input_share"),
)
"""At their defaults they leave the hashes of configurations as they were before there were such keys."""


_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")
"""Of a task: it becomes a folder's."""

OWN = "tasks"
"""Begins the dotted key of a variable that a task has for itself, and its name follows."""


class Config(Settings):
    """Everything that defines a run."""

    plant: Annotated[SerializeAsAny[PlantConfig], PlainValidator(read_plant)] = Field(description="the robot")
    task: TaskConfig = Field(description="from where to where, and within what")
    tasks: dict[str, TaskChanges] = Field(
        default={}, description="of one design for several tasks, by name: what each has of its own"
    )
    design: dict[str, Variable] = Field(description="the plant's design fields by name, all >= 1e-6")
    weights: WeightsConfig = Field(description="cost weights >= 1e-9, searched on a log scale")
    trajectory: TrajectoryConfig = Field(default=TrajectoryConfig(), description="the nominal motion")
    policy: PolicyConfig = Field(default=PolicyConfig(), description="the controller that tracks it")
    uncertainty: UncertaintyConfig = Field(
        default=UncertaintyConfig(), description="what every funnel must bear; all zero: one exact model"
    )
    funnel: FunnelConfig = Field(default=FunnelConfig(), description="how the funnel is sampled")
    search: SearchConfig = Field(default=SearchConfig(), description="CMA-ES over designs and weights")
    elites: ElitesConfig = Field(default=ElitesConfig(), description="the archive of the best")
    checkpoint: CheckpointConfig = Field(default=CheckpointConfig(), description="when the state is saved")

    @field_validator("design")
    @classmethod
    def _in_plants_order(cls, design: dict[str, Variable], info: ValidationInfo) -> dict[str, Variable]:
        names = info.data["plant"].design if "plant" in info.data else ()
        known = {name: design[name] for name in names if name in design}
        return known | design

    @field_validator("tasks", mode="before")
    @classmethod
    def _some(cls, tasks: Any) -> Any:
        if isinstance(tasks, Mapping) and not tasks:
            raise refusal("must name a task at least; leave the key away where there is the one of `task` alone")
        return tasks

    @model_serializer(mode="wrap")
    def _without_no_tasks(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if key != "tasks" or value}

    def problems(self) -> Iterator[Problem]:
        return _across_sections(dict(self))

    @property
    def each(self) -> "dict[str, Config]":
        """The configuration of each of its tasks alone, by name: that of a whole run, with one task; "" for `task`."""
        return {name: self.of_task(name) for name in self.tasks} or {"": self}

    def of_task(self, name: str) -> "Config":
        """That of one of its `tasks`: start, goal and the plant's constants are in their sections, `tasks` keeps it and
        what it changes of the design, and of the constants if one of them follows from the design.
        """
        changes, known = self.tasks[name], self.plant.values()
        ends = {key: getattr(changes, key) for key in ("start", "goal") if getattr(changes, key)}
        constants = {key: value for key, value in changes.plant.items() if key in known}
        if any(other in self.design for value in constants.values() for other in needs(value)):
            constants = {}
        kept = {key: value for key, value in changes.plant.items() if key not in constants}
        update: dict[str, Any] = {"task": self.task.model_copy(update=ends), "tasks": {name: TaskChanges(plant=kept)}}
        if constants:
            numbers = {key: _number(value, known) for key, value in constants.items()}
            update["plant"] = self.plant.edited(numbers)
        return self.model_copy(update=update)

    @property
    def edits(self) -> Mapping[str, Value]:
        """Numbers or arithmetic that the only one of its tasks has in the place of design fields and constants."""
        return next(iter(self.tasks.values())).plant if len(self.tasks) == 1 else {}

    @property
    def follows_design(self) -> bool:
        """Whether the ends of its motion, or constants of its one task, are arithmetic of the design."""
        ends = any(isinstance(value, str) for state in (self.task.start, self.task.goal) for value in state)
        return ends or any(name not in self.design for name in self.edits)

    @property
    def design_units(self) -> dict[str, str]:
        """Of the design's variables by name, in the plant's order."""
        own = self.plant.design
        return {name: own.get(name) or variable.unit for name, variable in self.design.items()}

    def variables(self) -> dict[str, Variable]:
        """Every variable by its dotted key: the design in the plant's order, then q, r, and the policy's; those of each
        task with `tasks.NAME.` before them where they are not shared.
        """
        design = {f"design.{name}": variable for name, variable in self.design.items()}
        others = {
            f"weights.{letter}.{i}": weight for letter, weights in self.weights for i, weight in enumerate(weights)
        }
        others |= {f"policy.{name}": variable for name, variable in self.policy.variables().items()}
        if self.shares_all:
            return design | others
        each = ((f"{OWN}.{task}.{name}", variable) for task in self.tasks for name, variable in others.items())
        return design | dict(each)

    @property
    def shares_all(self) -> bool:
        """Whether its tasks have weights and options of the policy in common, or there is only one."""
        return self.search.share == "all" or len(self.tasks) <= 1

    @property
    def at_rest(self) -> bool:
        """Whether the motion is rest at the goal: its region is all that is searched for."""
        return self.search.objective == GOAL

    def ends(self, design: Mapping[str, Any]) -> tuple[tuple, tuple]:
        """First and last state of the nominal motion, of these designs by name; both are the goal where no motion is
        asked for.
        """
        first = self.task.goal if self.at_rest else self.task.start
        return _placed(first, design), _placed(self.task.goal, design)

    @property
    def initial_ends(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Those of the initial design."""
        return self.ends({name: variable.initial for name, variable in self.design.items()})

    def logarithmic(self, key: str) -> bool:
        """Whether the search scales the variable of this dotted key logarithmically."""
        section, _, name = of_one_task(key).partition(".")
        return section == "weights" or (section == "policy" and self.policy.logarithmic(name))


def of_one_task(key: str) -> str:
    """The dotted key of a variable as the configuration of its task alone has it."""
    return key.split(".", 2)[2] if key.startswith(f"{OWN}.") else key


def _sizes(plant: PlantConfig, task: TaskConfig) -> Iterator[Problem]:
    for key in ("start", "goal", "state_limits"):
        yield from _size(("task", key), getattr(task, key), plant.states)
    for i, each in enumerate(task.keep_out):
        for key in ("normal", "center", "semi_axes"):
            if value := getattr(each, key):
                yield from _size(("task", "keep_out", i, key), value, plant.states)
    for path, value in (("catch", "half_widths"), task.catch.half_widths), (("cost_center",), task.cost_center):
        if value:
            yield from _size(("task", *path), value, plant.states)


def _weight_sizes(plant: PlantConfig, weights: WeightsConfig) -> Iterator[Problem]:
    yield from _size(("weights", "q"), weights.q, plant.states)
    yield from _size(("weights", "r"), weights.r, plant.input_units)


def _size(path: tuple[str | int, ...], values: tuple, names: Collection[str]) -> Iterator[Problem]:
    if len(values) != len(names):
        plural = "entry" if len(names) == 1 else "entries"
        yield Problem(path, f"must have {len(names)} {plural} ({', '.join(names)}), has {len(values)}")


def _placed(state: Sequence[Value], design: Mapping[str, Any]) -> tuple:
    return tuple(value_of(value, design) for value in state)


def _ends(task: TaskConfig, trajectory: TrajectoryConfig, design: dict[str, Variable]) -> Iterator[Problem]:
    """Of the initial design, and at the corners of the boxes of the designs that the ends name."""
    used: dict[str, Variable] = {}
    for key in ("start", "goal"):
        for i, value in enumerate(getattr(task, key)):
            for name in needs(value):
                if name not in design:
                    yield Problem(("task", key, i), f"names {name}; there is {', '.join(('pi', *design))}", value)
                    return
                used[name] = design[name]
            if isinstance(value, str) and key == "goal" and not task.caught:
                yield Problem(
                    ("task", key, i), "must be a number: only with task.catch a goal follows the design", value
                )
                return
    boxes = ((variable.min, variable.max) if variable.free else (variable.initial,) for variable in used.values())
    for corner in ([variable.initial for variable in used.values()], *itertools.product(*boxes)):
        names = dict(zip(used, corner, strict=True))
        found = list(_ends_at(task, trajectory, names))
        if found:
            where = ", ".join(f"{name} = {value:g}" for name, value in names.items())
            yield from (each._replace(text=f"{each.text}, at {where}") if used else each for each in found)
            return


def _ends_at(task: TaskConfig, trajectory: TrajectoryConfig, names: Mapping[str, float]) -> Iterator[Problem]:
    """Of designs with these numbers."""
    ends: dict[str, tuple[float, ...]] = {}
    for key in ("start", "goal"):
        numbers = []
        for i, value in enumerate(getattr(task, key)):
            try:
                numbers.append(_number(value, names))
            except ValueError as error:
                yield Problem(("task", key, i), str(error), value)
                return
        ends[key] = tuple(numbers)
    task, share = task.model_copy(update=ends), trajectory.limit_share
    for key in ("start", "goal"):
        for i, (value, limit) in enumerate(zip(getattr(task, key), task.state_limits, strict=False)):
            if abs(value) >= limit:
                text = f"must lie between -{limit:g} and {limit:g} (task.state_limits): on a limit there is no funnel"
                yield Problem(("task", key, i), text, value)
            elif abs(value) > share * limit:
                text = f"must lie in [-{share * limit:g}, {share * limit:g}] (trajectory.limit_share of the limit)"
                yield Problem(("task", key, i), text, value)
        yield from _outside(task, key, share)
    caught = zip(task.goal, task.catch.half_widths, task.state_limits, strict=False)
    for i, (value, width, limit) in enumerate(caught):
        if abs(value) + width > limit:
            text = (
                f"must lie in [{width - limit:g}, {limit - width:g}]: the catch set reaches {width:g} from it "
                "(task.catch.half_widths), and task.state_limits hold in all of it"
            )
            yield Problem(("task", "goal", i), text, value)


def _catch(
    task: TaskConfig,
    tasks: dict[str, TaskChanges],
    policy: PolicyConfig,
    search: SearchConfig,
    uncertainty: UncertaintyConfig,
) -> Iterator[Problem]:
    if not task.caught:
        if policy.weighs_catch:
            yield Problem(("policy", "catch_weight"), "needs task.catch: without a catch set it has no use")
        return
    if task.catch.cyclic and not tasks:
        yield Problem(("task", "catch", "reset"), "leads from task to task: it needs `tasks`, two at least")
    if task.catch.cyclic and uncertainty.center == "moving":
        text = "must be common with task.catch.reset: the next motion is that of the nominal robot"
        yield Problem(("uncertainty", "center"), text, uncertainty.center)
    if search.objective == GOAL:
        text = "must be another one with task.catch: at a goal that is no equilibrium there is no region"
        yield Problem(("search", "objective"), text, search.objective)
    if search.refine:
        yield Problem(("search", "refine"), "must be false with task.catch: a refinement needs the goal's region", True)


def _outside(task: TaskConfig, key: str, share: float) -> Iterator[Problem]:
    x = getattr(task, key)
    for i, each in enumerate(task.keep_out):
        if {len(x)} != {len(size) for size in (each.normal, each.center, each.semi_axes) if size}:
            continue
        if each.depth(x, 1.0) >= 0:
            yield Problem(("task", key), f"must lie outside of task.keep_out.{i}, and not on its boundary", x)
        elif each.depth(x, share) >= 0:
            text = f"must lie outside of task.keep_out.{i}, grown by 1 / trajectory.limit_share = {1 / share:g}"
            yield Problem(("task", key), text, x)


def _tasks(
    plant: PlantConfig, task: TaskConfig, tasks: dict[str, TaskChanges], design: dict[str, Variable],
    trajectory: TrajectoryConfig, search: SearchConfig,
) -> Iterator[Problem]:  # fmt: skip
    folders: dict[str, str] = {}
    for name, changes in tasks.items():
        path = "tasks", name
        if not _NAME.fullmatch(name):
            yield Problem(path, "must be a letter and up to 63 letters, digits and _: it names a folder")
        elif (other := folders.setdefault(name.lower(), name)) != name:
            yield Problem(path, f"differs from {other} by its case alone: both would have one folder")
        own = {key: value for key in ("start", "goal") if (value := getattr(changes, key))}
        whole = task.model_copy(update=own)
        for key, value in own.items():
            yield from _size((*path, key), value, plant.states)
        if own:
            ends = (fault for fault in _ends(whole, trajectory, design) if fault.path[1] in own)
            yield from (fault._replace(path=(*path, *fault.path[1:])) for fault in ends)
            yield from (fault._replace(path=(*path, *fault.path[1:])) for fault in _motion(whole, search))
        yield from (fault._replace(path=(*path, "plant", *fault.path)) for fault in _edits(plant, design, changes))
    if len(tasks) > 1 and search.refine:
        yield Problem(("search", "refine"), "must be false with several tasks: an elite is refined for one", True)


def _edits(plant: PlantConfig, design: dict[str, Variable], changes: TaskChanges) -> Iterator[Problem]:
    """What is wrong with a task's changes of the robot."""
    known, constants = plant.values(), {}
    names = tuple(dict.fromkeys((*known, *design)))
    designs = [{name: getattr(each, at) for name, each in design.items()} for at in ("initial", "min", "max")]
    for key, value in changes.plant.items():
        if key in known:
            try:
                constants[key] = [_number(value, known | numbers) for numbers in designs]
            except ValueError as error:
                yield Problem((key,), str(error), value)
        elif key in design:
            for other in needs(value):
                if other not in names:
                    yield Problem((key,), f"names {other}; there is {', '.join(('pi', *names))}", value)
        elif key in type(plant).model_fields:
            yield Problem((key,), "is the same in all tasks: only numbers and design fields may differ", value)
        else:
            yield Problem((key,), f"must be a constant or a design field of {plant.name}; {closest(key, names)}", value)
    for i in range(len(designs)):
        try:
            plant.edited({key: each[i] for key, each in constants.items()})
        except ValidationError as error:
            yield from (fault._replace(path=fault.path[-1:]) for fault in problems_of(error))
            return


def _number(value: Value, names: Mapping[str, float]) -> float:
    return arithmetic(value, names) if isinstance(value, str) else value


def _motion(task: TaskConfig, search: SearchConfig) -> Iterator[Problem]:
    if task.start == task.goal and search.objective != GOAL:
        yield Problem(("task", "goal"), f"must differ from task.start, unless search.objective = '{GOAL}'", task.goal)


def _design_names(plant: PlantConfig, design: dict[str, Variable]) -> Iterator[Problem]:
    for name in design:
        if name not in plant.design:
            yield Problem(
                ("design", name), f"unknown design field of {plant.name}; {closest(name, tuple(plant.design))}"
            )
    for name in plant.design:
        if name not in design:
            yield Problem(("design", name), f"is missing; {plant.name}'s design is {', '.join(plant.design)}")


def _units(plant: PlantConfig, design: dict[str, Variable], weights: WeightsConfig) -> Iterator[Problem]:
    for name, variable in design.items():
        known = plant.design.get(name)
        if known == "" and not variable.unit:
            yield Problem(("design", name, "unit"), "is missing: say kg, m, or - where it has none")
        elif known and variable.unit not in ("", known):
            yield Problem(("design", name, "unit"), f"must be {known} or left away", variable.unit)
    for letter, variables in weights:
        for i, variable in enumerate(variables):
            if variable.unit:
                yield Problem(("weights", letter, i, "unit"), "follows from the states and inputs", variable.unit)


def _positive_design(plant: PlantConfig, design: dict[str, Variable]) -> Iterator[Problem]:
    for name, variable in design.items():
        if isinstance(plant, PackagedPlant) and variable.min < SMALLEST_DESIGN:
            text = f"must be >= {SMALLEST_DESIGN:g}: masses and lengths are positive"
            yield Problem(("design", name, "min"), text, variable.min)


def _positive_weights(weights: WeightsConfig) -> Iterator[Problem]:
    for letter, variables in weights:
        for i, variable in enumerate(variables):
            if variable.min < SMALLEST_WEIGHT:
                text = f"must be >= {SMALLEST_WEIGHT:g}: weights have a log scale"
                yield Problem(("weights", letter, i, "min"), text, variable.min)


def _uncertain(plant: PlantConfig, uncertainty: UncertaintyConfig, funnel: FunnelConfig) -> Iterator[Problem]:
    for section, known in plant.uncertain.items():
        for name in getattr(uncertainty, section):
            if name not in known:
                path = "uncertainty", section, name
                yield Problem(path, f"must be a {section} parameter of {plant.name}; {closest(name, known)}")
    numbers = [name for name, width in (uncertainty.design | uncertainty.plant).items() if width]
    if uncertainty.center == "moving" and len(numbers) > MOST_CORNERS:
        text = f"follows all corners of the box: at most {MOST_CORNERS} numbers may be uncertain, {len(numbers)} are"
        yield Problem(("uncertainty", "center"), text, uncertainty.center)
    if uncertainty.noise:
        yield from _size(("uncertainty", "noise"), uncertainty.noise, plant.states)
    if not uncertainty.empty and funnel.rollouts != "closed_form":
        yield Problem(("funnel", "rollouts"), "must be closed_form where `uncertainty` is given", funnel.rollouts)


def _something_free(
    design: dict[str, Variable], weights: WeightsConfig, policy: PolicyConfig, search: SearchConfig
) -> Iterator[Problem]:
    designs = any(variable.free for variable in design.values())
    tunable = any(variable.free for variable in (*weights.q, *weights.r, *policy.variables().values()))
    if not designs and not tunable:
        yield Problem((), "nothing to search: every variable is pinned or has min = max")
    elif search.mode == "nested" and not (designs and tunable):
        text = "needs a free design variable and a free weight; use 'joint'"
        yield Problem(("search", "mode"), text, search.mode)


_ACROSS: tuple[Callable[..., Iterator[Problem]], ...] = (
    _sizes,
    _weight_sizes,
    _ends,
    _catch,
    _motion,
    _tasks,
    _design_names,
    _units,
    _positive_design,
    _positive_weights,
    _uncertain,
    _something_free,
)


def _across_sections(sections: Mapping[str, Any]) -> Iterator[Problem]:
    """Checks between sections; one runs as soon as all the sections that it names are there."""
    for check in _ACROSS:
        needed = inspect.signature(check).parameters
        if needed.keys() <= sections.keys():
            yield from check(**{name: sections[name] for name in needed})


def _valid_sections(data: Mapping[str, Any], failed: set[str | int]) -> dict[str, Any]:
    fields: dict[str, Any] = {
        name: (field.annotation, field) for name, field in Config.model_fields.items() if name not in failed
    }
    sections = create_model("Sections", **fields)
    return dict(sections.model_validate({name: data[name] for name in fields if name in data}))


def parse(data: Any, source: str = "configuration") -> Config:
    """The configuration that a mapping describes; `ConfigError` names everything that is wrong with it."""
    try:
        config = Config.model_validate(data)
        return next(iter(config.each.values())) if len(config.tasks) == 1 else config
    except ValidationError as error:
        problems = problems_of(error)
    if isinstance(data, Mapping):
        # pydantic checks between sections only if every section is valid: run those that can be run.
        failed = {problem.path[0] for problem in problems if problem.path}
        across = _across_sections(_valid_sections(data, failed))
        problems += [problem for problem in across if problem not in problems]
    raise ConfigError(problems, source)


def parse_yaml(text: str | bytes, source: str = "configuration") -> Config:
    """The configuration that a YAML text describes; `ConfigError` if it is no YAML or no valid configuration."""
    return parse(_plain_yaml(text, source), source)


def _plain_yaml(text: str | bytes, source: str) -> Any:
    try:
        return yaml12.read(text)
    except yaml12.NotYaml as error:
        raise ConfigError([Problem((), printable(error))], source) from None


def load(path: Path) -> Config:
    """The configuration in a YAML file; `ConfigError` names everything that is wrong with it."""
    data = read_yaml(path)
    if isinstance(data, Mapping) and "sweep" in data:
        problem = Problem(("sweep",), f"makes several runs of this file: they are started by `rtcd sweep {path}`")
        raise ConfigError([problem], str(path))
    return parse(data, str(path))


def _with_mjcf(data: Any, path: Path) -> Any:
    plant = data.get("plant") if isinstance(data, Mapping) else None
    if not isinstance(plant, Mapping) or not isinstance(plant.get("mjcf"), str) or "xml" in plant:
        return data
    try:
        return {**data, "plant": {**plant, "xml": mjcf.read_text(path.parent / plant["mjcf"])}}
    except mjcf.NotMjcf as error:
        raise ConfigError([Problem(("plant", "mjcf"), str(error), plant["mjcf"])], str(path)) from None


def parse_uncertainty(data: Any, source: str) -> UncertaintyConfig:
    """What is uncertain, of a mapping with the section's keys; `ConfigError` names everything that is wrong with it."""
    try:
        return UncertaintyConfig.model_validate(data)
    except ValidationError as error:
        raise ConfigError(problems_of(error), source) from None


def load_uncertainty(path: Path) -> UncertaintyConfig:
    """The `uncertainty` that a YAML file states; `ConfigError` as `load`."""
    return parse_uncertainty(read_uncertainty(path), str(path))


def read_uncertainty(path: Path) -> Any:
    """The `uncertainty` section of a YAML file, or a file of its keys alone, as it stands there.

    Raises:
        ConfigError: as `read_yaml`, or it is empty: what nobody stated is not taken as one exact model.
    """
    data = read_yaml(path)
    if isinstance(data, Mapping) and "uncertainty" in data:
        data = data["uncertainty"]
    if data is None:
        keys = ", ".join(UncertaintyConfig.model_fields)
        raise ConfigError([Problem((), f"states no uncertainty: must have some of {keys}")], str(path))
    return data


def read_yaml(path: Path) -> Any:
    """What a YAML file holds, with the text of the MJCF that its plant names, which lies beside it.

    Raises:
        ConfigError: there is no such file, no YAML in it, or no such MJCF.
    """
    if not path.is_file():
        folder, what = (path, "is a folder") if path.is_dir() else (path.parent, "no such file")
        there = sorted(str(other) for other in folder.glob("*.y*ml"))
        advice = closest(path, there) if there else f"{folder} has no YAML file"
        raise ConfigError([Problem((), f"{what}; {advice}")], str(path))
    with path.open("rb") as file:
        return _with_mjcf(_plain_yaml(file.read(yaml12.LARGEST_FILE + 1), str(path)), path)


def resolved(config: Config) -> dict[str, Any]:
    """Every key with its value, defaults included, as plain mappings, lists and numbers."""
    return json.loads(config.model_dump_json())


def dump(config: Config) -> str:
    """The resolved configuration as YAML; `parse_yaml` reads it back to an equal one."""
    return yaml.dump(resolved(config), Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120)


class _Dumper(yaml.SafeDumper):
    """Texts of several lines, as an MJCF's, stay lines where YAML allows it."""


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.Node:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style="|" if "\n" in text else None)


_Dumper.add_representer(str, _text)


def config_hash(config: Config) -> str:
    """Twelve hexadecimal digits of the SHA-256 of the canonical JSON: equal exactly for equal configurations."""
    stated = resolved(config)
    for *sections, key in LATER_KEYS:
        part, place = config, stated
        for section in sections:
            part, place = getattr(part, section), place[section]
        if getattr(part, key) == type(part).model_fields[key].default:
            del place[key]
    canonical = json.dumps(stated, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()[:12]


def differences(old: Config, new: Config) -> dict[str, tuple[Any, Any]]:
    """The dotted keys in which two configurations differ, with both values; None where a key is not there."""
    before, after = _flat(resolved(old)), _flat(resolved(new))
    keys = dict.fromkeys([*before, *after])
    return {key: (before.get(key), after.get(key)) for key in keys if before.get(key) != after.get(key)}


def _flat(tree: Any, path: str = "") -> dict[str, Any]:
    if isinstance(tree, dict):
        branches = tree.items()
    elif isinstance(tree, list):
        branches = enumerate(tree)
    else:
        return {path: tree}
    prefix = f"{path}." if path else ""
    return {key: leaf for name, branch in branches for key, leaf in _flat(branch, f"{prefix}{name}").items()}
