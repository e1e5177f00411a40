"""The catch of a brachiator against an impact of free bodies, and what every plastic impact obeys."""

import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics.derivatives import jacobian
from rtcd_jax.plants.brachiation import FIELDS, catch, exchanged, hook
from tests.plants.robots import design, packaged

NUMBERS = {
    2: (0.31401, 1.0419, 0.23347, 0.00170863, 0.631065, 0.124776, 0.00412099),
    3: (0.3146, 0.31253, 0.17065, 0.00099, 0.31254, 0.19283, 0.0037755, 2.631, 0.18247, 0.00524),
}
ACROMONK, RICMONK = (dict(zip(FIELDS[joints], NUMBERS[joints], strict=True)) for joints in NUMBERS)
ROBOTS = {"acromonk": ACROMONK, "ricmonk": RICMONK}
every_robot = pytest.mark.parametrize("robot", ROBOTS.values(), ids=ROBOTS)


def states(robot):
    """[n 50]."""
    joints = 3 if "body_mass" in robot else 2
    return np.random.default_rng(0).uniform(-1, 1, (50, 2 * joints)).T * np.repeat([2.8, 8.0], joints)[:, None]


def links(robot):
    """Mass, inertia, and what the center is away from the shoulder, in the link's direction, in the joints' order."""
    arm, m1, c1, i1, m2, c2, i2, *body = (robot[name] for name in FIELDS[2 + ("body_mass" in robot)])
    between = [(body[0], body[2], body[1])] if body else []
    return [(m1, i1, c1 - arm), *between, (m2, i2, c2)]


def _along(angle):
    """From a hinge along a link at this angle from hanging."""
    return np.array([np.sin(angle), -np.cos(angle)])


def _turn(r, angle):
    """The rate of r (sin, -cos) for a unit rate of the angle."""
    return r * np.array([np.cos(angle), np.sin(angle)])


def _impact(robot, q, v):
    """Absolute rates of all links after the impact of free links [x z angle each], hinged at the shoulder, whose free
    hook is stopped: M (w+ - w-) = J' impulse, J w+ = 0, by one linear system.
    """
    arm, parts, angles, rates = robot["arm_length"], links(robot), np.cumsum(q), np.cumsum(v)
    shoulder = _turn(arm, angles[0]) * rates[0]
    moves = [[*(shoulder + _turn(r, a) * w), w] for (_, _, r), a, w in zip(parts, angles, rates, strict=True)]
    before, count = np.concatenate(moves), len(parts)
    inertia = np.diag([each for m, i, _ in parts for each in (m, m, i)])
    # The shoulder as each link sees it, from its center.
    seen = [np.hstack([np.eye(2), -_turn(r, a)[:, None]]) for (_, _, r), a in zip(parts, angles, strict=True)]
    rows = []
    for other in range(1, count):
        row = np.zeros((2, 3 * count))
        row[:, :3], row[:, 3 * other : 3 * other + 3] = seen[0], -seen[other]
        rows.append(row)
    hook = np.zeros((2, 3 * count))
    hook[:, -3:] = np.hstack([np.eye(2), _turn(arm - parts[-1][2], angles[-1])[:, None]])
    constraint = np.vstack([*rows, hook])
    size = len(constraint)
    system = np.block([[inertia, -constraint.T], [constraint, np.zeros((size, size))]])
    return np.linalg.solve(system, np.concatenate([inertia @ before, np.zeros(size)]))[2 : 3 * count : 3]


@every_robot
def test_it_is_the_impact_of_free_links(robot):
    x = states(robot)
    joints = len(x) // 2
    after = np.cumsum(np.asarray(catch(robot, jnp.asarray(x)))[joints:], 0)
    expected = np.array([_impact(robot, each[:joints], each[joints:]) for each in x.T]).T
    np.testing.assert_allclose(after[::-1], expected, atol=1e-12)


@every_robot
def test_twice_it_is_the_identity_of_robot_and_place(robot):
    twice = exchanged(exchanged(robot))
    np.testing.assert_allclose([twice[name] for name in robot], [*robot.values()], rtol=1e-15)
    x = jnp.asarray(states(robot))
    x = x.at[len(x) // 2 :].set(0)
    again = catch(exchanged(robot), catch(robot, x))
    turned = np.asarray(again - x) / (2 * np.pi)
    np.testing.assert_allclose(turned, np.round(turned), atol=1e-12)


@every_robot
def test_links_stay_where_they_are(robot):
    """Of the robot from its new bar, seen from there, all links' centers are where they were."""
    arm, x = robot["arm_length"], states(robot)
    joints = len(x) // 2
    old, new = np.cumsum(x[:joints], 0), np.cumsum(np.asarray(catch(robot, jnp.asarray(x)))[:joints], 0)
    before = [arm * _along(old[0]) + r * _along(a) for (_, _, r), a in zip(links(robot), old, strict=True)]
    bar = arm * _along(old[0]) + arm * _along(old[-1])
    np.testing.assert_allclose(hook(robot, jnp.asarray(x)), bar, atol=1e-12)
    shoulder = bar + arm * _along(new[0])
    after = [shoulder + r * _along(a) for (_, _, r), a in zip(links(exchanged(robot)), new, strict=True)]
    np.testing.assert_allclose(after[::-1], before, atol=1e-12)


def _energy(robot, x):
    joints = len(x) // 2
    angles, rates = np.cumsum(x[:joints], 0), np.cumsum(x[joints:], 0)
    shoulder = _turn(robot["arm_length"], angles[0]) * rates[0]
    parts = zip(links(robot), angles, rates, strict=True)
    return sum(0.5 * (m * ((shoulder + _turn(r, a) * w) ** 2).sum(0) + i * w**2) for (m, i, r), a, w in parts)


@pytest.mark.parametrize(("robot", "share"), [(ACROMONK, 0.3), (RICMONK, 0.15)], ids=ROBOTS)
def test_it_loses_energy_and_a_motion_about_the_new_bar_none(robot, share):
    """A tail that hangs freely keeps more of it."""
    x = states(robot)
    before = _energy(robot, x)
    lost = before - _energy(exchanged(robot), np.asarray(catch(robot, jnp.asarray(x))))
    assert np.all(lost > 0)
    assert np.median(lost / before) > share


@every_robot
def test_its_derivative_is_that_of_differences(robot):
    x, step = jnp.asarray(states(robot)), 1e-6
    exact = jacobian(lambda x: catch(robot, x), x)
    for i in range(len(x)):
        away = jnp.zeros((len(x), 1)).at[i].set(step)
        differences = (catch(robot, x + away) - catch(robot, x - away)) / (2 * step)
        np.testing.assert_allclose(exact[:, i], differences, atol=1e-7)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_packaged_robot_is_the_one_of_the_formulas(name):
    """Without gravity and friction the motors' power u'q' of their joints is what the energy by hand grows by."""
    given = packaged(name)
    still = {key: 0 for key in vars(given) if key.endswith("_damping")}
    plant = packaged(name, gravity=1e-6, **still)
    fields = {key: value for key, value in ROBOTS[name].items() if key not in vars(plant)}
    robot = vars(plant) | fields
    x = states(robot)
    u = jnp.ones((plant.m, x.shape[1]))
    rates = np.asarray(plant.dynamics(design(name, **fields), jnp.asarray(x), u))
    gradient = np.stack([(_energy(robot, x + e) - _energy(robot, x - e)) / 2e-5
                         for e in 1e-5 * np.eye(len(x))[:, :, None]])  # fmt: skip
    np.testing.assert_allclose((gradient * rates).sum(0), x[len(x) // 2 + 1 :].sum(0), atol=1e-5)
