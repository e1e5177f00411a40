"""A cycle of tasks as a video: swing after swing, from bar to bar."""

import itertools

import numpy as np
import pytest
from PIL import Image, ImageSequence

from rtcd_jax.analysis.animate import animate, cycle
from tests import test_reset
from tests.analysis.animate.test_animate import rtcd


@pytest.mark.slow
def test_the_robot_goes_from_bar_to_bar(tmp_path, backend):
    folder = test_reset.cycle_folder(tmp_path / "run")
    course, bars = cycle._course(folder, 0, 4)
    np.testing.assert_allclose(bars, 0.34 * np.arange(-1, 5), rtol=1e-6)
    assert [swing.task for swing in course] == ["heavy_holds", "light_holds"] * 2
    for swing, following in itertools.pairwise(course):
        assert following.begin == pytest.approx(swing.begin + swing.motions.time[-1])
        assert following.bar == pytest.approx(swing.bar + 0.34)
    assert all(np.all(swing.motions.ratio <= 1) for swing in course)
    assert course[0].motions.ratio[0, 1] == pytest.approx(animate.NEAR)
    assert course[0].model is course[2].model is not course[1].model

    done = rtcd("animate", folder, "--swings", 1)
    assert done.returncode == 0, done.stdout + done.stderr
    with Image.open(folder / "animation" / "swingup.gif") as gif:
        frames = [np.asarray(frame.convert("RGB"), float) for frame in ImageSequence.Iterator(gif)]
    assert frames[0].shape == (cycle.HEIGHT + cycle.GAP // 2, cycle.WIDTH // 2, 3)
    red = [np.mean(np.nonzero((frame[..., 0] > 180) & (frame[..., 2] < 100))[1]) for frame in (frames[0], frames[-1])]
    assert red[1] > red[0] + cycle.WIDTH // 2 / 4, "the free arm has not come to the next bar"
