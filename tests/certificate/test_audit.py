"""Funnels from outside: read as documented, judged by simulation, their nominal mended into a solution."""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.audit.external import Cost, elite_of, read_outside
from rtcd_jax.certificate.audit.repair import defects, repaired
from rtcd_jax.cli import main as cli
from rtcd_jax.elite.records import read_elite
from tests.certificate import swing

HEADINGS = "time_s,theta_rad,theta_dot_rad_s,torque_Nm,rho,S11,S12,S22"
ARGUMENTS = [
    "--plant", "pendulum", "--parameters", *(f"{name}={value}" for name, value in swing.PARAMETERS.items()),
    "--q", "4", "8", "--r", "10",
]  # fmt: skip
REFERENCE = Path(os.environ.get("RTCD_REFERENCE", "no reference")) / "pendulum_initial.csv"
"""The table that the paper's authors published for their initial pendulum, where somebody has it."""


def table(path, rho=4.0, off=0.0):
    """The small motion's file; `off` [rad] bends its nominal away from the dynamics, but for its ends."""
    arrays, _ = swing.elite()
    bend = off * np.sin(np.pi * np.arange(5) / 4)
    torque = np.append(arrays["u"][:, 0], math.nan)
    s = arrays["S"]
    columns = [arrays["time"], arrays["x"][:, 0] + bend, arrays["x"][:, 1], torque, np.full(5, rho)]
    rows = np.column_stack([*columns, s[:, 0, 0], s[:, 0, 1], s[:, 1, 1]])
    path.write_text("\n".join([HEADINGS, *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n")
    return path


def read(path):
    return read_outside(path, "pendulum", swing.PARAMETERS)


def cost(outside):
    return Cost.of(outside, (4.0, 8.0), 10.0, (7.0, 7.0))


def test_a_table_is_read_bit_by_bit(tmp_path):
    arrays, _ = swing.elite()
    outside = read(table(tmp_path / "x.csv"))
    stored, record = elite_of(outside, cost(outside))
    for name in ("x", "u", "x_goal", "u_max", "Q", "R"):
        np.testing.assert_array_equal(stored[name], arrays[name])
    np.testing.assert_array_equal(np.triu(stored["S"]), np.triu(arrays["S"]))
    np.testing.assert_allclose(stored["K"], arrays["K"], rtol=1e-12)
    np.testing.assert_allclose(stored["volumes_per_knot"], 4 * math.pi / np.sqrt(np.linalg.det(arrays["S"])))
    assert record["rung"] == "claimed"
    assert record["state_limits"] == [7.0, 7.0]


def test_a_motion_that_solves_the_dynamics_is_left_as_it_is(tmp_path):
    outside = read(table(tmp_path / "x.csv"))
    assert np.abs(defects(outside)).max() < 1e-9
    mended = repaired(outside, cost(outside))
    np.testing.assert_allclose(mended.x, outside.x, atol=1e-8)
    np.testing.assert_allclose(mended.u, outside.u, atol=1e-6)
    np.testing.assert_allclose(mended.S, outside.S, rtol=1e-6)
    np.testing.assert_allclose(mended.volumes, outside.volumes)


def test_a_bent_motion_is_mended_with_its_ends_and_within_the_limits(tmp_path):
    outside = read(table(tmp_path / "x.csv", off=0.02))
    assert np.abs(defects(outside)).max() > 0.01
    mended = repaired(outside, cost(outside))
    assert np.abs(defects(mended)).max() < 1e-10
    np.testing.assert_array_equal(mended.x[[0, -1]], outside.x[[0, -1]])
    assert np.abs(mended.u).max() <= 2.5
    assert 0 < np.abs(mended.x - outside.x).max() < 0.1
    straight = read(table(tmp_path / "y.csv"))
    far = np.sum((mended.x - outside.x) ** 2) + np.sum((mended.u - outside.u) ** 2) / 2.5**2
    assert far < np.sum((straight.x - outside.x) ** 2) * 1.5  # the motion that was bent is one candidate


def test_an_honest_funnel_lets_nothing_out_and_is_proved(tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["audit", str(table(tmp_path / "x.csv")), *ARGUMENTS, "--states", "50", "--out", str(out)]) == 0
    assert "from 0 of 4 some leave the next one, from 0 some leave a later one" in capsys.readouterr().out
    numbers = json.loads((out / "audit.json").read_text())
    assert max(numbers["knots"]["level"]) < 1
    assert cli.main(["certify", str(out), "--workers", "1"]) == 0
    assert "claimed / proved" in capsys.readouterr().out
    report = check.check_file(out / "certificates" / "000.json")
    assert report.volumes["sum"] > numbers["volumes_claimed"]["sum"]


def test_an_immodest_funnel_is_found_out_knot_by_knot(tmp_path, capsys):
    """A first ellipsoid 100 times too large: all else is as it should be."""
    path, out = table(tmp_path / "x.csv"), tmp_path / "out"
    rows = path.read_text().split("\n")
    rows[1] = rows[1].replace(",4.0,", ",400.0,")
    path.write_text("\n".join(rows))
    assert cli.main(["audit", str(path), *ARGUMENTS, "--states", "50", "--out", str(out)]) == 1
    assert "from 1 of 4 some leave the next one" in capsys.readouterr().out
    knots = json.loads((out / "audit.json").read_text())["knots"]
    assert knots["next_share"][0] > 0.9
    assert knots["next_share"][1:] == [0, 0, 0]
    assert knots["level"][0] >= knots["next_level"][0] > 10
    arrays, record = read_elite(out / "elites", "001")
    assert arrays["rho"][0] == 400
    assert record["state_limits"] == [None, None]


def without(word):
    return [argument for argument in ARGUMENTS if not argument.startswith(word)]


@pytest.mark.parametrize(
    ("text", "arguments", "reason"),
    [
        ("a\n1,2\n", ARGUMENTS, "must have at least 2 rows of 8 finite numbers: time, theta, theta_dot, input, rho"),
        ("a\n1,x\n", ARGUMENTS, "must be a row of headings and rows of 8 numbers"),
        (None, without("b="), "must be those of the pendulum, m, l, b, g, torque_limit; differ in b"),
        (None, [*ARGUMENTS, "--parameters", "m=heavy"], "--parameters m=heavy: must be NAME=VALUE with a number"),
        (None, [*ARGUMENTS, "--plant", "pendulumm"], "--plant = 'pendulumm': unknown plant; did you mean 'pendulum'?"),
        (None, [*ARGUMENTS, "--q", "4"], "--q = 4.0: must be 2 numbers > 0 (theta, theta_dot)"),
        (None, [*ARGUMENTS, "--r", "-1"], "--r = -1.0: must be > 0"),
        (None, [*ARGUMENTS, "--state_limits", "1", "0"], "--state_limits = 1.0 0.0: must be 2 numbers > 0"),
        (None, [*ARGUMENTS, "--states", "0"], "--states = 0: must be >= 1"),
    ],
)
def test_wrong_input_is_refused(tmp_path, capsys, text, arguments, reason):
    path = table(tmp_path / "x.csv")
    if text is not None:
        path.write_text(text)
    assert cli.main(["audit", str(path), *arguments, "--out", str(tmp_path / "out")]) == 2
    assert reason in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        (",4.0,", ",-4.0,", "rho of knot 0 must be positive"),
        ("\n0.05,", "\n0.06,", "times must rise evenly"),
        ("3.141592653589793,", "3.0,", "must be at rest, its angle a multiple of pi"),
    ],
)
def test_wrong_tables_are_refused(tmp_path, capsys, old, new, reason):
    path = table(tmp_path / "x.csv")
    path.write_text(path.read_text().replace(old, new))
    assert cli.main(["audit", str(path), *ARGUMENTS, "--out", str(tmp_path / "out")]) == 2
    assert reason in capsys.readouterr().err


@pytest.mark.skipif(not REFERENCE.is_file(), reason="RTCD_REFERENCE names no folder with pendulum_initial.csv")
def test_the_published_funnel_of_the_initial_pendulum(tmp_path):
    """The exact areas are the published ones, most of the first ellipse leaves, and a mended nominal is near."""
    outside = read_outside(REFERENCE, "pendulum", {"m": 0.7, "l": 0.4, "b": 0.1, "g": 9.81, "torque_limit": 2.5})
    assert outside.volumes.sum() == pytest.approx(156.9, abs=0.05)
    mended = repaired(outside, Cost.of(outside, (10.0, 1.0), 0.1, ()))
    assert np.abs(mended.x - outside.x).max() < 0.2
    arguments = [
        "--parameters",
        "m=0.7",
        "l=0.4",
        "b=0.1",
        "g=9.81",
        "torque_limit=2.5",
        "--q",
        "10",
        "1",
        "--r",
        "0.1",
    ]
    command = ["audit", str(REFERENCE), "--plant", "pendulum", *arguments, "--states", "50", "--out", str(tmp_path)]
    assert cli.main(command) == 1
    assert json.loads((tmp_path / "audit.json").read_text())["knots"]["share"][0] > 0.8
