"""A motion that is inside all the way is told so, another one where it left; both sides of the level."""

import csv
import json

import numpy as np
import pytest

from rtcd_jax.analysis.replay.measured import jumps, read_measured
from rtcd_jax.analysis.replay.replay import replay_run
from rtcd_jax.config.plants import PLANTS
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import FunnelInterpolant
from rtcd_jax.elite.records import write_elite
from rtcd_jax.system.errors import UserError
from tests.analysis.report.loops import LOOPS, loop_folder, stored
from tests.consoles import Output

STATES = {name: plant().states for name, plant in PLANTS.items()}
HEADS = {"pendulum": "time,pos,vel,torque", "cartpole": "time,pos1,pos2,vel1,vel2,tau1,tau2"}


def motion(plant, scale, samples=41, after=0.05):
    """Times beyond the last knot, and states at sqrt(V/rho) = scale(t) along a fixed direction."""
    arrays, record = stored(plant)
    funnel = FunnelInterpolant.of(Elite.of(arrays, record))
    time = np.linspace(0, arrays["time"][-1] + after, samples)
    direction = np.ones(arrays["x"].shape[1])
    lengths = np.sqrt(funnel.level(time) / np.einsum("i,tij,j->t", direction, funnel.value(time), direction))
    return time, funnel.nominal(time) + (scale(time) * lengths)[:, None] * direction


def measured_file(path, plant, time, x):
    torques = np.zeros((len(time), x.shape[1] // 2))
    rows = np.column_stack([time, x, torques]).tolist()
    path.write_text("\n".join([HEADS[plant], *(",".join(map(repr, row)) for row in rows)]))
    return path


@pytest.fixture(params=LOOPS)
def plant(request):
    return request.param


def test_a_motion_inside_all_the_way_is_told_its_smallest_margin(tmp_path, plant, figures):
    folder = loop_folder(tmp_path / "run", plant)
    time, x = motion(plant, lambda t: 0.5 + 0.4 * np.exp(-(((t - 0.02) / 0.01) ** 2)))
    output = Output()
    assert replay_run(folder, measured_file(tmp_path / "lab.csv", plant, time, x), 0, output.console)
    told = json.loads((folder / "replay" / "lab_000.json").read_text())
    fill = (0.5 + 0.4 * np.exp(-(((time - 0.02) / 0.01) ** 2))) ** 2
    assert told["inside"]
    assert told["first_exit"] is None
    assert told["smallest_margin"] == pytest.approx(1 - fill.max())
    assert told["closest"]["time"] == time[fill.argmax()]
    with (folder / "replay" / "lab_000.csv").open() as file:
        rows = list(csv.DictReader(file))
    np.testing.assert_allclose([float(row["V/rho"]) for row in rows], fill)
    assert {row["inside"] for row in rows} == {"1"}
    assert any("inside the funnel all the way" in line for line in output.lines)


def test_the_initial_candidate_s_funnel_is_its_own(tmp_path, figures):
    folder = loop_folder(tmp_path / "run", "pendulum")
    arrays, record = stored("pendulum")
    write_elite(folder, "initial", arrays | {"rho": arrays["rho"] / 4}, record)
    path = measured_file(tmp_path / "lab.csv", "pendulum", *motion("pendulum", lambda t: np.full_like(t, 0.7)))
    assert replay_run(folder, path, 0, Output().console)
    assert not replay_run(folder, path, "initial", Output().console)
    told = json.loads((folder / "replay" / "lab_initial.json").read_text())
    assert told["first_exit"]["V/rho"] == pytest.approx(4 * 0.49)
    assert json.loads((folder / "replay" / "lab_000.json").read_text())["inside"]


@pytest.mark.parametrize(("peak", "kept"), [(0.999, True), (1.001, False)])
def test_the_level_divides_inside_from_outside(tmp_path, plant, figures, peak, kept):
    folder = loop_folder(tmp_path / "run", plant)
    time, x = motion(plant, lambda t: np.full_like(t, peak))
    assert replay_run(folder, measured_file(tmp_path / "lab.csv", plant, time, x), 0, Output().console) is kept


def test_the_first_exit_is_told_with_time_fill_and_state(tmp_path, plant, figures):
    folder = loop_folder(tmp_path / "run", plant)
    time, x = motion(plant, lambda t: np.where(t < 0.03, 0.5, np.where(t < 0.035, 3.0, 1.5)))
    output = Output()
    assert not replay_run(folder, measured_file(tmp_path / "lab.csv", plant, time, x), 0, output.console)
    told = json.loads((folder / "replay" / "lab_000.json").read_text())
    first = int(np.argmax(time >= 0.03))
    assert told["first_exit"]["time"] == time[first]
    assert told["first_exit"]["V/rho"] == pytest.approx(9.0)
    assert list(told["first_exit"]["state"].values()) == pytest.approx(x[first].tolist())
    assert told["share_inside"] == pytest.approx(first / len(time))
    assert any(
        line.startswith(f"OUTSIDE the funnel, first at t = {time[first]:.4g} s: V/rho = 9") for line in output.lines
    )


def test_the_figure_shows_what_was_measured_and_marks_what_was_outside(tmp_path, figures):
    folder = loop_folder(tmp_path / "run", "cartpole")
    time, x = motion("cartpole", lambda t: np.where(t < 0.03, 0.5, 2.0))
    replay_run(folder, measured_file(tmp_path / "lab.csv", "cartpole", time, x), 0, Output().console)
    *panels, fill = figures[0].axes
    assert len(panels) == 2
    for axes, plane in zip(panels, [(0, 2), (1, 3)], strict=True):
        (line,) = [line for line in axes.lines if line.get_label() == "measured"]
        np.testing.assert_allclose(line.get_xydata(), x[:, plane])
        (outside,) = [line for line in axes.lines if line.get_label() == "outside"]
        np.testing.assert_allclose(outside.get_xydata(), x[time >= 0.03][:, plane])
    np.testing.assert_allclose(fill.lines[0].get_ydata(), np.where(time < 0.03, 0.25, 4.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file; must be a CSV"),
        ("", "is empty: must be a CSV of measured states"),
        ("time,pos,vel,torque\n", "has no samples, only its columns: time, pos, vel, torque"),
        ("time,pos,vel\n-1,0,0\n1,0,0\n", r"time begins at -1 s: must begin in \[0, 0.2\).*--start T"),
        ("time,pos,vel\n1000,0,0\n1001,0,0\n", r"time begins at 1000 s: must begin in \[0, 0.2\)"),
        ("time,pos,vel\n0,3,0\n", "has 1 sample of the motion, which takes 0.2 s: must have 2 at least"),
        ("time,pos,vel\n0,3,0\n5,3,0\n", "has 1 sample of the motion"),
    ],
)
def test_what_is_no_measured_motion_is_refused(tmp_path, text, message):
    folder, path = loop_folder(tmp_path / "run", "pendulum"), tmp_path / "lab.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError, match=message):
        replay_run(folder, path, 0, Output().console)
    assert not (folder / "replay").exists()


def test_a_run_that_cannot_be_replayed_is_refused(tmp_path, figures):
    folder = loop_folder(tmp_path / "run", "pendulum")
    path = measured_file(tmp_path / "lab.csv", "pendulum", *motion("pendulum", lambda t: 0 * t))
    with pytest.raises(UserError, match=r"has no elite 003; there are 000"):
        replay_run(folder, path, 3, Output().console)
    with pytest.raises(UserError, match="is no run folder"):
        replay_run(tmp_path, path, 0, Output().console)
    (folder / "replay").write_text("in the way")
    with pytest.raises(UserError, match=r"cannot write .*replay"):
        replay_run(folder, path, 0, Output().console)


@pytest.mark.parametrize(
    ("kept", "share", "words"),
    [
        (slice(None), 1.0, "inside the funnel all the way"),
        (slice(1, None), 0.975, "inside the funnel all the way"),  # what is missing is shorter than an interval
        (slice(0, 5), 0.1, "inside the funnel at every sample"),
        (slice(0, None, 40), 0.0, "inside the funnel at every sample"),  # two samples, whatever was between them
        (np.r_[0:11, 31:41], 0.475, "inside the funnel at every sample"),  # a gap of half the motion
    ],
)
def test_all_the_way_is_said_of_motions_that_were_measured_all_the_way(tmp_path, figures, kept, share, words):
    folder = loop_folder(tmp_path / "run", "pendulum")
    time, x = motion("pendulum", lambda t: np.full_like(t, 0.5), after=0.0)
    output = Output()
    assert replay_run(folder, measured_file(tmp_path / "lab.csv", "pendulum", time[kept], x[kept]), 0, output.console)
    record = json.loads((folder / "replay" / "lab_000.json").read_text())
    assert record["share_covered"] == pytest.approx(share)
    assert any(line.startswith(words) for line in output.lines)
    assert any(f"they cover {share:.1%}" in line for line in output.lines)
    assert any("nothing is known of the other" in line for line in output.lines) is ("all the way" not in words)


def test_the_motion_begins_where_the_user_says(tmp_path, figures):
    folder = loop_folder(tmp_path / "run", "pendulum")
    time, x = motion("pendulum", lambda t: np.full_like(t, 0.7))
    waiting = np.linspace(0, 7.9, 5)
    later = np.concatenate([waiting, time + 8]), np.concatenate([np.zeros((5, 2)), x])
    output = Output()
    path = measured_file(tmp_path / "lab.csv", "pendulum", *later)
    assert replay_run(folder, path, 0, output.console, start=8.0)
    assert any("begins at 8 s of the file; 5 rows before that left out" in line for line in output.lines)
    record = json.loads((folder / "replay" / "lab_000.json").read_text())
    assert record["closest"]["V/rho"] == pytest.approx(0.49)
    with pytest.raises(UserError, match=r"--start = 9: .* ends before that, at 8.25 s"):
        replay_run(folder, path, 0, Output().console, start=9.0)


def test_turns_are_taken_out_of_angles_that_wrap(tmp_path, figures):
    """An encoder of one turn, and a count of turns that was not at zero."""
    folder = loop_folder(tmp_path / "run", "pendulum")
    time, x = motion("pendulum", lambda t: np.full_like(t, 0.7))
    wrapped = x.copy()
    middle = np.median(x[:, 0])
    wrapped[:, 0] = (x[:, 0] - middle) % (2 * np.pi) + middle - 4 * np.pi
    assert np.ptp(wrapped[:, 0]) > 6
    path = measured_file(tmp_path / "lab.csv", "pendulum", time, wrapped)
    output = Output()
    assert not replay_run(folder, path, 0, output.console)
    assert any("theta jumps by" in line and "--unwrap" in line for line in output.lines)
    assert replay_run(folder, path, 0, Output().console, unwrap=True)
    record = json.loads((folder / "replay" / "lab_000.json").read_text())
    assert record["closest"]["V/rho"] == pytest.approx(0.49)


def test_the_columns_that_were_taken_are_told(tmp_path, figures):
    folder = loop_folder(tmp_path / "run", "pendulum")
    time, x = motion("pendulum", lambda t: np.full_like(t, 0.7))
    rows = np.column_stack([time * 1000, np.degrees(x[:, 0]), x[:, 1]]).tolist()
    lines = ["Time [ms];Angle (deg);thetadot", *(";".join(map(repr, row)).replace(".", ",") for row in rows)]
    (tmp_path / "lab.csv").write_text("\n".join(lines))
    output = Output()
    assert replay_run(folder, tmp_path / "lab.csv", 0, output.console)
    taken = "time from Time [ms] (times 0.001), theta from Angle (deg) (times 0.0174533), theta_dot from thetadot"
    assert output.lines[0] == f"columns: {taken}"


@pytest.mark.parametrize(("step", "count"), [(3.0, 0), (3.2, 1)])
def test_half_a_turn_between_two_samples_looks_wrapped(tmp_path, step, count):
    path = tmp_path / "lab.csv"
    path.write_text(f"time,pos1,pos2,vel1,vel2\n0,0,0,0,0\n0.1,9,{step},0,0\n")
    found = jumps(read_measured(path, STATES["cartpole"]), STATES["cartpole"])
    assert len(found) == count
    assert all("theta jumps by 3.2 rad at t = 0.1 s" in line for line in found)
