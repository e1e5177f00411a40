"""What the videos show is the defined loop: beside scipy, then held at the goal."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rtcd_jax.analysis.animate.motion import dynamics_before_mujoco, frame_times, motions
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import FunnelInterpolant
from tests.analysis.report.loops import LOOPS, stored


@pytest.mark.parametrize("plant", LOOPS)
def test_an_undisturbed_motion_is_the_nominal_one_and_stays_at_the_goal(plant):
    arrays, record = stored(plant)
    funnel = FunnelInterpolant.of(Elite.of(arrays, record))
    _, f = dynamics_before_mujoco(funnel.elite, 1)
    time = np.linspace(0, arrays["time"][-1] + 0.5, 30)
    found = motions(funnel, f, arrays["x"][:1], time)
    np.testing.assert_allclose(found.x[:, 0], funnel.nominal(time), atol=1e-3)
    assert found.ratio.max() < 1e-3


@pytest.mark.parametrize("plant", LOOPS)
def test_a_disturbed_motion_is_that_of_the_clipped_policy(plant):
    arrays, record = stored(plant)
    funnel, loop = FunnelInterpolant.of(Elite.of(arrays, record)), LOOPS[plant]
    _, f = dynamics_before_mujoco(funnel.elite, 2)
    n, h = arrays["x"].shape[1], loop.DT
    starts = arrays["x"][0] + 0.05 * np.stack([np.zeros(n), np.ones(n)])

    def rate(t, x):
        k = min(int(t / h), len(arrays["u"]) - 1)
        share = t / h - k
        gain = (1 - share) * arrays["K"][k] + share * arrays["K"][k + 1]
        u = arrays["u"][k] - gain @ (x - funnel.nominal(np.array([t]))[0])
        return loop.rate(x, np.clip(u, -arrays["u_max"], arrays["u_max"])[0])

    # One interval alone: at its end the feed-forward jumps, over which an adaptive integrator stumbles.
    expected = solve_ivp(rate, (0, h * (1 - 1e-9)), starts[1], rtol=1e-10, atol=1e-10).y[:, -1]
    found = motions(funnel, f, starts, np.array([0.0, h]))
    np.testing.assert_array_equal(found.x[0], starts)
    np.testing.assert_allclose(found.x[1, 1], expected, rtol=1e-4, atol=1e-5)
    assert found.ratio[0, 0] == 0 < found.ratio[0, 1]


def test_a_video_shows_the_longest_motion_and_what_follows():
    elites = [Elite.of(*stored(plant)) for plant in LOOPS]
    time = frame_times(elites, hold=0.5, rate=10)
    assert time[0] == 0
    assert 0.7 <= time[-1] < 0.8 + 1e-12
    np.testing.assert_allclose(np.diff(time), 0.1)
