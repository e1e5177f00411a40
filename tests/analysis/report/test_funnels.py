"""What the figures draw is what the run folder holds: shadows of ellipsoids, volumes with their guarantee."""

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.text import Text

from rtcd_jax.analysis.report.funnels import draw_funnels, draw_over
from rtcd_jax.analysis.report.page import draw_figures, render
from rtcd_jax.analysis.report.plane import plane_of
from rtcd_jax.analysis.report.plots import plane_plot
from rtcd_jax.analysis.report.reading import compared, read_run
from rtcd_jax.analysis.report.shapes import outlines, planes, projections
from tests.analysis.report.runs import candidate, experiment, finished, run_folder


@pytest.fixture(params=["pendulum", "cartpole"])
def run(request, tmp_path):
    """A finished run's folder with its configuration."""
    config = experiment(request.param)
    return run_folder(tmp_path / "run", config, candidate(config), candidate(config, 1, 3.0)), config


def panels(figure):
    """The axes that show ellipsoids, row by row."""
    return [axes for axes in figure.axes if any(isinstance(drawn, PolyCollection) for drawn in axes.collections)]


def texts(figure):
    return "\n".join(text.get_text() for text in figure.findobj(Text))


def lines(axes, label):
    return [line for line in axes.lines if line.get_label() == label]


def test_every_panel_draws_the_shadows_of_its_own_funnel(run, figures):
    folder, config = run
    draw_funnels(read_run(folder))
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
    draw_funnels(read_run(folder))
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
    draw_funnels(read_run(run_folder(tmp_path / "run", config, candidate(config), candidate(config, 1, 3.0))))
    initial, best = (axes.collections[0].get_edgecolor() for axes in panels(figures[0]))
    np.testing.assert_array_equal(initial[6], best[2])
    assert not np.array_equal(initial[6], best[6])


@pytest.mark.parametrize(
    ("limits", "visible"),
    [
        ([1.2, 0.01], {(1.2, 0), (0, 0.01), (0, -0.01)}),
        ([float("inf"), 0.01], {(0, 0.01), (0, -0.01)}),
        ([100.0, 100.0], set()),
    ],
)
def test_state_limits_are_drawn_where_the_window_shows_them(tmp_path, figures, limits, visible):
    """S >= I and rho <= 0.2 keep the ellipsoids within 0.45 of the motion from 0 to 1, so that -1 is not seen."""
    config = experiment(task={"start": [0, 0], "goal": [1.0, 0.0], "state_limits": limits})
    draw_funnels(read_run(run_folder(tmp_path / "run", config, best=candidate(config))))
    (axes,) = panels(figures[0])
    assert {(line.get_xdata()[0], line.get_ydata()[0]) for line in lines(axes, "state limit")} == visible


KEPT_OUT = {
    "half space": ({"normal": [1, 1], "offset": 1.2}, lambda x, y: x + y >= 1.2),
    "disk": (
        {"center": [0.5, 0.3], "semi_axes": [0.2, 0.1]},
        lambda x, y: ((x - 0.5) / 0.2) ** 2 + ((y - 0.3) / 0.1) ** 2 <= 1,
    ),
    "strip": ({"center": [0.5, 9], "semi_axes": [0.1, float("inf")]}, lambda x, y: abs(x - 0.5) <= 0.1),
    "far away": ({"center": [0.5, 9], "semi_axes": [0.1, 1]}, lambda x, y: x > 99),
}


@pytest.mark.parametrize("kind", KEPT_OUT)
def test_sets_to_keep_out_of_are_drawn_as_far_as_the_window_shows_them(tmp_path, figures, kind):
    """The polygon has those points of the window that are in the set; the page draws the same."""
    stated, inside = KEPT_OUT[kind]
    task = {"start": [0, 0], "goal": [1.0, 0.0], "state_limits": [9.0, 9.0], "keep_out": [stated]}
    run = read_run(run_folder(tmp_path / "run", experiment(task=task), best=candidate(experiment(task=task))))
    draw_funnels(run)
    (axes,) = panels(figures[0])
    drawn = [patch for patch in axes.patches if patch.get_label() == "to keep out of"]
    x, y = np.random.default_rng(0).uniform(*zip(axes.get_xlim(), axes.get_ylim(), strict=True), (4000, 2)).T
    expected = inside(x, y)
    assert len(drawn) == expected.any()
    if drawn:
        shown = drawn[0].get_path().contains_points(np.stack([x, y], axis=1))
        assert np.mean(shown != expected) < 2e-3
    shapes = plane_plot(plane_of(run.config, run.funnels, (0, 1)), "", (0, 1), 181)["layout"]["shapes"]
    assert len(shapes) == len(drawn)
    for shape, patch in zip(shapes, drawn, strict=True):
        corners = np.array([pair.split(",") for pair in shape["path"][1:-1].split("L")], float)
        np.testing.assert_allclose(corners, patch.get_path().vertices[: len(corners)], atol=1e-4)


def test_volumes_are_drawn_over_time_with_their_guarantee(run, figures):
    folder, config = run
    draw_funnels(read_run(folder))
    (axes,) = [axes for axes in figures[0].axes if axes.get_yscale() == "log"]
    for line, (arrays, _) in zip(axes.lines, [candidate(config), candidate(config, 1, 3.0)], strict=True):
        np.testing.assert_array_equal(line.get_xdata(), arrays["time"])
        np.testing.assert_array_equal(line.get_ydata(), arrays["volumes_per_knot"])
    unit, integral = {
        "pendulum": ("rad²/s", "rad²"),
        "cartpole": ("m²·rad²/s²", "m²·rad²/s"),
    }[config.plant.name]
    told = [text.get_text() for text in figures[0].legends[-1].get_texts()]
    for text, label, scale in zip(told, ("initial", "best"), (1, 3), strict=True):
        volumes, guarantee = text.split("\n")
        assert volumes == (
            f"{label}: sum {111 * scale} {unit}, integral {22 * scale} {integral}, "
            f"initial ellipsoid {0.3 * scale:.4g} {unit}, geometric mean {4 * scale} {unit}"
        )
        assert guarantee == "sampled: failure probability at each knot ≤ 0.0023 with confidence 0.99"
    assert axes.get_title() == "best over initial: sum × 3, integral × 3, initial ellipsoid × 3, geometric mean × 3"


def test_a_higher_guarantee_stands_by_its_name(tmp_path, figures):
    config = experiment()
    draw_funnels(read_run(run_folder(tmp_path / "run", config, best=candidate(config, rung="certified"))))
    assert "\ncertified\n" in texts(figures[0]) + "\n"
    assert "sampled" not in texts(figures[0])


def test_titles_tell_design_and_weights(tmp_path, figures):
    config = experiment()
    other = candidate(config, 1, design={"mass": 0.61234, "length": 0.4}, weights={"q": [9.5, 1.2], "r": [1.64]})
    draw_funnels(read_run(run_folder(tmp_path / "run", config, candidate(config), other)))
    assert [axes.get_title() for axes in panels(figures[0])] == [
        "initial\nmass = 0.7 kg, length = 0.4 m\nq = (10, 1), r = 0.1",
        "best\nmass = 0.612 kg, length = 0.4 m\nq = (9.5, 1.2), r = 1.64",
    ]


def test_axes_carry_symbols_and_units(run, figures):
    folder, config = run
    draw_funnels(read_run(folder))
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
    draw_funnels(read_run(folder))
    (axes,) = panels(figures[0])
    assert axes.get_title().startswith("best\n")
    assert message in texts(figures[0])
    assert "over initial" not in texts(figures[0])


def test_with_both_funnels_nothing_is_said_to_be_missing(run, figures):
    draw_funnels(read_run(run[0]))
    assert "no initial" not in texts(figures[0])
    assert "no funnel" not in texts(figures[0])


def test_levels_and_volumes_of_every_knot_are_drawn_over_time(run, figures):
    folder, config = run
    draw_figures(read_run(folder))
    (levels_figure,) = {drawn for drawn in figures if "level ρ" in drawn.axes[0].get_ylabel()}
    levels, volumes = levels_figure.axes
    for i, (arrays, _) in enumerate([candidate(config), candidate(config, 1, 3.0)]):
        for axes, name in ((levels, "rho"), (volumes, "volumes_per_knot")):
            np.testing.assert_array_equal(axes.lines[i].get_xydata(), np.stack([arrays["time"], arrays[name]], axis=1))
    assert (levels.get_yscale(), volumes.get_yscale()) == ("log", "log")
    assert "sampled: failure probability" in texts(levels_figure)


def test_pushes_are_drawn_and_written_where_a_run_stored_them(tmp_path, figures):
    """The initial candidate's is of an older version that stored none; the page tells the best one's margin."""
    config = experiment()
    pushes = np.geomspace(0.5, 0.1, len(candidate(config)[0]["rho"]))
    arrays, record = candidate(config, 1)
    told = {"push": {"margin": 0.1, "input": "torque", "time": 1.8, "within_limits": 0.25}}
    best = arrays | {"pushes": pushes[:, None], "volumes_push": np.array(0.1)}, record | told
    run = read_run(run_folder(tmp_path / "run", config, candidate(config), best))
    draw_figures(run)
    (figure,) = {drawn for drawn in figures if "level ρ" in drawn.axes[0].get_ylabel()}
    (line,) = figure.axes[2].lines
    np.testing.assert_array_equal(line.get_xydata(), np.stack([arrays["time"], pushes], axis=1))
    assert "N·m·s" in figure.axes[2].get_ylabel()
    rows = (tmp_path / "run" / "figures" / "levels.csv").read_text().splitlines()
    stored = [row.split(",")[1:] for row in rows if row.startswith("largest impulse")]
    assert stored == [
        ["best", repr(t), repr(push)] for t, push in zip(arrays["time"].tolist(), pushes.tolist(), strict=True)
    ]
    text = render([run])
    assert "after an impulse of up to 0.1 N·m·s; the least is that at 1.8 s" in text
    assert "leave no more than 0.25 N·m·s" in text


def test_compared_funnels_lie_over_one_another_the_largest_lowest(tmp_path, figures):
    """The initial candidate that the runs share is drawn once."""
    folders = [finished(tmp_path / name, scale=scale) for name, scale in (("rtc", 2.0), ("rtcd", 5.0))]
    written = draw_over(compared([read_run(folder) for folder in folders]), tmp_path, "both")
    assert [path.name for path in written] == ["both.png", "both.pdf"]
    (axes,) = panels(figures[0])
    drawn = [line.get_label() for line in axes.lines if not line.get_label().startswith(("start", "goal", "state"))]
    assert drawn == ["rtcd", "rtc", "initial"]
    assert "rtc: sum 222, integral 44, initial ellipsoid 0.6, geometric mean 8 (sampled, ε = 0.0023)" in texts(
        figures[0]
    )
    assert "volumes in rad²/s, integrals in rad²" in texts(figures[0])
