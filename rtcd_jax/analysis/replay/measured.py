"""Measured motions from the CSV files of labs, in SI units."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float

from rtcd_jax.analysis.replay.columns import Column, find_columns
from rtcd_jax.system.delimited import Table, listed, number_or_nan, read_table, shown
from rtcd_jax.system.errors import UserError, printable

WHAT = "a CSV of measured states, a line of column names above its rows"
LARGEST = 1e12
"""Largest size of a time or a state that can be a measurement [SI units]."""


@final
@dataclass(frozen=True)
class Measured:
    """Times, ascending [s], and states (positions, then velocities) in SI units.

    `columns` says which column was taken for the time and for every state; `notes`, what was left out or changed.
    """

    columns: Mapping[str, Column]
    time: Float[np.ndarray, " T"]
    x: Float[np.ndarray, "T n"]
    notes: tuple[str, ...] = ()

    @property
    def states(self) -> tuple[str, ...]:
        """The names of the states."""
        return tuple(self.columns)[1:]


def read_measured(
    path: Path, states: Mapping[str, str], choices: Sequence[str] = (), start: float | None = None
) -> Measured:
    """A measured motion of a robot whose `states` are given with their units, positions first.

    Rows of zeros at the end (a recording that was stopped early) and rows that repeat a time are left out. `choices`
    are those of `--columns`, NAME=COLUMN each. The motion begins at the file's time `start` [s], which becomes 0.

    Raises:
        UserError: no such file, a column that is missing or there twice, no samples, a value that is no finite number
            (with its line), or times that fall.
    """
    table = read_table(path, WHAT)
    columns = find_columns(table, {"time": "s", **states}, choices)
    lines, rows = _samples(table, columns)
    notes = []
    if zeros := _zeros_at_the_end(rows):
        rows = rows[:-zeros]
        notes.append(f"{zeros} rows of zeros at the end left out")
    falls = np.flatnonzero(np.diff(rows[:, 0]) < 0)
    if falls.size:
        k = falls[0] + 1
        raise UserError(f"{path}, line {lines[k]}: time = {rows[k, 0]:g} after {rows[k - 1, 0]:g}: must not fall")
    repeated = np.diff(rows[:, 0], prepend=-np.inf) == 0
    if repeated.any():
        rows = rows[~repeated]
        notes.append(f"{repeated.sum()} rows with the time of the row above left out")
    if start is not None:
        early = rows[:, 0] < start
        if early.all():
            raise UserError(f"--start = {start:g}: {path} ends before that, at {rows[-1, 0]:g} s")
        rows = rows[~early] - [start, *[0.0] * len(states)]
        notes.append(f"the motion begins at {start:g} s of the file; {early.sum()} rows before that left out")
    return Measured(columns, rows[:, 0], rows[:, 1:], tuple(notes))


def unwrapped(measured: Measured, states: Mapping[str, str], first: Float[np.ndarray, " n"]) -> Measured:
    """The motion with angles that do not jump by turns, and begin within half a turn of the state `first`."""
    x, notes = measured.x.copy(), list(measured.notes)
    for i, name in _angles(states):
        x[:, i] = np.unwrap(x[:, i])
        x[:, i] -= 2 * np.pi * np.round((x[0, i] - first[i]) / (2 * np.pi))
        turned = np.abs(x[:, i] - measured.x[:, i]) > np.pi
        notes.append(f"{name} unwrapped: whole turns added to {turned.sum()} of {len(x)} samples")
    return replace(measured, x=x, notes=tuple(notes))


def jumps(measured: Measured, states: Mapping[str, str]) -> list[str]:
    """What looks like an angle that was wrapped: half a turn or more between two samples."""
    lines = []
    for i, name in _angles(states):
        steps = np.abs(np.diff(measured.x[:, i]))
        if steps.size and steps.max() >= np.pi:
            k = int(steps.argmax())
            lines.append(
                f"{name} jumps by {steps[k]:.3g} rad at t = {measured.time[k + 1]:.4g} s: if the encoder wraps, give "
                "--unwrap, since errors of angles are not wrapped here"
            )
    return lines


def _angles(states: Mapping[str, str]) -> list[tuple[int, str]]:
    return [(i, name) for i, (name, unit) in enumerate(states.items()) if unit == "rad"]


def _samples(table: Table, columns: Mapping[str, Column]) -> tuple[list[int], np.ndarray]:
    """The numbers [T 1+n] of the columns in SI units, and their lines."""
    width = math.inf if all(column.numbered for column in columns.values()) else len(table.headings)
    lines, numbers = [], []
    for line, cells in table.rows:
        if len(cells) > width and any(cells[int(width) :]):
            raise UserError(
                f"{table.path}, line {line} has {len(cells)} cells under {width} column names: choose all columns by "
                f"number, --columns {' '.join(f'{name}={k}' for k, name in enumerate(columns, 1))} perhaps"
            )
        lines.append(line)
        numbers.append([_number(table, line, cells, column) for column in columns.values()])
    if not numbers:
        raise UserError(f"{table.path} has no samples, only its columns: {listed(table.headings)}")
    return lines, np.array(numbers) * [column.scale for column in columns.values()]


def _number(table: Table, line: int, cells: Sequence[str], column: Column) -> float:
    cell = cells[column.place] if column.place < len(cells) else ""
    value = number_or_nan(cell)
    if not abs(value) <= LARGEST:
        raise UserError(
            f"{table.path}, line {line}: {printable(column.heading, 40)} = {shown(cell)}: must be a finite number, of "
            f"at most {LARGEST:g} in size"
        )
    return value


def _zeros_at_the_end(rows: np.ndarray) -> int:
    """How many rows of zeros stand below a time that is later than 0."""
    filled = np.flatnonzero(rows.any(axis=1))
    return len(rows) - 1 - int(filled[-1]) if filled.size and rows[filled[-1], 0] > 0 else 0
