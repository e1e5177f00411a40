"""Genome [d] in the unit box <-> Candidate: boxes, scaling, pinned variables.

Designs are scaled linearly, weights logarithmically, the policy's options as the configuration's schema says; pinned
variables have no dimension.
"""

from collections.abc import Sequence
from math import log

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rtcd_jax.config.load import OWN, of_one_task
from rtcd_jax.problem import Problem, Variable
from rtcd_jax.types import Candidate, TaskNumbers


def decode(problem: Problem, genome: Float[Array, " d"], task: Int[Array, ""] | None = None) -> Candidate:
    """The candidate that a genome stands for; entries outside [0, 1] leave the box.

    Of several tasks it is asked for the one of this number, with that one's design, weights and policy; where none is
    meant, weights and policy are the first one's.
    """
    values, dimension = {}, 0
    for variable in problem.variables:
        if variable.free:
            values[variable.name] = _from_unit(variable, genome[dimension])
            dimension += 1
        else:
            values[variable.name] = jnp.asarray(variable.initial, genome.dtype)

    if not problem.config.shares_all:
        values = _of_its_own(problem, values, task)

    def section(prefix: str) -> list[Array]:
        return [value for name, value in values.items() if name.startswith(prefix)]

    design, own = _of_task(problem, problem.plant.Design(*section("design.")), task)
    return Candidate(
        design=design,
        q=jnp.stack(section("weights.q.")),
        r=jnp.stack(section("weights.r.")),
        policy={name.removeprefix("policy."): value for name, value in values.items() if name.startswith("policy.")},
        task=task,
        own=own,
    )


def _of_its_own(problem: Problem, values: dict[str, Array], task: Int[Array, ""] | None) -> dict[str, Array]:
    """The values of the variables by their keys in a configuration of this task alone."""
    tables: dict[str, list[Array]] = {}
    for name, value in values.items():
        tables.setdefault(of_one_task(name), []).append(value)
    number = 0 if task is None else task
    return {name: jnp.stack(each)[number] if len(each) > 1 else each[0] for name, each in tables.items()}


def genome_of_task(
    problem: Problem, name: str, genome: Float[np.ndarray, "*batch d"]
) -> Float[np.ndarray, "*batch own"]:
    """What the genomes for several tasks are to one of them alone: the dimensions that it shares, and its own."""
    others = tuple(f"{OWN}.{other}." for other in problem.config.tasks if other != name)
    return genome[..., [i for i, variable in enumerate(problem.free) if not variable.name.startswith(others)]]


def _of_task(
    problem: Problem, design: eqx.Module, task: Int[Array, ""] | None
) -> tuple[eqx.Module, TaskNumbers | None]:
    """The design as the task has it, and what else of it follows; that of several tasks in common where none of them
    is meant.
    """
    following = problem.following
    if not problem.tasks:
        return problem.of_design(design, following)
    if task is None:
        return design, None
    each = [alone.of_design(design, following) for alone in problem.tasks]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves)[task], *each)


def encode(problem: Problem, values: Sequence[float]) -> Float[np.ndarray, " d"]:
    """The genome [d] of a candidate whose variables, in the order of `problem.variables`, have these values."""
    paired = zip(problem.variables, values, strict=True)
    return np.array([_to_unit(variable, value) for variable, value in paired if variable.free])


def initial_genome(problem: Problem) -> Float[np.ndarray, " d"]:
    """The genome [d] of the configuration's initial candidate."""
    return encode(problem, [variable.initial for variable in problem.variables])


def _from_unit(variable: Variable, share):
    if variable.logarithmic:
        return jnp.exp(log(variable.low) + share * log(variable.high / variable.low))
    return variable.low + share * (variable.high - variable.low)


def _to_unit(variable: Variable, value: float) -> float:
    if variable.logarithmic:
        return log(value / variable.low) / log(variable.high / variable.low)
    return (value - variable.low) / (variable.high - variable.low)
