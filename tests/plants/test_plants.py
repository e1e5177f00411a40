"""What every robot's closed form must satisfy, whatever the robot."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from rtcd_jax.elite.simulators import CLOSED_FORMS
from rtcd_jax.plants import PLANTS, plant_class
from rtcd_jax.plants.mjx import compile_model


def test_energy_changes_by_the_motors_power_less_the_dampers(robot):
    def energy_rate(design, x, u):
        return jax.jvp(lambda x: robot.plant.energy(design, x), (x,), (robot.plant.dynamics(design, x, u),))[1]

    rates = jax.vmap(energy_rate)(robot.designs, robot.x, robot.u)
    model = compile_model(robot.plant, robot.design(0))
    velocities = np.asarray(robot.x)[:, model.nq :]
    driven = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    motors = np.sum(np.asarray(robot.u) * model.actuator_gear[:, 0] * velocities[:, driven], axis=1)
    dampers = np.sum(model.dof_damping * velocities**2, axis=1)
    np.testing.assert_allclose(rates, motors - dampers, rtol=1e-10, atol=1e-10)


def test_energy_is_mujocos_up_to_a_constant(robot):
    def mujoco_energy(model, x):
        data = mujoco.MjData(model)
        data.qpos, data.qvel = np.split(x, 2)
        mujoco.mj_forward(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        return data.energy.sum()

    for index in range(3):
        design, model, x = robot.design(index), robot.recompiled(index), robot.x[index]
        ours = robot.plant.energy(design, x) - robot.plant.energy(design, 0 * x)
        theirs = mujoco_energy(model, x) - mujoco_energy(model, 0 * x)
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)


def test_derivatives_agree_with_central_differences(robot):
    """Truncation and cancellation of a central difference with step 1e-5 are both about 1e-10 of the values."""
    design, x, u = robot.design(0), robot.x[0], robot.u[0]
    for argument, value in enumerate((x, u)):

        def f(z, argument=argument):
            return robot.plant.dynamics(design, *(z if i == argument else v for i, v in enumerate((x, u))))

        exact = jax.jacfwd(f)(value)
        steps = 1e-5 * np.eye(len(value))
        numerical = np.stack([(f(value + step) - f(value - step)) / 2e-5 for step in steps], axis=-1)
        np.testing.assert_allclose(exact, numerical, rtol=1e-7, atol=1e-7 * np.abs(exact).max())


def test_parameters_name_the_robot_completely(robot):
    """A plant made anew from the stored parameters moves in the same way."""
    design = robot.design(0)
    parameters = robot.plant.parameters(design)
    again, its_design = type(robot.plant).from_parameters(parameters)
    assert again == robot.plant
    assert eqx.tree_equal(its_design, design, rtol=0.0, atol=0.0)
    for name in parameters:
        with pytest.raises(KeyError, match=name):
            type(robot.plant).from_parameters({k: v for k, v in parameters.items() if k != name})


def test_every_parameter_has_its_unit_and_every_state_and_input_its_sign(robot):
    assert robot.plant.parameter_units.keys() == robot.plant.parameters(robot.design(0)).keys()
    assert all(name in robot.plant.convention for name in (*robot.plant.state_names, *robot.plant.input_names))


def test_every_design_variable_moves_the_robot(robot):
    def acceleration(design):
        return jnp.sum(robot.plant.dynamics(design, robot.x[0], robot.u[0]) ** 2)

    slopes = jax.grad(acceleration)(robot.design(0))
    assert all(abs(slope) > 1e-3 for slope in jax.tree.leaves(slopes))


def test_pendulum_balances_at_the_torque_of_its_weight():
    plant, design = plant_class("pendulum").from_parameters(
        {"m": 0.7, "l": 0.4, "b": 0.1, "g": 9.81, "torque_limit": 2.0}
    )
    at_rest = plant.dynamics(design, jnp.array([jnp.pi / 2, 0.0]), jnp.array([0.7 * 9.81 * 0.4]))
    np.testing.assert_allclose(at_rest, 0, atol=1e-14)


def test_an_unknown_plant_is_answered_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'pendulun'; did you mean 'pendulum'\? Valid: pendulum, cartpole"):
        plant_class("pendulun")


def test_the_verifications_own_closed_form_is_the_plants(robot):
    name = next(name for name, robot_class in PLANTS.items() if isinstance(robot.plant, robot_class))
    for index in range(3):
        numpy_form = CLOSED_FORMS[name](robot.plant.parameters(robot.design(index)))
        expected = jax.vmap(lambda x, u, i=index: robot.plant.dynamics(robot.design(i), x, u))(robot.x, robot.u)
        np.testing.assert_allclose(
            numpy_form(np.asarray(robot.x), np.asarray(robot.u)), expected, rtol=1e-11, atol=1e-11
        )
