"""The largest factor of each uncertainty that a stored funnel's policy still bears, by bisection."""

import csv
import dataclasses
import io
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from rtcd_jax.analysis.tolerance.box import Side, about_own_motions, sides, stacked, with_box
from rtcd_jax.analysis.tolerance.factors import MOST, PRECISE, is_open, largest_factors
from rtcd_jax.analysis.tolerance.figures import draw_tolerance
from rtcd_jax.analysis.tolerance.proved import proved_factor
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import elite_name, read_config, require_held_goal
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

FOLDER = "tolerance"


def tolerance_run(folder: Path, which: int | str, file: Path | None, console: Console, prove: bool = False) -> None:
    """Stores `tolerance/NNN.json`, `.csv` and the figure of one elite, and shows the table.

    The box is the run's, or that of the YAML `file`. The whole box has a second row where the robot's numbers may be
    constant, each robot about its own motion, and one more where it is to `prove`: what was proved lies in
    `tolerance/certificates`.

    Raises:
        UserError: no run folder, no such elite or one without a funnel, a box that is wrong or empty, or a folder that
            cannot be written.
    """
    elite = Elite.read(folder, which)
    if prove:
        require_held_goal(folder, "tolerance --prove")
    problem = make_problem(with_box(read_config(folder), file))
    make_folder(folder / FOLDER)
    boxes = sides(problem)
    evaluate = _program(problem, elite)
    console.message(f"{len(boxes)} boxes in one program: compiling takes a minute or so")

    def bears(boxes: list[Side], factors: Float[np.ndarray, " B"]) -> Bool[np.ndarray, " B"]:
        return np.asarray(evaluate(stacked(boxes, factors))[0])

    factors = largest_factors(partial(bears, boxes), np.array([side.most for side in boxes]), _teller(boxes, console))
    _, volumes = evaluate(stacked(boxes, factors))
    numbers = {name: np.asarray(values) for name, values in volumes.items()}
    place, name, box = folder / FOLDER, elite_name(which), problem.config.uncertainty
    rows = _rows(boxes, factors, numbers)
    if (own := about_own_motions(problem, boxes[-1])) is not None:
        console.message("the whole box once more, each robot about its own motion")
        factor = largest_factors(partial(bears, [own]), np.array([own.most]), _teller([own], console))
        _, there = evaluate(stacked([own], factor))
        rows += _rows([own], factor, {name: np.asarray(values) for name, values in there.items()})
    if prove:
        rows.append(rows[len(boxes) - 1] | proved_factor(folder, FOLDER, name, box, boxes[-1].most, console))
    record = {"elite": name, "config_hash": elite.record.get("config_hash"), "rung": "sampled",
              "uncertainty": box.model_dump(), "precision": PRECISE - 1, "rows": rows}  # fmt: skip
    replace_json(place / f"{name}.json", record)
    replace(place / f"{name}.csv", _csv(record["rows"]).encode())
    draw_tolerance(place, name, record)
    console.message(_table(record["rows"]))
    console.message(f"stored: {place}/{name}.json, .csv, .png and .pdf")


def _teller(boxes: Sequence[Side], console: Console) -> Callable[[np.ndarray, np.ndarray], None]:
    clock, most = Clock(), np.minimum([side.most for side in boxes], MOST)
    rounds = 0

    def tell(low: np.ndarray, high: np.ndarray) -> None:
        nonlocal rounds
        rounds += 1
        known = int(np.sum(~is_open(low, high, most)))
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
            "guarantee": "sampled",
        }
        for i, (side, factor) in enumerate(zip(boxes, factors, strict=True))
    ]


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    columns = ("name", "unit", "half_width", "factor", "borne", "guarantee")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*columns, *VOLUMES])
    writer.writerows(
        [*(row[name] for name in columns), *(row["volumes"].get(name) for name in VOLUMES)] for row in rows
    )
    return text.getvalue()


def _table(rows: Sequence[dict[str, Any]]) -> str:
    shown = [
        [
            row["name"],
            "" if row["half_width"] is None else f"± {row['half_width']:.3g} {row['unit']}",
            f"{'≥ ' if row['at_most'] else ''}{row['factor']:.3g}",
            "" if row["borne"] is None else f"± {row['borne']:.3g} {row['unit']}",
            *(f"{row['volumes'][name]:.3g}" if name in row["volumes"] else "" for name in ("sum", "inlet", "push")),
            row["guarantee"],
        ]
        for row in rows
    ]
    headings = ("uncertainty", "half width", "largest factor", "borne", "sum there", "inlet", "push", "guarantee")
    return table(headings, shown, "alone, and all at once", left={"uncertainty", "guarantee"})
