"""What every robot's closed form must satisfy, whatever the robot."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.config.plants import PLANTS, stored_plant
from rtcd_jax.plants import dynamics_of, plant_of
from rtcd_jax.system.errors import UserError
from tests.plants.robots import BY_HAND, design, packaged


def test_an_input_has_the_power_of_its_motors_speed(robot):
    """Of the recompiled model: gear times the driven joint's velocity."""
    model = robot.recompiled(0)
    velocities = np.asarray(robot.x)[:, model.nq + model.jnt_dofadr[model.actuator_trnid[:, 0]]]
    found = robot.plant.motor_speeds(robot.design(0), robot.x.T)
    np.testing.assert_allclose(found, (model.actuator_gear[:, 0] * velocities).T, rtol=1e-12)


def test_derivatives_agree_with_central_differences(robot):
    """Truncation and cancellation of a central difference with step 1e-5 are both about 1e-10 of the values."""
    design, x, u = robot.design(0), robot.x[0], robot.u[0]
    rate = jax.jit(robot.plant.dynamics)
    both = jax.jit(jax.jacfwd(robot.plant.dynamics, argnums=(1, 2)))(design, x, u)
    for argument, (exact, value) in enumerate(zip(both, (x, u), strict=True)):

        def f(z, argument=argument):
            return rate(design, *(z if i == argument else v for i, v in enumerate((x, u))))

        steps = 1e-5 * np.eye(len(value))
        numerical = np.stack([(f(value + step) - f(value - step)) / 2e-5 for step in steps], axis=-1)
        np.testing.assert_allclose(exact, numerical, rtol=1e-7, atol=1e-7 * np.abs(exact).max())


def test_parameters_name_the_robot_completely(robot):
    """A plant made anew from the stored parameters moves in the same way."""
    design = robot.design(0)
    parameters, config = robot.plant.parameters(design), PLANTS[robot.name]()
    again, its_design = plant_of(config, parameters, {})
    assert again == robot.plant
    assert eqx.tree_equal(its_design, design, rtol=0.0, atol=0.0)
    for name in parameters:
        with pytest.raises(UserError, match=f"lack '{name}'"):
            plant_of(config, {k: v for k, v in parameters.items() if k != name}, {})


def test_every_parameter_has_its_unit_and_every_state_and_input_its_sign(robot):
    assert robot.plant.parameter_units.keys() == robot.plant.parameters(robot.design(0)).keys()
    assert all(name in robot.plant.convention for name in (*robot.plant.state_names, *robot.plant.input_names))


def test_every_design_variable_moves_the_robot(robot):
    def acceleration(design):
        return jnp.sum(robot.plant.dynamics(design, robot.x[0], robot.u[0]) ** 2)

    slopes = jax.jit(jax.grad(acceleration))(robot.design(0))
    assert all(abs(slope) > 1e-3 for slope in jax.tree.leaves(slopes))


def test_pendulum_balances_at_the_torque_of_its_weight():
    at_rest = packaged("pendulum").dynamics(
        design("pendulum", mass=0.7, length=0.4), jnp.array([jnp.pi / 2, 0.0]), jnp.array([0.7 * 9.81 * 0.4])
    )
    np.testing.assert_allclose(at_rest, 0, atol=1e-14)


def test_an_unknown_plant_is_answered_with_the_known_ones():
    with pytest.raises(UserError, match=r"'pendulun'; did you mean 'pendulum'\? Valid: .*cartpole"):
        stored_plant("pendulun")


@pytest.mark.parametrize("name", BY_HAND)
def test_the_closed_form_is_the_one_written_by_hand(name):
    """In JAX and in numpy, at random designs, states and inputs."""
    random, plant = np.random.default_rng(0), packaged(name)
    x, u = random.uniform(-4, 4, (100, plant.n)), random.uniform(-4, 4, (100, plant.m))
    for _ in range(3):
        values = {field: jnp.asarray(random.uniform(0.2, 0.8)) for field in plant.design_units}
        parameters = plant.parameters(plant.Design(**values))
        expected = BY_HAND[name](parameters)(x, u)
        found = plant.dynamics(plant.Design(**values), jnp.asarray(x.T), jnp.asarray(u.T))
        np.testing.assert_allclose(found.T, expected, rtol=1e-12, atol=1e-12)
        found = dynamics_of(PLANTS[name](), parameters, 100)(x, u)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12)
