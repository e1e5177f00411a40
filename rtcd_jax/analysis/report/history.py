"""generations.jsonl -> the course of a search: volumes, failures, and its variables in their own units."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log
from typing import Any, final

import numpy as np
from jaxtyping import Float

from rtcd_jax.analysis.report.words import letter, words
from rtcd_jax.config import settings
from rtcd_jax.config.load import Config
from rtcd_jax.config.schema import PolicyConfig, Variable

Generations = Sequence[Mapping[str, Any]]
QUANTILES = (10, 90)
"""Percentiles between which a population's spread is drawn."""
OPTIONS = {name: f"{words(name)} [{settings.unit(field)}]" for name, field in PolicyConfig.model_fields.items()}
"""What the policy's options are called."""


def column(generations: Generations, name: str) -> Float[np.ndarray, " generations"]:
    """A number of every generation, NaN where there was none."""
    return np.array([np.nan if record[name] is None else record[name] for record in generations], float)


def spread(generations: Generations) -> Float[np.ndarray, "2 generations"]:
    """`QUANTILES` of the searched volume over the feasible candidates of a generation, NaN where there are none."""
    rows = []
    for record in generations:
        values = record["volumes"][record["objective"]]
        volumes = np.array([value for value in values if value is not None], float)
        rows.append(np.percentile(volumes, QUANTILES) if volumes.size else np.full(2, np.nan))
    return np.array(rows).T


def feasible_volumes(generations: Generations) -> dict[str, Float[np.ndarray, " candidates"]]:
    """All volumes of all candidates with a funnel, of those that every generation has."""
    names = [name for name in generations[0]["volumes"] if all(name in record["volumes"] for record in generations)]
    table = {name: [volume for record in generations for volume in record["volumes"][name]] for name in names}
    volumes = {name: np.array([np.nan if v is None else v for v in values], float) for name, values in table.items()}
    whole = np.all([np.isfinite(values) for values in volumes.values()], axis=0)
    return {name: values[whole] for name, values in volumes.items()}


def front(
    objective: Float[np.ndarray, " candidates"], other: Float[np.ndarray, " candidates"]
) -> Float[np.ndarray, "2 front"]:
    """Of the candidates' volumes those that no candidate exceeds in both, the largest `objective` first."""
    order = np.lexsort((-other, -objective))
    best_before = np.maximum.accumulate(np.append(-np.inf, other[order]))[:-1]
    chosen = order[other[order] > best_before]
    return np.stack([objective[chosen], other[chosen]])


def failures(generations: Generations) -> dict[str, Float[np.ndarray, " generations"]]:
    """Shares of the candidates of every generation by status, `OK` first."""
    names = dict.fromkeys(name for record in generations for name in record["counts"])
    totals = np.array([sum(record["counts"].values()) for record in generations], float)
    ordered = sorted(names, key=lambda name: name != "OK")
    return {name: np.array([record["counts"].get(name, 0) for record in generations]) / totals for name in ordered}


def searched(config: Config) -> dict[str, tuple[Variable, str]]:
    """The free variables by their dotted names, in the order of the genome, with what they are called and units."""
    plant = config.plant
    titles = {f"design.{name}": f"{words(name)} [{unit}]" for name, unit in config.design_units.items()}
    for sign, named in (("q", plant.states), ("r", plant.input_units)):
        for i, (name, unit) in enumerate(named.items()):
            squared = f"({unit})²" if "/" in unit or " " in unit else f"{unit}²"
            titles[f"weights.{sign}.{i}"] = f"{sign}{i + 1} of {letter(name)} [1/(s {squared})]"
    titles |= {f"policy.{name}": title for name, title in OPTIONS.items()}
    return {name: (variable, titles[name]) for name, variable in config.variables().items() if variable.free}


def physical(variable: Variable, logarithmic: bool, shares: np.ndarray) -> np.ndarray:
    """The values that shares of a variable's box stand for, linearly or logarithmically."""
    if logarithmic:
        return variable.min * np.exp(shares * log(variable.max / variable.min))
    return variable.min + shares * (variable.max - variable.min)


@final
@dataclass(frozen=True)
class Course:
    """One variable through the search, in its own unit: each generation's best and its population's quantiles."""

    name: str
    title: str
    variable: Variable
    logarithmic: bool
    best: Float[np.ndarray, " generations"]
    low: Float[np.ndarray, " generations"]
    median: Float[np.ndarray, " generations"]
    high: Float[np.ndarray, " generations"]

    @property
    def window(self) -> tuple[float, float]:
        """The variable's box with a margin, on its own scale."""
        low, high = (physical(self.variable, self.logarithmic, np.array(share)) for share in (-0.05, 1.05))
        return float(low), float(high)


def courses(config: Config, generations: Generations) -> list[Course]:
    """How the search moved its variables; the best is NaN where no candidate had a funnel."""
    genomes = np.array([record["genomes"] for record in generations], float)
    best = np.full((len(generations), genomes.shape[2]), np.nan)
    for index, record in enumerate(generations):
        volumes = np.array([-1.0 if v is None else v for v in record["volumes"][record["objective"]]])
        if volumes.max() > 0:
            best[index] = genomes[index, volumes.argmax()]
    quantiles = np.percentile(genomes, (QUANTILES[0], 50, QUANTILES[1]), axis=1)
    return [
        Course(name, title, variable, log_scale, *(physical(variable, log_scale, s[:, i]) for s in (best, *quantiles)))
        for i, (name, (variable, title)) in enumerate(searched(config).items())
        for log_scale in [config.logarithmic(name)]
    ]
