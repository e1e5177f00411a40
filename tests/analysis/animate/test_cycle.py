"""A cycle of tasks as a video: swing after swing, from bar to bar."""

import itertools

import jax
import numpy as np
import pytest
from PIL import Image, ImageSequence

from rtcd_jax.analysis.animate import animate, cycle
from rtcd_jax.elite.records import mark_of
from rtcd_jax.reset import closed
from rtcd_jax.run.format import arrays_of, common_arrays, common_record, record_of
from rtcd_jax.run.reevaluation import row
from rtcd_jax.run.tasks import store_task
from rtcd_jax.system.files import replace_json
from tests import test_reset
from tests.analysis.animate.test_animate import rtcd
from tests.analysis.report.runs import run_folder


@pytest.mark.slow
def test_the_robot_goes_from_bar_to_bar(tmp_path, backend):
    problem, whole = test_reset.problem(), test_reset.evaluated()
    whole = closed(problem, whole, jax.random.key(1), 100)
    common = common_arrays(whole), common_record(problem, whole)
    folder = run_folder(tmp_path / "run", problem.config, common, common, generations=[])
    replace_json(folder / "format.json", mark_of(problem.config))
    for i, (name, alone) in enumerate(zip(problem.config.tasks, problem.tasks, strict=True)):
        one = row(whole.tasks, i)
        stored = arrays_of(alone, one), record_of(alone, one)
        store_task(folder, name, alone.config, [stored], stored)

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
