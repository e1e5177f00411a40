"""MuJoCo, MJX and the closed form describe one robot."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import subprocess
import sys
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rtcd_jax.config.plants import PLANTS
from rtcd_jax.plants import model_of
from rtcd_jax.plants.mjx import MjxStepper, compile_model
from rtcd_jax.plants.model import CpuDynamics
from tests.plants.robots import design, packaged

DT = 0.01
BOUNDING_VOLUMES = {"geom_rbound", "geom_aabb", "bvh_aabb"}  # of the drawing alone; nothing here collides


def _rk4(f, x, dt):
    k1 = f(x)
    k2 = f(x + dt / 2 * k1)
    k3 = f(x + dt / 2 * k2)
    k4 = f(x + dt * k3)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def runge_kutta(robot):
    """The closed form's step over a batch of designs, states and inputs."""
    return jax.jit(jax.vmap(lambda design, x, u: _rk4(lambda y: robot.plant.dynamics(design, y, u), x, DT)))


def _c_step(model: mujoco.MjModel, x, u, dt: float) -> np.ndarray:
    model.opt.timestep = dt
    data = mujoco.MjData(model)
    data.qpos, data.qvel = np.split(np.asarray(x), 2)
    data.ctrl = np.asarray(u)
    mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel])


def _arrays(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    names = (name for name in dir(model) if not name.startswith("_") and name not in BOUNDING_VOLUMES)
    values = {name: getattr(model, name) for name in names}
    values["opt.gravity"] = model.opt.gravity
    return {k: v for k, v in values.items() if isinstance(v, np.ndarray) and np.issubdtype(v.dtype, np.number)}


def test_edited_model_is_the_recompiled_one_in_every_array(robot):
    edited = _arrays(compile_model(robot.plant, robot.design(1)))
    recompiled = _arrays(robot.recompiled(1))
    assert {"body_mass", "body_ipos", "dof_damping", "dof_invweight0", "geom_size"} <= edited.keys()
    for name, array in edited.items():
        np.testing.assert_allclose(array, recompiled[name], rtol=1e-12, atol=1e-15, err_msg=name)


def test_a_model_by_name_is_exact_in_any_precision(robot):
    parameters = robot.plant.parameters(robot.design(1))
    with jax.enable_x64(False):
        found = _arrays(model_of(PLANTS[robot.name](), parameters))
    for name, array in _arrays(robot.recompiled(1)).items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


def test_c_accelerations_are_the_closed_forms(robot):
    """1e-8 of them: the bodies' own inertia, which MuJoCo wants positive for a point mass, is far below that."""
    over_states = jax.jit(jax.vmap(robot.plant.dynamics, in_axes=(None, 0, 0)))
    for index in range(3):
        design = robot.design(index)
        expected = over_states(design, robot.x, robot.u)
        found = CpuDynamics(robot.recompiled(index), len(robot.x))(np.asarray(robot.x), np.asarray(robot.u))
        np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-8)


def test_c_accelerations_of_fewer_states_than_the_capacity(robot):
    x, u = np.asarray(robot.x), np.asarray(robot.u)
    dynamics = CpuDynamics(robot.recompiled(0), len(x))
    everything = dynamics(x, u)
    np.testing.assert_array_equal(dynamics(x[:5], u[:5]), everything[:5])
    np.testing.assert_array_equal(dynamics(x[5:], u[5:]), everything[5:])


@pytest.mark.thorough
def test_mjx_step_is_the_closed_forms_runge_kutta_step(robot, mjx_step):
    """Step by step along 100 steps; the tolerance is the bodies' own inertia, as above."""
    closed_form, x = runge_kutta(robot), robot.x
    for _ in range(100):
        ours, theirs = closed_form(robot.designs, x, robot.u), mjx_step(robot.designs, x, robot.u, DT)
        np.testing.assert_allclose(theirs, ours, rtol=1e-8, atol=1e-8)
        x = ours


@pytest.mark.thorough
def test_mjx_step_of_batched_designs_is_c_mujocos_on_recompiled_models(robot, mjx_step):
    """Same formulas in another order of summation: some ten roundings of values of about 100."""
    found = mjx_step(robot.designs, robot.x, robot.u, DT)
    for index in range(len(robot.x)):
        expected = _c_step(robot.recompiled(index), robot.x[index], robot.u[index], DT)
        np.testing.assert_allclose(found[index], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.thorough
def test_mjx_step_takes_a_traced_time_step(robot, mjx_step):
    for dt in (0.001, 0.02):
        expected = _c_step(robot.recompiled(0), robot.x[0], robot.u[0], dt)
        found = mjx_step(robot.designs, robot.x, robot.u, dt)
        np.testing.assert_allclose(found[0], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.thorough
def test_mjx_step_of_a_batch_is_the_loop_of_steps(robot, mjx_step):
    step = jax.jit(MjxStepper(robot.plant).step)
    batched = mjx_step(robot.designs, robot.x, robot.u, DT)
    for index in range(3):
        single = step(robot.design(index), robot.x[index], robot.u[index], DT)
        np.testing.assert_allclose(batched[index], single, rtol=1e-14, atol=1e-14)


@pytest.mark.thorough
@pytest.mark.parametrize("dtype", [pytest.param(jnp.float32, marks=pytest.mark.slow), jnp.float64])
def test_mjx_scans_under_strict_promotion_in_the_states_dtype(robot, dtype):
    stepper = MjxStepper(robot.plant)
    designs, x0, us = jax.tree.map(lambda leaf: leaf.astype(dtype), (robot.designs, robot.x, robot.u))

    def last_state(design, x, u):
        return jax.lax.scan(lambda x, _: (stepper.step(design, x, u, DT), None), x, length=10)[0]

    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        found = jax.jit(jax.vmap(last_state))(designs, x0, us)
        slopes = jax.jit(jax.vmap(stepper.dynamics))(designs, x0, us)
    assert found.dtype == slopes.dtype == dtype
    tolerance = {jnp.float32: 1e-4, jnp.float64: 1e-9}[dtype]
    closed_form = jax.jit(jax.vmap(robot.plant.dynamics))(robot.designs, robot.x, robot.u)
    np.testing.assert_allclose(slopes, closed_form, rtol=tolerance, atol=tolerance)
    step, reference = runge_kutta(robot), robot.x
    for _ in range(10):
        reference = step(robot.designs, reference, robot.u)
    np.testing.assert_allclose(found, reference, rtol=tolerance, atol=tolerance)


@pytest.mark.thorough
def test_the_template_belongs_to_no_trace(robot):
    """A stepper made for the first time inside jit must not leak tracers into the next one."""

    fresh: Any = type("Fresh", (type(robot.plant),), {})
    plant = fresh(*jax.tree.leaves(robot.plant))
    arguments = robot.design(0), robot.x[0], robot.u[0]
    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        first, second = (jax.jit(lambda *a: MjxStepper(plant).dynamics(*a))(*arguments) for _ in range(2))
    np.testing.assert_allclose(first, second, rtol=1e-14)


MOTOR = '<motor name="torque" joint="theta" gear="1"/>'
HINGE = 'type="hinge" axis="0 -1 0"'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('contype="0"', 'contype="1"', r"contacts are on .*: geom motor, hub, rod, bob$"),
        (
            "</mujoco>",
            '<contact><pair name="touch" geom1="motor" geom2="bob"/></contact></mujoco>',
            r"pairs: pair touch",
        ),
        (HINGE, f'{HINGE} limited="true" range="-1 1"', r"joint limits are on .*: joint theta$"),
        (HINGE, f'{HINGE} frictionloss="0.1"', r"friction loss, which is not smooth: joint theta$"),
        (HINGE, f'{HINGE} actuatorfrclimited="true" actuatorfrcrange="-1 1"', r"force limits are on .*: joint theta$"),
        (HINGE, 'type="ball"', r"quaternions are no coordinates .*: joint theta$"),
        ('gear="1"', 'forcelimited="true" forcerange="-1 1"', r"force limits are on .*: actuator torque$"),
        (
            "</mujoco>",
            '<equality><joint joint1="theta"/></equality></mujoco>',
            r"equality constraints: equality number 0$",
        ),
        (MOTOR, '<general joint="theta" dyntype="integrator"/>', r"1 actuator states"),
        (
            'body name="bob"',
            'body name="ball"',
            r"is edited at 'bob', but the model has no body of that name$",
        ),
    ],
)
def test_models_that_an_edit_cannot_represent_are_refused_by_name(old, new, message):
    plant, text = packaged("pendulum"), packaged("pendulum").xml
    assert text.count(old) == 1
    robot = type("Robot", (type(plant),), {"xml": text.replace(old, new)})(*jax.tree.leaves(plant))
    bob = design("pendulum", mass=0.7, length=0.4)
    with pytest.raises(ValueError, match=message):
        compile_model(robot, bob)
    with pytest.raises(ValueError, match=message):
        MjxStepper(robot).dynamics(bob, jnp.zeros(2), jnp.zeros(1))


def test_importing_mjx_says_nothing():
    done = subprocess.run(
        [sys.executable, "-c", "import rtcd_jax.plants.mjx"], capture_output=True, text=True, check=True
    )
    assert done.stdout + done.stderr == ""
