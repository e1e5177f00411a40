"""Claims about any robot of one motor: derived from its MJCF, equal to C MuJoCo, and to what was written by hand."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import json
from math import comb

import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.falsify.falsify import Part, summed
from rtcd_jax.certificate.falsify.simulation import Motions
from rtcd_jax.certificate.prove.certify import certify_elite
from rtcd_jax.certificate.prove.closed_loop import claim_of, double, doubles, robot_record, with_digests
from rtcd_jax.certificate.prove.field import ControlPoints, rate
from rtcd_jax.certificate.prove.robot import claimed_robot
from rtcd_jax.certificate.prove.uncertainty import bounds_of
from rtcd_jax.certificate.standing import difference, standing, standing_of
from rtcd_jax.cli import main as cli
from rtcd_jax.config.plants import PLANTS, read_plant
from rtcd_jax.config.schema import UncertaintyConfig
from rtcd_jax.elite.elite import Elite
from rtcd_jax.plants import model_of
from rtcd_jax.plants.model import LEAST_INERTIA, CpuDynamics
from rtcd_jax.system.errors import UserError
from tests.certificate import balance, swing, upright
from tests.certificate.folder import folder_with
from tests.certificate.test_check import refusal, resealed
from tests.plants.trees import SWING, link, mjcf

STATES = 100
FIELD_ROUNDING = 1e-12
"""Share of the largest rate."""


def claimed(elite, **uncertainty):
    bounds = bounds_of(elite, UncertaintyConfig(**uncertainty))
    told = {**claim_of(elite, bounds), "start": [0, double(0.0)], "push": double(0.0)}
    return check.read_claim(check.Node("claim", with_digests(told)))


def standing_elite(config, parameters, limit, n):
    """One that stays where it is: what claims read of it is its robot."""
    arrays = {
        "time": np.array([0.0, 0.1]), "x": np.zeros((2, n)), "u": np.zeros((1, 1)), "K": np.zeros((2, 1, n)),
        "S": np.array([np.eye(n)] * 2), "rho": np.ones(2), "Q": np.eye(n), "R": np.eye(1), "K_goal": np.zeros((1, n)),
        "x_goal": np.zeros(n), "u_max": np.array([limit]), "volumes_per_knot": np.ones(2),
    }  # fmt: skip
    section = None if config.name in PLANTS else config.model_dump(mode="json")
    record = {"plant": config.name, "parameters": parameters, "state_limits": [None] * n, **swing.PROMISE}
    return Elite.of(arrays, record | ({"robot": section} if section else {}))


def assert_field_is_mujoco_s(elite, seed=0):
    """The claim's equations beside C MuJoCo's accelerations of the recompiled model, without its least inertias."""
    robot, random = claimed_robot(elite), np.random.default_rng(seed)
    model = model_of(elite.robot, elite.parameters)
    model.body_inertia[model.body_inertia <= LEAST_INERTIA] = 0
    x = random.uniform(-3, 3, (STATES, len(robot.description.states)))
    u = random.uniform(-1, 1, (STATES, 1)) * robot.limit
    expected = CpuDynamics(model, STATES)(x, u)
    found = rate(robot.description, robot.numbers, x.T, u[:, 0]).T
    np.testing.assert_allclose(found, expected, rtol=0, atol=FIELD_ROUNDING * np.abs(expected).max())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", [name for name, plant in PLANTS.items() if len(plant().input_units) == 1])
def test_the_derived_field_is_c_mujoco_s(name, seed):
    random = np.random.default_rng(seed)
    numbers = {
        key: value * random.uniform(0.7, 1.3) + 1e-3 * (value == 0) for key, value in PLANTS[name]().values().items()
    }
    parameters, limit = upright.parameters_of(name, **numbers)
    config = PLANTS[name]()
    assert_field_is_mujoco_s(standing_elite(config, parameters, limit, len(config.states)), seed)


SPRUNG = mjcf(
    link(
        "cart",
        'type="slide" axis="1 0.3 0.2" damping="2" stiffness="3" springref="0.2" armature="0.1"',
        link("pole", SWING, link("tip", 'type="hinge" axis="0.1 1 0.4" pos="0 0.02 0.1"', place="0.1 0.02 0.3")),
    ),
    'name="motor" joint="cart" gear="-3" ctrllimited="true" ctrlrange="-2 2"',
)


def own(xml, **section):
    return read_plant({"mjcf": "own.xml", "xml": xml, **section})


def own_elite(xml, parameters, limit, **section):
    config = own(xml, **section)
    return standing_elite(config, parameters | {"motor_limit": limit}, limit, len(config.states))


def sprung_elite():
    return own_elite(
        SPRUNG,
        {"heavy": 0.7, "long": 0.4, "ratio": 1.7},
        2.0,
        constants={"ratio": 1.7},
        set={"body.pole": {"mass": "heavy"}, "body.tip": {"pos": ["long/ratio", 0.1, "long**2"]}},
    )


def test_an_own_robot_in_space_with_a_spring_on_a_slide_is_c_mujoco_s():
    elite = sprung_elite()
    assert_field_is_mujoco_s(elite)
    names = claimed_robot(elite).numbers
    assert names == {"heavy": 0.7, "long": 0.4, "long/ratio": 0.4 / 1.7}, "a quotient is a number of its own"


@pytest.mark.parametrize(
    ("uncertainty", "reason"),
    [
        ({"design": {"weight": 0.1}}, "no number of the own is 'weight'; "),
        ({"design": {"long": 0.1}}, "no certificate bears long, which the robot has in 'long/ratio'"),
        ({"plant": {"ratio": 0.1}}, "no certificate bears ratio, which the robot has in 'long/ratio'"),
        ({"plant": {"motor_limit": 0.1}}, "no number of the own is 'motor_limit'; "),
    ],
)
def test_what_no_proof_bears_is_refused(uncertainty, reason):
    elite = sprung_elite()
    with pytest.raises(UserError, match=reason):
        claimed(elite, **uncertainty)


def test_a_spring_on_a_hinge_has_no_claim():
    """Its potential is no trigonometric polynomial."""
    sprung = mjcf(
        link("pole", 'type="hinge" axis="0 1 0" stiffness="1"'),
        'name="motor" joint="pole" ctrllimited="true" ctrlrange="-1 1"',
    )
    with pytest.raises(UserError, match="no certificate for a spring on the hinge pole"):
        claim_of(own_elite(sprung, {}, 1.0))


def test_more_states_than_proofs_are_for_are_told_in_a_line(tmp_path, capsys):
    run = folder_with(tmp_path / "run", *upright.elite("double_cartpole", inputs=(0.0,), dt=0.001))
    assert cli.main(["certify", str(run)]) == 2
    assert capsys.readouterr().err == "rtcd: no certificate for 6 states: proofs are for 2 and 4\n"


# Boxes ----------------------------------------------------------------------------------------------------------------


def test_a_number_that_follows_from_others_is_their_arithmetic():
    """The cart-pole's inertia, a rod's: stored a millionth beside it, it keeps that share and moves with mass and
    length; a measured one is a number of its own."""
    elite = Elite.of(*balance.elite())
    claim = claimed(elite, design={"pole_mass": 0.1, "pole_length": 0.05})
    assert claim.uncertain == ["Mp", "lp"]
    assert "inertia_about_com" not in claim.parameters
    p = balance.PARAMETERS
    numbers = {**p, "Mp": 1.1 * p["Mp"], "lp": 0.95 * p["lp"], "inertia_about_com": 1.1 * 0.95**2 * 0.00239204}
    x = np.random.default_rng(0).uniform(-2, 2, (4, 50))
    np.testing.assert_allclose(rate(claim.robot, numbers, x, 1.0), balance.rate(x, 1.0, numbers), rtol=1e-11)
    arrays, record = balance.elite()
    measured = {**record, "parameters": {**p, "inertia_about_com": 0.004359984}}
    assert claimed_robot(Elite.of(arrays, measured)).numbers["inertia_about_com"] == 0.004359984


def test_ends_of_a_box_are_rounded_outward():
    claim = claimed(Elite.of(*swing.elite()), design={"mass": 0.03}, plant={"damping": 0.2})
    for name, value, width in (("m", 0.6, 0.03), ("b", 0.1, 0.2)):
        low, high = claim.parameters[name]
        assert float(low) < value * (1 - width)
        assert float(high) > value * (1 + width)
        assert float(high - low) < 2 * value * width * (1 + 1e-12)


@pytest.mark.parametrize(
    ("name", "box"),
    [("acrobot", {"lower_mass": 0.1, "upper_length": 0.05}), ("furuta", {"rod_length": 0.1, "arm_length": 0.1})],
)
def test_control_points_of_two_swinging_joints_are_the_field_s(name, box):
    """Their means by the Bernstein weights are D, a and b of robots inside the box."""
    elite = Elite.of(*upright.elite(name))
    claim = claimed(elite, design=box)
    points = ControlPoints.of(claim)
    x = np.random.default_rng(1).uniform(-2, 2, (claim.n, 5))
    found = points.field(claim.robot, x)
    degrees = [len(np.unique(points.numbers[key])) - 1 for key in claim.uncertain]
    for place in (0.2, 0.9):
        weights = np.eye(1)
        for degree in degrees:
            weights = np.kron(
                weights, [comb(degree, j) * place**j * (1 - place) ** (degree - j) for j in range(degree + 1)]
            )
        numbers = {key: float(low) + place * float(high - low) for key, (low, high) in claim.parameters.items()}
        determinant, a, b = (np.einsum("j,...jd->...d", weights[0], each) for each in found)
        np.testing.assert_allclose(
            (a + 0.3 * b) / determinant, rate(claim.robot, numbers, x, 0.3), rtol=1e-9, atol=1e-9
        )


# A whole certificate of two swinging joints ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def acrobot(tmp_path_factory):
    """A run folder whose elite, an acrobot, is proved."""
    folder = folder_with(tmp_path_factory.mktemp("acrobot"), *upright.elite("acrobot", inputs=(0.3,), dt=0.005))
    outcome = certify_elite(folder, "000", "proved", lambda step: None)
    assert outcome is not None
    assert outcome.whole
    return folder


@pytest.fixture(scope="module")
def proof_text(acrobot):
    return (acrobot / "certificates" / "000.json").read_text()


@pytest.fixture
def proof(proof_text):
    return json.loads(proof_text)


@pytest.mark.thorough
def test_two_swinging_joints_are_proved_and_not_falsified(acrobot, proof):
    report = check.check(proof)
    assert standing(acrobot, "000").proved
    assert "the model 'acrobot' (upper_length = 0.3, lower_length = 0.2" in check.sentence(report)
    assert set(report.claim.equations.waves) == {(1, 0), (0, 1), (1, 1)}
    found = summed([Part.of(Motions(proof).follow(100, 8, np.random.default_rng(3)))], 8)
    assert found.broken == 0
    assert found.level > 0.9


def _scaled(*path, factor):
    def change(content):
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = (float.fromhex(content[path[-1]]) * factor).hex()

    return change


LIES = {
    "a heavier link": (_scaled("claim", "parameters", "lower_mass", 0, factor=1.3), "parameters.lower_mass: must rise"),
    "heavier links": (_scaled("claim", "parameters", "lower_mass", 1, factor=1.3), "goal"),
    "another coupling": (_scaled("claim", "robot", "mass", 1, 0, 1, "cos", factor=0.7), "goal"),
    "a mass matrix that is none": (_scaled("claim", "robot", "mass", 1, 1, 1, "cos", factor=1e-3), "determinant"),
    "another wave of the potential": (_scaled("claim", "robot", "potential", 0, "cos", factor=-1.0), "goal"),
    "a motor at two joints": (
        lambda c: c["claim"]["robot"]["motor"][0].extend(c["claim"]["robot"]["motor"][1]),
        "goal",
    ),
    "no weight": (lambda c: c["claim"]["robot"]["potential"].clear(), "claim.parameters: must be the robot's"),
    "another axis": (_scaled("funnel", 0, "first", 1, 0, factor=1.4), "funnel[0]"),
    "a wider goal": (_scaled("goal", "axes", 0, 0, factor=1.5), "goal"),
    "an input": (_scaled("claim", "u", 0, factor=1.5), "funnel[0]"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("lie", LIES)
def test_what_is_not_so_of_two_swinging_joints_is_refused_with_its_place(proof, lie):
    change, reason = LIES[lie]
    change(proof)
    assert reason in refusal(resealed(proof))


# Files about robots in other words ------------------------------------------------------------------------------------


def in_other_words(content, robot, parameters):
    """The same claim with a robot as it was once written by hand."""
    numbers = check.numbers_of(robot)
    told = {name: doubles((value, value)) for name, value in parameters.items() if name in numbers}
    content["claim"] |= {"robot": robot_record(robot), "parameters": told}
    return resealed(content)


def test_a_certificate_in_other_words_proves_the_same_elite(content, tmp_path):
    """Files of version 2 had the two robots in words of their own."""
    file, elite = tmp_path / "000.json", Elite.of(*swing.elite())
    file.write_text(json.dumps(in_other_words(content, check.PLANTS["pendulum"].robot, swing.PARAMETERS)))
    assert standing_of(file, elite).proved
    told = in_other_words(content, check.PLANTS["pendulum"].robot, swing.PARAMETERS)
    told["claim"]["robot"]["mass"][0][0][0]["cos"] = (1.01).hex()
    file.write_text(json.dumps(resealed(told)))
    assert "robot.mass: function 0 is another there" in standing_of(file, elite).reason


@pytest.mark.parametrize(("name", "stored"), [("pendulum", swing.elite), ("cartpole", balance.elite)])
def test_the_robots_of_version_1_are_the_derived_ones(name, stored):
    elite = Elite.of(*stored())
    content = {**claim_of(elite), "start": [0, double(0.0)], "push": double(0.0)}
    theirs = in_other_words({"claim": content}, check.PLANTS[name].robot, elite.parameters)["claim"]
    assert difference(theirs, check.read_claim(check.Node("claim", theirs)), elite) == ""
    x = np.random.default_rng(0).uniform(-3, 3, (len(elite.x_goal), STATES))
    robot = claimed_robot(elite)
    np.testing.assert_allclose(
        rate(robot.description, robot.numbers, x, 1.0),
        rate(check.PLANTS[name].robot, elite.parameters, x, 1.0),
        rtol=1e-11, atol=1e-11,
    )  # fmt: skip
