"""The largest factor of each uncertainty that a stored funnel's policy still bears, by bisection."""

import csv
import dataclasses
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rtcd_jax.analysis.tolerance.box import Side, sides, stacked, with_box
from rtcd_jax.analysis.tolerance.figures import draw_tolerance
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import elite_name, read_config
from rtcd_jax.evaluation import elite_key, search_budget
from rtcd_jax.funnel import estimate_funnel
from rtcd_jax.plants import plant_of
from rtcd_jax.policy import input_jumps
from rtcd_jax.problem import Problem, make_problem
from rtcd_jax.run.format import policy_of
from rtcd_jax.system.console import Clock, Console, Progress, duration, table
from rtcd_jax.system.files import make_folder, replace, replace_json
from rtcd_jax.types import Candidate, Status, Uncertainty
from rtcd_jax.volume import VOLUMES, funnel_volume

PRECISE = 1.01
"""Ratio of the smallest factor that is not borne to the largest one that is."""
LEAST, MOST = 1e-3, 1e4
"""Factors that are tried."""
FOLDER = "tolerance"

Bears = Callable[[Float[np.ndarray, " B"]], Bool[np.ndarray, " B"]]


def tolerance_run(folder: Path, which: int | str, file: Path | None, console: Console) -> None:
    """Stores `tolerance/NNN.json`, `.csv` and the figure of one elite, and shows the table.

    The box is the run's, or that of the YAML `file`.

    Raises:
        UserError: no run folder, no such elite or one without a funnel, a box that is wrong or empty, or a folder that
            cannot be written.
    """
    elite = Elite.read(folder, which)
    problem = make_problem(with_box(read_config(folder), file))
    make_folder(folder / FOLDER)
    boxes = sides(problem)
    evaluate = _program(problem, elite)
    console.message(f"{len(boxes)} boxes in one program: compiling takes a minute or so")

    def bears(factors: Float[np.ndarray, " B"]) -> Bool[np.ndarray, " B"]:
        return np.asarray(evaluate(stacked(boxes, factors))[0])

    factors = largest_factors(bears, np.array([side.most for side in boxes]), _teller(boxes, console))
    _, volumes = evaluate(stacked(boxes, factors))
    numbers = {name: np.asarray(values) for name, values in volumes.items()}
    record = {"elite": elite_name(which), "config_hash": elite.record.get("config_hash"), "rung": "sampled",
              "uncertainty": problem.config.uncertainty.model_dump(), "precision": PRECISE - 1,
              "rows": _rows(boxes, factors, numbers)}  # fmt: skip
    place, name = folder / FOLDER, elite_name(which)
    replace_json(place / f"{name}.json", record)
    replace(place / f"{name}.csv", _csv(record["rows"]).encode())
    draw_tolerance(place, name, record)
    console.message(_table(record["rows"]))
    console.message(f"stored: {place}/{name}.json, .csv, .png and .pdf")


def largest_factors(
    bears: Bears, most: Float[np.ndarray, " B"], tell: Callable[[np.ndarray, np.ndarray], None]
) -> Float[np.ndarray, " B"]:
    """For each box the largest factor at which `bears` holds, within PRECISE; 0 where it does not even at LEAST.

    Factors double until one is not borne, or `most` is, or halve until one is; then the bracket is halved on a log
    scale, all boxes at once. What a smaller box has lost a larger one does not regain. `tell(low, high)` hears of the
    brackets.
    """
    most = np.minimum(most, MOST)
    low, high = np.zeros_like(most), np.where(bears(np.zeros_like(most)), np.inf, 0.0)
    while np.any(open_ := _open(low, high, most)):
        finite = np.where(np.isinf(high), 1.0, high)
        between = np.where(low > 0, np.sqrt(low * finite), finite / 2)
        tried = np.minimum(np.where(np.isinf(high), np.maximum(1.0, 2 * low), between), most)
        tried = np.where(open_, tried, low)
        borne = bears(tried)
        low, high = np.where(open_ & borne, tried, low), np.where(open_ & ~borne, tried, high)
        tell(low, high)
    return low


def _open(low: np.ndarray, high: np.ndarray, most: np.ndarray) -> np.ndarray:
    """Whose bracket is too wide: neither narrow, nor all that is tried borne, nor the least of it lost."""
    return (high > PRECISE * low) & (low < most) & (high > LEAST)


def _teller(boxes: Sequence[Side], console: Console) -> Callable[[np.ndarray, np.ndarray], None]:
    clock, most = Clock(), np.minimum([side.most for side in boxes], MOST)
    rounds = 0

    def tell(low: np.ndarray, high: np.ndarray) -> None:
        nonlocal rounds
        rounds += 1
        known = int(np.sum(~_open(low, high, most)))
        whole = f"{boxes[-1].name} between {low[-1]:.3g} and {high[-1]:.3g}"
        text = f"round {rounds}: {known}/{len(boxes)} factors known, {whole}  elapsed {duration(clock.elapsed)}"
        console.progress(Progress(known, len(boxes), text))

    return tell


def _program(problem: Problem, elite: Elite) -> Callable[[Uncertainty], tuple[Array, dict[str, Array]]]:
    """Of boxes [B]: whether the elite's policy has a funnel under each, and its volumes there."""
    candidate = _candidate(problem, elite)
    policy = policy_of(vars(elite), elite.record)
    jumps = input_jumps(problem, candidate, policy.trajectory)
    directions = {"directions": problem.config.elites.directions}

    def under(box: Uncertainty):
        robust = dataclasses.replace(problem, uncertainty=box)
        budget = search_budget(robust)
        budget = dataclasses.replace(budget, funnel=budget.funnel.model_copy(update=directions))
        funnel = estimate_funnel(robust, candidate, policy, elite_key(), budget)
        return funnel.status == Status.OK, funnel_volume(funnel, jumps).named

    return jax.jit(jax.vmap(under))


def _candidate(problem: Problem, elite: Elite) -> Candidate:
    """The stored candidate, as a run has it."""
    _, design = plant_of(elite.robot, elite.parameters, elite.design_units)
    searched = {name: jnp.asarray(elite.policy[name], float) for name in problem.config.policy.variables()}
    return Candidate(design, jnp.diag(jnp.asarray(elite.Q)), jnp.diag(jnp.asarray(elite.R)), searched)


def _rows(boxes: Sequence[Side], factors: np.ndarray, volumes: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """What is known of every side, with the volumes at its factor."""
    return [
        {
            "name": side.name,
            "unit": side.unit,
            "half_width": side.width,
            "factor": float(factor),
            "borne": None if side.width is None else float(factor) * side.width,
            "at_most": bool(factor >= min(side.most, MOST)),
            "volumes": {name: float(volumes[name][i]) for name in VOLUMES},
        }
        for i, (side, factor) in enumerate(zip(boxes, factors, strict=True))
    ]


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    columns = ("name", "unit", "half_width", "factor", "borne")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*columns, *VOLUMES])
    writer.writerows([*(row[name] for name in columns), *row["volumes"].values()] for row in rows)
    return text.getvalue()


def _table(rows: Sequence[dict[str, Any]]) -> str:
    shown = [
        [
            row["name"],
            "" if row["half_width"] is None else f"± {row['half_width']:.3g} {row['unit']}",
            f"{'≥ ' if row['at_most'] else ''}{row['factor']:.3g}",
            "" if row["borne"] is None else f"± {row['borne']:.3g} {row['unit']}",
            *(f"{row['volumes'][name]:.3g}" for name in ("sum", "inlet", "push")),
            "sampled",
        ]
        for row in rows
    ]
    headings = ("uncertainty", "half width", "largest factor", "borne", "sum there", "inlet", "push", "guarantee")
    return table(headings, shown, "alone, and all at once", left={"uncertainty", "guarantee"})
