"""An MJCF makes a problem if it moves as its equations say, and is refused by name otherwise."""

import jax
import numpy as np
import pytest

from rtcd_jax.config.load import EXAMPLE, parse
from rtcd_jax.config.plants import PLANTS
from rtcd_jax.plants.agreement import require_agreement
from rtcd_jax.problem import make_problem
from rtcd_jax.system.errors import UserError
from tests.plants.robots import design, packaged

MOTOR = '<motor name="torque" joint="theta" gear="1"/>'
HINGE = 'type="hinge" axis="0 -1 0"'
RK4 = 'integrator="RK4"'
TENDON = '<tendon><fixed name="t"><joint joint="theta" coef="1"/></fixed></tendon></mujoco>'
SET = """
theta: {damping: 0.1}
body.bob: {mass: mass, ipos: [0, 0, -length], inertia: [0, 0, 0]}
"""


def pendulum(*replacements):
    """The problem of the example's pendulum as a robot of one's own, with replacements in its MJCF."""
    text = PLANTS["pendulum"].xml
    for old, new in replacements:
        assert text.count(old) == 1
        text = text.replace(old, new)
    from rtcd_jax.config import yaml12

    data = yaml12.read(EXAMPLE)
    data["plant"] = {"mjcf": "robot.xml", "xml": text, "inputs": {"torque": {"limit": 2.5}}, "set": yaml12.read(SET)}
    for name, unit in ("mass", "kg"), ("length", "m"):
        data["design"][name]["unit"] = unit
    return make_problem(parse(data))


@pytest.mark.thorough
@pytest.mark.parametrize(
    "replacements",
    {
        "none": (),
        "gear": ((MOTOR, MOTOR.replace('gear="1"', 'gear="-2"')),),
        "armature": ((HINGE, f'{HINGE} armature="1e-4"'),),
        "joint's place": ((HINGE, f'{HINGE} pos="0 0.01 0"'),),
        "the mirror image": ((HINGE, 'type="hinge" axis="0 1 0"'),),
        "degrees where nothing is an angle": (('angle="radian"', 'angle="degree"'),),
        "numbers that every design replaces": (('mass="0.7" pos="0 0 -0.4"', 'mass="7" pos="0 0 -4"'),),
        "limits of the control": ((MOTOR, MOTOR.replace('gear="1"', 'ctrllimited="true" ctrlrange="-1 1"')),),
        "another integrator": ((RK4, 'integrator="Euler"'),),
    }.values(),
)
def test_what_has_equations_is_taken(replacements):
    assert pendulum(*replacements).plant.state_names == ("theta", "theta_dot")


@pytest.mark.parametrize(
    ("replacement", "words"),
    [
        ((MOTOR, '<position name="torque" joint="theta" kp="1"/>'), r"an actuator that is no motor .*actuator torque"),
        ((MOTOR, '<velocity name="torque" joint="theta" kv="1"/>'), r"an actuator that is no motor .*actuator torque"),
        (('<body name="bob">', '<body name="bob" gravcomp="0.1">'), r"gravity compensation: body bob"),
        ((RK4, f'{RK4} viscosity="1"'), r"a fluid: option viscosity = 1"),
        (("</mujoco>", TENDON), r"tendons: tendon t"),
        (('contype="0"', 'contype="1"'), r"contacts are on .*geom motor, hub, rod, bob"),
        ((HINGE, f'{HINGE} frictionloss="0.1"'), r"friction loss, which is not smooth: joint theta"),
        ((HINGE, f'{HINGE} limited="true" range="-1 1"'), r"joint limits are on .*task.state_limits.*joint theta"),
        ((HINGE, f'{HINGE} ref="0.5"'), r"task.goal = .* is no equilibrium"),
        ((RK4, f'{RK4} solver="PGS"'), r"PGS"),
        (('damping="0.1"/>', 'damping="0.1 0.05"/>'), r"moves otherwise than its equations: at mass = "),
        ((f"<option {RK4}", f'<option {RK4} actuatorgroupdisable="0"'), r"moves otherwise than its equations"),
        (("</actuator>", '<motor joint="theta"/></actuator>'), r"plant.mjcf.*motor number 1 has no name"),
        ((HINGE, 'type="ball"'), r"plant.mjcf.*joint theta is a ball: use hinges and slides"),
        (("<worldbody>", "<worldbody"), r"plant.mjcf.*is no XML"),
        (('body name="bob"', 'body name="ball"'), r"plant.set.body.bob: is no body, joint, motor or geom of the MJCF"),
    ],
)
def test_what_has_none_is_refused_by_name_in_one_line(replacement, words):
    with pytest.raises(UserError, match=words) as caught:
        pendulum(replacement)
    assert len(str(caught.value).splitlines()) == 1


def test_an_mjcf_that_moves_otherwise_is_refused_with_the_numbers():
    plant = packaged("pendulum")
    xml = plant.xml.replace('gear="1"', 'gear="2"')
    other = type("Robot", (type(plant),), {"xml": xml})(*jax.tree.leaves(plant))
    number = r"-?[\d.e-]+"
    words = (
        rf"^the MJCF of Robot moves otherwise than its equations: at mass = {number}, length = {number}, "
        rf"theta = {number}, theta_dot = {number}, torque = {number} "
        rf"MuJoCo's accelerations are \({number}\), the equations' \({number}\)$"
    )
    random = np.random.default_rng(0)
    with pytest.raises(UserError, match=words):
        require_agreement(
            other, [design("pendulum", mass=0.7, length=0.4)], random.normal(size=(8, 2)), random.normal(size=(8, 1))
        )
