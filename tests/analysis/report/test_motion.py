"""The swing-up over time: what the charts draw is the stored motion, and V/rho is that of simulated motions."""

import csv
import io

import numpy as np
import pytest

from rtcd_jax.analysis.report.charts import Band, Curve, table
from rtcd_jax.analysis.report.motion import STARTS, boundary_ratio, gains, motion
from rtcd_jax.analysis.report.reading import read_run
from rtcd_jax.elite.elite import Elite
from rtcd_jax.system.errors import UserError
from tests.analysis.report.loops import loop_folder
from tests.analysis.report.runs import finished


@pytest.fixture
def run(tmp_path):
    return read_run(finished(tmp_path / "run"))


def test_states_inputs_and_gains_are_the_stored_ones(run):
    angle, speed, torque, ratio = motion(run.config, run.funnels).panels
    assert [panel.label.split("\n")[0] for panel in (angle, speed, torque)] == [
        "θ [rad]", "dθ/dt [rad/s]", "torque [N m],",
    ]  # fmt: skip
    for i, panel in enumerate((angle, speed)):
        curves = [mark for mark in panel.marks if isinstance(mark, Curve)]
        for curve, funnel in zip(curves, run.funnels, strict=True):
            assert curve.label == funnel.label
            np.testing.assert_array_equal(curve.y, funnel.elite.x[:, i])
    limits = [mark for mark in torque.marks if not mark.label]
    assert sorted(float(mark.y[0]) for mark in limits) == [-1.0, 1.0]
    u = torque.marks[-1]
    for t in (0.01, 0.29, 1.79):  # held between the knots, of 0.3 s
        np.testing.assert_allclose(np.interp(t, u.x, u.y), run.best.u[int(t / 0.3), 0])
    assert ratio.logarithmic
    entries = gains(run.config, run.funnels).panels
    assert [panel.title for panel in entries] == ["torque by θ [N m/rad]", "torque by dθ/dt [N m/(rad/s)]"]
    np.testing.assert_array_equal(entries[1].marks[-1].y, run.best.K[:, 0, 1])


def test_a_band_is_the_extent_of_the_ellipsoids(run):
    """No state on an ellipsoid's boundary is beyond it, and one is on it."""
    random, elite = np.random.default_rng(0), run.best
    for i, panel in enumerate(motion(run.config, run.funnels).panels[:2]):
        (band,) = [mark for mark in panel.marks if isinstance(mark, Band) and mark.group == "best"]
        for k in (0, 3, 6):
            y = random.normal(size=(20_000, 2))
            errors = y * np.sqrt(elite.rho[k] / np.einsum("si,ij,sj->s", y, elite.S[k], y))[:, None]
            assert band.high[k] - elite.x[k, i] == pytest.approx(errors[:, i].max(), rel=1e-4)
            assert band.low[k] - elite.x[k, i] == pytest.approx(errors[:, i].min(), rel=1e-4)


def test_the_ratio_of_a_loop_without_disturbance_is_that_of_its_value(tmp_path):
    """It starts at one; where V falls on all motions it falls."""
    elite = Elite.read(loop_folder(tmp_path / "run", "pendulum"), 0)
    ratio = boundary_ratio(elite)
    assert ratio[0] == 1
    assert np.all(np.isfinite(ratio))
    assert len(ratio) == len(elite.time)
    assert 2**elite.x_goal.size <= STARTS


def test_parameters_that_are_missing_are_named(run):
    lacking = dict(run.best.parameters)
    del lacking["m"]
    with pytest.raises(UserError, match=r"^the elite's parameters lack 'm'$"):
        boundary_ratio(Elite(**{**vars(run.best), "parameters": lacking}))


def test_the_numbers_of_a_chart_are_its_curves_and_edges(run):
    head, *rows = csv.reader(io.StringIO(table(motion(run.config, run.funnels))))
    assert head == ["panel", "curve", "time [s]", "value"]
    points = {name: [row[2:] for row in rows if row[:2] == ["θ [rad]", name]] for name in ("best", "best, to")}
    np.testing.assert_array_equal(np.array(points["best"], float), np.c_[run.best.time, run.best.x[:, 0]])
    assert np.all(np.array(points["best, to"], float)[:, 1] > run.best.x[:, 0])
