"""Text tables of anybody's tools: cells apart by commas, semicolons, tabs, bars or spaces.

# anything                        lines above the headings
# time;angle [deg]                the headings, with or without a #: the last line above the first row of numbers
0,00;12,5                         rows; a decimal comma where the comma separates nothing
"""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

from rtcd_jax.system.errors import UserError, printable

SEPARATORS = (";", "\t", "|", ",")
"""In the order in which they are tried: beside the others, a comma may be a decimal one."""
_PROBED = 20
"""Lines from which the separator is found."""
_LISTED = 40
"""Columns that an error names."""
_LONGEST = 30
"""Characters of a cell that an error shows."""

Row = tuple[int, list[str]]
"""A line's number in the file and its cells, without the spaces around them."""


class Table(NamedTuple):
    """Headings, empty where there are none, and the rows below them, read as they are asked for: once."""

    path: Path
    headings: tuple[str, ...]
    rows: Iterator[Row]


def read_table(path: Path, what: str) -> Table:
    """The table in a text file; `what` is what the file must be, for errors ("a CSV of measured states").

    Lines without content and comments between rows are left out.

    Raises:
        UserError: no such file, one that cannot be read or is no text, or nothing in it; from `rows`, a line that is
            no CSV.
    """
    text = _text(path, what)
    lines = _rows(path, text, _separator(text))
    above: list[str] = []
    for number, cells in lines:
        if _is_data(cells):
            rows = ((line, row) for line, row in chain([(number, cells)], lines) if not row[0].startswith("#"))
            return Table(path, tuple(above), rows)
        above = [cells[0].lstrip("#").strip(), *cells[1:]]
    if not above:
        raise UserError(f"{path} is empty: must be {what}")
    return Table(path, tuple(above), iter(()))


def number_in(cell: str) -> float:
    """The number in a cell, by a point or a comma. Raises ValueError for anything else; nan and inf are numbers."""
    if not cell.isascii() or "_" in cell:  # Python would take 1_0 and Arabic digits
        raise ValueError(cell)
    return float(cell.replace(",", ".") if "." not in cell else cell)


def number_or_nan(cell: str) -> float:
    """The number in a cell, nan for anything else."""
    try:
        return number_in(cell)
    except ValueError:
        return math.nan


def listed(headings: Sequence[str]) -> str:
    """Headings for an error's line, with the number of those that do not fit."""
    shown = ", ".join(printable(heading, _LONGEST) for heading in headings[:_LISTED]) or "none"
    return shown if len(headings) <= _LISTED else f"{shown} and {len(headings) - _LISTED} more"


def shown(cell: str) -> str:
    """A cell for an error's line."""
    return repr(printable(cell, _LONGEST))


def _text(path: Path, what: str) -> str:
    if not path.is_file():
        raise UserError(f"{path}: {'is a folder' if path.is_dir() else 'no such file'}; must be {what}")
    try:
        content = path.read_bytes()
        if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
            text = content.decode("utf-16")
        elif b"\x00" in content:
            raise UserError(f"{path} is no text (it has zero bytes): must be {what}")
        else:
            text = _decoded(content)
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is no text ({error.reason}): must be {what}") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    return text


def _decoded(content: bytes) -> str:
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")  # °, ü of older tools; any other bytes become headings that mean nothing


def _separator(text: str) -> str | None:
    """What separates cells: the first of SEPARATORS that half of the first lines have, None for spaces."""
    lines = [line for line in text[:100_000].splitlines() if line.strip()][:_PROBED]
    return next((mark for mark in SEPARATORS if 2 * sum(mark in line for line in lines) >= len(lines) > 0), None)


def _rows(path: Path, text: str, separator: str | None) -> Iterator[Row]:
    if separator is None:
        for number, line in enumerate(io.StringIO(text, newline=None), 1):
            if line.strip():
                yield number, line.split()
        return
    reader = csv.reader(io.StringIO(text, newline=None), delimiter=separator, skipinitialspace=True)
    while True:
        try:
            cells = next(reader, None)
        except csv.Error as error:
            raise UserError(f"{path}, line {reader.line_num}: {error}") from None
        if cells is None:
            return
        cells = [cell.strip() for cell in cells]
        if any(cells):
            yield reader.line_num, cells


def _is_data(cells: Sequence[str]) -> bool:
    """Whether the first cell that holds something is a number, or half of those that do are; no comment is."""
    filled = [cell for cell in cells if cell]
    if filled[0].startswith("#"):
        return False
    return _is_number(filled[0]) or 2 * sum(map(_is_number, filled)) >= len(filled)


def _is_number(cell: str) -> bool:
    try:
        number_in(cell)
    except ValueError:
        return False
    return True


def words(heading: str) -> list[str]:
    """The words and numbers of a heading in small letters: "poleAngle_2" gives pole, angle, 2."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", heading)
    return re.findall(r"[^\W\d_]+|\d+", apart.lower())
