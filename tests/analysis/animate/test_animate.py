"""The videos move, show both candidates, and are refused by one line where nothing can draw."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image, ImageSequence

from rtcd_jax.analysis.animate import animate
from rtcd_jax.analysis.animate.camera import BACKENDS, choose_backend
from rtcd_jax.system.errors import UserError
from tests.analysis.report.loops import LOOPS, loop_folder
from tests.paths import ROOT

CODE = "import sys; from rtcd_jax.cli.main import main; sys.exit(main(sys.argv[1:]))"


def rtcd(*arguments, **environment):
    """In a process of its own: MuJoCo binds itself to one way of drawing for good."""
    command = [sys.executable, "-c", CODE, *map(str, arguments)]
    told = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"} | environment
    return subprocess.run(command, cwd=ROOT, env=told, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("plant", LOOPS)
def test_the_videos_show_both_candidates_moving(tmp_path, backend, plant):
    folder = loop_folder(tmp_path / "run", plant)
    done = rtcd("animate", folder, "--to", tmp_path / "videos")
    assert done.returncode == 0, done.stdout + done.stderr
    with Image.open(tmp_path / "videos" / "swingup.gif") as gif:
        frames = [np.asarray(frame.convert("RGB"), float) for frame in ImageSequence.Iterator(gif)]
    side = animate.SIDE + animate.GAP // 2
    assert frames[0].shape == (side, side, 3)
    assert len(frames) >= 15
    half = animate.SIDE // 2
    for rows in (slice(0, half), slice(half, None)):
        for columns in (slice(0, half), slice(half, None)):
            panel = [frame[rows, columns] for frame in frames]
            assert np.ptp(panel[0]) > 50, "an empty picture"
            assert np.abs(panel[0] - panel[-1]).max() > 50, "nothing moves"
    if animate.ffmpeg():
        assert (tmp_path / "videos" / "swingup.mp4").read_bytes()[4:8] == b"ftyp"
    else:
        assert "no MP4: there is no ffmpeg" in done.stdout
    assert not list((tmp_path / "videos").glob(".*"))


@pytest.mark.slow
def test_without_an_initial_funnel_the_best_is_shown_alone(tmp_path, backend):
    folder = loop_folder(tmp_path / "run", "pendulum", initial={"status": "FUNNEL_EMPTY"})
    done = rtcd("animate", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the initial candidate has no funnel (FUNNEL_EMPTY): the best elite is shown alone" in done.stdout
    with Image.open(folder / "animation" / "swingup.gif") as gif:
        assert gif.size == (animate.SIDE // 2, animate.SIDE + animate.GAP // 2)


@pytest.mark.thorough
def test_progress_is_drawn_on_a_terminal(tmp_path, backend):
    """Three frames a second of a short motion, in a process of its own."""
    code = (
        "import sys\nfrom pathlib import Path\nfrom rtcd_jax.system.devices import prepare_jax\nprepare_jax()\n"
        "from rtcd_jax.analysis.animate import animate\nfrom tests.consoles import Screen\n"
        "animate.RATE, animate.HOLD, animate.SIDE = 3, 0.0, 60\nscreen = Screen()\n"
        "with screen.console as console:\n    animate.animate_run(Path(sys.argv[1]), None, 0, console)\n"
        "print(screen.text)"
    )
    command = [sys.executable, "-c", code, str(loop_folder(tmp_path / "run", "pendulum"))]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"MUJOCO_GL": backend}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.search(r"frame (\d+) of \1  elapsed 0:\d\d  left 0:00", done.stdout)


def test_where_nothing_draws_it_is_told_in_one_line(tmp_path):
    done = rtcd("animate", loop_folder(tmp_path / "run", "pendulum"), MUJOCO_GL="glfw", DISPLAY="")
    assert done.returncode == 2
    assert done.stderr.startswith("rtcd: MuJoCo cannot draw here by glfw: install one, on Debian")
    assert done.stderr.count("\n") == 1


def test_a_run_without_elites_is_refused(tmp_path):
    from tests.analysis.report.runs import experiment, run_folder

    with pytest.raises(UserError, match="has no elites yet: finish the run first"):
        animate.animate_run(run_folder(tmp_path / "run", experiment()), None, 0, None)
    folder = loop_folder(tmp_path / "loop", "pendulum")
    (folder / "animation").write_text("in the way")
    with pytest.raises(UserError, match=r"cannot write .*animation"):
        animate.animate_run(folder, None, 0, None)


def test_a_failing_ffmpeg_is_told_by_its_own_words(tmp_path):
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\ncat >/dev/null\necho no such codec >&2\nexit 1\n")
    program.chmod(0o755)
    with (
        pytest.raises(UserError, match=r"ffmpeg cannot write .*x.mp4: no such codec"),
        animate.mp4(tmp_path / "x.mp4", (8, 8), str(program)) as add,
    ):
        add(Image.new("RGB", (8, 8)))
    assert [path.name for path in tmp_path.iterdir()] == ["ffmpeg"]


def test_without_any_ffmpeg_there_is_none(monkeypatch):
    monkeypatch.setattr(animate.shutil, "which", lambda _: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert animate.ffmpeg() is None
    monkeypatch.setattr(animate.shutil, "which", lambda name: f"/bin/{name}")
    assert animate.ffmpeg() == "/bin/ffmpeg"


def test_the_ways_of_drawing_are_tried_in_turn(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "none")  # so that what the choice leaves there goes with this test
    monkeypatch.delenv("MUJOCO_GL")
    tried = []

    def run(_, env, **__):
        tried.append(env["MUJOCO_GL"])
        return subprocess.CompletedProcess([], env["MUJOCO_GL"] != "osmesa")

    monkeypatch.setattr(subprocess, "run", run)
    assert choose_backend() == "osmesa"
    assert tried == list(BACKENDS)
    assert os.environ["MUJOCO_GL"] == "osmesa"
