"""The exported MJCF and URDF move as the design that the run has optimized."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

from xml.etree import ElementTree as Xml

import mujoco
import numpy as np
import pytest

from rtcd_jax.config.plants import PLANTS
from rtcd_jax.export import robot
from rtcd_jax.plants.model import CpuDynamics


def mass_matrix_and_forces(model, position, velocity):
    """M(q), and gravity, centrifugal and damping forces, without limits and contacts."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    data.qpos, data.qvel = position, velocity
    mujoco.mj_forward(model, data)
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, matrix)
    return matrix, data.qfrc_bias - data.qfrc_passive


@pytest.fixture(params=["robot.xml", "robot.urdf"])
def described(request, export):
    """The robot as MuJoCo reads the exported file."""
    model = mujoco.MjModel.from_xml_path(str(export.folder / request.param))
    if request.param == "robot.urdf":
        model.opt.gravity = export.bundle.model.opt.gravity  # no part of a URDF
    return model


@pytest.mark.thorough
def test_mass_matrix_gravity_and_damping_are_the_designs(export, described):
    random, joints = np.random.default_rng(0), export.bundle.model.nv
    for _ in range(10):
        position, velocity = random.uniform(-3, 3, joints), random.uniform(-3, 3, joints)
        for ours, theirs in zip(
            mass_matrix_and_forces(export.bundle.model, position, velocity),
            mass_matrix_and_forces(described, position, velocity),
            strict=True,
        ):
            np.testing.assert_allclose(theirs, ours, rtol=1e-12, atol=1e-12)


@pytest.mark.thorough
def test_joints_keep_their_names_and_order(export, described):
    names = [described.joint(i).name for i in range(described.njnt)]
    assert names == [export.bundle.model.joint(i).name for i in range(described.njnt)]


def test_the_mjcf_saturates_where_the_robot_does(export):
    model = mujoco.MjModel.from_xml_path(str(export.folder / "robot.xml"))
    np.testing.assert_array_equal(model.actuator_ctrlrange, [[-u, u] for u in export.bundle.elite.u_max])
    assert model.actuator_ctrllimited.all()


def test_the_urdf_says_how_strong_a_motor_is_and_where_a_slide_ends(export):
    text = (export.folder / "robot.urdf").read_text()
    if export.bundle.elite.plant == "cartpole":
        assert 'effort="6.0" velocity="1000.0" lower="-0.3" upper="0.3"' in text
        assert text.count('effort="0.0"') == 1
    else:
        assert 'type="continuous"' in text
        assert 'effort="2.5" velocity="7.0"' in text


def test_drake_finds_the_urdfs_joints_and_actuators_and_the_designs_accelerations(export):
    pytest.importorskip("pydrake")
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant, ours = MultibodyPlant(0.0), export.bundle.model
    Parser(plant).AddModels(str(export.folder / "robot.urdf"))
    plant.Finalize()
    motors = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    assert [motor.joint().name() for motor in motors] == [ours.joint(int(j)).name for j in export.bundle.joints]
    assert [motor.effort_limit() for motor in motors] == export.bundle.elite.u_max.tolist()
    context = plant.CreateDefaultContext()
    for x, u, rates in _motions(export.bundle):
        plant.SetPositionsAndVelocities(context, x)
        plant.get_actuation_input_port().FixValue(context, u)
        derivatives = plant.EvalTimeDerivatives(context).CopyToVector()
        np.testing.assert_allclose(derivatives, rates, rtol=1e-7, atol=1e-7)


def test_pinocchio_moves_the_urdf_as_the_design(export):
    pinocchio = pytest.importorskip("pinocchio")
    model, ours = pinocchio.buildModelFromUrdf(str(export.folder / "robot.urdf")), export.bundle.model
    assert list(model.names)[1:] == [ours.joint(i).name for i in range(ours.njnt)]
    data, half = model.createData(), ours.nv
    turns = [model.joints[i + 1].nq == 2 for i in range(half)]  # (cos, sin)
    for x, u, rates in _motions(export.bundle):
        q = np.concatenate([[np.cos(a), np.sin(a)] if turn else [a] for a, turn in zip(x[:half], turns, strict=True)])
        tau = -model.damping * x[half:]
        tau[export.bundle.joints] += u
        np.testing.assert_allclose(pinocchio.aba(model, data, q, x[half:], tau), rates[half:], rtol=1e-7, atol=1e-7)


def _motions(bundle):
    """States, inputs and the state's rates by the exported design's own MuJoCo model."""
    random, n, m = np.random.default_rng(1), bundle.elite.x_goal.size, bundle.elite.u_max.size
    f = CpuDynamics(bundle.model, n + m)
    for x, u in zip(random.uniform(-2, 2, (10, n)), random.uniform(-2, 2, (10, m)), strict=True):
        yield x, u, f(x[None], u[None])[0]


def test_every_input_has_a_transmission_of_its_own(export):
    """Where Drake and ROS look for motors."""
    model, root = export.bundle.model, Xml.parse(export.folder / "robot.urdf").getroot()
    driven = [(each.find("joint").get("name"), each.find("actuator").get("name")) for each in root.iter("transmission")]
    expected = [(model.joint(int(j)).name, model.actuator(i).name) for i, j in enumerate(export.bundle.joints)]
    assert driven == expected
    assert len(driven) == export.bundle.elite.u_max.size


def test_an_edit_that_the_file_cannot_take_is_refused_by_name():
    with pytest.raises(ValueError, match=r"geom_rgba edited; known: body_mass"):
        robot.mjcf(PLANTS["pendulum"].xml, {"geom_rgba": {"bob": np.ones(4)}}, [2.5])
    with pytest.raises(ValueError, match=r"body_mass is edited, but the MJCF has no body\[@name='ball'\]"):
        robot.mjcf(PLANTS["pendulum"].xml, {"body_mass": {"ball": np.ones(())}}, [2.5])


@pytest.mark.parametrize("joint", ['type="ball"', 'type="hinge" pos="0 0 1"'])
def test_a_joint_that_a_urdf_cannot_say_is_refused_by_name(joint):
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body name="arm"><joint {joint}/><geom size="1"/></body></worldbody></mujoco>'
    )
    with pytest.raises(ValueError, match="body arm: a URDF wants one hinge or slide"):
        robot.urdf("arm", model, [np.inf] * 6, [])
