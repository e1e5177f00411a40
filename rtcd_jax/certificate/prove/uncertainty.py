"""What a certificate bears: the box of robots and what acts on them, from the `uncertainty` of a run or a file."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtcd_jax.config.load import load_uncertainty, parse_uncertainty
from rtcd_jax.config.schema import UncertaintyConfig
from rtcd_jax.elite.elite import Elite
from rtcd_jax.system.errors import UserError, closest

NONE = "none"
"""In place of a file: the proof is about one exact model."""
SYMBOLS: dict[str, dict[str, dict[str, int]]] = {
    "pendulum": {"mass": {"m": 1}, "length": {"l": 1}, "damping": {"b": 1}, "gravity": {"g": 1}},
    "cartpole": {
        "pole_mass": {"Mp": 1, "inertia_about_com": 1},
        "pole_length": {"lp": 1, "inertia_about_com": 2},
        "cart_mass": {"Mc": 1},
        "cart_damping": {"Beq": 1},
        "pivot_damping": {"Bp": 1},
        "gravity": {"g": 1},
    },
}
"""By plant and name in a configuration: the powers with which the equations' numbers scale with it."""


class Bounds(NamedTuple):
    """Least and largest values of the numbers and of the motor's limit; the rest as a claim has it.

    `rest` is the largest |y| of the goal region below which motions may stay.
    """

    parameters: dict[str, tuple[float, float]]
    limit: tuple[float, float]
    disturbance: float
    noise: list[float]
    age: float
    rest: float


def bounds_of(elite: Elite, uncertainty: UncertaintyConfig) -> Bounds:
    """What is uncertain about an elite, its relative half widths rounded outward.

    Raises:
        UserError: names that the plant does not have.
    """
    known = SYMBOLS.get(elite.plant, {})
    widths = {name: width for name, width in (uncertainty.design | uncertainty.plant).items() if width}
    for name in widths:
        if name not in known:
            raise UserError(f"uncertainty: no number of the {elite.plant} is {name!r}; {closest(name, tuple(known))}")
    if any(width >= 1 for width in (*widths.values(), uncertainty.input_limit)):
        raise UserError("uncertainty: relative half widths must be < 1")
    n = len(elite.x_goal)
    if uncertainty.noise and len(uncertainty.noise) != n:
        raise UserError(f"uncertainty.noise: has {len(uncertainty.noise)} entries, must have {n}")
    factors: dict[str, list[float]] = {}
    for name, width in widths.items():
        for symbol, power in known[name].items():
            low, high = factors.get(symbol, [1.0, 1.0])
            factors[symbol] = [low * (1 - width) ** power, high * (1 + width) ** power]
    parameters = {name: _around(value, *factors.get(name, (1.0, 1.0))) for name, value in elite.parameters.items()}
    return Bounds(
        parameters,
        _around(float(elite.u_max[0]), 1 - uncertainty.input_limit, 1 + uncertainty.input_limit),
        uncertainty.input,
        list(uncertainty.noise) or [0.0] * n,
        uncertainty.age,
        uncertainty.residual,
    )


def _around(value: float, low: float, high: float) -> tuple[float, float]:
    if low == high == 1:
        return float(value), float(value)
    ends = sorted((value * low, value * high))
    return float(np.nextafter(ends[0], -np.inf)), float(np.nextafter(ends[1], np.inf))


def uncertainty_of(elite: Elite, source: Path | None) -> UncertaintyConfig:
    """What an elite's certificate is to bear: what its run bore, or what a file says, of which NONE says nothing.

    Raises:
        UserError: a file or a record that cannot be read.
    """
    if source is not None:
        return UncertaintyConfig() if str(source) == NONE else load_uncertainty(source)
    stored = elite.record.get("uncertainty")
    return UncertaintyConfig() if stored is None else parse_uncertainty(stored, "the elite's uncertainty")
