"""The control rate of funnels that leave a held input no room, or whose last ellipsoid is smaller than the goal's."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm, solve_continuous_are

from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import linearized
from rtcd_jax.elite.simulators import dynamics_of
from rtcd_jax.export.proof import ProvedFunnel
from rtcd_jax.export.rate import RADII, control_rate
from tests.certificate import swing

DT, KNOTS = 0.05, 6
SIZE = 1e-4
"""Of the ellipsoids: what is not linear in such an error is far below the tolerance."""


def standing(dt=DT):
    """A pendulum that its LQR holds upright, in ellipsoids that are levels of V; and the closed loop's A."""
    arrays, record = swing.elite()
    there = {
        "time": dt * np.arange(KNOTS), "x": np.array([swing.UPRIGHT] * KNOTS), "u": np.zeros((KNOTS - 1, 1)),
        "K": np.zeros((KNOTS, 1, 2)), "S": np.array([np.eye(2)] * KNOTS), "rho": np.full(KNOTS, SIZE**2),
        "Q": np.diag([10.0, 1.0]), "R": np.eye(1), "K_goal": np.zeros((1, 2)), "x_goal": swing.UPRIGHT,
        "volumes_per_knot": np.ones(KNOTS),
    }  # fmt: skip
    elite = Elite.of({**arrays, **there}, {**record, "state_limits": [None, None]})
    (a,), (b,) = linearized(dynamics_of(elite), swing.UPRIGHT[None], np.zeros((1, 1)))
    s = solve_continuous_are(a, b, elite.Q, elite.R)
    gain = b.T @ s
    return replace(elite, K=np.array([gain] * KNOTS), K_goal=gain, S=np.array([s] * KNOTS)), a - b @ gain


@pytest.mark.thorough
def test_a_funnel_whose_boundary_is_a_motion_has_a_rate_for_what_starts_a_little_inside():
    """Its ellipsoids are images of the first one under the flow: a held input leaves them at any rate, if by little."""
    elite, loop = standing()
    back = np.array([expm(-loop * t) for t in elite.time])
    elite = replace(elite, S=np.swapaxes(back, 1, 2) @ elite.S[0] @ back)
    found = control_rate(elite, None)
    assert found.radius in RADII[1:]
    assert found.failed[found.divisor] == 0
    assert f"states at {found.radius:.1%} of the funnel's radius" in found.sentence
    assert control_rate(replace(elite, rho=elite.rho * 1.05 ** np.arange(KNOTS)), None).radius == 1


@pytest.mark.parametrize("dt", [DT, 0.0527])
def test_after_the_motion_the_goal_s_region_counts(dt):
    """The last ellipsoid before is smaller, as in every proof with a margin; what starts at the goal may be outside of
    it. (5 x 0.0527 / 0.0527 is less than 5 in doubles.)
    """
    elite, _ = standing(dt)
    axes = SIZE * np.linalg.inv(np.linalg.cholesky(elite.S[0])).T
    shrunk = np.zeros((KNOTS, 4, 2, 2))
    shrunk[:-1, 0], shrunk[-1, 0] = 0.5 * axes, axes
    proof = ProvedFunnel(np.arange(float(KNOTS)), shrunk, np.zeros((KNOTS - 1, 2, 2)), np.zeros(KNOTS))
    found = control_rate(elite, proof)
    assert found.radius == 1
    assert found.divisor is not None
