"""What figures, tables and pages have in common: names, units, numbers and guarantees in words."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rtcd_jax.config.load import Config
from rtcd_jax.volume import OTHERS, VOLUMES

NONE = "–"
"""Stands where there is no number."""

_WORDS = {"inlet": "initial ellipsoid", "push": "push margin"}
_GREEK = {"alpha": "α", "beta": "β", "gamma": "γ", "phi": "φ", "psi": "ψ", "theta": "θ"}
_POWERS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


def words(name: str) -> str:
    """A stored name as it is read; the inlet is the first knot's ellipsoid."""
    return _WORDS.get(name, name.replace("_", " "))


def letter(name: str) -> str:
    """A state's name, Greek ones as letters and their rates as derivatives: fonts set dots above letters badly."""
    base = name.removesuffix("_dot")
    if base not in _GREEK:
        return name
    return _GREEK[base] if name == base else f"d{_GREEK[base]}/dt"


def quantity(name: str, unit: str) -> str:
    """An axis' label in matplotlib's mathematics, which sets the dot well."""
    base = name.removesuffix("_dot")
    if base not in _GREEK:
        return f"{name} [{unit}]"
    drawn = rf"\dot{{\{base}}}" if name != base else rf"\{base}"
    return f"${drawn}$ [{unit}]"


def volume_unit(config: Config, volume: str = "sum") -> str:
    """That of a volume, the product of the states' units with equal ones as powers; some have a second more.

    A push has the unit of an input times a second.
    """
    if volume in OTHERS:
        return OTHERS[volume].unit
    if VOLUMES[volume].push:
        return "·".join([*next(iter(config.plant.input_units.values())).split(), "s"])
    powers = Counter({"s": VOLUMES[volume].seconds})
    for unit in config.plant.states.values():
        above, _, below = unit.partition("/")
        powers[above] += 1
        powers.subtract([below] if below else [])
    above, below = (
        "·".join(
            name + ("" if power == 1 else str(power).translate(_POWERS)) for name, power in signed.items() if power > 0
        )
        for signed in (powers, {name: -power for name, power in powers.items()})
    )
    return f"{above}/{below}" if below else above


def guarantee(record: Mapping[str, Any]) -> str:
    """On what ground a funnel's record promises what; no volume stands without it."""
    if record["rung"] != "sampled":
        return str(record["rung"])
    return (
        f"sampled: failure probability at each knot ≤ {record['epsilon']:.2g} with confidence {record['confidence']:g}"
    )


def listed(name: str, value: float | Sequence[float], unit: str = "") -> str:
    """`pole mass = 0.2 kg`, `q = (10, 1)`."""
    numbers = [f"{number:.3g}" for number in np.atleast_1d(value)]
    values = numbers[0] if len(numbers) == 1 else f"({', '.join(numbers)})"
    return f"{words(name)} = {values} {unit}".rstrip()


def ratio(after: float, before: float) -> float | None:
    """`after / before`, None where that says nothing."""
    return after / before if before > 0 else None


def duration(seconds: float) -> str:
    """`2 h 5 min`, `2 min 13 s`, `7.2 s`."""
    if seconds < 60:
        return f"{seconds:.3g} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"
