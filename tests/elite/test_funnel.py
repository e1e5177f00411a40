"""The funnel between its knots, beside scipy's solutions of the Riccati equation and of the motion."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import FunnelInterpolant, linearized
from rtcd_jax.elite.simulators import dynamics_of, mujoco_of
from tests.analysis.report.loops import LOOPS, stored
from tests.certificate import balance, swing
from tests.plants.robots import BY_HAND


def linear(plant, x, u):
    return swing.linear(x) if plant == "pendulum" else balance.linear(x, u)


def interpolant(arrays, record):
    return FunnelInterpolant.of(Elite.of(arrays, record))


def between(plant, arrays, k, share, policy=None):
    """x* and S at a share of the interval k, integrated from its end backward."""
    loop, u, told = LOOPS[plant], arrays["u"][k, 0], policy or {}
    n, left = arrays["x"].shape[1], max(1 - abs(u) / arrays["u_max"][0], told.get("authority", 1.0))
    r = told.get("input_weight", 1.0) * loop.R / left**2

    def backward(_, z):
        x, s = z[:n], z[n:].reshape(n, n)
        a, b = linear(plant, x, u)
        a = a + told.get("discount", 0.0) * np.eye(n)
        return -np.concatenate(
            [loop.rate(x, u), -(a.T @ s + s @ a - s @ b @ np.linalg.solve(r, b.T @ s) + loop.Q).ravel()]
        )

    ends = np.concatenate([arrays["x"][k + 1], arrays["S"][k + 1].ravel()])
    found = solve_ivp(backward, (0, (1 - share) * loop.DT), ends, rtol=1e-10, atol=1e-10).y[:, -1]
    return found[:n], found[n:].reshape(n, n)


@pytest.mark.parametrize("plant", LOOPS)
@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_between_knots_the_nominal_and_s_solve_their_equations(plant, share):
    arrays, record = stored(plant)
    funnel = interpolant(arrays, record)
    for k in range(len(arrays["u"])):
        time = np.array([(k + share) * LOOPS[plant].DT])
        x, S = between(plant, arrays, k, share)
        np.testing.assert_allclose(funnel.nominal(time)[0], x, atol=5e-5)
        np.testing.assert_allclose(funnel.value(time)[0], S, rtol=2e-3, atol=2e-3 * np.abs(np.diag(S)).min())


@pytest.mark.parametrize("policy", [{"discount": 1.5}, {"input_weight": 0.5, "authority": 0.3}])
def test_the_slopes_of_s_are_those_of_the_run_s_own_policy(policy):
    arrays, record = stored("pendulum")
    with_policy, without = interpolant(arrays, record | {"policy": policy}), interpolant(arrays, record)
    step = 1e-5
    for k in range(len(arrays["u"])):
        _, before = between("pendulum", arrays, k, 1 - step, policy)
        slope = (arrays["S"][k + 1] - before) / (step * swing.DT)
        np.testing.assert_allclose(with_policy.value_rates[k, 1], slope, rtol=1e-4, atol=1e-3)
        assert not np.allclose(without.value_rates[k, 1], slope, rtol=1e-2)


@pytest.mark.parametrize("plant", LOOPS)
def test_at_the_knots_it_is_the_stored_funnel_and_after_the_last_the_goal_s(plant):
    arrays, record = stored(plant)
    arrays["rho"] = np.geomspace(0.5, 2, len(arrays["rho"]))
    funnel = interpolant(arrays, record)
    np.testing.assert_allclose(funnel.nominal(arrays["time"]), arrays["x"], atol=1e-12)
    np.testing.assert_allclose(funnel.value(arrays["time"]), arrays["S"], rtol=1e-12)
    np.testing.assert_allclose(funnel.level(arrays["time"]), arrays["rho"])
    middle = (arrays["time"][:-1] + arrays["time"][1:]) / 2
    np.testing.assert_allclose(funnel.level(middle), np.sqrt(arrays["rho"][:-1] * arrays["rho"][1:]))
    late = arrays["time"][-1] + np.array([0.0, 0.01, 100.0])
    np.testing.assert_array_equal(funnel.nominal(late), np.tile(arrays["x_goal"], (3, 1)))
    np.testing.assert_array_equal(funnel.value(late), np.tile(arrays["S"][-1], (3, 1, 1)))
    np.testing.assert_allclose(funnel.level(late), arrays["rho"][-1])


@pytest.mark.parametrize("plant", LOOPS)
def test_v_over_rho_is_zero_on_the_motion_one_on_the_boundary_and_grows_with_the_square(plant):
    arrays, record = stored(plant)
    funnel = interpolant(arrays, record)
    n = arrays["x"].shape[1]
    direction = np.random.default_rng(0).normal(size=(len(arrays["time"]), n))
    lengths = np.sqrt(arrays["rho"] / np.einsum("ki,kij,kj->k", direction, arrays["S"], direction))
    error = lengths[:, None] * direction
    for scale, ratio in ((0.0, 0.0), (0.5, 0.25), (1.0, 1.0), (2.0, 4.0)):
        np.testing.assert_allclose(funnel.ratio(arrays["time"], arrays["x"] + scale * error), ratio, atol=1e-9)


def test_an_angle_s_error_is_not_wrapped():
    arrays, record = stored("pendulum")
    turned = arrays["x"][:1] + np.array([2 * np.pi, 0.0])
    assert interpolant(arrays, record).ratio(arrays["time"][:1], turned)[0] > 1


@pytest.mark.parametrize("plant", LOOPS)
def test_the_linearization_is_exact_to_rounding(plant):
    x = np.random.default_rng(1).normal(size=(5, LOOPS[plant].Q.shape[0]))
    u = np.linspace(-1, 1, 5)
    a, b = linearized(BY_HAND[plant](LOOPS[plant].PARAMETERS), x, u[:, None])
    for k in range(5):
        true_a, true_b = linear(plant, x[k], u[k])
        np.testing.assert_allclose(a[k], true_a, atol=1e-5)
        np.testing.assert_allclose(b[k], true_b, atol=1e-5)


def test_closed_form_and_mujoco_are_one_robot():
    elite = interpolant(*stored("pendulum")).elite
    x = np.random.default_rng(0).normal(size=(4, 2))
    expected = swing.rate(x.T, np.zeros(4)).T
    for f in dynamics_of(elite), mujoco_of(elite, 4):
        np.testing.assert_allclose(f(x, np.zeros((4, 1))), expected, rtol=1e-8)
