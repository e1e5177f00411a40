"""The exported controller swings up inside the DFKI toolkits' own call patterns.

The loops below are written anew from the toolkits' interfaces: torque_limited_simple_pendulum, double_pendulum, and the
cart-pole of robust_codesign. The robots are C MuJoCo's models of the exported designs.
"""

import numpy as np
import pytest

from rtcd_jax.plants.model import CpuDynamics

STEP = 0.002


class Robot:
    """A model with a time and a state that a toolkit's loop steps; `tau` are the joints' torques or forces."""

    def __init__(self, bundle):
        self.bundle, self.t = bundle, 0.0
        self.dof = bundle.elite.x_goal.size // 2
        self.x = bundle.elite.x[0].copy()
        self._f = CpuDynamics(bundle.model, sum(bundle.elite.K_goal.shape))

    def step(self, tau):
        u = np.atleast_1d(tau)[self.bundle.joints]
        k1 = self._rate(self.x, u)
        k2 = self._rate(self.x + STEP / 2 * k1, u)
        k3 = self._rate(self.x + STEP / 2 * k2, u)
        k4 = self._rate(self.x + STEP * k3, u)
        self.x += STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        self.t += STEP

    def _rate(self, x, u):
        return self._f(x[None], u[None])[0]


def simple_pendulum(robot, controller):
    """Arrays by name, three answers of which the last is the torque."""
    controller.init(x0=robot.x)
    controller.set_goal(robot.bundle.elite.x_goal)
    dof = robot.dof
    while True:
        _, _, tau = controller.get_control_output(
            meas_pos=robot.x[:dof], meas_vel=robot.x[dof:], meas_tau=np.zeros(dof), meas_time=np.copy(robot.t)
        )
        assert tau.shape == (dof,)
        yield tau


def simple_pendulum_motor(robot, controller):
    """The motor's loop: floats by place."""
    while True:
        pos, vel, tau = controller.get_control_output(float(robot.x[0]), float(robot.x[1]), 0.0, robot.t)
        assert [type(answer) for answer in (pos, vel, tau)] == [float] * 3
        yield np.array([tau])


def double_pendulum(robot, controller):
    """State and time by name, the torques of all joints, cut off at their limits."""
    controller.init()
    controller.reset()
    limit = np.zeros(robot.dof)
    limit[robot.bundle.joints] = robot.bundle.elite.u_max
    while True:
        tau = controller.get_control_output(x=robot.x, t=robot.t)
        np.testing.assert_array_equal(controller.get_control_output_(robot.x, robot.t), tau)
        assert tau.shape == (robot.dof,)
        yield np.clip(tau, -limit, limit)


def cart_pole(robot, controller):
    """Six floats by place, five answers of which the last is the force."""
    while True:
        cart, pole, speed, rate = robot.x.tolist()
        *desired, force = controller.get_control_output(cart, pole, speed, rate, 0.0, robot.t)
        assert [type(answer) for answer in (*desired, force)] == [float] * 5
        yield np.array([force, 0.0])


def cart_pole_tvlqr(robot, controller):
    """The time first, arrays of one entry, the force alone."""
    while True:
        cart, pole, speed, rate = robot.x.reshape(4, 1)
        force = controller.get_control_output(
            mea_time=robot.t, mea_cart_pos=cart, mea_pend_pos=pole, mea_cart_vel=speed, mea_pend_vel=rate
        )
        assert force == controller.get_control_output(robot.t, cart, pole, speed, rate)
        yield np.array([force, 0.0])


LOOPS = {
    "pendulum": [simple_pendulum, simple_pendulum_motor, double_pendulum],
    "cartpole": [simple_pendulum, double_pendulum, cart_pole, cart_pole_tvlqr],
}


@pytest.mark.thorough
@pytest.mark.parametrize("number", range(4))
def test_the_controller_swings_up_in_a_toolkits_own_loop(export, number):
    """From 0.02 off the nominal start into the goal, for as long as the goal's LQR needs."""
    loops = LOOPS[export.bundle.elite.plant]
    if number >= len(loops):
        pytest.skip("this robot has no such toolkit")
    robot = Robot(export.bundle)
    robot.x += 0.02
    before = np.abs(robot.x - export.bundle.elite.x_goal).max()
    loop = loops[number](robot, export.module.Controller())
    while robot.t < export.bundle.elite.time[-1] + 6.0:
        robot.step(next(loop))
    away = np.abs(robot.x - export.bundle.elite.x_goal).max()
    assert away < 1e-2 < before


@pytest.mark.thorough
def test_a_call_of_no_toolkit_is_refused_with_those_that_there_are(export):
    controller, n = export.module.Controller(), export.bundle.elite.x_goal.size
    for measured, named in (
        ((), {}),
        ((0.0,) * 7, {}),
        ((), {"position": 0.0, "velocity": 0.0}),
        ((np.zeros(n), 0.0), {"meas_time": 0.0}),
    ):
        with pytest.raises(TypeError, match=r"get_control_output takes \(meas_pos, meas_vel, meas_tau, meas_time\)"):
            controller.get_control_output(*measured, **named)
    with pytest.raises(TypeError, match="the time t is needed"):
        controller.get_control_output(x=np.zeros(n))
