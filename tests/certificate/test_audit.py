"""External funnels: read as documented, judged by simulation, their nominal projected onto the dynamics."""

import json
import math
import os
import random
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from rtcd_jax.analysis.disturb.comparison import read_comparison
from rtcd_jax.certificate import check
from rtcd_jax.certificate.audit.external import Cost, elite_of, read_external
from rtcd_jax.certificate.audit.projection import defects, projected, with_fitting_inputs
from rtcd_jax.certificate.prove.closed_loop import claim_of
from rtcd_jax.certificate.prove.robot import robot_of
from rtcd_jax.cli import main as cli
from rtcd_jax.config.plants import PLANTS, ROBOTS, read_plant
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import read_elite
from rtcd_jax.system.console import silent
from rtcd_jax.system.errors import UserError
from rtcd_jax.volume import VOLUMES, Volume
from tests.analysis.replay.test_measured import mutated
from tests.certificate import swing, upright
from tests.paths import CONFIGS
from tests.plants.trees import SWING, link, mjcf

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
    return read_external(path, "pendulum", swing.PARAMETERS)


def cost(external):
    return Cost.of(external, (4.0, 8.0), 10.0, (7.0, 7.0))


def test_a_table_is_read_bit_by_bit(tmp_path):
    arrays, _ = swing.elite()
    external = read(table(tmp_path / "x.csv"))
    stored, record = elite_of(external, cost(external))
    for name in ("x", "u", "x_goal", "u_max", "Q", "R"):
        np.testing.assert_array_equal(stored[name], arrays[name])
    np.testing.assert_array_equal(np.triu(stored["S"]), np.triu(arrays["S"]))
    np.testing.assert_allclose(stored["K"], arrays["K"], rtol=1e-12)
    np.testing.assert_allclose(stored["volumes_per_knot"], 4 * math.pi / np.sqrt(np.linalg.det(arrays["S"])))
    assert record["rung"] == "claimed"
    assert record["state_limits"] == [7.0, 7.0]


def test_an_external_funnel_has_every_volume_of_the_list(tmp_path, monkeypatch):
    monkeypatch.setitem(VOLUMES, "largest", Volume("the largest knot's", lambda at: at.v.max()))
    external = read(table(tmp_path / "x.csv"))
    arrays, record = elite_of(external, cost(external))
    v = external.volumes
    dt = external.dt
    impulse = swing.PARAMETERS["m"] * swing.PARAMETERS["l"] ** 2 * np.sqrt(external.rho / external.S[:, 1, 1])
    expected = [v.sum(), np.trapezoid(v, dx=dt), v[0], np.prod(v) ** (1 / len(v)), impulse.min(), v[-1], v.max()]
    np.testing.assert_allclose([arrays[f"volumes_{name}"] for name in VOLUMES], expected)
    np.testing.assert_allclose([record["volumes"][name] for name in VOLUMES], expected)


def test_a_motion_that_solves_the_dynamics_is_left_as_it_is(tmp_path):
    external = read(table(tmp_path / "x.csv"))
    assert np.abs(defects(external)).max() < 1e-9
    moved = projected(external, cost(external))
    np.testing.assert_allclose(moved.x, external.x, atol=1e-8)
    np.testing.assert_allclose(moved.u, external.u, atol=1e-6)
    np.testing.assert_allclose(moved.S, external.S, rtol=1e-6)
    np.testing.assert_allclose(moved.volumes, external.volumes)


def test_a_bent_motion_is_moved_with_its_ends_and_within_the_limits(tmp_path):
    external = read(table(tmp_path / "x.csv", off=0.02))
    assert np.abs(defects(external)).max() > 0.01
    moved = projected(external, cost(external))
    assert np.abs(defects(moved)).max() < 1e-10
    np.testing.assert_array_equal(moved.x[[0, -1]], external.x[[0, -1]])
    assert np.abs(moved.u).max() <= 2.5
    assert 0 < np.abs(moved.x - external.x).max() < 0.1
    straight = read(table(tmp_path / "y.csv"))
    far = np.sum((moved.x - external.x) ** 2) + np.sum((moved.u - external.u) ** 2) / 2.5**2
    assert far < np.sum((straight.x - external.x) ** 2) * 1.5  # the motion that was bent is one candidate


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


# Other robots ---------------------------------------------------------------------------------------------------------


def table_of(path, arrays, rho):
    """An elite's motion as a table, under levels of one's own."""
    rows, places = np.triu_indices(arrays["x"].shape[1])
    held = np.append(arrays["u"][:, 0], math.nan)
    levels, s = np.full(len(held), rho), arrays["S"][:, rows, places]
    columns = np.column_stack([arrays["time"], arrays["x"], held, levels, s]).tolist()
    path.write_text("\n".join(["headings", *(",".join(map(repr, row)) for row in columns)]))
    return path


def arguments_of(arrays, record, plant):
    numbers = [f"{name}={value!r}" for name, value in record["parameters"].items()]
    q, r = np.diag(arrays["Q"]), arrays["R"][0, 0]
    return ["--plant", str(plant), "--parameters", *numbers, "--q", *map(repr, q.tolist()), "--r", repr(float(r))]


def audited_without_faults(tmp_path, arrays, record, plant, rho):
    out, path = tmp_path / "out", table_of(tmp_path / "x.csv", arrays, rho)
    command = ["audit", str(path), *arguments_of(arrays, record, plant), "--states", "20", "--out", str(out)]
    assert cli.main(command) == 0
    assert max(json.loads((out / "audit.json").read_text())["largest_defect"]) < 1e-7
    return Elite.read(out, "000")


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["acrobot", "furuta", "reaction_wheel"])
def test_the_funnel_of_any_packaged_robot_is_audited(tmp_path, name):
    """Its elite is the robot's, bit by bit, and has a claim."""
    arrays, record = upright.elite(name, inputs=(0.05, 0.02), dt=0.005)
    found = audited_without_faults(tmp_path, arrays, record, name, 1e-6)
    assert found.plant == name
    assert dict(found.parameters) == record["parameters"]
    np.testing.assert_array_equal(found.u_max, arrays["u_max"])
    assert claim_of(found)["robot"]["name"] == name


@pytest.mark.thorough
def test_the_funnel_of_a_robot_of_one_s_own_is_audited(tmp_path, capsys):
    """By the configuration that has it; constants that are not given are the file's."""
    arrays, record = upright.elite("reaction_wheel", inputs=(0.05, 0.02), dt=0.005)
    robot = PLANTS["reaction_wheel"]
    (tmp_path / "wheel.xml").write_text(robot.xml)
    section = yaml.safe_load((ROBOTS / "reaction_wheel.yaml").read_text())
    plant = {"mjcf": "wheel.xml", "name": "wheel", **{key: section[key] for key in ("inputs", "set")}}
    plant["constants"] = {name: {"value": each["value"]} for name, each in section["constants"].items()}
    config = yaml.safe_load((CONFIGS / "reaction_wheel.yaml").read_text())
    config = {key: config[key] for key in ("task", "weights", "trajectory")} | {"plant": plant}
    config["design"] = {
        name: {"initial": record["parameters"][name], "min": 0.01, "max": 1, "unit": each["unit"]}
        for name, each in section["design"].items()
    }
    file = tmp_path / "wheel.yaml"
    file.write_text(yaml.safe_dump(config))
    record["parameters"] = {name: record["parameters"][name] for name in section["design"]}
    found = audited_without_faults(tmp_path, arrays, record, file, 1e-6)
    assert found.plant == "wheel"
    assert found.parameters["mass"] == section["constants"]["mass"]["value"]
    assert claim_of(found)["robot"]["name"] == "wheel"
    wrong = arguments_of(arrays, {"parameters": {"length": 0.1, "size": 1.0}}, file)
    assert cli.main(["audit", str(tmp_path / "x.csv"), *wrong, "--out", str(tmp_path / "other")]) == 2
    assert "differ in size, wheel_mass, wheel_radius" in capsys.readouterr().err


def test_a_robot_of_two_motors_has_no_claim():
    both = mjcf(
        link("first", SWING, link("second", SWING, place="0 0 -0.3")),
        *(f'name="{name}" joint="{name}" ctrllimited="true" ctrlrange="-1 1"' for name in ("first", "second")),
    )
    plant = read_plant({"mjcf": "two.xml", "xml": both})
    with pytest.raises(UserError, match="no certificate for 2 inputs: the checker knows loops with one"):
        robot_of(plant, plant.values(), {})


def without(word):
    return [argument for argument in ARGUMENTS if not argument.startswith(word)]


@pytest.mark.parametrize(
    ("text", "arguments", "reason"),
    [
        ("a\n1,2\n", ARGUMENTS, "must have at least 2 rows of 8 finite numbers: time, theta, theta_dot, input, rho"),
        ("a\n1,x\n", ARGUMENTS, "line 2, cell 2 = 'x': must be a finite number"),
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


def pair(tmp_path, moved=False, across=True):
    """The small motion's two files, as the labs' tools write them: inputs moved by a knot, a knot a column."""
    arrays, _ = swing.elite()
    torques = arrays["u"][:, 0]
    inputs = np.append(0.0, torques) if moved else np.append(torques, 0.0)
    rows = np.column_stack([arrays["time"], arrays["x"], inputs])
    trajectory, funnel = tmp_path / "trajectory.csv", tmp_path / "funnel.csv"
    np.savetxt(trajectory, rows, delimiter=",", header="time,pos,vel,torque", comments="")
    numbers = np.column_stack([np.full(5, 4.0), arrays["S"].reshape(5, -1)])
    np.savetxt(funnel, numbers.T if across else numbers, delimiter=",", header="rho,S_t", comments="")
    return trajectory, funnel


@pytest.mark.parametrize("moved", [False, True])
def test_inputs_are_taken_as_they_fit_the_dynamics(tmp_path, moved):
    trajectory, funnel = pair(tmp_path, moved)
    given, misfits = with_fitting_inputs(read_external(trajectory, "pendulum", swing.PARAMETERS, funnel))
    np.testing.assert_array_equal(given.u, swing.elite()[0]["u"][:, 0])
    names = ["as written", "moved by one knot"]
    fits, other = names[::-1] if moved else names
    assert misfits[fits] < 1e-8
    assert misfits[other] > 1e-3
    np.testing.assert_allclose(given.S, swing.elite()[0]["S"], rtol=1e-12)


def test_a_pair_of_files_is_audited_as_one_table_is(tmp_path, capsys):
    results = []
    for name, files in (("one", [table(tmp_path / "x.csv")]), ("two", pair(tmp_path, moved=True, across=False))):
        more = ["--funnel", str(files[1])] if len(files) == 2 else []
        out = tmp_path / name
        command = ["audit", str(files[0]), *more, *ARGUMENTS, "--states", "20", "--out", str(out)]
        assert cli.main(command) == 0
        results.append(json.loads((out / "audit.json").read_text())["knots"])
    for name, numbers in results[0].items():
        np.testing.assert_allclose(results[1][name], numbers, rtol=1e-9)
    said = capsys.readouterr().out
    assert "inputs taken moved by one knot" in said
    assert "0.0% miss the goal's ellipsoid at the last knot, 0.0% leave the limits" in said


def test_a_rail_that_is_left_is_told(tmp_path):
    """The motion's own velocities lie on both sides of the limit."""
    fastest = np.abs(swing.elite()[0]["x"][:, 1]).max()
    limits = ["--state_limits", "inf", str(1.001 * fastest)]
    out = tmp_path / "out"
    cli.main(["audit", str(table(tmp_path / "x.csv")), *ARGUMENTS, *limits, "--states", "50", "--out", str(out)])
    shares = json.loads((out / "audit.json").read_text())["knots"]["limit_share"]
    assert 0 < shares[0] < 1


def test_an_integrated_s_that_is_not_quite_symmetric_is_its_symmetric_part(tmp_path):
    trajectory, funnel = pair(tmp_path)
    off = np.array([0, 0, 1e-3, -1e-3, 0])[:, None]
    np.savetxt(funnel, np.loadtxt(funnel, delimiter=",", skiprows=1) + off, delimiter=",")
    external = read_external(trajectory, "pendulum", swing.PARAMETERS, funnel)
    np.testing.assert_allclose(external.S, swing.elite()[0]["S"], rtol=1e-12)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda rows: rows[:, :-1], "has 5 rows of 4 numbers: must have 5 rows"),
        (lambda rows: rows + 0.1 * rows.max() * np.eye(5)[2][:, None], "an S is not symmetric"),
        (lambda rows: rows * [[-1], [1], [1], [1], [1]], "rho of knot 0 must be positive"),
    ],
)
def test_wrong_funnel_files_are_refused(tmp_path, change, reason):
    trajectory, funnel = pair(tmp_path)
    np.savetxt(funnel, change(np.loadtxt(funnel, delimiter=",", skiprows=1)), delimiter=",")
    if "rows of 4" in reason:
        reason = "has 5 rows of 4 numbers"
    with pytest.raises(UserError, match=reason):
        read_external(trajectory, "pendulum", swing.PARAMETERS, funnel)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["m=0"], "--parameters m=0.0: must be a number from 1e-12"),
        (["m=nan"], "--parameters m=nan: must be"),
        (["b=-1"], "--parameters b=-1.0: must be a number from 0"),
        (["torque_limit=inf"], "--parameters torque_limit=inf: must be"),
        (["m=1e300"], "--parameters m=1e+300: must be"),
        ([*["b=0", "--r", "nan"]], "--r = nan"),
        ([*["b=0", "--r", "inf"]], "--r = inf"),
        ([*["b=0", "--q", "inf", "1"]], "--q inf: must be finite"),
        ([*["b=0", "--state_limits", "nan", "1"]], "--state_limits = nan 1.0: must be 2 numbers"),
    ],
)
def test_numbers_that_no_robot_has_are_refused(tmp_path, capsys, arguments, reason):
    name, _, _ = arguments[0].partition("=")
    own = [f"{key}={value}" for key, value in swing.PARAMETERS.items() if key != name]
    given = ["--plant", "pendulum", "--q", "4", "8", "--r", "10", "--parameters", *own, *arguments]
    assert cli.main(["audit", str(table(tmp_path / "x.csv")), *given, "--out", str(tmp_path / "out")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert reason in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (
            "h\n-1e308,3.14159265,0,0,1,1,0,1\n1e308,3.14159265,0,0,1,1,0,1\n",
            "cell 1 = '-1e308': must be a finite number",
        ),
        ("h\n0,1e308,0,0,1,1,0,1\n", "cell 2 = '1e308'"),
        ("h\n0,0,0,0,1,1,0," + "1" * 200_000 + "\n", "field larger than field limit"),
        ("h\n0,3.14159265,0,0,1,1,0,1\n1,2\n", "line 3 has 2 cells, the first row 8"),
        ("h\n0,0,0,0,1,1e-300,0,1e-300\n1,3.14159265,0,0,1,1,0,1\n", "the volume of knot 0 is beyond all numbers"),
        ("", "is empty: must be a table of the columns time, theta, theta_dot, input, rho, upper triangle of S"),
        ("h\n\x00\n", "is no text"),
    ],
)
def test_tables_of_impossible_numbers_are_one_line(tmp_path, text, reason):
    path = tmp_path / "x.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=re.escape(reason)) as error:
        read(path)
    assert str(error.value).isprintable()


def test_a_thousand_mutated_tables_are_funnels_or_one_line(tmp_path):
    rng, whole = random.Random(2), table(tmp_path / "whole.csv").read_bytes()
    trajectory, funnel = pair(tmp_path)
    files = [(tmp_path / "x.csv", whole, ()), (funnel, funnel.read_bytes(), (trajectory, funnel))]
    messages = []
    for number in range(1000):
        path, content, files_of_pair = files[number % 2]
        path.write_bytes(mutated(content, rng))
        first, *second = files_of_pair or (path,)
        try:
            external = read_external(first, "pendulum", swing.PARAMETERS, *second)
            external, _ = with_fitting_inputs(external)
        except UserError as error:
            messages.append(str(error))
        else:
            assert np.isfinite(external.volumes).all()
            assert (external.volumes > 0).all()
            assert np.isfinite(external.u).all()
    assert 100 < len(messages) < 950
    assert [message for message in messages if not message.isprintable()] == []


@pytest.fixture(scope="module")
def audited(tmp_path_factory):
    folder = tmp_path_factory.mktemp("audited")
    out = folder / "out"
    assert cli.main(["audit", str(table(folder / "x.csv")), *ARGUMENTS, "--states", "5", "--out", str(out)]) == 0
    arrays, _ = swing.elite()
    rows = np.column_stack([arrays["time"], arrays["x"]]).tolist()
    (folder / "lab.csv").write_text("\n".join(["time,pos,vel", *(",".join(map(str, row)) for row in rows)]))
    return out


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("verb", "arguments", "made"),
    [
        ("replay", ["{run}/../lab.csv"], "replay/lab_000.json"),
        ("replay", ["{run}/../lab.csv", "--elite", "initial"], "replay/lab_initial.json"),
        ("report", [], "report.html"),
        ("verify", ["--states", "5", "--workers", "1"], "verification/initial.json"),
        ("export", ["--to", "{run}/lab"], "lab/export.json"),
    ],
)
def test_every_verb_reads_the_audited_folder(audited, verb, arguments, made, monkeypatch):
    monkeypatch.setattr(cli, "prepare_jax", lambda *_, **__: None)
    given = [argument.replace("{run}", str(audited)) for argument in arguments]
    assert cli.main([verb, str(audited), *given]) == 0
    assert (audited / made).exists()


@pytest.mark.thorough
def test_animate_reads_the_audited_folder(audited):
    """In a process of its own, which owns the graphics."""
    done = subprocess.run([sys.executable, "-m", "rtcd_jax", "animate", str(audited)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (audited / "animation" / "swingup.gif").is_file()


def test_disturb_reads_the_audited_folder(audited):
    comparison = read_comparison(audited, silent())
    assert comparison.names == ("initial", "best")
    assert {elite.guarantee for elite in comparison.elites} == {"claimed"}


@pytest.mark.skipif(not REFERENCE.is_file(), reason="RTCD_REFERENCE names no folder with pendulum_initial.csv")
def test_the_published_funnel_of_the_initial_pendulum(tmp_path):
    """The exact areas are the published ones, most of the first ellipse leaves, and a moved nominal is near."""
    external = read_external(REFERENCE, "pendulum", {"m": 0.7, "l": 0.4, "b": 0.1, "g": 9.81, "torque_limit": 2.5})
    assert external.volumes.sum() == pytest.approx(156.9, abs=0.05)
    moved = projected(external, Cost.of(external, (10.0, 1.0), 0.1, ()))
    assert np.abs(moved.x - external.x).max() < 0.2
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
