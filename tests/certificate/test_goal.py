"""The goal region of the saturated pendulum beside a fine grid of simulations and beside a closed form."""

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_are

from rtcd_jax.certificate.prove.closed_loop import Loop
from rtcd_jax.certificate.prove.goal import goal_region
from rtcd_jax.certificate.prove.levels import goal_level, unit_directions
from rtcd_jax.elite.elite import Elite
from tests.certificate import swing
from tests.certificate.claims import claimed
from tests.certificate.loops import Simulated

PAPER = {"m": 0.7, "l": 0.4, "b": 0.1, "g": 9.81, "torque_limit": 2.5}
OTHER = {"m": 0.676, "l": 0.45, "b": 0.1, "g": 9.81, "torque_limit": 2.0}
GRID = 101


class Upright:
    """A pendulum's LQR about the upright, and the goal region that is proved without limits on the states."""

    def __init__(self, parameters, q, r):
        self.parameters, inertia = parameters, parameters["m"] * parameters["l"] ** 2
        a = np.array([[0, 1], [parameters["g"] / parameters["l"], -parameters["b"] / inertia]])
        b = np.array([[0], [1 / inertia]])
        self.S = solve_continuous_are(a, b, np.diag(q), [[r]])
        self.K = b.T @ self.S / r
        self.linear, self.limit = a - b @ self.K, parameters["torque_limit"]
        arrays = {
            "time": np.array([0, 0.05]), "x": np.array([swing.UPRIGHT] * 2), "u": np.zeros((1, 1)),
            "K": np.array([self.K] * 2), "S": np.array([self.S] * 2), "Q": np.diag(q), "R": np.array([[r]]),
            "K_goal": self.K, "x_goal": swing.UPRIGHT, "u_max": np.array([self.limit]), "rho": np.ones(2),
            "volumes_per_knot": np.ones(2),
        }  # fmt: skip
        record = {"plant": "pendulum", "parameters": parameters, "state_limits": [None, None], **swing.PROMISE}
        elite = Elite.of(arrays, record)
        claim = claimed(elite)
        self.claim, self.loop = claim, Loop(claim, elite)
        region = goal_region(claim, self.loop, exact=True)
        assert region is not None
        self.rho = region.rho

    def area(self, level):
        """Of {V <= level}."""
        return np.pi * level / np.sqrt(np.linalg.det(self.S))

    def grid(self, width=1.5):
        """Errors [2 M] all over a box around the region, and the area of a cell."""
        half = width * np.sqrt(self.rho * np.diag(np.linalg.inv(self.S)))
        sides = [np.linspace(-h, h, GRID) for h in half]
        return np.stack(np.meshgrid(*sides)).reshape(2, -1), np.prod(2 * half / (GRID - 1))

    def value(self, error):
        return np.sum(error * (self.S @ error), axis=0)

    def rate(self, error):
        u = np.clip(-self.K @ error, -self.limit, self.limit)[0]
        return swing.rate(swing.UPRIGHT[:, None] + error, u, self.parameters)

    def arrive(self, error, duration=8.0, step=0.01):
        for _ in range(round(duration / step)):
            error = Simulated.step(lambda x, _: self.rate(x), error, 0.0, step)
        return self.value(error) < 1e-3 * self.rho

    def never_saturated(self, error):
        """Where the linear loop's own input stays within the limit for all time, and the motor holds what the sine is
        short of the angle (Gross et al., CDC 2022).

        With two real modes the input has one extremum at most, here looked for on a fine grid of times.
        """
        p = self.parameters
        near = np.abs(error[0] - np.sin(error[0])) < self.limit / (p["m"] * p["g"] * p["l"])
        assert np.all(np.isreal(np.linalg.eigvals(self.linear)))
        inputs = [np.abs(self.K @ expm(t * self.linear) @ error) for t in np.linspace(0, 2, 400)]
        return near & (np.max(inputs, axis=0)[0] <= self.limit)


@pytest.fixture(scope="module", params=[(PAPER, (10.0, 1.0), 1.0), (OTHER, (1.0, 1.0), 1.0)], ids=["paper", "other"])
def upright(request):
    return Upright(*request.param)


def test_it_lies_in_the_simulated_region_and_is_not_far_from_it(upright):
    error, _ = upright.grid()
    arrive, inside = upright.arrive(error), upright.value(error) <= upright.rho
    assert inside.sum() > 2000
    assert np.all(arrive[inside])
    assert upright.value(error)[~arrive].min() < 1.5 * upright.rho


def test_it_is_the_largest_on_which_the_value_falls(upright):
    """Within the resolution of the levels that are tried; above it, V rises somewhere on its boundary."""
    angle = np.linspace(0, 2 * np.pi, 2000)
    circle = np.linalg.cholesky(np.linalg.inv(upright.S)) @ np.stack([np.cos(angle), np.sin(angle)])

    def rises(level):
        error = np.sqrt(level) * circle
        return np.max(np.sum((upright.S @ error) * upright.rate(error), axis=0)) > 0

    assert not rises(upright.rho)
    assert rises(1.04 * upright.rho)


def test_the_closed_form_of_the_unsaturated_loop_arrives_and_is_smaller(upright):
    """It is no ellipse, and no proof for the true sine; the proved region has saturated states that it lacks."""
    error, cell = upright.grid(4.0)
    closed = upright.never_saturated(error)
    assert np.all(upright.arrive(error[:, closed]))
    assert not np.any(closed[np.abs(error[0]) >= error[0].max() * (1 - 1e-9)])  # the grid is wide enough
    assert 1.05 < upright.area(upright.rho) / (closed.sum() * cell) < 1.3
    assert np.mean(closed[upright.value(error) <= upright.rho]) < 0.6
    alone = upright.limit**2 / float((upright.K @ np.linalg.inv(upright.S) @ upright.K.T)[0, 0])
    assert upright.rho > 2 * alone  # the largest ellipse of the same shape without saturation


def falling_level(K, S, Q, r, limit):
    """The lowest V at which that of a linear loop, saturated at `limit`, does not fall any more.

    With s = K e beyond the limit, V' = -e'Q e + r (s^2 - 2 |s| limit): on each line K e = s an interval, at most.
    """
    along = np.array([-K[0, 1], K[0, 0]]) / np.linalg.norm(K)
    s = limit * np.linspace(2, 100, 1_000_001)
    foot = (K.T / np.sum(K**2) * s).T
    a, b, c = along @ Q @ along, foot @ Q @ along, np.einsum("si,ij,sj->s", foot, Q, foot) - r * (s**2 - 2 * s * limit)
    some = b**2 >= a * c
    foot, b, reach = foot[some], b[some] / a, np.sqrt(b[some] ** 2 - a * c[some]) / a
    best = np.clip(-(foot @ S @ along) / (along @ S @ along), -b - reach, -b + reach)
    error = foot + best[:, None] * along
    return np.min(np.einsum("si,ij,sj->s", error, S, error))


@pytest.mark.parametrize("limit", [1e-2, 1e-3])
def test_the_level_of_a_small_region_is_that_of_the_saturated_linear_loop(limit):
    """Far below a 400th of the level at which the ellipsoid reaches half a turn. V' is sampled each half degree."""
    weak = Upright(PAPER | {"torque_limit": limit}, (10.0, 1.0), 1.0)
    level = goal_level(weak.loop, unit_directions(2))
    assert level < 1e-4 * weak.loop.goal_box_level()
    expected = falling_level(weak.K, weak.S, np.diag([10.0, 1.0]), 1.0, limit)
    assert level == pytest.approx(expected, rel=5e-3)
    assert 0.5 * level < weak.rho <= level
