"""`rtcd new` and `rtcd optimize --dry`: a robot that nobody has seen, from its MJCF to what is understood of it."""

import os
import subprocess
import sys

import pytest

from rtcd_jax.cli.main import main
from rtcd_jax.config.load import load
from tests.paths import ROOT
from tests.plants.trees import NAMED


@pytest.fixture
def robot(tmp_path):
    """The MJCF of a triple pendulum on a cart, whose motor has a range."""
    path = tmp_path / "triple.xml"
    text = NAMED["triple pendulum on a cart"]
    path.write_text(text.replace("<motor ", '<motor name="force" ctrllimited="true" ctrlrange="-30 30" ', 1))
    return path


def test_a_draft_is_a_configuration_of_what_the_mjcf_says(robot, capsys):
    assert main(["new", str(robot)]) == 0
    written = robot.with_suffix(".yaml")
    assert f"{written}" in capsys.readouterr().out
    config = load(written)
    assert len(config.plant.states) == 8
    assert config.plant.values() == {f"{next(iter(config.plant.input_units))}_limit": 30.0}
    text = written.read_text()
    for part in ("# set:", "mass:", "rad/s", "goal: ["):
        assert part in text


def test_a_draft_is_never_written_over_a_file(robot, capsys):
    robot.with_suffix(".yaml").write_text("mine")
    assert main(["new", str(robot)]) == 2
    assert "is there: choose another file by --to" in capsys.readouterr().err
    assert robot.with_suffix(".yaml").read_text() == "mine"


def dry(robot):
    """`rtcd new` and then --dry, as commands beside the MJCF."""
    command = [sys.executable, "-m", "rtcd_jax"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    for words in ["new", robot.name], ["optimize", f"{robot.stem}.yaml", "--dry"]:
        done = subprocess.run([*command, *words], cwd=robot.parent, env=environment, capture_output=True, text=True)
    return done


@pytest.mark.thorough
def test_what_is_understood_is_said_and_nothing_is_run(robot):
    done = dry(robot)
    assert done.returncode == 0
    said = done.stdout
    for part in ("an unstable equilibrium", "8 of 8 directions are controllable", "109 terms", "<= 30 N"):
        assert part in said
    assert not (robot.parent / "checkpoints").exists()


def test_a_goal_that_no_input_can_hold_is_refused_with_its_mode(robot):
    """The second of two pendulums that hang from one fixed frame, of which one alone has a motor."""
    inertial = '<inertial pos="0 0 -1" mass="1" diaginertia="1 1 1"/>'
    bodies = (f'<body><joint name="{name}" axis="0 -1 0"/>{inertial}</body>' for name in ("driven", "free"))
    robot.write_text(
        f"<mujoco><worldbody>{''.join(bodies)}</worldbody>"
        '<actuator><motor name="torque" joint="driven" ctrlrange="-1 1"/></actuator></mujoco>'
    )
    done = dry(robot)
    assert done.returncode == 2
    said = done.stderr
    assert "task.goal" in said
    assert "no input reaches the mode" in said
    assert "in which free" in said
