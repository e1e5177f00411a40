"""What a certificate bears: the box of robots and what acts on them, from the `uncertainty` of a run or a file."""

from pathlib import Path
from typing import NamedTuple

from rtcd_jax.certificate.prove.robot import around, claimed_robot
from rtcd_jax.config.load import load_uncertainty, parse_uncertainty
from rtcd_jax.config.schema import UncertaintyConfig
from rtcd_jax.elite.elite import Elite
from rtcd_jax.system.errors import UserError

NONE = "none"
"""In place of a file: the proof is about one exact model."""


class Bounds(NamedTuple):
    """Least and largest values of the numbers and of the motor's limit; the rest as a claim has it.

    `rest` is the largest |y| of the goal region below which motions may stay. `moving`: the numbers are constant, and
    each robot's funnel is about its own motion.
    """

    parameters: dict[str, tuple[float, float]]
    limit: tuple[float, float]
    disturbance: float
    noise: list[float]
    age: float
    rest: float
    moving: bool = False


def bounds_of(elite: Elite, uncertainty: UncertaintyConfig) -> Bounds:
    """What is uncertain about an elite, its relative half widths rounded outward.

    Raises:
        UserError: names that the robot does not have, numbers of which no proof bears a range, or a robot of which
            there is no claim.
    """
    robot, widths = claimed_robot(elite), uncertainty.design | uncertainty.plant
    if any(width >= 1 for width in (*widths.values(), uncertainty.input_limit)):
        raise UserError("uncertainty: relative half widths must be < 1")
    n = len(elite.x_goal)
    if uncertainty.noise and len(uncertainty.noise) != n:
        raise UserError(f"uncertainty.noise: has {len(uncertainty.noise)} entries, must have {n}")
    return Bounds(
        robot.ranges(widths),
        around(robot.limit, uncertainty.input_limit),
        uncertainty.input,
        list(uncertainty.noise) or [0.0] * n,
        uncertainty.age,
        uncertainty.residual,
        uncertainty.center == "moving" and any(widths.values()),
    )


def uncertainty_of(elite: Elite, source: Path | UncertaintyConfig | None) -> UncertaintyConfig:
    """What an elite's certificate is to bear: what its run bore, or else `source`, of whose files NONE says nothing.

    Raises:
        UserError: a file or a record that cannot be read.
    """
    if isinstance(source, UncertaintyConfig):
        return source
    if source is not None:
        return UncertaintyConfig() if str(source) == NONE else load_uncertainty(source)
    stored = elite.record.get("uncertainty")
    return UncertaintyConfig() if stored is None else parse_uncertainty(stored, "the elite's uncertainty")
