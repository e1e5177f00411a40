"""matplotlib as all print figures use it: one style, no window, equal figures as equal bytes."""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rtcd_jax.system.files import make_folder, replace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH = 7.2
"""[in], the text width of a two-column paper."""
BLACK, GRAY, LIGHT = "#000000", "#8A8A8A", "#DDDDDD"
SMALL = 8
"""Font size of legends [pt]."""

_STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "legend.fontsize": SMALL,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "pdf.fonttype": 42,  # text that can be searched and edited
}
_DPI = 200


def logarithmic(axes: "Axes") -> None:
    """A logarithmic y axis whose few labels are plain numbers, for small panels."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3), numticks=5))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


@contextlib.contextmanager
def blank(size: tuple[float, float]) -> Iterator["Figure"]:
    """A figure [in] that no window and no other figure knows, drawn in the style of all figures."""
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with style.context(["default", _STYLE]):
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def written(figure: "Figure", folder: Path, name: str) -> list[Path]:
    """Writes NAME.png and NAME.pdf; UserError if the folder cannot be written."""
    make_folder(folder)
    paths = []
    for suffix, undated in (("png", {"Software": None}), ("pdf", {"CreationDate": None})):
        content = io.BytesIO()
        figure.savefig(content, format=suffix, metadata=undated)
        paths.append(folder / f"{name}.{suffix}")
        replace(paths[-1], content.getvalue())
    return paths
