"""The experiment: one YAML as frozen models, every key with its unit, its range and its default. Knows no JAX.

`load` reads a file, `parse` a mapping; both raise `ConfigError` with everything that is wrong at once.
"the paper" is Girlanda et al., ICRA 2024 (arXiv 2403.10966).
"""

import hashlib
import inspect
import json
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import yaml
from pydantic import (
    Field,
    PlainValidator,
    SerializeAsAny,
    ValidationError,
    ValidationInfo,
    create_model,
    field_validator,
)

from rtcd_jax.errors import ConfigError, Problem, closest
from rtcd_jax.settings import Settings, invalid, problems_of

EXAMPLE = """\
plant: {name: pendulum}
task: {start: [0, 0], goal: [3.141592653589793, 0], state_limits: [6.283185307179586, 7]}
design: {mass: {initial: 0.7, min: 0.6, max: 0.8}, length: {initial: 0.4, min: 0.4, max: 0.6}}
weights:
  q: [{initial: 10, min: 1, max: 10}, {initial: 1, min: 1, max: 10}]
  r: [{initial: 0.1, min: 0.001, max: 10}]
"""
"""The shortest complete YAML: the paper's pendulum with the default settings."""


UNIT = "its unit"
"""Stands in a description for the unit that the plant gives."""


class PlantConfig(Settings):
    """A robot's physical constants. The class variables name its states, inputs and design fields, with units."""

    states: ClassVar[dict[str, str]]
    inputs: ClassVar[dict[str, str]]
    design: ClassVar[dict[str, str]]

    name: str


class PendulumConfig(PlantConfig):
    states: ClassVar = {"theta": "rad", "theta_dot": "rad/s"}
    inputs: ClassVar = {"torque": "N m"}
    design: ClassVar = {"mass": "kg", "length": "m"}

    name: Literal["pendulum"] = Field(default="pendulum", description="torque-limited pendulum (paper, section III)")
    damping: float = Field(default=0.1, ge=0, description="viscous friction at the pivot [N m s/rad]")
    gravity: float = Field(default=9.81, gt=0, description="gravitational acceleration [m/s^2]")
    torque_limit: float = Field(default=2.5, gt=0, description="largest |torque| of the motor [N m]")


class CartpoleConfig(PlantConfig):
    states: ClassVar = {"cart": "m", "theta": "rad", "cart_dot": "m/s", "theta_dot": "rad/s"}
    inputs: ClassVar = {"force": "N"}
    design: ClassVar = {"pole_length": "m", "pole_mass": "kg"}

    name: Literal["cartpole"] = Field(default="cartpole", description="force-limited cart-pole (paper, section III)")
    cart_mass: float = Field(default=1.0731266, gt=0, description="mass of the cart, its motor's inertia included [kg]")
    cart_damping: float = Field(default=5.4, ge=0, description="viscous friction of the cart [N s/m]")
    pivot_damping: float = Field(default=0.0024, ge=0, description="viscous friction at the pivot [N m s/rad]")
    gravity: float = Field(default=9.81, gt=0, description="gravitational acceleration [m/s^2]")
    force_limit: float = Field(default=6.0, gt=0, description="largest |force| on the cart [N]")
    inertia: Literal["rod", "measured"] = Field(
        default="rod", description="of the pole about its center of mass: a uniform rod's, or the measured constant"
    )


PLANTS: dict[str, type[PlantConfig]] = {"pendulum": PendulumConfig, "cartpole": CartpoleConfig}


def _read_plant(data: Any) -> PlantConfig:
    if isinstance(data, PlantConfig):
        return data
    if not isinstance(data, Mapping) or "name" not in data:
        raise invalid([Problem((), f"must be a mapping with a `name`; valid: {', '.join(PLANTS)}", data)])
    name = data["name"]
    if not isinstance(name, str) or name not in PLANTS:
        raise invalid([Problem(("name",), f"unknown plant; {closest(name, tuple(PLANTS))}", name)])
    return PLANTS[name].model_validate(data)


class Variable(Settings):
    """One searched number and its box."""

    initial: float = Field(description=f"value of the initial candidate [{UNIT}]")
    min: float = Field(description=f"lower end of the box [{UNIT}]")
    max: float = Field(description=f"upper end of the box [{UNIT}]")
    pinned: bool = Field(default=False, description="hold the initial value instead of searching")

    @property
    def free(self) -> bool:
        """True if the search may move it."""
        return not self.pinned and self.min < self.max

    def problems(self) -> Iterator[Problem]:
        if self.min > self.max:
            yield Problem(("min",), f"must be <= max = {self.max:g}", self.min)
        elif not self.min <= self.initial <= self.max:
            yield Problem(("initial",), f"must lie in [min, max] = [{self.min:g}, {self.max:g}]", self.initial)


# Strictness is for the numbers: YAML's lists become tuples.
Numbers = Annotated[tuple[float, ...], Field(strict=False)]
Limits = Annotated[tuple[Annotated[float, Field(gt=0, allow_inf_nan=True)], ...], Field(strict=False)]
Variables = Annotated[tuple[Variable, ...], Field(strict=False)]


class TaskConfig(Settings):
    start: Numbers = Field(description=f"first state of the nominal motion, pinned [{UNIT}]")
    goal: Numbers = Field(description=f"last state of the nominal motion, pinned, an equilibrium [{UNIT}]")
    state_limits: Limits = Field(
        description=f"largest |x_i|, .inf for none, not all; leaving them is a failure [{UNIT}]"
    )

    def problems(self) -> Iterator[Problem]:
        limits = self.state_limits
        if limits and all(limit == float("inf") for limit in limits):
            yield Problem(("state_limits",), "one must be finite: funnels are looked for inside them", limits)


class WeightsConfig(Settings):
    """Diagonals of the running cost's Q and R, searched on a log scale."""

    q: Variables = Field(description="diagonal of Q, one variable for each state [1/(s state's unit^2)]")
    r: Variables = Field(description="diagonal of R, one variable for each input [1/(s input's unit^2)]")


class StepConfig(Settings):
    min: float = Field(default=0.01, gt=0, description="shortest interval [s] (paper, section III)")
    max: float = Field(default=0.1, gt=0, description="longest interval [s] (paper, section III)")

    def problems(self) -> Iterator[Problem]:
        if self.min >= self.max:
            yield Problem(("min",), f"must be < max = {self.max:g}", self.min)


class TrajectoryConfig(Settings):
    knots: int = Field(default=51, ge=3, description="knots N+1 of the nominal motion [-] (paper, section III)")
    step: StepConfig = Field(default=StepConfig(), description="box of the one free step that all intervals share [s]")
    time_weight: float = Field(default=0.1, ge=0, description="w_t, the cost of duration [1/s] (paper, section III)")
    substeps: int = Field(
        default=5, ge=1, description="RK4 steps of dynamics and Riccati equation inside an interval [-]"
    )
    limit_share: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="share of the state limits for the nominal motion; the rest is the funnel's [-]",
    )
    max_iterations: int = Field(default=200, ge=1, description="iterations of the trajectory optimizer [-]")
    starts: int = Field(
        default=1, ge=1, le=2, description="starts to solve, the cheapest is kept; others replace those that fail [-]"
    )


def _searchable(must: str, holds: Callable[[float], bool]) -> PlainValidator:
    """Of a number that stays, or of a variable that the search moves."""

    def read(data: Any) -> float | Variable:
        if isinstance(data, Mapping | Variable):
            variable = Variable.model_validate(data)
            ends = ((end, getattr(variable, end)) for end in ("min", "max"))
            wrong = [Problem((end,), f"must be {must}", value) for end, value in ends if not holds(value)]
            if wrong:
                raise invalid(wrong)
            return variable
        if isinstance(data, bool) or not isinstance(data, int | float):
            keys = ", ".join(Variable.model_fields)
            raise invalid([Problem((), f"must be a number, or a mapping with the keys {keys}", data)])
        if not holds(data):
            raise invalid([Problem((), f"must be {must}", data)])
        return float(data)

    return PlainValidator(read)


Searchable = SerializeAsAny[float | Variable]
Authority = Annotated[Searchable, _searchable("> 0 and <= 1", lambda a: 0 < a <= 1)]
Discount = Annotated[Searchable, _searchable(">= 0 and finite", lambda a: 0 <= a < float("inf"))]


class PolicyConfig(Settings):
    """What the tracking controller's Riccati equation changes of Q and R; the defaults are the paper's TVLQR.

    `authority` and `discount` are numbers, or variables with their boxes: then the search chooses them, `authority` on
    a log scale.
    """

    input_weight: float = Field(default=1.0, gt=0, description="R of the controller over that of the trajectory [-]")
    authority: Authority = Field(
        default=1.0,
        description="R grows to R / max(1 - |u*| / u_max, authority)^2 where u* leaves little of the input [-] "
        "(> 0 and <= 1)",
    )
    discount: Discount = Field(default=0.0, description="alpha: V falls as if A were A + alpha I [1/s] (>= 0)")

    def variables(self) -> dict[str, Variable]:
        """Those of the options that are variables."""
        return {name: option for name, option in self if isinstance(option, Variable)}

    def initial(self) -> dict[str, float]:
        """The options' numbers, a variable's initial one."""
        return {name: option.initial if isinstance(option, Variable) else option for name, option in self}


class GoalConfig(Settings):
    """The region of attraction of the goal's LQR, from which the last level follows."""

    directions: int = Field(default=24, ge=1, description="quasi-random directions about the goal, in each round [-]")
    radii: int = Field(default=6, ge=3, description="radii along each direction, in each round [-]")
    rounds: int = Field(default=4, ge=1, description="rounds, each between two neighboring radii of the one before [-]")
    horizon: float = Field(default=2.0, gt=0, description="time over which a rollout must come closer to the goal [s]")
    step: float = Field(default=0.02, gt=0, description="RK4 step of these rollouts [s]")

    def problems(self) -> Iterator[Problem]:
        if self.step >= self.horizon:
            yield Problem(("step",), f"must be < horizon = {self.horizon:g}", self.step)


class FunnelConfig(Settings):
    rollouts: Literal["closed_form", "mjx", "mixed"] = Field(default="mixed", description="dynamics of the rollouts")
    mjx_share: float = Field(default=0.01, ge=0, le=1, description="share of the fresh samples on MJX when mixed [-]")
    directions: int = Field(default=12, ge=1, description="quasi-random directions at each knot [-]")
    climbers: int = Field(default=4, ge=2, description="directions led to the worst one, from knot to knot [-]")
    climbs: int = Field(default=3, ge=0, description="steps towards it, at each knot [-]")
    steps: int = Field(default=5, ge=1, description="RK4 steps of a rollout inside an interval [-]")
    trials: int = Field(default=32, ge=1, description="fresh uniform states of each ellipsoid, at each knot [-]")
    confidence: float = Field(default=0.99, gt=0, lt=1, description="1 - beta, jointly over the knots [-]")
    goal: GoalConfig = Field(default=GoalConfig(), description="region of attraction of the goal's LQR")

    def problems(self) -> Iterator[Problem]:
        if self.rollouts == "mixed" and self.mjx_share == 0:
            yield Problem(
                ("mjx_share",), "must be > 0 when rollouts = 'mixed', or choose 'closed_form'", self.mjx_share
            )


class NestedConfig(Settings):
    """The paper's two loops: an outer search over designs, each with an inner search over weights."""

    designs: int = Field(default=8, ge=4, description="outer population; the inner one is population / designs [-]")
    generations: int = Field(default=10, ge=1, description="inner generations for each design [-]")


SMALLEST_POPULATION = 4
"""CMA-ES needs two parents, the better half of its population."""


class SearchConfig(Settings):
    objective: Literal["sum", "integral", "inlet", "geometric_mean"] = Field(
        default="sum", description="volume to maximize"
    )
    mode: Literal["joint", "nested"] = Field(
        default="joint", description="one search over all, or weights inside designs"
    )
    population: int = Field(default=128, ge=SMALLEST_POPULATION, description="candidates in a generation [-]")
    generations: int = Field(
        default=60, ge=1, description="generations; each evaluates the whole population, also when nested [-]"
    )
    sigma: float = Field(default=0.3, gt=0, le=1, description="initial step size in the unit box [-]")
    seed: int = Field(default=0, ge=0, lt=2**32, description="of all random numbers [-]")
    chunk: int = Field(
        default=64, ge=1, description="candidates that a device evaluates at once, which bounds its memory [-]"
    )
    nested: NestedConfig = Field(
        default=NestedConfig(), description="budget of the two loops, used in mode nested alone"
    )

    def problems(self) -> Iterator[Problem]:
        if self.mode != "nested":
            return
        designs = self.nested.designs
        if self.population % designs:
            yield Problem(("population",), f"must be a multiple of nested.designs = {designs}", self.population)
        elif self.population // designs < SMALLEST_POPULATION:
            smallest = SMALLEST_POPULATION * designs
            yield Problem(("population",), f"must be >= {smallest} for nested.designs = {designs}", self.population)


class ElitesConfig(Settings):
    count: int = Field(default=8, ge=1, description="candidates kept and evaluated again [-]")
    distance: float = Field(
        default=0.02, ge=0, lt=1, description="smallest distance between two of them in the unit box [-]"
    )
    trials: int = Field(default=2000, ge=1, description="fresh states at each knot of their evaluation [-]")
    directions: int = Field(default=192, ge=1, description="fresh directions at each knot of their evaluation [-]")


class CheckpointConfig(Settings):
    seconds: float = Field(default=20.0, ge=0, description="least time between two saves [s]")


class Config(Settings):
    """Everything that defines a run."""

    plant: Annotated[SerializeAsAny[PlantConfig], PlainValidator(_read_plant)] = Field(description="the robot")
    task: TaskConfig = Field(description="from where to where, and within what")
    design: dict[str, Variable] = Field(description="the plant's design fields by name")
    weights: WeightsConfig = Field(description="cost weights, searched on a log scale")
    trajectory: TrajectoryConfig = Field(default=TrajectoryConfig(), description="the nominal motion")
    policy: PolicyConfig = Field(default=PolicyConfig(), description="the controller that tracks it")
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

    def problems(self) -> Iterator[Problem]:
        return _across_sections(dict(self))

    def variables(self) -> dict[str, Variable]:
        """Every variable by its dotted key: the design in the plant's order, then q, r, and the policy's."""
        found = {f"design.{name}": variable for name, variable in self.design.items()}
        for letter, variables in self.weights:
            found |= {f"weights.{letter}.{i}": variable for i, variable in enumerate(variables)}
        return found | {f"policy.{name}": variable for name, variable in self.policy.variables().items()}


def _sizes(plant: PlantConfig, task: TaskConfig) -> Iterator[Problem]:
    for key, value in task:
        yield from _size(("task", key), value, plant.states)


def _weight_sizes(plant: PlantConfig, weights: WeightsConfig) -> Iterator[Problem]:
    yield from _size(("weights", "q"), weights.q, plant.states)
    yield from _size(("weights", "r"), weights.r, plant.inputs)


def _size(path: tuple[str, ...], values: tuple, names: Collection[str]) -> Iterator[Problem]:
    if len(values) != len(names):
        plural = "entry" if len(names) == 1 else "entries"
        yield Problem(path, f"must have {len(names)} {plural} ({', '.join(names)}), has {len(values)}")


def _ends(task: TaskConfig) -> Iterator[Problem]:
    for key in ("start", "goal"):
        for i, (value, limit) in enumerate(zip(getattr(task, key), task.state_limits, strict=False)):
            if abs(value) > limit:
                yield Problem(("task", key, i), f"must lie in [-{limit:g}, {limit:g}] (task.state_limits)", value)
    if task.start == task.goal:
        yield Problem(("task", "goal"), "must differ from task.start", task.goal)


def _design_names(plant: PlantConfig, design: dict[str, Variable]) -> Iterator[Problem]:
    for name in design:
        if name not in plant.design:
            yield Problem(
                ("design", name), f"unknown design field of {plant.name}; {closest(name, tuple(plant.design))}"
            )
    for name in plant.design:
        if name not in design:
            yield Problem(("design", name), f"is missing; {plant.name}'s design is {', '.join(plant.design)}")


def _positive_design(design: dict[str, Variable]) -> Iterator[Problem]:
    for name, variable in design.items():
        if variable.min <= 0:
            yield Problem(("design", name, "min"), "must be > 0: masses and lengths are positive", variable.min)


def _positive_weights(weights: WeightsConfig) -> Iterator[Problem]:
    for letter, variables in weights:
        for i, variable in enumerate(variables):
            if variable.min <= 0:
                yield Problem(("weights", letter, i, "min"), "must be > 0: weights have a log scale", variable.min)


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
    _design_names,
    _positive_design,
    _positive_weights,
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
        return Config.model_validate(data)
    except ValidationError as error:
        problems = problems_of(error)
    if isinstance(data, Mapping):
        # pydantic checks between sections only if every section is valid: run those that can be run.
        failed = {problem.path[0] for problem in problems if problem.path}
        found = _across_sections(_valid_sections(data, failed))
        problems += [problem for problem in found if problem not in problems]
    raise ConfigError(problems, source)


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, but 1e-3 is a number, as in YAML 1.2, and a key given twice is an error."""

    def construct_mapping(self, node, deep=False):
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.MarkedYAMLError(problem=f"the key {key.value!r} is given twice", problem_mark=key.start_mark)
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


_EXPONENT_WITHOUT_DOT = re.compile(r"[-+]?\d+[eE][-+]?\d+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _EXPONENT_WITHOUT_DOT, list("-+0123456789"))


def parse_yaml(text: str | bytes, source: str = "configuration") -> Config:
    """The configuration that a YAML text describes; `ConfigError` if it is no YAML or no valid configuration."""
    return parse(_plain_yaml(text, source), source)


def _plain_yaml(text: str | bytes, source: str) -> Any:
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        raise ConfigError([Problem((), f"no valid YAML: {place}{error.problem}")], source) from None
    except yaml.YAMLError as error:
        raise ConfigError([Problem((), f"no valid YAML: {error}")], source) from None


def load(path: Path) -> Config:
    """The configuration in a YAML file; `ConfigError` names everything that is wrong with it."""
    data = read_yaml(path)
    if isinstance(data, Mapping) and "sweep" in data:
        problem = Problem(("sweep",), f"makes several runs of this file: they are started by `rtcd sweep {path}`")
        raise ConfigError([problem], str(path))
    return parse(data, str(path))


def read_yaml(path: Path) -> Any:
    """What a YAML file holds, as it stands there; `ConfigError` if there is no such file, or no YAML in it."""
    if not path.is_file():
        folder, what = (path, "is a folder") if path.is_dir() else (path.parent, "no such file")
        there = sorted(str(other) for other in folder.glob("*.y*ml"))
        advice = closest(path, there) if there else f"{folder} has no YAML file"
        raise ConfigError([Problem((), f"{what}; {advice}")], str(path))
    return _plain_yaml(path.read_bytes(), str(path))


def resolved(config: Config) -> dict[str, Any]:
    """Every key with its value, defaults included, as plain mappings, lists and numbers."""
    return json.loads(config.model_dump_json())


def dump(config: Config) -> str:
    """The resolved configuration as YAML; `parse_yaml` reads it back to an equal one."""
    return yaml.safe_dump(resolved(config), sort_keys=False, default_flow_style=None, width=120)


def config_hash(config: Config) -> str:
    """Twelve hexadecimal digits of the SHA-256 of the canonical JSON: equal exactly for equal configurations."""
    canonical = json.dumps(resolved(config), sort_keys=True, separators=(",", ":"))
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
