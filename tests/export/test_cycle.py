"""The hand-over of an exported cycle: the model's impact, and swings behind one another in MuJoCo."""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.elite.elite import Elite
from rtcd_jax.export.source import TEMPLATES
from rtcd_jax.plants import brachiation
from tests import test_reset
from tests.analysis.animate.test_animate import rtcd
from tests.export.conftest import module

NUMBERS = 0.314, 1.04, 0.233, 0.0017, 0.63, 0.125, 0.0041, 2.6, 0.18, 0.0052


@pytest.mark.parametrize("joints", [2, 3])
def test_the_exported_impact_is_that_of_the_search(joints):
    """Written twice: by the links' velocities here, by the angles between them there."""
    cycle = module(TEMPLATES / "rtcd_cycle.py").Cycle()
    robot = dict(zip(brachiation.FIELDS[joints], NUMBERS, strict=False))
    cycle._robots = [robot]
    for x in np.random.default_rng(0).normal(size=(100, 2 * joints)) * np.repeat([2, 4], joints):
        np.testing.assert_allclose(
            cycle.after_catch(x), brachiation.catch(robot, jnp.asarray(x)), rtol=1e-10, atol=1e-10
        )


def ends_with_its_catch(lab, elite):
    """In Python and in C: until t_N the closed loop and V/rho, then no input, and no state inside."""
    exported = module(lab / "acromonk_000_controller.py")
    assert exported.self_test(lab) <= exported.TOLERANCE
    sources = [lab / f"acromonk_000_controller{name}" for name in ("_test.c", ".c")]
    subprocess.run(["cc", "-std=c99", "-O2", *sources, "-lm", "-o", lab / "test"], check=True)
    done = subprocess.run(["./test"], cwd=lab, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    controller = exported.Controller(lab)
    end = controller.duration
    assert np.any(np.loadtxt(lab / "test_vectors.csv", delimiter=",", skiprows=1)[:, 0] > end)
    near = elite.x_goal + 0.5 * (elite.points(np.array([len(elite.u)]), np.random.default_rng(0))[0] - elite.x_goal)
    assert controller.monitor(end, near).ratio == pytest.approx(elite.value_of_goal(near[None])[0] / elite.rho[-1])
    assert controller.monitor(end, near).inside
    assert controller.control(end - 1e-6, near) != 0
    assert controller.control(end + 1e-6, near) == 0
    after = controller.monitor(end + 1e-6, near)
    assert (after.inside, after.abort) == (False, True)
    assert "it ends in a catch set" in (lab / "README.md").read_text()
    demo = [sys.executable, lab / "acromonk_000_controller.py", "--demo", "--headless"]
    assert subprocess.run(demo, cwd=lab).returncode == 0


@pytest.mark.slow
def test_the_export_swings_from_bar_to_bar(tmp_path):
    folder, lab = test_reset.cycle_folder(tmp_path / "run"), tmp_path / "lab"
    done = rtcd("export", folder, "--to", lab)
    assert done.returncode == 0, done.stdout + done.stderr
    assert sorted(path.name for path in lab.iterdir()) == ["cycle.py", "heavy_holds", "light_holds"]
    done = subprocess.run([sys.executable, lab / "cycle.py", "5"], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == [f"swing {k}" for k in range(1, 6)]
    ends_with_its_catch(lab / "heavy_holds", Elite.read(folder / "tasks" / "heavy_holds", 0))
    (lab / "cycle.py").write_text("mine")
    assert rtcd("export", folder, "--to", lab).returncode == 2
    assert (lab / "cycle.py").read_text() == "mine"
