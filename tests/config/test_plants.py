"""The `plant` section: a robot of one's own from an MJCF, in one line each what is wrong with it."""

import numpy as np
import pytest

from rtcd_jax.config import yaml12
from rtcd_jax.config.load import config_hash, dump, load, parse, parse_yaml
from rtcd_jax.config.mjcf import LARGEST_FILE, NotMjcf, read_names
from rtcd_jax.config.plants import PLANTS, stored_plant
from rtcd_jax.run.sweep import read_cases
from rtcd_jax.system.errors import ConfigError, UserError

XML = PLANTS["acrobot"].xml
TEXT = """
plant:
  mjcf: robot.xml
  constants: {half: upper_length/2, gravity: 9.81}
  inputs: {torque: {limit: 6}}
  set:
    option: {gravity: [0, 0, -gravity]}
    body.upper: {ipos: [0, 0, -half], mass: 0.6}
    body.lower: {pos: [0, 0, -upper_length], mass: lower_mass}
design:
  upper_length: {initial: 0.3, min: 0.2, max: 0.4, unit: m}
  lower_mass: {initial: 0.6, min: 0.2, max: 1.0, unit: kg}
task: {start: [0, 0, 0, 0], goal: [pi, 0, 0, 0], state_limits: [2*pi, 2*pi, 30, 30]}
weights:
  q: [&any {initial: 1, min: 1, max: 10}, *any, *any, *any]
  r: [{initial: 1, min: 1, max: 10}]
"""


@pytest.fixture
def written(tmp_path):
    """Writes a configuration and its MJCF, each with replacements, and reads it."""

    def read(*replacements, xml=()):
        model, text = XML, TEXT
        for old, new in xml:
            assert old in model
            model = model.replace(old, new)
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "robot.xml").write_text(model)
        (tmp_path / "robot.yaml").write_text(text)
        return load(tmp_path / "robot.yaml")

    return read


def test_a_robot_is_read_from_the_mjcf_beside_its_configuration(written):
    config = written()
    assert config.plant.name == "robot"
    assert config.plant.states == {"shoulder": "rad", "elbow": "rad", "shoulder_dot": "rad/s", "elbow_dot": "rad/s"}
    assert config.plant.input_units == {"torque": "N m"}
    assert config.design_units == {"upper_length": "m", "lower_mass": "kg"}
    assert config.plant.uncertain == {"design": ("upper_length", "lower_mass"), "plant": ("gravity",)}


def test_the_resolved_configuration_stands_alone(written):
    """With the MJCF's text in it: read elsewhere, it is the same experiment, and another MJCF is another one."""
    config = written()
    assert parse_yaml(dump(config)) == config
    assert config_hash(parse_yaml(dump(config))) == config_hash(config)
    assert config_hash(written(xml=[("0.012", "0.013")])) != config_hash(config)


def test_a_number_of_the_model_is_its_arithmetic(written):
    robot = written().plant.robot({"upper_length": "m", "lower_mass": "kg"})
    values = {"upper_length": 0.4, "lower_mass": 0.5, "gravity": 9.0, "torque_limit": 6.0}
    assert robot.complete(values)["half"] == 0.2
    assert robot.values(robot.parameters(values)) == values
    assert robot.units["upper_length"] == "m"


def test_a_motor_s_limit_may_be_a_design_whose_uncertainty_is_the_input_limit_s(written):
    motor = ("limit: 6", "limit: 2*motor"), ("\ntask", "\n  motor: {initial: 3, min: 1, max: 4, unit: N m}\ntask")
    config = written(*motor)
    assert config.design_units["motor"] == "N m"
    assert config.plant.uncertain["design"] == ("upper_length", "lower_mass")
    with pytest.raises(ConfigError, match=r"uncertainty.design.motor: must be a design parameter"):
        written(*motor, ("\ntask", "\nuncertainty: {design: {motor: 0.1}}\ntask"))


@pytest.mark.parametrize(
    ("replacement", "words"),
    [
        (("body.upper", "body.uper"), r"plant.set.body.uper: is no body, joint, motor or geom .*did you mean"),
        (("mass: 0.6", "weight: 0.6"), r"plant.set.body.upper.weight: unknown key of a body; .*mass"),
        (
            ("body.upper: {ipos: [0, 0, -half], mass", "upper: {pos"),
            r"plant.set.upper.pos: is meant of which\? .*say body",
        ),
        (("-half]", "-half, 1]"), r"plant.set.body.upper.ipos = .*: must have 3 numbers, has 4"),
        (("upper_length/2", "half/2"), r"plant.constants: needs itself: half -> half"),
        (("-half]", "abs(half)]"), r"plant.set.body.upper.ipos.2 = .*is no arithmetic"),
        (("unit: m}", "pinned: false}"), r"design.upper_length.unit: is missing: say kg, m, or -"),
        (("torque: {limit: 6}", "force: {limit: 6}"), r"plant.inputs.force: is no motor of the MJCF; .*torque"),
        (("limit: 6", "limit: 0"), r"plant.inputs.torque.limit = 0: must be"),
        (
            ("limit: 6", "limit: half"),
            r"plant.inputs.torque.limit = 'half': names half: a motor",
        ),
        (("inputs: {torque: {limit: 6}}", "inputs: {}"), r"plant.inputs.torque.limit: is missing: .*no ctrlrange"),
        (
            ("lower_mass}", "lower_weight}"),
            r"design.lower_weight: is missing; robot's design is ",
        ),
        (("goal: [pi, 0, 0, 0]", "goal: [pi, 0, 0]"), r"task.goal: must have 4 entries"),
        (("mjcf: robot.xml", "mjcf: robots.xml"), r"plant.mjcf = 'robots.xml': cannot be read: No such file"),
        (("plant:\n", "plant:\n  name: acrobot\n"), r"plant.name: is a packaged robot"),
        (("plant:\n", "plant:\n  name: a-b\n"), r"plant.name = 'a-b': must be a letter"),
        (("plant:\n", "plant:\n  robot: 3\n"), r"plant.robot = 3: unknown key"),
    ],
)
def test_what_is_wrong_is_named(written, replacement, words):
    with pytest.raises(ConfigError, match=words):
        written(replacement)


@pytest.mark.parametrize(
    ("xml", "words"),
    [
        ("<robot/>", "root is <robot>, must be <mujoco>"),
        ("<mujoco>", "is no XML"),
        ("<mujoco/>", "has no joints"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><mujoco/>', "document type"),
        ('<mujoco><include file="other.xml"/></mujoco>', "has <include>: write the model out"),
        (XML.replace('name="elbow" type="hinge"', 'type="hinge"'), "joint number 1 has no name"),
        (XML.replace('name="elbow" type="hinge"', 'name="shoulder" type="hinge"'), "joint shoulder is there twice"),
        (XML.replace('name="elbow" type="hinge"', 'name="elbow" type="ball"'), "joint elbow is a ball"),
        (XML.replace('joint="elbow"', 'joint="knee"'), "actuator torque drives joint knee, which is not there"),
        (XML.replace('joint="elbow"', 'tendon="t"'), "actuator torque drives no joint"),
    ],
)
def test_an_mjcf_that_cannot_be_meant_is_refused(xml, words):
    with pytest.raises(NotMjcf, match=words):
        read_names(xml)


def test_defaults_of_classes_count():
    """Types and ranges stand in classes as well, which bodies hand down."""
    xml = """<mujoco>
      <default><motor ctrlrange="-3 3"/><default class="rail"><joint type="slide"/></default></default>
      <worldbody>
        <body name="outer" childclass="rail"><body name="inner"><joint name="b"/></body><joint name="a"/>
          <frame><joint name="c" type="hinge"/></frame></body>
      </worldbody>
      <actuator><motor name="u" joint="a"/></actuator>
    </mujoco>"""
    names = read_names(xml)
    assert [(joint.name, joint.hinge) for joint in names.joints] == [("a", False), ("c", True), ("b", False)]
    assert names.motors[0].limit == 3
    assert names.bodies == ("outer", "inner")


def test_a_stored_robot_that_is_not_there_is_named():
    with pytest.raises(UserError, match=r"no plant is called 'acrobat'; did you mean 'acrobot'"):
        stored_plant("acrobat")
    with pytest.raises(UserError, match=r"the robot mine: mjcf = 3: must be a text"):
        stored_plant("mine", {"name": "mine", "mjcf": 3})


@pytest.mark.parametrize("name", PLANTS)
def test_every_number_of_a_packaged_robot_may_be_stored_and_read(name):
    plant = PLANTS[name]()
    robot = plant.robot()
    random = np.random.default_rng(0)
    values = {named.name: float(random.uniform(0.1, 0.9)) for named in (*robot.design, *robot.constants)}
    again = plant.with_parameters(robot.parameters(values))
    assert again.values() == {named.name: values[named.name] for named in robot.constants}


def test_a_class_outside_the_package_is_a_robot(tmp_path, monkeypatch):
    (tmp_path / "my_robots.py").write_text(
        "from typing import ClassVar\n"
        "from rtcd_jax.plants.robot import plant_class\n"
        "from rtcd_jax.config.plants import PLANTS\n"
        "class Mine(plant_class(PLANTS['pendulum']().robot())):\n"
        "    damping: float = 0.1\n    gravity: float = 9.81\n    torque_limit: float = 2.5\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    data = yaml12.read(TEXT) | {"plant": {"python": "my_robots:Mine", "constants": {"damping": 0.2}}}
    variable = {"initial": 0.5, "min": 0.4, "max": 0.6}
    data |= {"design": {"mass": variable, "length": variable}}
    data["task"] = {"start": [0, 0], "goal": ["pi", 0], "state_limits": [7, 7]}
    data["weights"]["q"] = data["weights"]["q"][:2]
    config = parse(data)
    assert config.plant.states == {"theta": "rad", "theta_dot": "rad/s"}
    assert config.design_units == {"mass": "kg", "length": "m"}
    assert parse_yaml(dump(config)) == config
    for python, words in (
        ("my_robots:Yours", "no attribute 'Yours'"),
        ("no_such_module:Mine", "No module named"),
        ("my_robots", "must be package.module:Class"),
        ("math:pi", "must be a subclass of"),
    ):
        with pytest.raises(ConfigError, match=words):
            parse(data | {"plant": {"python": python}})


def test_a_sweep_of_a_robot_reads_its_mjcf(written, tmp_path):
    config = written()
    text = (tmp_path / "robot.yaml").read_text() + "sweep: {product: {design.lower_mass.initial: [0.5, 0.6]}}\n"
    (tmp_path / "sweep.yaml").write_text(text)
    cases = read_cases(tmp_path / "sweep.yaml", tmp_path / "runs")
    assert [case.config.design["lower_mass"].initial for case in cases] == [0.5, 0.6]
    assert cases[1].config == config


def test_the_largest_mjcf_makes_a_configuration_that_can_be_read(written):
    """Also where YAML must quote it."""
    comment = "x\t" * ((LARGEST_FILE - len(XML) - len("<!---->")) // 2)
    config = written(xml=[("</mujoco>\n", f"</mujoco>\n<!--{comment}-->")])
    assert parse_yaml(dump(config)) == config
    with pytest.raises(ConfigError, match=r"plant.mjcf = 'robot.xml': has more than 131072 bytes"):
        written(xml=[("</mujoco>\n", f"</mujoco>\n<!--{'x' * LARGEST_FILE}-->")])
