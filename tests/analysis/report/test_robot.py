"""The motions of the page's robots: the stored one at the knots, held at the goal, beside one from the boundary."""

import numpy as np
import pytest

from rtcd_jax.analysis.report.motion import HOLD, boundary_motions
from rtcd_jax.analysis.report.reading import FunnelView
from rtcd_jax.analysis.report.robot import robots_of
from rtcd_jax.elite.elite import Elite
from tests.analysis.report.loops import LOOPS, loop_folder


@pytest.fixture(params=LOOPS)
def elite(request, tmp_path):
    return Elite.read(loop_folder(tmp_path / "run", request.param), 0)


def test_the_nominal_motion_is_the_stored_one_and_the_goal_is_held(elite):
    """To the integrator's accuracy; after the last knot it stays where the last knot is."""
    motions = boundary_motions(elite)
    assert np.all(np.diff(motions.time) > 0)
    assert motions.time[-1] >= elite.time[-1] + HOLD
    knots = motions.x[:: motions.stride, 0]
    np.testing.assert_allclose(motions.time[:: motions.stride][: len(elite.time)], elite.time, atol=1e-12)
    np.testing.assert_allclose(knots[: len(elite.time)], elite.x, atol=1e-3)
    np.testing.assert_allclose(motions.x[-1, 0], elite.x_goal, atol=1e-2)


def test_the_disturbed_motion_begins_on_the_boundary_and_uses_most_of_the_funnel(elite):
    motions = boundary_motions(elite)
    widest = motions.widest
    assert elite.value(0, motions.x[:1, widest]) == pytest.approx(elite.rho[0])
    after = motions.ratio[motions.stride :]
    assert after[:, widest].max() == after[:, 1:].max()


def test_every_instant_has_a_pose_for_every_body(elite):
    told = robots_of([FunnelView("best", "#000000", elite)])
    (robot,) = told["robots"]
    for name in ("nominal", "disturbed"):
        poses = np.array(robot[name]["poses"])
        assert len(poses) == len(robot[name]["x"]) == len(robot["times"])
        np.testing.assert_allclose(np.linalg.norm(poses[:, :, 3:], axis=2), 1, atol=1e-3)
        assert {part["body"] for part in robot["parts"]} <= set(range(poses.shape[1]))
        assert np.abs(poses[:, :, :3]).max() <= told["reach"]
