"""The catch of a brachiator against an impact of two free bodies, and what every plastic impact obeys."""

import jax.numpy as jnp
import numpy as np

from rtcd_jax.numerics.derivatives import jacobian
from rtcd_jax.plants.brachiation import FIELDS, catch, exchanged
from tests.plants.robots import design, packaged

ARMS = (0.31401, 1.0419, 0.23347, 0.00170863, 0.631065, 0.124776, 0.00412099)
STATES = np.random.default_rng(0).uniform([-2, -2.8, -8, -8], [2, 2.8, 8, 8], (50, 4)).T


ACROMONK: dict[str, float] = dict(zip(FIELDS, ARMS, strict=True))


def _centers(q):
    """x, z of the arms' centers, of the elbow's and of the free hook's position, by hand."""
    arm, _, c1, _, _, c2, _ = ARMS
    a, b = q[0], q[0] + q[1]
    elbow = arm * _along(a)
    return c1 * _along(a), elbow + c2 * _along(b), elbow, elbow + arm * _along(b)


def _along(angle):
    """From a hinge along a link at this angle from hanging."""
    return np.array([np.sin(angle), -np.cos(angle)])


def _impact(q, v):
    """Rates (of the first arm, of the second one) after the impact of two free arms [x z angle each], hinged at the
    elbow, whose free hook is stopped: M (w+ - w-) = J' impulse, J w+ = 0, by one linear system.
    """
    arm, m1, c1, i1, m2, c2, i2 = ARMS
    a, b = q[0], q[0] + q[1]
    turn = lambda r, t: r * np.array([np.cos(t), np.sin(t)])  # noqa: E731  rate of r (sin t, -cos t)
    before = np.concatenate(
        [turn(c1, a) * v[0], [v[0]], turn(arm, a) * v[0] + turn(c2, b) * (v[0] + v[1]), [v[0] + v[1]]]
    )
    inertia = np.diag([m1, m1, i1, m2, m2, i2])
    eye = np.eye(2)
    elbow = np.hstack([eye, turn(arm - c1, a)[:, None], -eye, turn(c2, b)[:, None]])
    hook = np.hstack([np.zeros((2, 3)), eye, turn(arm - c2, b)[:, None]])
    constraint = np.vstack([elbow, hook])
    system = np.block([[inertia, -constraint.T], [constraint, np.zeros((4, 4))]])
    after = np.linalg.solve(system, np.concatenate([inertia @ before, np.zeros(4)]))
    return after[2], after[5]


def test_it_is_the_impact_of_two_free_arms():
    after = np.asarray(catch(ACROMONK, jnp.asarray(STATES)))
    expected = np.array([_impact(x[:2], x[2:]) for x in STATES.T]).T
    np.testing.assert_allclose(after[2], expected[1], atol=1e-12)
    np.testing.assert_allclose(after[2] + after[3], expected[0], atol=1e-12)


def test_twice_it_is_the_identity_of_robot_and_place():
    twice = exchanged(exchanged(ACROMONK))
    np.testing.assert_allclose([twice[name] for name in FIELDS], ARMS, rtol=1e-15)
    x = jnp.asarray(STATES).at[2:].set(0)
    again = catch(exchanged(ACROMONK), catch(ACROMONK, x))
    turned = np.asarray(again - x) / (2 * np.pi)
    np.testing.assert_allclose(turned, np.round(turned), atol=1e-12)


def test_links_stay_where_they_are():
    """Of the robot from its new bar, seen from there, both arms' centers are where they were."""
    x = STATES.copy()
    after = np.asarray(catch(ACROMONK, jnp.asarray(x)))
    arm, _, c1, _, _, c2, _ = ARMS
    first, second, elbow, bar = _centers(x)
    a, b = after[0], after[0] + after[1]
    np.testing.assert_allclose(bar + arm * _along(a), elbow, atol=1e-12)
    np.testing.assert_allclose(bar + (arm - c2) * _along(a), second, atol=1e-12)
    np.testing.assert_allclose(bar + arm * _along(a) + (arm - c1) * _along(b), first, atol=1e-12)


def _energy(arms, x):
    arm, m1, c1, i1, m2, c2, i2 = (arms[name] for name in FIELDS)
    first, second, bend = x[2], x[2] + x[3], np.cos(x[1])
    of_second = arm**2 * first**2 + 2 * arm * c2 * bend * first * second + c2**2 * second**2
    return 0.5 * ((m1 * c1**2 + i1) * first**2 + m2 * of_second + i2 * second**2)


def test_it_loses_energy_and_a_motion_about_the_new_bar_none():
    after = np.asarray(catch(ACROMONK, jnp.asarray(STATES)))
    lost = _energy(ACROMONK, STATES) - _energy(exchanged(ACROMONK), after)
    assert np.all(lost > 0)
    assert np.median(lost / _energy(ACROMONK, STATES)) > 0.3


def test_its_derivative_is_that_of_differences():
    x, step = jnp.asarray(STATES), 1e-6
    exact = jacobian(lambda x: catch(ACROMONK, x), x)
    for i in range(4):
        away = jnp.zeros((4, 1)).at[i].set(step)
        differences = (catch(ACROMONK, x + away) - catch(ACROMONK, x - away)) / (2 * step)
        np.testing.assert_allclose(exact[:, i], differences, atol=1e-7)


def test_the_packaged_robot_is_the_one_of_the_formulas():
    """Without gravity and friction the motor's power u q2' is what the energy by hand grows by."""
    plant = packaged("acromonk", shoulder_damping=0, elbow_damping=0, gravity=1e-6)
    x, u = jnp.asarray(STATES), jnp.ones((1, STATES.shape[1]))
    arms = design("acromonk", **{name: ACROMONK[name] for name in ("arm_length", "support_mass", "swing_mass")})
    rates = np.asarray(plant.dynamics(arms, x, u))
    gradient = np.stack([(_energy(ACROMONK, STATES + e) - _energy(ACROMONK, STATES - e)) / 2e-6
                         for e in 1e-6 * np.eye(4)[:, :, None]])  # fmt: skip
    np.testing.assert_allclose((gradient * rates).sum(0), STATES[3], atol=1e-5)
