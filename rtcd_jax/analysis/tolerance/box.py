"""A box of uncertainty and the single uncertainties that it is made of."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import Any, final

import jax
import jax.numpy as jnp

from rtcd_jax.config.load import MOST_CORNERS, Config, parse, read_uncertainty, resolved
from rtcd_jax.problem import Problem
from rtcd_jax.system.errors import UserError
from rtcd_jax.types import Uncertainty

ALL_OF_ITSELF = 0.999
"""Largest relative half width: a mass is positive."""
WHOLE = "whole box"
OWN = "whole box about own motions"


@final
@dataclass(frozen=True)
class Side:
    """One uncertainty of a box, or all of them: `width` [unit] at the factor 1, `box` the half widths with it alone.

    Factors above `most` mean nothing. The whole box has no width of its own.
    """

    name: str
    unit: str
    width: float | None
    box: Uncertainty
    most: float


def with_box(config: Config, file: Path | None) -> Config:
    """The run's configuration with the box of a YAML file, whose `uncertainty` section it is, or with its own.

    Raises:
        ConfigError: the file's section is wrong, with everything that is.
        UserError: nothing is uncertain.
    """
    data = resolved(config)
    data["funnel"]["rollouts"] = "closed_form"
    if file is not None:
        data["uncertainty"] = read_uncertainty(file)
    changed = parse(data, str(file or "configuration"))
    if changed.uncertainty.empty:
        where = f"{file} states" if file else "the run states"
        raise UserError(f"{where} no uncertainty: give --uncertainty FILE, a YAML with an `uncertainty` section")
    return changed


def sides(problem: Problem) -> list[Side]:
    """The uncertainties of the problem's box one by one, and the whole box last."""
    whole = problem.uncertainty
    assert whole is not None
    nothing = whole.times(0.0)
    singles = [Side(*each) for each in _singles(problem, whole, nothing) if each[2]]
    most = min((side.most for side in singles), default=inf)
    return [*singles, Side(WHOLE, "", None, whole, most)]


def about_own_motions(problem: Problem, whole: Side) -> Side | None:
    """The whole box of constant numbers, each robot about its own motion; None where that is nothing else."""
    box = problem.config.uncertainty
    numbers = [name for name, width in (box.design | box.plant).items() if width]
    if whole.box.moving or not 0 < len(numbers) <= MOST_CORNERS:
        return None
    return replace(whole, name=OWN, box=replace(whole.box, moving=True))


def stacked(boxes: list[Side], factors: Any) -> Uncertainty:
    """The half widths of every side times its factor, leading axis [B]."""
    scaled = [side.box.times(factor) for side, factor in zip(boxes, factors, strict=True)]
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf, float) for leaf in leaves]), *scaled)


def _singles(
    problem: Problem, whole: Uncertainty, nothing: Uncertainty
) -> Iterator[tuple[str, str, float, Uncertainty, float]]:
    plant = problem.plant

    def alone(**changes: Any) -> Uncertainty:
        return Uncertainty(**{**vars(nothing), **changes})

    def relative(width: Any) -> float:
        return ALL_OF_ITSELF / float(width) if width else inf

    for name, width in whole.parameters.items():
        parameters = nothing.parameters | {name: width}
        yield name, "-", float(width), alone(parameters=parameters), relative(width)
    limit = whole.input_limit
    yield "input limit", "-", float(limit), alone(input_limit=limit), relative(limit)
    yield "disturbance", plant.input_units[0], float(whole.input), alone(input=whole.input), inf
    for i, (name, unit) in enumerate(zip(plant.state_names, plant.state_units, strict=True)):
        if whole.noise is not None:
            noise = jnp.zeros_like(whole.noise).at[i].set(whole.noise[i])
            yield f"measured {name}", unit, float(whole.noise[i]), alone(noise=noise), inf
    if whole.age is not None:
        longest = max(problem.config.trajectory.step.max, float(whole.age))  # of first order: no more than an interval
        yield "age", "s", float(whole.age), alone(age=whole.age), longest / float(whole.age) if whole.age else inf
