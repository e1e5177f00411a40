"""What is understood of a configuration, before anything is searched."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax.plants.mjcf import closed_form
from rtcd_jax.plants.robot import MjcfPlant
from rtcd_jax.problem import AT_REST, Problem, initial, initial_design, linearized_goal


def understood(problem: Problem) -> Iterator[str]:
    """Lines about the robot, its equations, the task's ends and what is searched, all of the initial design; of several
    tasks for each.
    """
    if problem.tasks:
        for name, alone in zip(problem.config.tasks, problem.tasks, strict=True):
            yield f"task       {name}"
            yield from _of_one(initial(alone))
    else:
        yield from _of_one(initial(problem))
    free = [variable.name for variable in problem.free]
    yield f"search     {len(free)} variables: {', '.join(free)}"


def _of_one(problem: Problem) -> Iterator[str]:
    plant, design = problem.plant, initial_design(problem)
    yield f"robot      {problem.config.plant.name}: {plant.convention}"
    bounds = zip(plant.state_names, plant.state_units, problem.state_limits, strict=True)
    yield "states     " + ", ".join(f"|{name}| <= {limit:.6g} {unit}" for name, unit, limit in bounds)
    for each in problem.config.task.keep_out:
        yield f"keep out   {each.in_words(plant.state_names)}"
    inputs = zip(plant.input_names, plant.input_units, np.asarray(problem.input_limits(design)), strict=True)
    yield "inputs     " + ", ".join(f"|{name}| <= {limit:.6g} {unit}" for name, unit, limit in inputs)
    units = plant.parameter_units
    numbers = (f"{name} = {value:.6g} {units[name]}".rstrip() for name, value in plant.parameters(design).items())
    yield "parameters " + ", ".join(numbers)
    if isinstance(plant, MjcfPlant):
        form = closed_form(plant.robot)
        yield (
            f"equations  {form.equations.terms} terms, {len(form.program.motion)} operations a state and "
            f"{len(form.program.lumping)} a design; C MuJoCo agrees at random states, inputs and designs"
        )
    for name, state in ("start", problem.start), ("goal", problem.goal):
        x, rest = jnp.asarray(state), jnp.zeros(plant.m)
        rates = np.asarray(jax.jit(plant.dynamics)(design, x, rest))
        a = np.asarray(jax.jit(jax.jacfwd(plant.dynamics, 1))(design, x, rest))
        still = np.max(np.abs(rates)) <= AT_REST
        fastest = float(np.max(np.linalg.eigvals(a).real))
        kind = "an equilibrium" if still else "no equilibrium"
        if still and fastest > AT_REST:
            kind = f"an unstable equilibrium, from which motions grow by {fastest:.3g} 1/s"
        yield f"{name:10} {state.tolist()}: {kind}"
    if not problem.caught:
        a, b = linearized_goal(problem)
        blocks = [b]
        for _ in range(plant.n - 1):
            blocks.append(a @ blocks[-1] / max(1.0, float(np.linalg.norm(a))))
        rank = np.linalg.matrix_rank(np.concatenate(blocks, axis=1))
        yield f"control    the goal can be stabilized; {rank} of {plant.n} directions are controllable"
    else:
        within = problem.config.task.catch.in_words(problem.config.plant.states)
        yield f"catch      the motion ends in an ellipsoid about the goal: {within}; nothing is asked after it"
