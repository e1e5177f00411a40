"""A run in two figures, `figures/NAME.png` and `.pdf`: the best funnel beside the initial one, and the search.

A funnel's ellipsoids {x : (x - x_k)' S_k (x - x_k) <= rho_k} are shown by their projections onto the planes of a
coordinate and its velocity. matplotlib is imported at the first figure, and its global state is left as it was.
"""

import contextlib
import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

from rtcd_jax.config import Config
from rtcd_jax.errors import UserError
from rtcd_jax.files import replace, writing
from rtcd_jax.storage import elite_names, read_config, read_elite, read_generations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

VOLUMES = ("sum", "integral", "inlet", "geometric_mean")

# Okabe and Ito's colors: told apart by all kinds of color vision.
_BLACK, _BLUE, _VERMILION, _GREEN, _GRAY, _LIGHT = "#000000", "#0072B2", "#D55E00", "#009E73", "#8A8A8A", "#DDDDDD"
_STYLE = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.useoffset": False,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "pdf.fonttype": 42,  # text that can be searched and edited
}
_WIDTH = 7.2  # [in], the text width of a two-column paper
_DPI = 200
_GREEK = {"alpha", "beta", "gamma", "phi", "psi", "theta"}


@final
@dataclass(frozen=True)
class Drawn:
    """What a figure tells of one funnel: arrays as in the run folder, `volumes` by name, `record` beside them.

    `label` and `color` are its own in all panels.
    """

    label: str
    color: str
    time: Float[np.ndarray, " knots"]
    x: Float[np.ndarray, "knots n"]
    S: Float[np.ndarray, "knots n n"]
    rho: Float[np.ndarray, " knots"]
    per_knot: Float[np.ndarray, " knots"]
    volumes: Mapping[str, float]
    record: Mapping[str, Any]

    @classmethod
    def of(cls, label: str, color: str, arrays: Mapping[str, np.ndarray], record: Mapping[str, Any]) -> "Drawn":
        """A funnel from its stored arrays and record. Raises UserError if something is missing."""
        needed = ["time", "x", "S", "rho", "volumes_per_knot", *(f"volumes_{name}" for name in VOLUMES)]
        missing = [name for name in needed if name not in arrays]
        missing += [name for name in ("design", "weights", "rung") if name not in record]
        if missing:
            raise UserError(f"the {label} candidate lacks {', '.join(missing)}")
        volumes = {name: float(arrays[f"volumes_{name}"]) for name in VOLUMES}
        shapes = {name: arrays[name] for name in ("time", "x", "S", "rho")}
        return cls(label, color, **shapes, per_knot=arrays["volumes_per_knot"], volumes=volumes, record=record)


def draw_funnels(folder: Path) -> list[Path]:
    """Draws the best funnel beside the initial one, on the same axes; the files written.

    Above, the nominal motion and the ellipsoids of all knots in every plane of a coordinate and its velocity; below,
    the volume of every ellipsoid over time. Where the initial candidate has no funnel, the figure says so.

    Raises:
        UserError: no run folder, no elites yet, an elite without a funnel or with something missing, or a folder
            that cannot be written.
    """
    config = read_config(folder)
    best = _best(folder)
    initial, absence = _initial(folder)
    shown = [best] if initial is None else [initial, best]
    with _figure((_WIDTH, 2.9 * len(planes(best.x.shape[1])) + 3.1)) as figure:
        _funnel_panels(figure, config, shown, absence)
        return _written(figure, folder, "funnel")


def draw_convergence(folder: Path) -> list[Path]:
    """Draws the volumes, the feasible share and the step size over the generations of a run; the files written.

    Raises:
        UserError: no run folder, no generations yet, or a folder that cannot be written.
    """
    config = read_config(folder)
    generations = read_generations(folder)
    if not generations:
        raise UserError(f"{folder} has no generations yet: begin the run first")
    with _figure((_WIDTH, 5.4)) as figure:
        _convergence_panels(figure, config, generations)
        return _written(figure, folder, "convergence")


def planes(n: int) -> list[tuple[int, int]]:
    """Indices of the coordinate and of its velocity, for x = (q_1 .. q_{n/2}, their rates). ValueError for odd n."""
    if n % 2:
        raise ValueError(f"states must be coordinates and their velocities, got an odd number of them: {n}")
    return [(i, i + n // 2) for i in range(n // 2)]


def projections(
    S: Float[np.ndarray, "knots n n"], rho: Float[np.ndarray, " knots"], plane: tuple[int, int]
) -> Float[np.ndarray, "knots 2 2"]:
    """M such that {d' M^-1 d <= 1} is the shadow of {x' S x <= rho} on a plane: that block of rho S^-1."""
    i = np.asarray(plane)
    return rho[:, None, None] * np.linalg.inv(S)[:, i[:, None], i]


def outlines(
    centers: Float[np.ndarray, "knots 2"], M: Float[np.ndarray, "knots 2 2"], points: int = 181
) -> Float[np.ndarray, "knots points 2"]:
    """Closed curves of `points` points on the boundaries of {x : (x - c)' M^-1 (x - c) <= 1}."""
    angle = np.linspace(0, 2 * np.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    # M = L L' makes the ellipse the image of the unit disk under L.
    return centers[:, None] + np.swapaxes(np.linalg.cholesky(M) @ circle, 1, 2)


def _best(folder: Path) -> Drawn:
    if not elite_names(folder):
        raise UserError(f"{folder} has no elites yet: finish the run first, by the command that began it")
    arrays, record = read_elite(folder / "elites", "000")
    if record["status"] != "OK":
        raise UserError(f"{folder / 'elites'}: 000 has no funnel ({record['status']})")
    return Drawn.of("best", _VERMILION, arrays, record)


def _initial(folder: Path) -> tuple[Drawn | None, str]:
    """The initial candidate's funnel, or None and the reason."""
    if not (folder / "initial.json").is_file():
        return None, "no initial candidate was stored"
    arrays, record = read_elite(folder, "initial")
    if record["status"] != "OK":
        return None, f"the initial candidate has no funnel ({record['status']})"
    return Drawn.of("initial", _BLUE, arrays, record), ""


def _funnel_panels(figure: "Figure", config: Config, shown: Sequence[Drawn], absence: str) -> None:
    pairs = planes(shown[0].x.shape[1])
    grid = figure.add_gridspec(len(pairs) + 1, len(shown), height_ratios=[2.9] * len(pairs) + [2.0])
    colors = _time_colors(max(float(funnel.time[-1]) for funnel in shown))
    panels = []
    for row, plane in enumerate(pairs):
        view = _view(shown, plane)
        for column, funnel in enumerate(shown):
            axes = figure.add_subplot(grid[row, column])
            _draw_plane(axes, config, funnel, plane, view, colors)
            if row == 0:
                axes.set_title(_title(config, funnel))
            panels.append(axes)
    figure.colorbar(colors, ax=panels, label="time [s]", pad=0.02, aspect=30 * len(pairs))
    figure.legend(**_told_once(panels), loc="outside upper center", title=absence or None)
    volumes = figure.add_subplot(grid[-1, :])
    _draw_volumes(volumes, config, shown)
    # The figure's legend, not the panel's: its width must not squeeze the panels.
    figure.legend(handles=volumes.lines, loc="outside lower center")


def _told_once(panels: Sequence["Axes"]) -> dict[str, Any]:
    """The entries of a legend, in one row, for all that the panels have in common."""
    found = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in panels]
    handles = {label: handle for pairs in found for handle, label in pairs}
    return {"handles": list(handles.values()), "labels": list(handles), "ncols": len(handles)}


def _time_colors(duration: float) -> "ScalarMappable":
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    # Without the brightest tenth, which is lost on white paper.
    shades = ListedColormap(colormaps["viridis"](np.linspace(0, 0.9, 256)))
    return ScalarMappable(Normalize(0, duration), shades)


def _view(shown: Sequence[Drawn], plane: tuple[int, int]) -> Float[np.ndarray, "2 2"]:
    """Lower and upper corner of a plane's window: all funnels with a margin."""
    reach = [_shadow(funnel, plane).reshape(-1, 2) for funnel in shown]
    points = np.concatenate([*reach, *(funnel.x[:, plane] for funnel in shown)])
    low, high = points.min(0), points.max(0)
    return np.stack([low, high]) + 0.04 * np.outer([-1, 1], high - low)


def _shadow(funnel: Drawn, plane: tuple[int, int]) -> Float[np.ndarray, "knots points 2"]:
    return outlines(funnel.x[:, plane], projections(funnel.S, funnel.rho, plane))


def _draw_plane(
    axes: "Axes", config: Config, funnel: Drawn, plane: tuple[int, int], view: np.ndarray, colors: "ScalarMappable"
) -> None:
    from matplotlib.collections import PolyCollection

    shades = colors.to_rgba(funnel.time)
    faces = shades * np.array([1, 1, 1, 0.05])
    axes.add_collection(PolyCollection(list(_shadow(funnel, plane)), facecolors=faces, edgecolors=shades, lw=0.6))
    axes.plot(*funnel.x[:, plane].T, color=_BLACK, label="nominal motion")
    # An open circle, so that small ellipsoids at the start, and the goal where it lies there too, are seen inside it.
    for point, marker, fill, name in (
        (config.task.start, "o", "none", "start"),
        (config.task.goal, "*", "white", "goal"),
    ):
        position = [[point[i]] for i in plane]
        axes.plot(*position, marker, mfc=fill, mec=_BLACK, ms=9, ls="none", label=name, zorder=4)
    _draw_limits(axes, [config.task.state_limits[i] for i in plane], view)
    axes.set(xlim=view[:, 0], ylim=view[:, 1])
    states = list(config.plant.states.items())
    axes.set(xlabel=_quantity(*states[plane[0]]), ylabel=_quantity(*states[plane[1]]))


def _draw_limits(axes: "Axes", limits: Sequence[float], view: np.ndarray) -> None:
    """Dashed lines at the limits on |x_i| that the window shows."""
    for lines, limit, (low, high) in zip((axes.axvline, axes.axhline), limits, view.T, strict=True):
        for value in (-limit, limit):
            if low <= value <= high:
                lines(value, color=_GRAY, ls="--", lw=1, label="state limit")


def _draw_volumes(axes: "Axes", config: Config, shown: Sequence[Drawn]) -> None:
    for funnel in shown:
        axes.semilogy(funnel.time, funnel.per_knot, ".-", ms=4, color=funnel.color, label=_told(config, funnel))
    axes.set(xlabel="time [s]", ylabel=f"volume of a knot's\nellipsoid [{_unit(config)}]")
    axes.grid(axis="y", lw=0.4, color=_LIGHT)
    if len(shown) == 2:
        first, second = shown
        ratios = [f"{_words(name)} × {second.volumes[name] / first.volumes[name]:.3g}" for name in VOLUMES]
        axes.set_title(f"{second.label} over {first.label}: {', '.join(ratios)}")


def _told(config: Config, funnel: Drawn) -> str:
    """The four volumes with their rung, which no volume is told without."""
    told = [f"{_words(name)} {funnel.volumes[name]:.4g} {_unit(config, name)}" for name in VOLUMES]
    return f"{funnel.label}: {', '.join(told)}\n{_rung(funnel.record)}"


def _rung(record: Mapping[str, Any]) -> str:
    if record["rung"] != "sampled":
        return str(record["rung"])
    return (
        f"sampled: failure probability at each knot ≤ {record['epsilon']:.2g} with confidence {record['confidence']:g}"
    )


def _title(config: Config, funnel: Drawn) -> str:
    design = [_number(name, value, config.plant.design[name]) for name, value in funnel.record["design"].items()]
    weights = [_number(name, value) for name, value in funnel.record["weights"].items()]
    return "\n".join([funnel.label, ", ".join(design), ", ".join(weights)])


def _number(name: str, value: float | Sequence[float], unit: str = "") -> str:
    """`pole mass = 0.2 kg`, `q = (10, 1)`."""
    numbers = [f"{number:.3g}" for number in np.atleast_1d(value)]
    told = numbers[0] if len(numbers) == 1 else f"({', '.join(numbers)})"
    return f"{_words(name)} = {told} {unit}".rstrip()


def _quantity(name: str, unit: str) -> str:
    """An axis' label: Greek names as letters, `_dot` as a dot above them."""
    base = name.removesuffix("_dot")
    if base not in _GREEK:
        return f"{name} [{unit}]"
    letter = rf"\dot{{\{base}}}" if name != base else rf"\{base}"
    return f"${letter}$ [{unit}]"


def _unit(config: Config, volume: str = "sum") -> str:
    """That of a volume, the product of the states' units with equal ones as powers; the integral has a second more."""
    powers = Counter({"s": 1} if volume == "integral" else {})
    for unit in config.plant.states.values():
        above, _, below = unit.partition("/")
        powers[above] += 1
        powers.subtract([below] if below else [])
    above, below = (
        "·".join(name if power == 1 else f"{name}$^{power}$" for name, power in signed.items() if power > 0)
        for signed in (powers, {name: -power for name, power in powers.items()})
    )
    return f"{above}/{below}" if below else above


def _words(name: str) -> str:
    return name.replace("_", " ")


def _convergence_panels(figure: "Figure", config: Config, generations: Sequence[Mapping[str, Any]]) -> None:
    volumes, share, sigma = figure.subplots(3, 1, sharex=True, height_ratios=[3, 1, 1])
    index = _column(generations, "index")
    for name, color, style in (("best_so_far", _VERMILION, "-"), ("best", _BLUE, "."), ("median", _GREEN, ".--")):
        volumes.plot(index, _column(generations, name), style, ms=5, color=color, label=_words(name))
    share.plot(index, _column(generations, "feasible"), ".-", ms=5, color=_BLACK)
    sigma.plot(index, _column(generations, "sigma"), ".-", ms=5, color=_BLACK)
    restarts = index[np.diff(_column(generations, "restarts"), prepend=0) > 0]
    for axes in (volumes, share, sigma):
        axes.grid(axis="y", lw=0.4, color=_LIGHT)
        label = "restart" if restarts.size else "_"
        axes.vlines(restarts, 0, 1, transform=axes.get_xaxis_transform(), color=_GRAY, ls=":", lw=1, label=label)
    _wide(volumes)
    _wide(sigma)
    search = config.search
    volumes.set_title(f"{config.plant.name}, {search.mode} search, population {search.population}, seed {search.seed}")
    volumes.set_ylabel(f"volume ({_words(search.objective)}) [{_unit(config, search.objective)}]")
    volumes.legend(title="sampled, as the search saw it", title_fontsize=_STYLE["legend.fontsize"])
    share.set(ylabel="feasible\nshare [-]", ylim=(-0.05, 1.05))
    sigma.set(ylabel="step size\n[box widths]", xlabel="generation")
    sigma.xaxis.get_major_locator().set_params(integer=True)


def _wide(axes: "Axes") -> None:
    """A logarithmic axis for positive numbers of more than one decade, a linear one for fewer."""
    numbers = np.concatenate([line.get_ydata() for line in axes.lines])
    numbers = numbers[np.isfinite(numbers)]
    if numbers.size and 0 < 10 * numbers.min() < numbers.max():
        axes.set_yscale("log")


def _column(generations: Sequence[Mapping[str, Any]], name: str) -> Float[np.ndarray, " generations"]:
    """A number of every generation, NaN where there was none."""
    return np.array([np.nan if record[name] is None else record[name] for record in generations], float)


@contextlib.contextmanager
def _figure(size: tuple[float, float]) -> Iterator["Figure"]:
    """A figure that no window and no other figure knows, drawn in the style of all figures."""
    from matplotlib import style
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with style.context(["default", _STYLE]):
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure


def _written(figure: "Figure", folder: Path, name: str) -> list[Path]:
    """Writes the figure in both formats, equal figures as equal bytes."""
    results = folder / "figures"
    with writing(results):
        results.mkdir(exist_ok=True)
    paths = []
    for suffix, undated in (("png", {"Software": None}), ("pdf", {"CreationDate": None})):
        content = io.BytesIO()
        figure.savefig(content, format=suffix, metadata=undated)
        paths.append(results / f"{name}.{suffix}")
        replace(paths[-1], content.getvalue())
    return paths
