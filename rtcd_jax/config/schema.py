"""The sections of an experiment's configuration as frozen models, every key with its unit, range and default.

"the paper" is Girlanda et al., ICRA 2024 (arXiv 2403.10966).
"""

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

from pydantic import (
    BeforeValidator,
    Field,
    GetCoreSchemaHandler,
    PlainSerializer,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
    model_serializer,
)
from pydantic_core.core_schema import CoreSchema, no_info_plain_validator_function

from rtcd_jax.config.arithmetic import arithmetic, names_of
from rtcd_jax.config.plants import Number as Arithmetic
from rtcd_jax.config.plants import PlantConfig
from rtcd_jax.config.settings import Settings, invalid, refusal
from rtcd_jax.system.errors import Problem, closest
from rtcd_jax.volume import OBJECTIVES, OTHERS, OVER_TASKS, VOLUMES

UNIT = "its unit"
"""Stands in a description for the unit that the plant gives."""


def _number(value: Any) -> Any:
    """A text as the number that it writes in arithmetic; all else, a quoted number too, as it is."""
    if not isinstance(value, str):
        return value
    with contextlib.suppress(ValueError):
        float(value)
        return value
    try:
        return arithmetic(value, {})
    except ValueError as error:
        raise refusal(str(error)) from None


def _of_names(value: Any, number: ValidatorFunctionWrapHandler) -> Any:
    """Arithmetic of names as it stands, all else by `number`."""
    with contextlib.suppress(ValueError):
        if isinstance(value, str) and names_of(value):
            return value
    return number(value)


def _as_it_is(value: Any) -> Any:
    return value


ARITHMETIC = BeforeValidator(_number)
"""Of the numbers of a task and of boxes: they may be written as arithmetic with pi."""
Number = Annotated[float, ARITHMETIC]


class Variable(Settings):
    """One searched number and its box."""

    initial: Number = Field(ge=-1e9, le=1e9, description=f"value of the initial candidate [{UNIT}]")
    min: Number = Field(ge=-1e9, le=1e9, description=f"lower end of the box [{UNIT}]")
    max: Number = Field(ge=-1e9, le=1e9, description=f"upper end of the box [{UNIT}]")
    pinned: bool = Field(default=False, description="hold the initial value instead of searching")
    unit: str = Field(default="", description="of a design variable of a robot of one's own: its unit [-]")

    @model_serializer(mode="wrap")
    def _without_empty_unit(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if key != "unit" or value}

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
Numbers = Annotated[tuple[Annotated[float, Field(ge=-1e6, le=1e6), ARITHMETIC], ...], Field(strict=False)]
Ends = Annotated[
    tuple[
        Annotated[float, Field(ge=-1e6, le=1e6), ARITHMETIC, WrapValidator(_of_names), PlainSerializer(_as_it_is)], ...
    ],
    Field(strict=False),
]
"""A state whose numbers may be arithmetic of the design, and are then kept as text."""
Limits = Annotated[tuple[Annotated[float, Field(ge=1e-6, allow_inf_nan=True), ARITHMETIC], ...], Field(strict=False)]
Widths = Annotated[tuple[Annotated[float, Field(ge=1e-6, le=1e6), ARITHMETIC], ...], Field(strict=False)]
LARGEST_LIMIT = 1e6
LARGEST_OFFSET = 1e9
Variables = Annotated[tuple[Variable, ...], Field(strict=False)]


class KeepOutConfig(Settings):
    """A set of states to keep out of: a half space by `normal` and `offset`, or an ellipsoid by the other two."""

    normal: Numbers = Field(
        default=(), description="half space: a vector; normal . x > offset is kept out [1/state's unit]"
    )
    offset: float | None = Field(default=None, description="half space: see normal [-]")
    center: Numbers = Field(default=(), description=f"ellipsoid: its center [{UNIT}]")
    semi_axes: Limits = Field(
        default=(), description=f"ellipsoid: half its width in every state, .inf where it has no end [{UNIT}]"
    )

    @field_validator("offset", mode="plain")
    @classmethod
    def _finite(cls, offset: Any) -> float | None:
        if offset is None:  # that of an ellipsoid, among the options of a command
            return None
        offset = _number(offset)
        if isinstance(offset, bool) or not isinstance(offset, int | float) or not abs(offset) <= LARGEST_OFFSET:
            raise refusal(f"must be >= {-LARGEST_OFFSET:g} and <= {LARGEST_OFFSET:g}")
        return float(offset)

    @model_serializer(mode="wrap")
    def _of_its_kind(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value not in ((), [], None)}

    def problems(self) -> Iterator[Problem]:
        kinds = {("normal", "offset"), ("center", "semi_axes")}
        given = tuple(key for key, value in self if value not in ((), None))
        if given not in kinds:
            text = "must have the keys normal and offset of a half space, or center and semi_axes of an ellipsoid"
            yield Problem((), f"{text}; has {', '.join(given) or 'none'}")
            return
        if self.normal and not any(self.normal):
            yield Problem(("normal",), "must not be zero", self.normal)
        for i, axis in enumerate(self.semi_axes):
            if LARGEST_LIMIT < axis < inf:
                yield Problem(("semi_axes", i), f"must be <= {LARGEST_LIMIT:g}, or .inf for no end", axis)
        if self.semi_axes and inf == min(self.semi_axes):
            yield Problem(("semi_axes",), "must have an entry that is not .inf: nothing would be left", self.semi_axes)

    def in_words(self, states: Iterable[str]) -> str:
        """The set as an inequality in the states."""
        if self.normal:
            terms = [f"{a:+g} {name}" for a, name in zip(self.normal, states, strict=True) if a]
            return f"{' '.join(terms)} > {self.offset:g}"
        parts = zip(states, self.center, self.semi_axes, strict=True)
        terms = [f"(({name} - {center:g}) / {axis:g})^2" for name, center, axis in parts if axis < inf]
        return f"{' + '.join(terms)} < 1"

    def depth(self, x: tuple[float, ...], share: float) -> float:
        """Positive inside, negative outside; of the ellipsoid grown by 1 / share."""
        if self.normal:
            return sum(a * b for a, b in zip(self.normal, x, strict=True)) - cast(float, self.offset)
        parts = zip(x, self.center, self.semi_axes, strict=True)
        return 1 - sum(((a - c) / axis) ** 2 for a, c, axis in parts) * share**2


class CatchConfig(Settings):
    """The set {x : (x - goal)' C (x - goal) <= 1}, C the diagonal of 1 / half width^2, or that of a reset."""

    half_widths: Widths = Field(
        default=(),
        description="of an ellipsoid about the goal in which the motion ends, that of all tasks; empty: the goal is an "
        f"equilibrium that is held [{UNIT}]",
    )
    reset: Literal["none", "brachiation"] = Field(
        default="none",
        description="instead of half widths: the tasks are a cycle, each ends where this reset leads into the next "
        "one's funnel; brachiation: the free hook takes the next bar, the other one lets go",
    )
    window: dict[Literal["gripper"], Annotated[float, Field(ge=1e-6, le=1e6)]] = Field(
        default={},
        description="how far the gripper, the free hook of a robot that brachiates, may be from its place at the goal: "
        "with `reset` in the last ellipsoids, else, with `speed`, the catch set itself, instead of half widths [m]",
    )
    speed: float = Field(
        default=0.0,
        ge=0,
        le=1e6,
        description=f"half width of all velocities in the catch set of a `window` without `reset`; 0: none [{UNIT}]",
    )

    @model_serializer(mode="wrap")
    def _of_its_kind(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value and value != "none"}

    @property
    def cyclic(self) -> bool:
        """Whether each task ends where the next one begins."""
        return self.reset != "none"

    def problems(self) -> Iterator[Problem]:
        if self.half_widths and self.cyclic:
            yield Problem(("reset",), "must be left away where there are half_widths: the one or the other", self.reset)
        if self.half_widths and self.window:
            yield Problem(("window",), "must be left away where there are half_widths", self.window)
        if self.window and not self.cyclic and not self.speed:
            yield Problem(("speed",), "must be > 0: a window without reset is the catch set with it", self.speed)
        if self.speed and (self.cyclic or not self.window):
            yield Problem(("speed",), "must be left away: it belongs to a window without reset", self.speed)

    def in_words(self, states: Mapping[str, str]) -> str:
        """The half widths of states that are given with their units, or what the reset does."""
        points = [f"{name} within {size:.6g} m of its place" for name, size in self.window.items()]
        if self.cyclic:
            return "; ".join([f"what the reset ({self.reset}) leads into the next task's first ellipsoid", *points])
        if self.window:
            return ", ".join([*points, f"velocities ± {self.speed:.6g}"])
        widths = zip(states.items(), self.half_widths, strict=True)
        return ", ".join(f"{name} ± {width:.6g} {unit}" for (name, unit), width in widths)


class TaskConfig(Settings):
    start: Ends = Field(
        description=f"first state of the nominal motion, pinned; may be arithmetic of the design [{UNIT}]"
    )
    goal: Ends = Field(
        description="last state of the nominal motion, pinned, an equilibrium unless there is a `catch`, with which it "
        f"may be arithmetic of the design [{UNIT}]"
    )
    state_limits: Limits = Field(
        description=f"largest |x_i|, at most 1e6, or .inf for none; leaving them is a failure [{UNIT}]"
    )
    keep_out: Annotated[tuple[KeepOutConfig, ...], Field(strict=False)] = Field(
        default=(), description="sets of states to keep out of, of all tasks; entering one is a failure"
    )
    catch: CatchConfig = Field(
        default=CatchConfig(), description="a set about the goal in which the motion ends, of all tasks"
    )
    cost_center: Numbers = Field(
        default=(), description=f"state from which the trajectory's cost counts, of all tasks; empty: the goal [{UNIT}]"
    )

    @model_serializer(mode="wrap")
    def _without_what_is_empty(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        empty = {"keep_out": not self.keep_out, "catch": not self.caught, "cost_center": not self.cost_center}
        return {key: value for key, value in handler(self).items() if not empty.get(key)}

    @property
    def caught(self) -> bool:
        """Whether the motion ends in a catch set, and no time follows."""
        return bool(self.catch.half_widths or self.catch.cyclic or self.catch.window)

    def problems(self) -> Iterator[Problem]:
        for i, limit in enumerate(self.state_limits):
            if LARGEST_LIMIT < limit < inf:
                yield Problem(("state_limits", i), f"must be <= {LARGEST_LIMIT:g}, or .inf for none", limit)


class TaskChanges(Settings):
    """One of several tasks: what it has of its own; all else is as `task` says."""

    start: Ends = Field(default=(), description=f"its first state; empty: that of `task` [{UNIT}]")
    goal: Ends = Field(default=(), description=f"its last state, as that of `task`; empty: the same [{UNIT}]")
    plant: dict[str, Arithmetic] = Field(
        default={},
        description="constants and design fields that differ in it: numbers, or arithmetic [their units]",
    )

    @model_serializer(mode="wrap")
    def _own(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value}


class WeightsConfig(Settings):
    """Diagonals of the running cost's Q and R, searched on a log scale."""

    q: Variables = Field(description="diagonal of Q, one variable for each state [1/(s state's unit^2)]")
    r: Variables = Field(description="diagonal of R, one variable for each input [1/(s input's unit^2)]")


class StepConfig(Settings):
    min: float = Field(default=0.01, ge=1e-6, le=1e3, description="shortest interval [s] (paper, section III)")
    max: float = Field(default=0.1, ge=1e-6, le=1e3, description="longest interval [s] (paper, section III)")

    def problems(self) -> Iterator[Problem]:
        if self.min > self.max:
            yield Problem(("min",), f"must be <= max = {self.max:g}; equal ones fix the duration", self.min)


class TrajectoryConfig(Settings):
    knots: int = Field(
        default=51, ge=3, le=10_000, description="knots N+1 of the nominal motion [-] (paper, section III)"
    )
    step: StepConfig = Field(
        default=StepConfig(),
        description="box of the one step that all intervals share; a box without width fixes it [s]",
    )
    time_weight: float = Field(
        default=0.1, ge=0, le=1e6, description="w_t, the cost of duration [1/s] (paper, section III)"
    )
    substeps: int = Field(
        default=5, ge=1, le=1000, description="RK4 steps of dynamics and Riccati equation inside an interval [-]"
    )
    limit_share: float = Field(
        default=1.0,
        ge=0.01,
        le=1,
        description="share of the state limits and of the room to sets to keep out of for the nominal motion; the rest "
        "is the funnel's [-]",
    )
    input_share: float = Field(
        default=1.0,
        ge=0.01,
        le=1,
        description="share of the input limits for the nominal motion; the rest is the tracking controller's [-]",
    )
    max_iterations: int = Field(default=200, ge=1, le=100_000, description="iterations of the trajectory optimizer [-]")
    starts: int = Field(
        default=1, ge=1, le=2, description="starts to solve, the cheapest is kept; where all fail, others follow [-]"
    )


@dataclass(frozen=True)
class Option:
    """A number of the policy that stays or, as a variable, is searched: its range, and whether on a log scale."""

    ge: float
    le: float
    logarithmic: bool = False

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return no_info_plain_validator_function(
            self._read, serialization=cast(Any, handler(source).get("serialization"))
        )

    def _read(self, data: Any) -> float | Variable:
        if isinstance(data, Mapping | Variable):
            data = Variable.model_validate(data)
            numbers = {(end,): getattr(data, end) for end in ("min", "max")}
        elif isinstance(data, bool) or not isinstance(data, int | float):
            keys = ", ".join(Variable.model_fields)
            raise invalid([Problem((), f"must be a number, or a mapping with the keys {keys}", data)])
        else:
            numbers = {(): data}
        text = f"must be >= {self.ge:g} and <= {self.le:g}"
        wrong = [Problem(path, text, value) for path, value in numbers.items() if not self.ge <= value <= self.le]
        if wrong:
            raise invalid(wrong)
        return data if isinstance(data, Variable) else float(data)


Searchable = SerializeAsAny[float | Variable]


class PolicyConfig(Settings):
    """What the tracking controller's Riccati equation changes of Q and R; the defaults are the paper's TVLQR.

    The options are numbers, or variables with their boxes: then the search chooses them.
    """

    input_weight: Annotated[Searchable, Option(1e-9, 1e9, logarithmic=True)] = Field(
        default=1.0, description="R of the controller over that of the trajectory [-]"
    )
    authority: Annotated[Searchable, Option(1e-6, 1, logarithmic=True)] = Field(
        default=1.0,
        description="R grows to R / max(1 - |u*| / u_max, authority)^2 where u* leaves little of the input [-]",
    )
    discount: Annotated[Searchable, Option(0, 1000)] = Field(
        default=0.0, description="alpha: V falls as if A were A + alpha I [1/s]"
    )
    catch_weight: Annotated[Searchable, Option(1e-9, 1e9, logarithmic=True)] = Field(
        default=1.0, description="V on the boundary of the catch set, what a miss costs; with `task.catch` only [-]"
    )

    @model_serializer(mode="wrap")
    def _without_usual_weight(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if key != "catch_weight" or self.weighs_catch}

    @property
    def weighs_catch(self) -> bool:
        """Whether there is another `catch_weight` than by default."""
        return self.catch_weight != type(self).model_fields["catch_weight"].default

    def variables(self) -> dict[str, Variable]:
        """Those of the options that are variables."""
        return {name: option for name, option in self if isinstance(option, Variable)}

    def logarithmic(self, name: str) -> bool:
        """Whether this option is searched on a log scale."""
        return any(getattr(item, "logarithmic", False) for item in type(self).model_fields[name].metadata)

    def initial(self) -> dict[str, float]:
        """The options' numbers, a variable's initial one; a `catch_weight` only where it is not that by default."""
        numbers = {name: option.initial if isinstance(option, Variable) else option for name, option in self}
        return {name: number for name, number in numbers.items() if name != "catch_weight" or self.weighs_catch}


Share = Annotated[float, Field(ge=0, lt=1)]


class UncertaintyConfig(Settings):
    """What every funnel of the run must bear, as half widths; all zero: one exact model."""

    design: dict[str, Share] = Field(default={}, description="relative half widths of design fields, by name [-]")
    plant: dict[str, Share] = Field(
        default={}, description="relative half widths of the robot's constants, by name [-]"
    )
    input_limit: Share = Field(default=0.0, description="relative half width of the motors' limits [-]")
    input: float = Field(
        default=0.0,
        ge=0,
        le=1e9,
        description="|w(t)| of a disturbance on the motors' axes, any function of time [input's unit]",
    )
    noise: Annotated[tuple[Annotated[float, Field(ge=0, le=1e9)], ...], Field(strict=False)] = Field(
        default=(), description="largest errors of the measured states; empty: none [states' units]"
    )
    age: float = Field(
        default=0.0, ge=0, le=10, description="age of the oldest measurement that acts: hold and delay [s]"
    )
    residual: Annotated[float, Field(gt=0, lt=1)] = Field(
        default=0.5, description="share of the goal's region, in radius, below which a motion may stay [-]"
    )

    center: Literal["common", "moving"] = Field(
        default="common",
        description="common: the numbers of `design` and `plant` may vary in time, all robots have one funnel; moving: "
        "they are constant, and every robot's funnel is about its own motion",
    )

    @property
    def empty(self) -> bool:
        """Whether nothing is uncertain."""
        widths = (*self.design.values(), *self.plant.values(), *self.noise, self.input_limit, self.input, self.age)
        return not any(widths)

    def times(self, factor: float) -> "UncertaintyConfig":
        """The box with all half widths multiplied."""
        shares = {
            section: {k: factor * v for k, v in getattr(self, section).items()} for section in ("design", "plant")
        }
        widths = {name: factor * getattr(self, name) for name in ("input_limit", "input", "age")}
        return self.model_copy(update=shares | widths | {"noise": tuple(factor * error for error in self.noise)})

    def in_words(self, plant: PlantConfig) -> str:
        """The box as every result of the robot states it."""
        if self.empty:
            return "one exact model"
        shares = self.design | self.plant | {"input limit": self.input_limit}
        parts = [f"{name} ± {share:.3g} of itself" for name, share in shares.items() if share]
        if self.center == "moving" and any((self.design | self.plant).values()):
            parts.append("constant in time, each robot about its own motion")
        unit = next(iter(plant.input_units.values()))
        parts += [f"|w(t)| <= {self.input:g} {unit} on the motors' axes"] if self.input else []
        measured = zip(plant.states.items(), self.noise, strict=False)
        parts += [f"{name} measured within {error:g} {unit}" for (name, unit), error in measured if error]
        parts += [f"measurements up to {self.age:g} s old"] if self.age else []
        return ", ".join(parts)


MOST_STEPS = 100_000
"""Of one rollout about the goal."""


class GoalConfig(Settings):
    """The region of attraction of the goal's LQR, from which the last level follows."""

    directions: int = Field(
        default=24, ge=1, le=100_000, description="quasi-random directions about the goal, in each round [-]"
    )
    radii: int = Field(default=6, ge=3, le=1000, description="radii along each direction, in each round [-]")
    rounds: int = Field(
        default=4, ge=1, le=20, description="rounds, each between two neighboring radii of the one before [-]"
    )
    horizon: float = Field(
        default=2.0, ge=1e-3, le=1e3, description="time over which a rollout must come closer to the goal [s]"
    )
    step: float = Field(
        default=0.02, ge=1e-6, le=1e3, description="RK4 step of these rollouts, divided where the loop is fast [s]"
    )

    def problems(self) -> Iterator[Problem]:
        if self.step >= self.horizon:
            yield Problem(("step",), f"must be < horizon = {self.horizon:g}", self.step)
        elif self.horizon > MOST_STEPS * self.step:
            yield Problem(("step",), f"must be >= horizon / {MOST_STEPS} = {self.horizon / MOST_STEPS:g}", self.step)


class FunnelConfig(Settings):
    rollouts: Literal["closed_form", "mjx", "mixed"] = Field(
        default="closed_form",
        description="dynamics of the search's rollouts; mixed: a share of the held-out samples on MJX",
    )
    mjx_share: float = Field(
        default=0.01, ge=0, le=1, description="share of the held-out samples on MJX when mixed [-]"
    )
    directions: int = Field(default=12, ge=1, le=100_000, description="quasi-random directions at each knot [-]")
    climbers: int = Field(default=4, ge=2, le=10_000, description="adversarial directions, from knot to knot [-]")
    climbs: int = Field(default=3, ge=0, le=1000, description="steps of each to a worse one, at each knot [-]")
    steps: int = Field(default=5, ge=1, le=1000, description="RK4 steps of a rollout inside an interval [-]")
    trials: int = Field(
        default=32, ge=1, le=1_000_000, description="held-out samples, uniform in the ellipsoid, at each knot [-]"
    )
    confidence: float = Field(default=0.99, gt=0, lt=1, description="1 - beta, jointly over the knots [-]")
    goal: GoalConfig = Field(default=GoalConfig(), description="region of attraction of the goal's LQR")

    def problems(self) -> Iterator[Problem]:
        if self.rollouts == "mixed" and self.mjx_share == 0:
            yield Problem(
                ("mjx_share",), "must be > 0 when rollouts = 'mixed', or choose 'closed_form'", self.mjx_share
            )


class NestedConfig(Settings):
    """The paper's two loops: an outer search over designs, each with an inner search over weights."""

    designs: int = Field(
        default=8, ge=4, le=2**20, description="outer population; the inner one is population / designs [-]"
    )
    generations: int = Field(default=10, ge=1, le=1_000_000, description="inner generations for each design [-]")


SMALLEST_POPULATION = 4
"""CMA-ES needs two parents, the better half of its population."""


if TYPE_CHECKING:
    Objective = OverTasks = str
else:
    Objective, OverTasks = Literal[OBJECTIVES], Literal[tuple(OVER_TASKS)]


REFINABLE = ("gains", "shapes")
"""What an elite's refinement may move."""
REFINEMENT_STEPS = 400
"""Of its optimizer."""


class SearchConfig(Settings):
    objective: Objective = Field(
        default="sum",
        description="volume to maximize; goal: of the region there, without a motion; dirtrel: 1 / l_w, for comparison",
    )
    at_least: dict[str, Annotated[float, Field(gt=0, le=1e12)]] = Field(
        default={},
        description="smallest volumes or push margin, by name, before which the objective counts [their units]",
    )
    mode: Literal["joint", "nested"] = Field(
        default="joint", description="one search over all, or weights inside designs"
    )
    population: int = Field(default=128, ge=SMALLEST_POPULATION, le=2**20, description="candidates in a generation [-]")
    generations: int = Field(
        default=60,
        ge=1,
        le=1_000_000,
        description="generations; each evaluates the whole population, also when nested [-]",
    )
    patience: int = Field(
        default=10,
        ge=0,
        le=1_000_000,
        description="(outer) generations without 0.1 % of gain after which the search ends; 0: never [-]",
    )
    over_tasks: OverTasks = Field(
        default="geometric_mean",
        description="of several tasks: what of their volumes is maximized; min: ties by the geometric mean",
    )
    share: Literal["all", "design"] = Field(
        default="all",
        description="what several tasks have in common; design: each has its own weights and options of the policy",
    )
    sigma: float = Field(default=0.3, ge=1e-6, le=1, description="initial step size in the unit box [-]")
    seed: int = Field(default=0, ge=0, lt=2**32, description="of all random numbers [-]")
    chunk: Annotated[int, Field(ge=1, le=2**20)] | Literal["auto"] = Field(
        default="auto", description="candidates that a device is given at once; auto: as many as its memory holds [-]"
    )
    refine: bool = Field(
        default=False,
        description="refine gains and ellipsoids of the elites by gradients at the end, as `rtcd refine` does",
    )
    nested: NestedConfig = Field(
        default=NestedConfig(), description="budget of the two loops, used in mode nested alone"
    )

    def __hash__(self) -> int:
        return hash(self.model_dump_json())  # pydantic's own fails at the mapping

    def problems(self) -> Iterator[Problem]:
        for name in self.at_least:
            if name not in VOLUMES:
                yield Problem(("at_least", name), f"must be a volume; {closest(name, tuple(VOLUMES))}")
        if self.refine and self.objective in OTHERS:
            text = f"goes up no {self.objective}: it needs a volume as search.objective"
            yield Problem(("refine",), text, self.refine)
        if self.mode != "nested":
            return
        designs = self.nested.designs
        if self.population % designs:
            yield Problem(("population",), f"must be a multiple of nested.designs = {designs}", self.population)
        elif self.population // designs < SMALLEST_POPULATION:
            smallest = SMALLEST_POPULATION * designs
            yield Problem(("population",), f"must be >= {smallest} for nested.designs = {designs}", self.population)


class ElitesConfig(Settings):
    count: int = Field(default=8, ge=1, le=10_000, description="candidates kept and evaluated again [-]")
    distance: float = Field(
        default=0.02, ge=0, lt=1, description="smallest distance between two of them in the unit box [-]"
    )
    trials: int = Field(
        default=24_000, ge=1, le=100_000_000, description="held-out samples at each knot, followed to the goal [-]"
    )
    directions: int = Field(
        default=192, ge=1, le=1_000_000, description="directions at each knot of their evaluation [-]"
    )
    mjx_states: int = Field(
        default=2000,
        ge=0,
        le=100_000_000,
        description="held-out samples of each that MJX follows to the goal as well; 0: none [-]",
    )
    keys: int = Field(
        default=5,
        ge=0,
        le=1000,
        description="further keys under which best and initial are evaluated, for the spread; 0: none [-]",
    )


class CheckpointConfig(Settings):
    seconds: float = Field(default=20.0, ge=0, le=1e6, description="least time between two saves [s]")
