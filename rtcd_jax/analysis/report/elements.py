"""The page's elements as HTML: sections, places of plots, remarks, tables, numbers."""

import html

from rtcd_jax.analysis.report.tables import Cell, Table
from rtcd_jax.analysis.report.words import NONE

LONGEST = 40
"""Characters of a cell that is not wrapped."""
FEW = 50
"""Cells of a table that a phone shows as one card a row; larger ones scroll."""
_NUMBER, _LONG = ' class="number"', ' class="long"'


def section(title: str, *parts: str) -> str:
    """A titled part of the page."""
    return f"<section><h2>{html.escape(title)}</h2>\n{''.join(parts)}\n</section>"


def place(name: str, size: str = "") -> str:
    """Where page.js draws the plot of that name."""
    return f'<div class="plot {size}" data-figure="{name}"></div>'


def note(text: str) -> str:
    """A small remark."""
    return f'<p class="note">{html.escape(text)}</p>'


def table(table: Table, folds: bool = False) -> str:
    """A table that a click on a heading sorts; on a phone one card a row if it is small or `folds`, else it scrolls."""
    heads = "".join(
        f'<th scope="col"{_NUMBER * numeric}><button type="button">{html.escape(head)}</button></th>'
        for head, numeric in zip(table.heads, table.numeric, strict=True)
    )
    rows = "\n".join(f"<tr>{''.join(map(_cell, row, table.numeric, table.heads))}</tr>" for row in table.rows)
    fold = " fold" * (folds or len(table.rows) * len(table.heads) <= FEW)
    head = f"<thead><tr>{heads}</tr></thead>"
    return f'<div class="scroll shaded{fold}"><table>\n{head}\n<tbody>\n{rows}\n</tbody></table></div>'


def _cell(value: Cell, numeric: bool, head: str) -> str:
    named = f' data-head="{html.escape(head)}"'
    if isinstance(value, str):
        return f"<td{_LONG * (len(value) > LONGEST)}{named}>{html.escape(value)}</td>"
    sorted_by = " data-none" if value is None else f' data-value="{value!r}"'
    return f"<td{_NUMBER * numeric}{sorted_by}{named}>{four_digits(value)}</td>"


def four_digits(value: float | int | None) -> str:
    """A number as it is read."""
    return NONE if value is None else f"{value}" if isinstance(value, int) else f"{value:.4g}"
