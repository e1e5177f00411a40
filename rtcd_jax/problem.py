"""What stays fixed during a run: the robot, the task, the time grid, the searched variables."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtcd_jax.config.load import Config
from rtcd_jax.config.robot import value_of
from rtcd_jax.config.schema import CatchConfig
from rtcd_jax.numerics.keep_out import Set, sets_of
from rtcd_jax.plants import brachiation, make_plant
from rtcd_jax.plants.base import Plant
from rtcd_jax.system.devices import require_float64
from rtcd_jax.system.errors import ConfigError
from rtcd_jax.system.errors import Problem as Fault
from rtcd_jax.types import Candidate, TaskNumbers, Uncertainty

AT_REST = 1e-6
"""Largest rate of a goal [state/s]: one typed with 16 digits leaves the rounding of pi times the stiffness."""
NEAR = 0.15
"""From a quarter turn [rad]: what was meant by 3, 3.1 or 3.14."""
UNREACHED = 1e-9
"""Least share of the pencil's largest singular value with which an input reaches a mode."""
STRETCHED = 1e6
"""Condition of a point's Jacobian from which on it says nothing of one direction."""
DESIGNS, STATES, LARGEST_STATE = 3, 8, 10.0
"""Where the MJCF is compared with the equations: random designs, states of each, within this or the task's limits."""

SAME = 1e-9
"""Largest relative difference of two numbers of a robot that should be one."""


class Reset(NamedTuple):
    """The numbers of a robot that it needs, by the robot's joints; those that it changes, and which of them only change
    places; what becomes of them, and of the state [n *batch].
    """

    fields: Mapping[int, tuple[str, ...]]
    changed: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]
    numbers: Callable[..., dict[str, Any]]
    state: Callable[..., Array]


class Point(NamedTuple):
    """A point of a robot in a plane: the numbers that it needs, by the robot's joints; the two angles that it is a
    function of, [2 joints], and its place [2 *batch] in meters.
    """

    fields: Mapping[int, tuple[str, ...]]
    angles: Callable[[int], Float[np.ndarray, "2 joints"]]
    place: Callable[..., Array]


POINTS = {"gripper": Point(dict.fromkeys(brachiation.FIELDS, ("arm_length",)), brachiation.arms_of, brachiation.hook)}
"""By the name in `task.catch.window`."""


class Window(NamedTuple):
    """What a point may be off its place at the goal: by at most `size` [m], and where the window is the catch set's
    shape, with `speed` > 0 as half width of the velocities.
    """

    angles: Float[np.ndarray, "2 joints"]
    place: Callable[..., Array]
    size: float
    speed: float


RESETS = {
    "brachiation": Reset(
        brachiation.FIELDS, brachiation.ARMS, brachiation.PAIRS, brachiation.exchanged, brachiation.catch
    )
}
"""By the name in the configuration."""


@dataclass(frozen=True)
class Variable:
    """One number of a candidate, its box, and whether the unit box scales it logarithmically."""

    name: str
    initial: float
    low: float
    high: float
    free: bool
    logarithmic: bool

    @property
    def design(self) -> bool:
        """Whether it is a field of the robot."""
        return self.name.startswith("design.")


@dataclass(frozen=True, eq=False)
class Problem:
    """The experiment with its robot. Arrays are numpy: they become constants of compiled programs.

    `variables` are the design fields in the plant's order, then the diagonal of Q, that of R, and those of the policy;
    of each task where they are not shared.
    """

    config: Config
    plant: Plant
    start: Float[Array | np.ndarray, "n *batch"]
    goal: Float[Array | np.ndarray, "n *batch"]
    state_limits: Float[np.ndarray, " n"]
    variables: tuple[Variable, ...]
    keep_out: tuple[Set, ...] = ()
    """Sets of states that no motion enters."""
    uncertainty: Uncertainty | None = None
    """What the funnels must bear; None for one exact model."""
    catch: Float[np.ndarray, "n n"] | None = None
    """C of the catch set {x : (x - goal)' C (x - goal) <= 1} in which the motions end, and no time follows; None where
    the goal is an equilibrium that is held.
    """
    reset: Callable | None = None
    """R(numbers of the robot, x) of tasks in a cycle: each motion ends where R leads into the next one's funnel."""
    window: Window | None = None
    """Of the last ellipsoid, with `reset` or as the catch set's shape."""
    cost_center: Float[np.ndarray, " n"] | None = None
    """From where the trajectory's cost counts; None for the goal."""
    tasks: tuple["Problem", ...] = ()
    """Where there are several: each alone. Start, goal and the robot's constants are then the first one's."""

    @property
    def caught(self) -> bool:
        """Whether the motions end with t_N, and no goal is held."""
        return self.catch is not None or self.reset is not None or self.window is not None

    def numbers(self, candidate: Candidate) -> dict[str, Any]:
        """The candidate's robot's own, constants and design, by name."""
        return vars(self.of(candidate).plant) | vars(candidate.design)

    @property
    def intervals(self) -> int:
        return self.config.trajectory.knots - 1

    def input_limits(self, design: eqx.Module) -> Float[Array | np.ndarray, "m *batch"]:
        """Largest |u_i| of every input; numpy's, a constant of the program, if it does not depend on the design."""
        limits = self.plant.input_limits(design)
        if all(isinstance(limit, int | float) for limit in limits):
            return np.array(limits, float)
        return jnp.stack(jnp.broadcast_arrays(*map(jnp.asarray, limits)))

    def of(self, candidate: Candidate) -> "Problem":
        """The problem as this candidate has it: with several tasks, start, goal and robot are those of its own task,
        arrays that a compiled program reads out of tables by the task's number; what follows from the design is the
        candidate's.
        """
        if not self.tasks:
            return self._with(candidate.own)

        def own(numbers: Callable[[Problem], Array | np.ndarray]) -> Array:
            table = jnp.asarray(np.stack([np.asarray(numbers(each)) for each in self.tasks]))
            return jnp.moveaxis(table[candidate.task], -1, 0)

        first, *others = (vars(each.plant) for each in self.tasks)
        names = [name for name in first if any(other[name] != first[name] for other in others)]
        plant = self.plant
        if names:
            table = own(lambda each: np.array([getattr(each.plant, name) for name in names]))
            plant = _with_constants(plant, dict(zip(names, table, strict=True)))
        common = replace(self, plant=plant, start=own(lambda each: each.start), goal=own(lambda each: each.goal))
        return common._with(candidate.own)

    @property
    def following(self) -> tuple[str, ...] | None:
        """The robot's constants that follow from the design in one of the tasks; None where not even an end does."""
        each = [alone.config for alone in self.tasks or (self,)]
        if not any(config.follows_design for config in each):
            return None
        return tuple(dict.fromkeys(name for config in each for name in config.edits if name not in config.design))

    def of_design(self, design: eqx.Module, following: tuple[str, ...] | None) -> tuple[eqx.Module, TaskNumbers | None]:
        """The design as the configuration's one task changes it, and what else of the task follows from it: the
        constants `following`, and the motion's ends.
        """
        names = vars(self.plant) | vars(design)
        edits = {name: jnp.asarray(value_of(value, names)) for name, value in self.config.edits.items()}
        fields = {name: edits.get(name, value) for name, value in vars(design).items()}
        if following is None:
            return type(design)(**fields), None
        ends = self.config.ends(vars(design))
        start, goal = (tuple(jnp.asarray(value, float) for value in end) for end in ends)
        constants = {name: jnp.asarray(edits.get(name, names[name]), float) for name in following}
        return type(design)(**fields), TaskNumbers(start, goal, constants)

    def _with(self, own: TaskNumbers | None) -> "Problem":
        if own is None:
            return self
        start, goal = (jnp.stack(jnp.broadcast_arrays(*end)) for end in (own.start, own.goal))
        return replace(self, plant=_with_constants(self.plant, own.constants), start=start, goal=goal)

    @property
    def free(self) -> tuple[Variable, ...]:
        return tuple(variable for variable in self.variables if variable.free)

    @property
    def design_dims(self) -> tuple[bool, ...]:
        """For every genome dimension, whether it is a design variable (else one of the controller)."""
        return tuple(variable.design for variable in self.free)


def make_problem(config: Config) -> Problem:
    """The problem that a configuration describes.

    Raises:
        UserError: if JAX computes in float32.
        ConfigError: if a goal that is to be held is no equilibrium of the initial design without input, or cannot be
            stabilized there.
        UserError: if the robot's MJCF does not move as its equations say, at random states, inputs and designs.
    """
    require_float64()
    if len(config.tasks) <= 1:
        (alone,) = config.each.values()
        return _make_problem(alone, ("task",))
    tasks = tuple(_make_problem(alone, ("tasks", name)) for name, alone in config.each.items())
    variables = tuple(_variables(config))
    whole = replace(tasks[0], config=config, variables=variables, keep_out=_keep_out(config), tasks=tasks)
    if whole.reset is not None:
        _require_cycle(whole)
    return whole


def _make_problem(config: Config, path: tuple[str, ...]) -> Problem:
    plant, task = make_plant(config.plant, config.design_units), config.task
    start, goal = config.initial_ends
    problem = Problem(
        config=config,
        plant=plant,
        start=np.array(start, float),
        goal=np.array(goal, float),
        state_limits=np.array(task.state_limits, float),
        variables=tuple(_variables(config)),
        keep_out=_keep_out(config),
        uncertainty=_uncertainty(config),
        catch=np.diag(1 / np.square(task.catch.half_widths)) if task.catch.half_widths else None,
        reset=RESETS[task.catch.reset].state if task.catch.cyclic else None,
        window=_window(task.catch, plant.n // 2),
        cost_center=np.array(task.cost_center, float) if task.cost_center else None,
    )
    if problem.window is not None:
        _require_point(problem)
    if not problem.caught:
        _require_equilibrium(initial(problem), path)
        _require_stabilizable(initial(problem), path)
    _require_agreement(problem)
    return problem


def initial(problem: Problem) -> Problem:
    """The problem, for one task, as the design that the configuration begins with has it."""
    _, own = _of_share(problem, 0.0, problem.following)
    return problem._with(jax.tree.map(float, own))


def initial_design(problem: Problem) -> eqx.Module:
    """The design that the configuration begins with."""
    return _design(problem, 0.0)


def linearized_goal(problem: Problem) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n m"]]:
    """A and B of the initial design at the goal."""
    rest = jnp.zeros(problem.plant.m)
    jacobians = jax.jit(jax.jacfwd(problem.plant.dynamics, (1, 2)))(
        initial_design(problem), jnp.asarray(problem.goal), rest
    )
    a, b = map(np.asarray, jacobians)
    return a, b


def unreached_mode(a: Float[np.ndarray, "n n"], b: Float[np.ndarray, "n m"]) -> tuple[complex, int] | None:
    """The fastest mode that grows and that no input reaches (Popov, Belevitch, Hautus): its rate [1/s] and the state
    that moves most in it; None if the system can be stabilized.
    """
    found = []
    for rate in np.linalg.eigvals(a):
        pencil = np.concatenate([a - rate * np.eye(len(a)), b], axis=1)
        left, sizes, _ = np.linalg.svd(pencil)
        if rate.real >= -UNREACHED and sizes[-1] <= UNREACHED * sizes[0]:
            found.append((complex(rate), int(np.argmax(np.abs(left[:, -1])))))
    return max(found, key=lambda mode: mode[0].real, default=None)


def _variables(config: Config):
    for key, variable in config.variables().items():
        yield Variable(
            name=key,
            initial=variable.initial,
            low=variable.min,
            high=variable.max,
            free=variable.free,
            logarithmic=config.logarithmic(key),
        )


def _keep_out(config: Config) -> tuple[Set, ...]:
    ends = [end for alone in config.each.values() for end in alone.initial_ends]
    return sets_of(config.task.model_dump().get("keep_out", ()), np.array(ends))


def _window(catch: CatchConfig, joints: int) -> Window | None:
    for name, size in catch.window.items():
        return Window(POINTS[name].angles(joints), POINTS[name].place, size, catch.speed)
    return None


def _require_point(problem: Problem) -> None:
    """Raises ConfigError if the robot has no such point or, where the window is the catch set's shape, if a joint does
    not move it at the goal.
    """
    ((name, size),) = problem.config.task.catch.window.items()
    path, robot = ("task", "catch", "window", name), vars(problem.plant) | vars(initial_design(problem))
    if lacking := _lacking(problem.plant, robot, POINTS[name].fields):
        raise ConfigError([Fault(path, lacking, size)])
    if problem.window is not None and problem.window.speed and problem.plant.n > 4:
        text = "is no shape of a robot with more than two joints: the hook does not say where all of them are"
        raise ConfigError([Fault(path, text, size)])
    turn = np.asarray(jax.jacfwd(partial(POINTS[name].place, robot))(jnp.asarray(problem.goal)))[:, :2]
    if problem.window is not None and problem.window.speed and np.linalg.cond(turn) > STRETCHED:
        text = "is no shape at the goal: there the arms are stretched or folded, and not every direction is open to it"
        raise ConfigError([Fault(path, text, size)])


def _uncertainty(config: Config) -> Uncertainty | None:
    box = config.uncertainty
    if box.empty:
        return None
    return Uncertainty(
        parameters={name: jnp.asarray(width) for name, width in (box.design | box.plant).items()},
        input_limit=jnp.asarray(box.input_limit),
        input=jnp.asarray(box.input),
        noise=jnp.array(box.noise) if any(box.noise) else None,
        age=jnp.asarray(box.age) if box.age else None,
        residual=jnp.asarray(box.residual),
        moving=box.center == "moving" and any((box.design | box.plant).values()),
    )


def _require_equilibrium(problem: Problem, path: tuple[str, ...]) -> None:
    plant, initial = problem.plant, initial_design(problem)
    dynamics = jax.jit(plant.dynamics)

    def rates(state: np.ndarray) -> np.ndarray:
        return np.asarray(dynamics(initial, jnp.asarray(state), jnp.zeros(plant.m)))

    goal = np.asarray(problem.goal)
    found = rates(goal)
    if np.max(np.abs(found)) <= AT_REST:
        return
    quarters = np.round(goal / (np.pi / 2))
    turns = quarters * np.pi / 2
    near = [
        unit == "rad" and abs(turn - value) < NEAR
        for unit, turn, value in zip(plant.state_units, turns, goal, strict=True)
    ]
    meant, hint = np.where(near, turns, goal), ""
    if np.max(np.abs(rates(meant))) <= AT_REST:
        named = (f"{plant.state_names[i]} = {_quarter_turns(int(quarters[i]))}" for i in np.flatnonzero(meant != goal))
        hint = f"; did you mean {', '.join(named)}?"
    text = (
        f"is no equilibrium without input: there the state's derivative is {found.tolist()} and would have to be zero"
    )
    raise ConfigError([Fault((*path, "goal"), text + hint, goal.tolist())])


def _require_stabilizable(problem: Problem, path: tuple[str, ...]) -> None:
    mode = unreached_mode(*linearized_goal(problem))
    if mode is None:
        return
    rate, state = mode
    text = (
        f"cannot be held: no input reaches the mode with the rate {rate.real:.3g} 1/s, in which "
        f"{problem.plant.state_names[state]} moves most"
    )
    raise ConfigError([Fault((*path, "goal"), text, problem.goal.tolist())])


def _require_cycle(problem: Problem) -> None:
    """Every task's end and robot after the reset must be the start and the robot of the next one, of all designs."""
    reset = RESETS[problem.config.task.catch.reset]
    _require_exchangeable(problem.config, reset)
    names = list(problem.config.tasks)
    for share in (0.0, *np.random.default_rng(0).random(DESIGNS)):
        designs = [_of_share(alone, share, problem.following) for alone in problem.tasks]
        tasks = [alone._with(own) for alone, (_, own) in zip(problem.tasks, designs, strict=True)]
        robots = [vars(alone.plant) | vars(design) for alone, (design, _) in zip(tasks, designs, strict=True)]
        for i, (alone, robot) in enumerate(zip(tasks, robots, strict=True)):
            if lacking := _lacking(alone.plant, robot, reset.fields):
                raise ConfigError([Fault(("task", "catch", "reset"), lacking, problem.config.task.catch.reset)])
            following = (i + 1) % len(names)
            path, behind = ("tasks", names[following]), f"after the reset at the end of {names[i]}"
            for name, value in reset.numbers(robot).items():
                if abs(float(value) - float(robots[following][name])) > SAME * abs(float(value)):
                    text = f"must be {float(value):.9g}, what it is {behind}"
                    raise ConfigError([Fault((*path, "plant", name), text, float(robots[following][name]))])
            start, expected = tasks[following].start, np.asarray(reset.state(robot, jnp.asarray(alone.goal)))
            if np.max(np.abs(start - expected)) > AT_REST:
                text = f"must be {expected.round(9).tolist()}, where the motion is {behind}"
                raise ConfigError([Fault((*path, "start"), text, start.tolist())])


def _lacking(plant: Plant, robot: Mapping[str, Any], fields: Mapping[int, tuple[str, ...]]) -> str:
    """What the robot lacks of those fields, by its number of joints; empty if it has them."""
    needed = fields.get(plant.n // 2)
    if needed is None:
        return f"needs a robot with {' or '.join(map(str, fields))} joints; this one has {plant.n // 2}"
    missing = [name for name in needed if name not in robot]
    return f"needs a robot with {', '.join(needed)}; there is no {', '.join(missing)}" if missing else ""


def _require_exchangeable(config: Config, reset: Reset) -> None:
    """Raises ConfigError unless the robots of the box are the same after the reset."""
    partners = {name: other for pair in reset.pairs for name, other in (pair, pair[::-1])}
    box = config.uncertainty
    for section in ("design", "plant"):
        for name, width in getattr(box, section).items():
            path = ("uncertainty", section, name)
            if name in reset.changed and width and name not in partners:
                text = "must be 0 with task.catch.reset: after a reset it is another number of the robot"
                raise ConfigError([Fault(path, text, width)])
            if name in partners and width != (expected := (box.design | box.plant).get(partners[name], 0.0)):
                text = f"must be that of {partners[name]}, which is {expected:g}: at a reset they change places"
                raise ConfigError([Fault(path, text, width)])


def _quarter_turns(count: int) -> str:
    """`pi (3.141592653589793)`, `-pi/2 (…)`, `0`."""
    if count == 0:
        return "0"
    whole, half = divmod(abs(count), 2)
    sign, times = "-" * (count < 0), abs(count) if half else whole
    return f"{sign}{f'{times} ' if times > 1 else ''}pi{'/2' if half else ''} ({count * np.pi / 2!r})"


def _require_agreement(problem: Problem) -> None:
    from rtcd_jax.plants.agreement import require_agreement

    rng = np.random.default_rng(0)
    designs = [_design(problem, share) for share in (0.0, *rng.random(DESIGNS))]
    largest = np.minimum(problem.state_limits, LARGEST_STATE)
    x = rng.uniform(-largest, largest, (STATES, problem.plant.n))
    limits = np.asarray(problem.input_limits(designs[0]))
    u = rng.uniform(-limits, limits, (STATES, problem.plant.m))
    require_agreement(problem.plant, designs, x, u)


def _design(problem: Problem, share: float) -> eqx.Module:
    return _of_share(problem, share, problem.following)[0]


def _of_share(
    problem: Problem, share: float, following: tuple[str, ...] | None
) -> tuple[eqx.Module, TaskNumbers | None]:
    """The design at a share of the way from the initial one to the far corner of its box, and what follows from it."""
    fields = (variable for variable in problem.variables if variable.design)
    design = problem.plant.Design(*(jnp.asarray(v.initial + share * (_far_end(v) - v.initial)) for v in fields))
    return problem.of_design(design, following)


def _with_constants(plant: Plant, values: Mapping[str, Any]) -> Plant:
    """A robot with other numbers for some of its constants, arrays as well."""
    if not values:
        return plant
    return eqx.tree_at(lambda plant: [getattr(plant, name) for name in values], plant, [*values.values()])


def _far_end(variable: Variable) -> float:
    return max(variable.low, variable.high, key=lambda end: abs(end - variable.initial))
