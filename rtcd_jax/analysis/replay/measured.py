"""Measured motions as CSV files with the columns of the DFKI toolkits: time, positions, velocities, torques.

    one joint    time,pos,vel,torque
    two joints   time,pos1,pos2,vel1,vel2,tau1,tau2

SI units, the time [s] from the start of the swing-up. Torques and other columns may be absent and are not looked at.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float

from rtcd_jax.system.errors import UserError

TORQUES = {1: ["torque"], 2: ["tau1", "tau2"]}


@final
@dataclass(frozen=True)
class Measured:
    """Times, ascending [s], and states (positions, then velocities) in SI units."""

    columns: tuple[str, ...]
    time: Float[np.ndarray, " T"]
    x: Float[np.ndarray, "T n"]


def columns_of(n: int) -> list[str]:
    """The columns that a file of `n` states needs, in the state's order behind the time."""
    joints = n // 2
    numbers = [""] if joints == 1 else [str(i + 1) for i in range(joints)]
    return ["time", *(f"{kind}{number}" for kind in ("pos", "vel") for number in numbers)]


def read_measured(path: Path, n: int) -> Measured:
    """A measured motion of a robot with `n` states.

    Raises:
        UserError: no such file, a column that is missing, no samples, a value that is no finite number (with its
            line), or times that do not rise.
    """
    needed = columns_of(n)
    lines = _lines(path)
    head = [name.strip() for name in lines[0]]
    missing = [name for name in needed if name not in head]
    if missing:
        valid = ",".join([*needed, *TORQUES.get(n // 2, [])])
        raise UserError(f"{path} lacks the column{'s'[: len(missing) > 1]} {', '.join(missing)}: must have {valid}")
    rows = [(number, line) for number, line in enumerate(lines[1:], 2) if line]
    if not rows:
        raise UserError(f"{path} has no samples: only its first line, the columns")
    places = [head.index(name) for name in needed]
    numbers = np.array([[_number(path, line, row, place, head) for place in places] for line, row in rows])
    time, x = numbers[:, 0], numbers[:, 1:]
    late = np.flatnonzero(np.diff(time) <= 0)
    if late.size:
        first, (line, _) = late[0], rows[late[0] + 1]
        raise UserError(f"{path}, line {line}: time = {time[first + 1]:g} after {time[first]:g}: must rise")
    return Measured(tuple(needed), time, x)


def jumps(measured: Measured, units: Sequence[str]) -> list[str]:
    """What looks like an angle that was wrapped: half a turn or more between two samples."""
    found = []
    for i, unit in enumerate(units[: len(units) // 2]):
        steps = np.abs(np.diff(measured.x[:, i]))
        if unit == "rad" and steps.size and steps.max() >= np.pi:
            k = int(steps.argmax())
            found.append(
                f"{measured.columns[1 + i]} jumps by {steps[k]:.3g} rad at t = {measured.time[k + 1]:.4g} s: if the "
                "encoder wraps, unwrap it first, since errors of angles are not wrapped here"
            )
    return found


def _lines(path: Path) -> list[list[str]]:
    if not path.is_file():
        raise UserError(f"{path}: no such file; must be a CSV of measured states")
    try:
        lines = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"cannot read {path}: {error}") from error
    if not lines:
        raise UserError(f"{path} is empty: must begin with the columns' names")
    return lines


def _number(path: Path, line: int, row: Sequence[str], place: int, head: Sequence[str]) -> float:
    text = row[place].strip() if place < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise UserError(f"{path}, line {line}: {head[place]} = {text!r}: must be a finite number")
    return value
