"""An MJCF that moves otherwise than the equations makes no problem, whatever of MuJoCo's features is the reason."""

import re

import pytest

from rtcd_jax import plants
from rtcd_jax.config.load import EXAMPLE, parse_yaml
from rtcd_jax.plants.cartpole import Cartpole
from rtcd_jax.plants.pendulum import Pendulum
from rtcd_jax.problem import make_problem
from rtcd_jax.system.errors import UserError

MOTOR = '<motor name="torque" joint="theta" gear="1"/>'
HINGE = 'type="hinge" axis="0 -1 0"'
RK4 = 'integrator="RK4"'
TENDON = '<tendon><fixed name="t"><joint joint="theta" coef="1"/></fixed></tendon></mujoco>'


@pytest.fixture
def pendulum(tmp_path, monkeypatch):
    """Makes the problem of the example's pendulum with replacements in its MJCF."""

    def make(*replacements):
        text = Pendulum.mjcf.read_text()
        for old, new in replacements:
            assert text.count(old) == 1
            text = text.replace(old, new)
        path = tmp_path / "robot.xml"
        path.write_text(text)
        monkeypatch.setitem(plants.PLANTS, "pendulum", type("Robot", (Pendulum,), {"mjcf": path}))
        return make_problem(parse_yaml(EXAMPLE))

    return make


@pytest.mark.parametrize(
    "replacement",
    {
        "gear": (MOTOR, MOTOR.replace('gear="1"', 'gear="2"')),
        "sign": (MOTOR, MOTOR.replace('gear="1"', 'gear="-1"')),
        "position actuator": (MOTOR, '<position name="torque" joint="theta" kp="1"/>'),
        "velocity actuator": (MOTOR, '<velocity name="torque" joint="theta" kv="1"/>'),
        "actuator's own damping": (MOTOR, '<general name="torque" joint="theta" biastype="affine" biasprm="0 0 -1"/>'),
        "stiffness": (HINGE, f'{HINGE} stiffness="0.01"'),
        "springdamper": (HINGE, f'{HINGE} springdamper="1 1"'),
        "armature": (HINGE, f'{HINGE} armature="1e-4"'),
        "ref": (HINGE, f'{HINGE} ref="0.5"'),
        "joint's place": (HINGE, f'{HINGE} pos="0.01 0 0"'),
        "gravity compensation": ('<body name="bob">', '<body name="bob" gravcomp="0.1">'),
        "viscosity": (RK4, f'{RK4} viscosity="1"'),
        "polynomial damping": ('damping="0.1"', 'damping="0.1 0.05"'),
        "actuation switched off": (f"<option {RK4}", f'<option {RK4} actuatorgroupdisable="0"'),
    }.values(),
)
def test_a_feature_that_the_equations_lack_is_refused_with_the_numbers(pendulum, replacement):
    number = r"-?[\d.e-]+"
    words = (
        rf"^robot\.xml moves otherwise than the equations of Robot: at mass = {number}, length = {number}, "
        rf"theta = {number}, theta_dot = {number}, torque = {number} "
        rf"MuJoCo's accelerations are \({number}\), the equations' \({number}\)$"
    )
    with pytest.raises(UserError, match=words):
        pendulum(replacement)


@pytest.mark.parametrize(
    "replacements",
    {
        "none": (),
        "a motor on a tendon that is the joint": (
            (MOTOR, '<motor name="torque" tendon="t"/>'),
            ("</mujoco>", TENDON),
        ),
        "the mirror image": ((HINGE, 'type="hinge" axis="0 1 0"'),),
        "degrees where nothing is an angle": (('angle="radian"', 'angle="degree"'),),
        "numbers that every design replaces": (
            ('mass="0.7" pos="0 0 -0.4"', 'mass="7" pos="0 0 -4"'),
            ('damping="0.1"', 'damping="3"'),
        ),
    }.values(),
)
def test_what_moves_the_same_is_taken(pendulum, replacements):
    assert pendulum(*replacements).plant.mjcf.name == "robot.xml"


@pytest.mark.parametrize(
    ("replacement", "words"),
    [
        ((RK4, 'integrator="Euler"'), r"robot.xml: robot.xml is no smooth model of Robot: its integrator must be"),
        ((RK4, f'{RK4} solver="PGS"'), r"robot.xml: .*PGS"),
        (("<worldbody>", "<worldbody"), r"robot.xml: XML"),
    ],
)
def test_a_file_that_mujoco_or_mjx_cannot_use_is_named(pendulum, replacement, words):
    with pytest.raises(UserError, match=words) as caught:
        pendulum(replacement)
    assert len(str(caught.value).splitlines()) == 1


def test_both_accelerations_of_a_robot_of_two_joints_are_compared(tmp_path, monkeypatch):
    path = tmp_path / "robot.xml"
    path.write_text(
        re.sub(r'(name="theta" type="hinge" axis="0 -1 0")', r'\1 stiffness="1"', Cartpole.mjcf.read_text())
    )
    monkeypatch.setitem(plants.PLANTS, "cartpole", type("Robot", (Cartpole,), {"mjcf": path}))
    variable = "{initial: 0.2, min: 0.1, max: 0.3}"
    text = f"""
plant: {{name: cartpole}}
task: {{start: [0, 3.141592653589793, 0, 0], goal: [0, 0, 0, 0], state_limits: [0.3, .inf, .inf, .inf]}}
design: {{pole_length: {variable}, pole_mass: {variable}}}
weights: {{q: [{variable}, {variable}, {variable}, {variable}], r: [{variable}]}}
"""
    with pytest.raises(UserError, match=r"MuJoCo's accelerations are \(\S+, \S+\), the equations' \(\S+, \S+\)$"):
        make_problem(parse_yaml(text))
