"""The closed loop beside an independent one: scipy's interpolants, numpy's controller, an adaptive integrator."""

import dataclasses
import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from rtcd_jax import rollout
from rtcd_jax.config import load as configuration
from rtcd_jax.problem import make_problem
from rtcd_jax.types import Candidate, Policy, Trajectory

MASS, LENGTH, DAMPING, GRAVITY, LIMIT = 0.65, 0.45, 0.1, 9.81, 2.5
DT = 0.1
TORQUES = np.array([2.0, -1.0, 1.5, 0.5])
GAINS = np.array([[4.0, 0.5], [6.0, 1.0], [5.0, 1.5], [7.0, 0.8], [6.0, 1.2]])
GOAL_GAIN = np.array([[6.0, 1.2]])
GOAL = np.array([np.pi, 0.0])
PROBLEM = make_problem(configuration.parse_yaml(configuration.EXAMPLE))
CANDIDATE = Candidate(PROBLEM.plant.Design(jnp.asarray(MASS), jnp.asarray(LENGTH)), jnp.ones(2), jnp.ones(1))
CLOSED_FORM = rollout.closed_form(PROBLEM.plant)
LOOPED = CLOSED_FORM._replace(large=True)
SMALL = np.array([[0.0, 0.0], [0.01, -0.02], [-0.02, 0.05], [0.03, 0.1]])
WIDE = np.concatenate([SMALL, 0.5 * np.random.default_rng(0).normal(size=(12, 2))])


def _pendulum(x, u):
    inertia = MASS * LENGTH**2
    return np.array([x[1], (u - DAMPING * x[1] - MASS * GRAVITY * LENGTH * np.sin(x[0])) / inertia])


def _integrated(rate, start, end, x):
    settings = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13, "max_step": (end - start) / 20}
    return solve_ivp(rate, (start, end), x, dense_output=True, **settings)


def _motion(dt=DT, torques=TORQUES) -> np.ndarray:
    xs = [np.array([0.5, -1.0])]
    for torque in torques:
        xs.append(_integrated(lambda _, x, u=torque: _pendulum(x, u), 0, dt, xs[-1]).y[:, -1])
    return np.array(xs)


def _policy(dt=DT, torques=TORQUES, gains=GAINS) -> Policy:
    zero = jnp.zeros((), jnp.int32)
    knots = len(torques) + 1
    motion = Trajectory(
        us=jnp.asarray(torques)[:, None],
        xs=jnp.asarray(_motion(dt, torques)),
        dt=jnp.asarray(dt),
        cost=jnp.zeros(()),
        defect=jnp.zeros(()),
        iterations=zero,
        status=zero,
    )
    gains = jnp.asarray(np.broadcast_to(gains, (knots, 2)))[:, None]
    return Policy(motion, gains, jnp.tile(jnp.eye(2), (knots, 1, 1)), zero)


def _oracle(policy: Policy, k: int, x: np.ndarray):
    """The path over interval k under the loop's definition."""
    h, xs = float(policy.trajectory.dt), np.asarray(policy.trajectory.xs)
    torque, gains = float(policy.trajectory.us[k, 0]), np.asarray(policy.gains)[:, 0]
    nominal = CubicHermiteSpline([0, h], xs[k : k + 2], [_pendulum(x, torque) for x in xs[k : k + 2]])

    def rate(t, x):
        gain = [np.interp(t, [0, h], gains[k : k + 2, i]) for i in range(2)]
        return _pendulum(x, np.clip(torque - gain @ (x - nominal(t)), -LIMIT, LIMIT))

    return _integrated(rate, 0, h, x)


def _oracle_at_goal(x: np.ndarray, duration: float):
    def rate(_, x):
        return _pendulum(x, np.clip(-GOAL_GAIN[0] @ (x - GOAL), -LIMIT, LIMIT))

    return _integrated(rate, 0, duration, x)


@partial(jax.jit, static_argnames=("steps", "dynamics", "problem"))
def _rolled(policy, x, steps, dynamics=CLOSED_FORM, problem=PROBLEM):
    tracking = rollout.tracking_data(problem, CANDIDATE, policy, steps)
    return rollout.roll_intervals(problem, CANDIDATE, tracking, x, dynamics)


@partial(jax.jit, static_argnames=("dynamics", "duration", "step", "problem"))
def _rolled_at_goal(x, duration, step, dynamics=CLOSED_FORM, problem=PROBLEM):
    return rollout.roll_at_goal(
        problem, CANDIDATE, (jnp.asarray(GOAL_GAIN), jnp.eye(len(x))), x, dynamics, duration, step
    )


def _about(policy: Policy, offsets) -> jax.Array:
    """States [n N offsets] at all intervals' starts."""
    return policy.trajectory.xs[:-1].T[:, :, None] + jnp.asarray(offsets).T[:, None]


def _limited(*limits: float):
    return dataclasses.replace(PROBLEM, state_limits=np.array(limits))


@pytest.mark.thorough
def test_an_interval_is_that_of_its_definition_to_fourth_order():
    """Away from the torque limit each halving of the step divides the error by 2^4, on every interval."""
    policy = _policy()
    x = _about(policy, SMALL)
    expected = np.stack([[_oracle(policy, k, x0).y[:, -1] for x0 in x[:, k].T] for k in range(len(TORQUES))])
    errors = []
    for steps in (8, 16, 32):
        ends, _ = _rolled(policy, x, steps)
        errors.append(np.abs(np.moveaxis(ends, 0, -1) - expected).max((1, 2)))
    assert np.all(errors[-1] < 1e-8)
    for coarse, fine in itertools.pairwise(errors):
        np.testing.assert_allclose(coarse / fine, 16, rtol=0.2)


def test_the_nominal_motion_is_followed_to_the_interpolants_accuracy():
    """The Hermite interpolant is off by h^4 inside an interval of length h, so that the loop drifts by h^5."""
    drifts = []
    for dt in (DT, DT / 2):
        policy = _policy(dt, TORQUES[:1], GAINS[:2])
        ends, _ = _rolled(policy, _about(policy, SMALL[:1]), 32)
        drifts.append(np.abs(ends[:, 0, 0] - policy.trajectory.xs[1]).max())
    assert drifts[0] < 1e-4
    assert drifts[0] / drifts[1] > 2**4


def test_without_gains_the_nominal_motion_is_a_solution():
    policy = _policy(gains=np.zeros(2))
    ends, _ = _rolled(policy, _about(policy, SMALL[:1]), 32)
    np.testing.assert_allclose(ends[:, :, 0], policy.trajectory.xs[1:].T, atol=1e-8)


def test_a_step_in_parts_is_that_many_shorter_steps():
    x = jnp.asarray(GOAL)[:, None] + jnp.asarray(SMALL).T

    @jax.jit
    def divided(parts):
        lqr = jnp.asarray(GOAL_GAIN), jnp.eye(2)
        return rollout.roll_at_goal(PROBLEM, CANDIDATE, lqr, x, CLOSED_FORM, 0.4, 0.04, parts)

    for parts in (1, 2, 5):
        for whole, part in zip(_rolled_at_goal(x, 0.4, 0.04 / parts), divided(parts), strict=True):
            np.testing.assert_allclose(part, whole, rtol=1e-12)


def test_the_goal_is_not_left():
    ends, peaks = _rolled_at_goal(jnp.asarray(GOAL)[:, None], 1.0, 0.02)
    np.testing.assert_allclose(ends[:, 0], GOAL, atol=1e-13)
    np.testing.assert_allclose(peaks, np.max(np.abs(GOAL) / PROBLEM.state_limits), rtol=1e-13)


@pytest.mark.parametrize("side", [-1, 1])
def test_far_from_the_motion_the_torque_is_the_limit(side):
    """On both sides the end is that of a constant torque, whatever the gains; near the motion it is not."""
    far, near = side * np.array([4.0, 0.0]), side * np.array([0.2, 0.0])
    for gains in (GAINS, 10 * GAINS):
        policy = _policy(gains=gains)
        ends, _ = _rolled(policy, _about(policy, [far, near]), 32)
        for k, x in enumerate(policy.trajectory.xs[:-1]):
            # A larger angle calls for a smaller torque.
            held = [_integrated(lambda _, x: _pendulum(x, -side * LIMIT), 0, DT, x + off) for off in (far, near)]
            np.testing.assert_allclose(ends[:, k, 0], held[0].y[:, -1], atol=1e-8)
            if gains is GAINS:
                assert np.abs(ends[:, k, 1] - held[1].y[:, -1]).max() > 1e-3


@pytest.mark.parametrize("side", [-1, 1])
def test_far_from_the_goal_the_torque_is_the_limit(side):
    x = GOAL + side * np.array([1.2, 0.0])
    ends, _ = _rolled_at_goal(jnp.asarray(x)[:, None], 0.2, 0.01)
    held = _integrated(lambda _, x: _pendulum(x, -side * LIMIT), 0, 0.2, x)
    np.testing.assert_allclose(ends[:, 0], held.y[:, -1], atol=1e-7)


def test_at_the_goal_the_loop_is_that_of_its_definition_to_fourth_order():
    offsets = 2 * SMALL[1:]
    x = jnp.asarray(GOAL + offsets).T
    expected = np.stack([_oracle_at_goal(x0, 1.0).y[:, -1] for x0 in x.T], 1)
    coarse, fine = (np.abs(_rolled_at_goal(x, 1.0, step)[0] - expected).max() for step in (0.02, 0.01))
    assert fine < 1e-6
    assert coarse / fine == pytest.approx(16, rel=0.2)


def _excursion(path) -> tuple[float, float]:
    """The largest speed of a path and the larger one of its two ends."""
    speed = np.abs(path.sol(np.linspace(0, path.t[-1], 2001))[1])
    return speed.max(), max(speed[0], speed[-1])


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_limits_are_watched_inside_an_interval(share):
    """A state that leaves the box and is back at the end has failed; one that only comes near has not.

    Between two of 64 steps the speed rises by 0.03 % above both.
    """
    policy = _policy(0.4, np.zeros(1), np.array([[20.0, 1.0]] * 2))
    x = np.asarray(policy.trajectory.xs[0]) + np.array([0.1, 1.0])
    peak, at_ends = _excursion(_oracle(policy, 0, x))
    assert at_ends < 0.97 * peak
    _, reached = _rolled(policy, jnp.asarray(x)[:, None, None], 64, problem=_limited(np.inf, share * peak))
    assert reached.item() == pytest.approx(1 / share, rel=5e-4)
    assert (reached.item() <= 1) == (share > 1)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_limits_are_watched_on_the_way_to_the_goal(share):
    x = GOAL + np.array([0.1, 0.0])
    peak, at_ends = _excursion(_oracle_at_goal(x, 2.0))
    assert at_ends < 0.9 * peak
    _, reached = _rolled_at_goal(jnp.asarray(x)[:, None], 2.0, 0.01, problem=_limited(np.inf, share * peak))
    assert reached.item() == pytest.approx(1 / share, rel=1e-3)
    assert (reached.item() <= 1) == (share > 1)


@pytest.mark.thorough
def test_the_peak_is_the_largest_share_of_any_limit():
    """On either side of zero; a component without a limit has none."""
    policy = _policy()
    x = _about(policy, WIDE)
    shares = []
    for limits in ((3.0, np.inf), (np.inf, 5.0), (3.0, 5.0), (np.inf, np.inf)):
        shares.append(np.asarray(_rolled(policy, x, 8, problem=_limited(*limits))[1]))
    angle, speed, both, none = shares
    assert np.any(angle > speed)
    assert np.any(angle < speed)
    np.testing.assert_array_equal(both, np.maximum(angle, speed))
    np.testing.assert_array_equal(none, 0)
    assert np.any(x[1] < -np.max(x[1]))
    assert np.all(both >= (1 - 1e-15) * np.maximum(np.abs(x[0]) / 3, np.abs(x[1]) / 5))


def test_a_state_that_starts_outside_has_failed():
    """It brakes at once into the box, at the motion and at the goal."""
    policy = _policy(torques=np.zeros(1), gains=np.array([[20.0, 1.0]] * 2))
    x = np.asarray(policy.trajectory.xs[0]) + np.array([0.0, 3.0])
    at_goal = GOAL + np.array([0.0, 1.5])
    for path in (_oracle(policy, 0, x), _oracle_at_goal(at_goal, 1.0)):
        assert np.argmax(np.abs(path.y[1])) == 0
    for share in (0.999, 1.001):
        _, peak = _rolled(policy, jnp.asarray(x)[:, None, None], 32, problem=_limited(np.inf, share * x[1]))
        assert peak.item() == pytest.approx(1 / share, rel=1e-14)
        limited = _limited(np.inf, share * at_goal[1])
        _, peak = _rolled_at_goal(jnp.asarray(at_goal)[:, None], 1.0, 0.02, problem=limited)
        assert peak.item() == pytest.approx(1 / share, rel=1e-14)


def test_a_state_that_is_not_finite_fails_alone():
    policy = _policy()
    x = _about(policy, SMALL)
    ends, peaks = _rolled(policy, x, 8)
    broken, broken_peaks = _rolled(policy, x.at[0, 1, 2].set(jnp.nan), 8)
    assert not broken_peaks[1, 2] <= 1
    others = np.ones(peaks.shape, bool)
    others[1, 2] = False
    np.testing.assert_array_equal(np.asarray(broken)[:, others], np.asarray(ends)[:, others])
    np.testing.assert_array_equal(np.asarray(broken_peaks)[others], np.asarray(peaks)[others])


def test_a_part_of_the_intervals_moves_as_in_the_whole():
    policy = _policy()
    x, which = _about(policy, SMALL), np.array([2, 0])
    whole, _ = _rolled(policy, x, 8)

    @jax.jit
    def rolled_part(x):
        tracking = rollout.tracking_data(PROBLEM, CANDIDATE, policy, 8).part(which)
        return rollout.roll_intervals(PROBLEM, CANDIDATE, tracking, x, CLOSED_FORM)

    part, _ = rolled_part(x[:, which])
    np.testing.assert_allclose(part, whole[:, which], rtol=1e-13, atol=1e-14)


def test_a_looped_step_is_the_unrolled_one():
    """To rounding, saturated states included; so at the goal."""
    policy = _policy()
    x = _about(policy, WIDE)
    ends, peaks = _rolled(policy, x, 8)
    looped, looped_peaks = _rolled(policy, x, 8, dynamics=LOOPED)
    np.testing.assert_allclose(looped, ends, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(looped_peaks, peaks, rtol=1e-12)
    at_goal, _ = _rolled_at_goal(jnp.asarray(GOAL + 0.2 * WIDE).T, 1.0, 0.02)
    looped, _ = _rolled_at_goal(jnp.asarray(GOAL + 0.2 * WIDE).T, 1.0, 0.02, dynamics=LOOPED)
    np.testing.assert_allclose(looped, at_goal, rtol=1e-10, atol=1e-11)


@pytest.mark.thorough
def test_mjx_moves_as_the_closed_form():
    policy = _policy()
    x = _about(policy, WIDE)
    dynamics = rollout.mjx(PROBLEM.plant)
    ends, peaks = _rolled(policy, x, 8)
    mjx_ends, mjx_peaks = _rolled(policy, x, 8, dynamics=dynamics)
    np.testing.assert_allclose(mjx_ends, ends, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(mjx_peaks, peaks, rtol=1e-9)
    at_goal, _ = _rolled_at_goal(jnp.asarray(GOAL + 0.2 * WIDE).T, 1.0, 0.02)
    mjx_at_goal, _ = _rolled_at_goal(jnp.asarray(GOAL + 0.2 * WIDE).T, 1.0, 0.02, dynamics=dynamics)
    np.testing.assert_allclose(mjx_at_goal, at_goal, rtol=1e-8, atol=1e-8)
