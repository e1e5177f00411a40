"""What the figures draw is what the run folder holds: shadows of ellipsoids, volumes with their rung, the search."""

import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import yaml
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from rtcd_jax import config as configuration
from rtcd_jax.errors import UserError
from rtcd_jax.report import draw_convergence, draw_funnels
from rtcd_jax.report.figures import outlines, planes, projections
from rtcd_jax.storage import RunFolder

KNOTS = 7
CARTPOLE = """\
plant: {name: cartpole}
task: {start: [0, 3.14, 0, 0], goal: [0, 0, 0, 0], state_limits: [0.3, .inf, .inf, .inf]}
design: {pole_length: {initial: 0.2, min: 0.17, max: 0.3}, pole_mass: {initial: 0.2, min: 0.12, max: 0.3}}
weights:
  q: [{initial: 10, min: 1, max: 20}, {initial: 10, min: 1, max: 20}, {initial: 1, min: 1, max: 1}, {initial: 1, min: 1, max: 1}]
  r: [{initial: 10, min: 5, max: 15}]
"""  # noqa: E501 (YAML of one variable a line would hide the rest)
YAMLS = {"pendulum": configuration.EXAMPLE, "cartpole": CARTPOLE}


def experiment(plant="pendulum", **changes):
    data = yaml.safe_load(YAMLS[plant])
    return configuration.parse(data | {section: data.get(section, {}) | new for section, new in changes.items()})


def random_values(n, seed=0):
    """Symmetric positive definite matrices [KNOTS n n] and levels [KNOTS], no axis aligned with another."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(KNOTS, n, n))
    return root @ np.swapaxes(root, 1, 2) + np.eye(n), random.uniform(0.05, 0.2, KNOTS)


def candidate(config, seed=0, scale=1.0, **changes):
    """A funnel as a run stores it: from start to goal, its ellipsoids random; the volumes are marks, not measured."""
    S, rho = random_values(len(config.task.start), seed)
    start, goal = np.array(config.task.start), np.array(config.task.goal)
    per_knot = scale * np.geomspace(0.01, 10, KNOTS)
    arrays = {
        "time": 0.1 * scale * np.arange(KNOTS),
        "x": start + (goal - start) * np.linspace(0, 1, KNOTS)[:, None],
        "S": S,
        "rho": scale * rho,
        "volumes_sum": np.array(111.0 * scale),
        "volumes_integral": np.array(22.0 * scale),
        "volumes_inlet": np.array(0.3 * scale),
        "volumes_geometric_mean": np.array(4.0 * scale),
        "volumes_per_knot": per_knot,
    }
    record = {
        "status": "OK",
        "design": {name: variable.initial for name, variable in config.design.items()},
        "weights": {letter: [variable.initial for variable in found] for letter, found in config.weights},
        "rung": "sampled",
        "epsilon": 0.0023,
        "confidence": 0.99,
    }
    return arrays, record | changes


def generation(index, **changes):
    numbers = {"best": 100.0 + index, "median": 60.0, "best_so_far": 100.0 + index, "feasible": 0.9, "sigma": 0.3}
    return {"index": index, "restarts": 0} | numbers | changes


def run_folder(path, config, initial=None, best=None, generations=()):
    with RunFolder.open(path, config) as folder:
        if initial:
            folder.write_initial(*initial)
        if best:
            folder.write_elites([best])
        for record in generations:
            folder.append(record)
    return path


@pytest.fixture(params=["pendulum", "cartpole"])
def run(request, tmp_path):
    """A finished run's folder with its configuration."""
    config = experiment(request.param)
    return run_folder(tmp_path / "run", config, candidate(config), candidate(config, 1, 3.0)), config


@pytest.fixture
def figures(monkeypatch):
    """The figures that were to be saved, as matplotlib's objects; the files stay empty, which saves the seconds."""
    saved = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: saved.append(self))
    return saved


def panels(figure):
    """The axes that show ellipsoids, row by row."""
    return [axes for axes in figure.axes if any(isinstance(drawn, PolyCollection) for drawn in axes.collections)]


def texts(figure):
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def lines(axes, label):
    return [line for line in axes.lines if line.get_label() == label]


@pytest.mark.parametrize(("n", "plane"), [(2, (0, 1)), (4, (0, 2)), (4, (1, 3))])
def test_the_shadow_holds_the_ellipsoid_and_touches_it(n, plane):
    S, rho = random_values(n)
    M = projections(S, rho, plane)
    # Any boundary point of the ellipsoid: x = sqrt(rho) L^-T y, |y| = 1, for S = L L'.
    y = np.random.default_rng(2).normal(size=(500, n))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    x = np.sqrt(rho)[:, None, None] * (y @ np.linalg.inv(np.linalg.cholesky(S)))
    np.testing.assert_allclose(np.einsum("ksi,kij,ksj->ks", x, S, x), rho[:, None] * np.ones(500))
    assert np.max(_level(M, x[..., list(plane)])) <= 1 + 1e-12
    # Farthest in a direction e of the plane is x = sqrt(rho / e' S^-1 e) S^-1 e: its shadow lies on the outline.
    e = np.zeros((60, n))
    e[:, list(plane)] = np.random.default_rng(3).normal(size=(60, 2))
    toward = e @ np.linalg.inv(S)
    x = np.sqrt(rho[:, None] / np.einsum("ksi,si->ks", toward, e))[..., None] * toward
    np.testing.assert_allclose(np.einsum("ksi,kij,ksj->ks", x, S, x), rho[:, None] * np.ones(60))
    np.testing.assert_allclose(_level(M, x[..., list(plane)]), 1)


def _level(M, d):
    return np.einsum("ksi,kij,ksj->ks", d, np.linalg.inv(M), d)


def test_an_outline_is_the_closed_boundary_about_its_center():
    S, rho = random_values(2)
    centers = np.random.default_rng(4).normal(size=(KNOTS, 2))
    curves = outlines(centers, projections(S, rho, (0, 1)))
    offsets = curves - centers[:, None]
    np.testing.assert_allclose(
        np.einsum("kpi,kij,kpj->kp", offsets, S, offsets), np.tile(rho[:, None], curves.shape[1])
    )
    np.testing.assert_allclose(curves[:, 0], curves[:, -1])
    x, y = np.moveaxis(offsets, -1, 0)
    area = 0.5 * np.sum(x[:, :-1] * y[:, 1:] - x[:, 1:] * y[:, :-1], axis=1)
    np.testing.assert_allclose(area, np.pi * rho / np.sqrt(np.linalg.det(S)), rtol=1e-3)


def test_planes_pair_every_coordinate_with_its_velocity():
    assert planes(2) == [(0, 1)]
    assert planes(4) == [(0, 2), (1, 3)]
    with pytest.raises(ValueError, match="got an odd number of them: 3"):
        planes(3)


def test_every_panel_draws_the_shadows_of_its_own_funnel(run, figures):
    folder, config = run
    draw_funnels(folder)
    shown = [candidate(config)[0], candidate(config, 1, 3.0)[0]]
    pairs = planes(len(config.task.start))
    expected = [(arrays, plane) for plane in pairs for arrays in shown]
    for axes, (arrays, plane) in zip(panels(figures[0]), expected, strict=True):
        (ellipses,) = [drawn for drawn in axes.collections if isinstance(drawn, PolyCollection)]
        centers = arrays["x"][:, plane]
        curves = outlines(centers, projections(arrays["S"], arrays["rho"], plane))
        for path, curve in zip(ellipses.get_paths(), curves, strict=True):
            np.testing.assert_allclose(path.vertices[: len(curve)], curve)
        (nominal,) = lines(axes, "nominal motion")
        np.testing.assert_array_equal(nominal.get_xydata(), centers)
        for name, point in (("start", config.task.start), ("goal", config.task.goal)):
            (mark,) = lines(axes, name)
            np.testing.assert_array_equal(mark.get_xydata()[0], [point[i] for i in plane])


def test_the_panels_of_a_row_share_their_window_and_it_holds_both_funnels(run, figures):
    folder, config = run
    draw_funnels(folder)
    drawn = panels(figures[0])
    assert len(drawn) == len(config.task.start)
    for left, right in zip(drawn[::2], drawn[1::2], strict=True):
        assert (left.get_xlim(), left.get_ylim()) == (right.get_xlim(), right.get_ylim())
    for axes in drawn:
        vertices = np.concatenate([path.vertices for drawn in axes.collections for path in drawn.get_paths()])
        low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
        assert np.all((low < vertices) & (vertices < high))


def test_colors_tell_the_same_time_in_both_columns(tmp_path, figures):
    """The best lasts three times as long here, so its third knot is as late as the initial's seventh."""
    config = experiment()
    draw_funnels(run_folder(tmp_path / "run", config, candidate(config), candidate(config, 1, 3.0)))
    initial, best = (axes.collections[0].get_edgecolor() for axes in panels(figures[0]))
    np.testing.assert_array_equal(initial[6], best[2])
    assert not np.array_equal(initial[6], best[6])


@pytest.mark.parametrize(
    ("limits", "visible"),
    [
        ([1.0, 0.01], {(1.0, 0), (0, 0.01), (0, -0.01)}),
        ([float("inf"), 0.01], {(0, 0.01), (0, -0.01)}),
        ([100.0, 100.0], set()),
    ],
)
def test_state_limits_are_drawn_where_the_window_shows_them(tmp_path, figures, limits, visible):
    """S >= I and rho <= 0.2 keep the ellipsoids within 0.45 of the motion from 0 to 1, so that -1 is not seen."""
    config = experiment(task={"start": [0, 0], "goal": [1.0, 0.0], "state_limits": limits})
    draw_funnels(run_folder(tmp_path / "run", config, best=candidate(config)))
    (axes,) = panels(figures[0])
    assert {(line.get_xdata()[0], line.get_ydata()[0]) for line in lines(axes, "state limit")} == visible


def test_volumes_are_drawn_over_time_and_told_with_their_rung(run, figures):
    folder, config = run
    draw_funnels(folder)
    (axes,) = [axes for axes in figures[0].axes if axes.get_yscale() == "log"]
    for line, (arrays, _) in zip(axes.lines, [candidate(config), candidate(config, 1, 3.0)], strict=True):
        np.testing.assert_array_equal(line.get_xdata(), arrays["time"])
        np.testing.assert_array_equal(line.get_ydata(), arrays["volumes_per_knot"])
    unit, integral = {
        "pendulum": ("rad$^2$/s", "rad$^2$"),
        "cartpole": ("m$^2$·rad$^2$/s$^2$", "m$^2$·rad$^2$/s"),
    }[config.plant.name]
    told = [text.get_text() for text in figures[0].legends[-1].get_texts()]
    for text, label, scale in zip(told, ("initial", "best"), (1, 3), strict=True):
        volumes, rung = text.split("\n")
        assert volumes == (
            f"{label}: sum {111 * scale} {unit}, integral {22 * scale} {integral}, "
            f"inlet {0.3 * scale:.4g} {unit}, geometric mean {4 * scale} {unit}"
        )
        assert rung == "sampled: failure probability at each knot ≤ 0.0023 with confidence 0.99"
    assert axes.get_title() == "best over initial: sum × 3, integral × 3, inlet × 3, geometric mean × 3"


def test_a_higher_rung_is_told_by_its_name(tmp_path, figures):
    config = experiment()
    draw_funnels(run_folder(tmp_path / "run", config, best=candidate(config, rung="certified")))
    assert "\ncertified\n" in texts(figures[0]) + "\n"
    assert "sampled" not in texts(figures[0])


def test_titles_tell_design_and_weights(tmp_path, figures):
    config = experiment()
    other = candidate(config, 1, design={"mass": 0.61234, "length": 0.4}, weights={"q": [9.5, 1.2], "r": [1.64]})
    draw_funnels(run_folder(tmp_path / "run", config, candidate(config), other))
    assert [axes.get_title() for axes in panels(figures[0])] == [
        "initial\nmass = 0.7 kg, length = 0.4 m\nq = (10, 1), r = 0.1",
        "best\nmass = 0.612 kg, length = 0.4 m\nq = (9.5, 1.2), r = 1.64",
    ]


def test_axes_carry_symbols_and_units(run, figures):
    folder, config = run
    draw_funnels(folder)
    labels = [(axes.get_xlabel(), axes.get_ylabel()) for axes in panels(figures[0])[::2]]
    angle = (r"$\theta$ [rad]", r"$\dot{\theta}$ [rad/s]")
    assert labels == {"pendulum": [angle], "cartpole": [("cart [m]", "cart_dot [m/s]"), angle]}[config.plant.name]


@pytest.mark.parametrize(
    ("initial", "message"),
    [
        ("failed", "the initial candidate has no funnel (RICCATI_INDEFINITE)"),
        ("absent", "no initial candidate was stored"),
    ],
)
def test_without_an_initial_funnel_the_best_is_drawn_alone_and_the_figure_says_so(tmp_path, figures, initial, message):
    config = experiment()
    arrays, record = candidate(config, status="RICCATI_INDEFINITE", epsilon=None)
    stored = {name: np.full_like(array, np.nan) for name, array in arrays.items()}, record
    folder = run_folder(tmp_path / "run", config, stored if initial == "failed" else None, candidate(config, 1))
    draw_funnels(folder)
    (axes,) = panels(figures[0])
    assert axes.get_title().startswith("best\n")
    assert message in texts(figures[0])
    assert "over initial" not in texts(figures[0])


def test_with_both_funnels_nothing_is_said_to_be_missing(run, figures):
    draw_funnels(run[0])
    assert "no initial" not in texts(figures[0])
    assert "no funnel" not in texts(figures[0])


def test_convergence_draws_the_stored_numbers_with_gaps_where_there_were_none(tmp_path, figures):
    records = [generation(k, sigma=0.3 / (k + 1)) for k in range(6)]
    records[2] |= {"best": None, "median": None, "feasible": 0.0}
    draw_convergence(run_folder(tmp_path / "run", experiment(), generations=records))
    volumes, share, sigma = figures[0].axes
    for label, name in (("best", "best"), ("median", "median"), ("best so far", "best_so_far")):
        (line,) = lines(volumes, label)
        np.testing.assert_array_equal(line.get_ydata(), [np.nan if r[name] is None else r[name] for r in records])
    for axes, name in ((share, "feasible"), (sigma, "sigma")):
        np.testing.assert_array_equal(axes.lines[0].get_xydata(), [[r["index"], r[name]] for r in records])
    assert volumes.get_ylabel() == "volume (sum) [rad$^2$/s]"
    assert volumes.get_legend().get_title().get_text().startswith("sampled")


def test_restarts_are_marked_at_their_generations_alone(tmp_path, figures):
    records = [generation(k, restarts=restarts) for k, restarts in enumerate([0, 0, 1, 1, 3])]
    draw_convergence(run_folder(tmp_path / "run", experiment(), generations=records))
    for axes in figures[0].axes:
        (marks,) = [drawn for drawn in axes.collections if isinstance(drawn, LineCollection)]
        assert [segment[0, 0] for segment in marks.get_segments()] == [2, 4]
    assert "restart" in texts(figures[0])


def test_without_restarts_the_legend_has_none(tmp_path, figures):
    draw_convergence(run_folder(tmp_path / "run", experiment(), generations=[generation(0), generation(1)]))
    assert "restart" not in texts(figures[0])


@pytest.mark.parametrize(("lowest", "scale"), [(11.0, "linear"), (9.0, "log")])
def test_an_axis_of_more_than_a_decade_is_logarithmic(tmp_path, figures, lowest, scale):
    records = [generation(0, median=lowest), generation(1, best=100.0, best_so_far=100.0)]
    draw_convergence(run_folder(tmp_path / "run", experiment(), generations=records))
    assert figures[0].axes[0].get_yscale() == scale


def test_a_search_without_any_volume_can_be_drawn(tmp_path, figures):
    nothing = {"best": None, "median": None, "best_so_far": None, "feasible": 0.0}
    draw_convergence(run_folder(tmp_path / "run", experiment(), generations=[generation(0, **nothing)]))
    assert np.isnan(figures[0].axes[0].lines[0].get_ydata()).all()


def test_the_files_are_whole_images_and_the_same_run_gives_the_same_bytes(run):
    folder, config = run
    with RunFolder.open(folder, config) as writable:
        writable.append(generation(0))
    paths = [*draw_funnels(folder), *draw_convergence(folder)]
    names = ["funnel.png", "funnel.pdf", "convergence.png", "convergence.pdf"]
    assert paths == [folder / "figures" / name for name in names]
    assert sorted(path.name for path in (folder / "figures").iterdir()) == sorted(names)
    for path in paths[::2]:
        with Image.open(path) as image:
            assert image.size[0] == 1440
            assert len(np.unique(np.asarray(image.convert("RGB")).reshape(-1, 3), axis=0)) > 10
    for path in paths[1::2]:
        assert path.read_bytes().startswith(b"%PDF-")
        assert path.read_bytes().rstrip().endswith(b"%%EOF")
    before = [path.read_bytes() for path in paths]
    assert [path.read_bytes() for path in [*draw_funnels(folder), *draw_convergence(folder)]] == before


def test_the_style_of_the_figures_does_not_depend_on_the_users_and_leaves_it(run):
    folder, _ = run
    before = [path.read_bytes() for path in draw_funnels(folder)]
    with matplotlib.rc_context({"font.size": 20, "axes.facecolor": "red", "figure.dpi": 30}):
        mine = dict(matplotlib.rcParams)
        assert [path.read_bytes() for path in draw_funnels(folder)] == before
        assert dict(matplotlib.rcParams) == mine


def test_drawing_needs_neither_jax_nor_a_display(run):
    script = (
        "import sys; from pathlib import Path; from rtcd_jax.report import draw_funnels\n"
        "assert 'matplotlib' not in sys.modules\n"
        "draw_funnels(Path(sys.argv[1]))\n"
        "print(*({'jax', 'matplotlib.pyplot', 'orbax'} & sys.modules.keys()))"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", script, run[0]], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_what_cannot_be_drawn_is_refused(tmp_path):
    config = experiment()
    with pytest.raises(UserError, match="is no run folder: it has no format"):
        draw_funnels(tmp_path)
    empty = run_folder(tmp_path / "empty", config)
    with pytest.raises(UserError, match="has no elites yet: finish the run first"):
        draw_funnels(empty)
    with pytest.raises(UserError, match="has no generations yet"):
        draw_convergence(empty)
    failed = run_folder(tmp_path / "failed", config, best=candidate(config, status="FUNNEL_EMPTY"))
    with pytest.raises(UserError, match=r"000 has no funnel \(FUNNEL_EMPTY\)"):
        draw_funnels(failed)
    arrays, record = candidate(config)
    del arrays["rho"], arrays["volumes_inlet"], record["design"]
    with pytest.raises(UserError, match="the best candidate lacks rho, volumes_inlet, design"):
        draw_funnels(run_folder(tmp_path / "poor", config, best=(arrays, record)))
    (empty / "figures").write_text("in the way")
    folder = run_folder(empty, config, best=candidate(config))
    with pytest.raises(UserError, match=r"cannot write .*figures"):
        draw_funnels(folder)
