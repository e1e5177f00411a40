"""What stays fixed during a run: the robot, the task, the time grid, the searched variables."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax.config.load import Config
from rtcd_jax.plants import plant_class
from rtcd_jax.plants.base import Plant


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

    `variables` are the design fields in the plant's order, then the diagonal of Q, that of R, and those of the policy.
    """

    config: Config
    plant: Plant
    start: np.ndarray
    goal: np.ndarray
    state_limits: np.ndarray
    input_limits: np.ndarray
    variables: tuple[Variable, ...]

    @property
    def intervals(self) -> int:
        return self.config.trajectory.knots - 1

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
        ValueError: if the goal is no equilibrium of the initial design without input.
    """
    constants = config.plant.model_dump(exclude={"name"})
    plant = plant_class(config.plant.name)(**constants)
    problem = Problem(
        config=config,
        plant=plant,
        start=np.array(config.task.start, float),
        goal=np.array(config.task.goal, float),
        state_limits=np.array(config.task.state_limits, float),
        input_limits=np.array(plant.input_limit, float),
        variables=tuple(_variables(config)),
    )
    _check_equilibrium(problem)
    return problem


def _variables(config: Config):
    for key, variable in config.variables().items():
        yield Variable(
            name=key,
            initial=variable.initial,
            low=variable.min,
            high=variable.max,
            free=variable.free,
            logarithmic=key.startswith("weights.") or key == "policy.authority",
        )


def _check_equilibrium(problem: Problem) -> None:
    plant = problem.plant
    values = [jnp.asarray(variable.initial) for variable in problem.variables if variable.design]
    design = plant.Design(*values)
    rate = np.asarray(jax.jit(plant.dynamics)(design, jnp.asarray(problem.goal), jnp.zeros(plant.m)))
    # A goal typed with 16 digits leaves the rounding of pi times the stiffness of the robot.
    if np.max(np.abs(rate)) > 1e-6:
        raise ValueError(
            f"task.goal = {problem.goal.tolist()} is no equilibrium without input: there the state's derivative is "
            f"{rate.tolist()} and would have to be zero"
        )
