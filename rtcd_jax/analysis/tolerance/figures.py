"""`tolerance/NNN.png` and `.pdf`: the largest factor of every uncertainty as bars, the weakest first."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rtcd_jax.analysis.report.canvas import GRAY, SMALL, WIDTH, blank, written
from rtcd_jax.analysis.report.reading import BLUE, VERMILION
from rtcd_jax.analysis.report.words import words

NARROWEST = 1e-2
"""Where the axis begins at the latest: a factor of zero has no place on it."""


def draw_tolerance(folder: Path, name: str, record: Mapping[str, Any]) -> list[Path]:
    """The figure of a record of `rtcd tolerance`; the files written. UserError if the folder cannot be written."""
    singles = [row for row in record["rows"] if row["half_width"] is not None]
    whole = [row for row in record["rows"] if row["half_width"] is None]
    rows = [*whole, *sorted(singles, key=lambda row: row["factor"])]
    factors = np.array([row["factor"] for row in rows])
    left = min(NARROWEST, factors[factors > 0].min(initial=1.0) / 2)
    with blank((WIDTH, 0.8 + 0.28 * len(rows))) as figure:
        axes = figure.subplots()
        colors = [*[VERMILION] * len(whole), *[BLUE] * len(singles)]
        axes.barh(np.arange(len(rows)), np.maximum(factors, left) - left, left=left, color=colors, height=0.6)
        axes.set_xscale("log")
        axes.invert_yaxis()
        axes.set_yticks(np.arange(len(rows)), [_label(row) for row in rows])
        for place, row in enumerate(rows):
            borne = "" if row["borne"] is None else f": ± {row['borne']:.3g} {row['unit']}".rstrip(" -")
            text = f" × {row['factor']:.3g}{borne}"
            axes.annotate(text, (max(row["factor"], left), place), va="center", fontsize=SMALL)
        axes.axvline(1, color=GRAY, ls="--", lw=1)
        axes.margins(x=0.25)
        axes.set_xlabel(f"largest factor of the box that elite {record['elite']} bears")
        return written(figure, folder, name)


def _label(row: Mapping[str, Any]) -> str:
    return f"{words(row['name'])}, {row.get('guarantee', 'sampled')}"
