"""What an export brings for a lab: wrapped encoders, the demonstration, the ROS 2 node, Drake, and its README's facts.

ROS 2 itself is not here: its interface, as far as the node uses it, is a stub.
"""

import ctypes
import json
import subprocess
import sys
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from rtcd_jax.export.robustness import borne
from tests.export.conftest import module
from tests.export.test_controller import COMPILER, STRICT, needs_compiler
from tests.export.test_toolkits import Robot


def turned(export, random):
    """Times, states around the funnel, and the same with their angles whole turns off."""
    bundle = export.bundle
    for t in random.uniform(0, 1.1 * bundle.elite.time[-1], 50):
        now = bundle.at(t)
        x = now.x + now.axes @ random.uniform(-0.7, 0.7, now.x.size)
        yield t, x, x + 2 * np.pi * random.integers(-3, 4, x.size) * bundle.angles


@pytest.mark.thorough
def test_whole_turns_are_taken_out_of_wrapped_angles_alone(export):
    plain, wrapped = export.module.Controller(), export.module.Controller(wrapped=True)
    differs = False
    for t, x, off in turned(export, np.random.default_rng(0)):
        np.testing.assert_allclose(wrapped.unwrap(t, off), x, atol=1e-12)
        np.testing.assert_allclose(wrapped.control(t, off), plain.control(t, x), atol=1e-9)
        assert wrapped.monitor(t, off).ratio == pytest.approx(plain.monitor(t, x).ratio, abs=1e-9)
        differs |= bool(np.abs(plain.control(t, off) - plain.control(t, x)).max() > 1e-3)
    assert differs
    assert wrapped.monitor(0.0, np.full(x.size, np.inf)).abort
    assert (
        list(export.bundle.angles)
        == {"pendulum": [True, False], "cartpole": [False, True, False, False]}[export.bundle.elite.plant]
    )


@pytest.mark.thorough
@needs_compiler
@pytest.mark.parametrize("options", ["-O2", "-O3 -ffast-math"])
def test_c_takes_whole_turns_out_as_python_does(export, tmp_path, options):
    label = export.bundle.label
    source, path = export.folder / f"{label}_controller.c", tmp_path / "controller.so"
    subprocess.run([COMPILER, *STRICT, *options.split(), "-shared", "-fPIC", source, "-o", path, "-lm"], check=True)
    vector = ctypes.c_double * export.bundle.elite.x_goal.size
    unwrap = getattr(ctypes.CDLL(str(path)), f"{label}_unwrap")
    unwrap.argtypes, unwrap.restype = [ctypes.c_double, vector], None
    for t, x, off in turned(export, np.random.default_rng(1)):
        values = vector(*off)
        unwrap(t, values)
        np.testing.assert_allclose(list(values), x, atol=1e-12)


def test_the_demonstration_swings_up_and_is_drawn_without_a_display(export):
    controller = export.folder / f"{export.bundle.label}_controller.py"
    done = subprocess.run(
        [sys.executable, controller, "--demo", "--headless", "--seed", "3"], capture_output=True, text=True
    )
    picture = export.folder / "demo.svg"
    try:
        assert done.returncode == 0, done.stderr
        assert "largest V/rho" in done.stdout
        assert picture.read_text().count("<path") == 2 * export.bundle.elite.x_goal.size + 3 + 2
    finally:
        picture.unlink(missing_ok=True)


class Stub:
    """ROS 2's node, as far as the exported one uses it: publishers keep what they are given, the clock is set."""

    def __init__(self, name):
        self.name, self.published, self.services, self.nanoseconds, self.warnings = name, {}, {}, 0, []

    def declare_parameter(self, name, default):
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_publisher(self, kind, topic, depth):
        sent = self.published.setdefault(topic, [])
        return SimpleNamespace(publish=lambda message: sent.append(message.data))

    def create_subscription(self, kind, topic, callback, depth):
        self.callback = callback

    def create_service(self, kind, name, callback):
        self.services[name] = callback

    def create_timer(self, period, callback):
        self.period, self.tick = period, callback

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=self.nanoseconds))

    def get_logger(self):
        return SimpleNamespace(warning=self.warnings.append)

    parameters: ClassVar[dict] = {}


@pytest.fixture
def node(export, monkeypatch):
    """The exported node on the stub."""
    data = type("Message", (SimpleNamespace,), {})
    modules = {
        "rclpy": {}, "rclpy.node": {"Node": Stub}, "sensor_msgs": {}, "sensor_msgs.msg": {"JointState": data},
        "std_msgs": {}, "std_msgs.msg": {"Float64": data, "Float64MultiArray": data}, "std_srvs": {},
        "std_srvs.srv": {"Trigger": SimpleNamespace(Response=SimpleNamespace)},
    }  # fmt: skip
    for name, content in modules.items():
        stub = ModuleType(name)
        vars(stub).update(content)
        monkeypatch.setitem(sys.modules, name, stub)
    monkeypatch.syspath_prepend(str(export.folder))
    return module(export.folder / f"{export.bundle.label}_ros2.py").ControllerNode()


COMMANDS = "/effort_controller/commands"


def say(node, x, joints=None):
    joints = joints or node.joints
    half = len(x) // 2
    node.callback(SimpleNamespace(name=list(joints), position=list(x[:half]), velocity=list(x[half:])))


def called(node, name):
    response = SimpleNamespace()
    return node.services[name](None, response)


def advance(node, robot, until):
    """Steps the robot under the last command and ticks the node every period; messages come every step."""
    due = 0.0
    while robot.t < until:
        node.nanoseconds = round(1e9 * robot.t)
        say(node, robot.x)
        if robot.t >= due - 1e-9:
            node.tick()
            due += node.period
        u = node.published[COMMANDS][-1]
        tau = np.zeros(robot.dof)
        tau[robot.bundle.joints] = u
        robot.step(tau)


def test_the_node_swings_up_from_a_fresh_state_inside_the_funnel(export, node):
    robot = Robot(export.bundle)
    assert node.joints == [joint.removesuffix("_dot") for joint in export.bundle.plant.state_names[: robot.dof]]
    calls = export.bundle.elite.time[1] / node.period
    assert calls == pytest.approx(round(calls))
    node.tick()
    assert COMMANDS in node.published
    assert node.published[COMMANDS] == []  # it commands nothing before it is started
    assert not called(node, "~/start").success
    say(node, robot.x)
    node.tick()
    assert node.published[COMMANDS] == []
    assert called(node, "~/start").success
    assert called(node, "~/start").message == "it runs"
    advance(node, robot, export.bundle.elite.time[-1] + 6.0)
    assert np.abs(robot.x - export.bundle.elite.x_goal).max() < 1e-2
    assert node.warnings == []
    assert max(node.published["~/ratio"]) <= 1


def test_the_node_stops_with_the_catch(export, node):
    """By itself, with zero efforts; until then it is that of any motion."""
    elite = export.bundle.elite
    node.controller.caught = True
    say(node, elite.x[0])
    assert called(node, "~/start").success
    node.tick()
    assert np.abs(node.published[COMMANDS][-1]).max() > 0
    node.nanoseconds = round(1e9 * (elite.time[-1] + node.period))
    say(node, elite.x_goal)
    node.tick()
    assert "catch set" in node.warnings[-1]
    assert not np.any(node.published[COMMANDS][-1])


def test_the_node_refuses_a_start_outside_and_stops_for_good(export, node):
    elite = export.bundle.elite
    say(node, elite.x[0] + 10 * export.bundle.at(0.0).axes[:, 0])
    assert not called(node, "~/start").success
    say(node, elite.x[0], joints=["another"] * len(node.joints))  # no state of these joints: the last one stays
    assert not called(node, "~/start").success
    say(node, elite.x[0])
    assert called(node, "~/start").success
    node.tick()
    assert np.abs(node.published[COMMANDS][-1]).max() > 0
    node.nanoseconds += round(1e9 * 1.1 * node.timeout)
    node.tick()
    assert "older than" in node.warnings[-1]
    assert not np.any(node.published[COMMANDS][-1])
    say(node, elite.x[0])
    node.tick()
    assert not np.any(node.published[COMMANDS][-1])  # it does not begin again by itself
    assert called(node, "~/start").success
    say(node, elite.x[0] + 10 * export.bundle.at(0.0).axes[:, 0])
    node.tick()
    assert "V/rho" in node.warnings[-1]
    assert not np.any(node.published[COMMANDS][-1])
    say(node, elite.x[0])
    assert called(node, "~/start").success
    assert called(node, "~/stop").success
    node.tick()
    assert not np.any(node.published[COMMANDS][-1])


def test_drake_simulates_the_exported_urdf_under_the_exported_system(export, monkeypatch):
    pytest.importorskip("pydrake", reason="pip install -e '.[drake]'")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
    from pydrake.systems.analysis import Simulator
    from pydrake.systems.framework import DiagramBuilder

    monkeypatch.syspath_prepend(str(export.folder))
    system = module(export.folder / f"{export.bundle.label}_drake.py").ControllerSystem()
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    Parser(plant).AddModels(str(export.folder / "robot.urdf"))
    plant.Finalize()
    controller = builder.AddSystem(system)
    builder.Connect(plant.get_state_output_port(), controller.get_input_port())
    builder.Connect(controller.GetOutputPort("input"), plant.get_actuation_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    elite = export.bundle.elite
    plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(context), elite.x[0] + 0.02)
    simulator.AdvanceTo(elite.time[-1] + 6.0)
    away = plant.GetPositionsAndVelocities(plant.GetMyContextFromRoot(context)) - elite.x_goal
    assert np.abs(away).max() < 1e-2
    ratio, abort = controller.GetOutputPort("monitor").Eval(controller.GetMyContextFromRoot(context))
    assert (ratio < 1, abort) == (True, 0.0)


def test_what_disturb_found_stands_in_the_readme(tmp_path):
    assert borne(tmp_path, "000") == ""
    (tmp_path / "disturbance").mkdir()
    levels, held = [-0.2, -0.1, 0.0, 0.1, 0.2], [0, 1, 1, 1, 1]
    perturbations = [
        {"name": "mass", "unit": "relative", "levels": levels, "success": {"best": held, "initial": [1, 0, 1, 0, 1]}},
        {"name": "delay", "unit": "s", "levels": [0.0, 0.01, 0.02], "success": {"best": [1] * 3, "initial": [0, 1, 1]}},
        {"name": "dry friction", "unit": "N m", "levels": [0.0, 0.1, 0.2], "success": {"best": [1, 1, 0]}},
        {"name": "control rate", "unit": "Hz", "levels": [1000.0, 100.0, 50.0], "success": {"best": [1, 1, 0]}},
        {"name": "torque noise", "unit": "input limit", "levels": [0.0, 0.1, 0.2], "success": {"best": [1, 0.9, 0]}},
        {"name": "perturbation", "unit": "profile", "levels": [0, 1], "success": {"best": [1, 0]}},
    ]  # fmt: skip
    (tmp_path / "disturbance" / "robustness.json").write_text(json.dumps({"troubles": perturbations}))
    push = {"impulse_unit": "N m s", "summary": {"best": {"tolerated_at_all_times": 0.25}}}
    (tmp_path / "disturbance" / "push_margin.json").write_text(json.dumps(push))
    assert borne(tmp_path, "000").splitlines()[2:] == [
        "- mass: -10 to +20 %",
        "- delay: up to 20 ms (the most that was tried)",
        "- dry friction: up to 0.1 N m",
        "- control rate: down to 100 Hz",
        "- torque noise: nothing that was tried",
        "- sudden push, at any time: up to 0.25 N m s",
    ]
    assert borne(tmp_path, "initial").splitlines()[2:] == [
        "- mass: nothing that was tried",
        "- delay: not even undisturbed",
    ]
    assert borne(tmp_path, "001") == ""
