"""`rtcd animate` of a cycle of tasks: swing after swing of the best elite, undisturbed above, disturbed below.

The robot goes from bar to bar to the right; an arm keeps its color. At a reset the free hook is taken to be on the bar.
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rtcd_jax.analysis.animate.animate import HOLD, RATE, disturbed_start, write_on, write_videos
from rtcd_jax.analysis.animate.camera import Camera, choose_backend
from rtcd_jax.analysis.animate.motion import Motions, dynamics_before_mujoco, motions
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import FunnelInterpolant
from rtcd_jax.elite.records import read_config, require_elites, task_folders
from rtcd_jax.plants import brachiation
from rtcd_jax.problem import RESETS
from rtcd_jax.system.console import Console
from rtcd_jax.system.files import make_folder

if TYPE_CHECKING:
    from PIL.Image import Image

WIDTH, HEIGHT, GAP = 840, 400, 4
"""Pixels of one row, and between the two."""
ROOM = 1.3
"""Width of the picture over that of the bars."""
DISTANCE = 8.0
"""Of the camera, over the picture's width: hardly any perspective."""


@final
@dataclass(frozen=True)
class Swing:
    """One motion of the cycle: of which task, from which bar [m], by which model, from which time on [s]."""

    task: str
    bar: float
    model: Any
    begin: float
    motions: Motions


def animate_cycle(run: Path, to: Path | None, seed: int, swings: int, console: Console) -> list[Path]:
    """Writes `swingup.gif` and `swingup.mp4` of the first `swings` into `to`, by default the run's `animation/`; the
    files written. The disturbed start is near the boundary of the first task's first ellipsoid.

    Raises:
        UserError: as `animate_run`.
    """
    require_elites(run)
    target = to or run / "animation"
    make_folder(target)
    backend = choose_backend()
    course, bars = _course(run, seed, swings)
    frames = math.ceil((course[-1].begin + float(course[-1].motions.time[-1]) + HOLD) * RATE) + 1
    console.message(f"rendering {frames} frames of {swings} swings by MuJoCo ({backend})")
    return write_videos(_frames(course, bars, frames), frames, (WIDTH, 2 * HEIGHT + GAP), target, console)


def _course(run: Path, seed: int, swings: int) -> tuple[list[Swing], Float[np.ndarray, " bars"]]:
    """The swings, one behind the other, and all bars [m]."""
    folders = task_folders(run)
    elites = [Elite.read(folder, 0) for folder in folders]
    models = {}
    reset = RESETS[read_config(run).task.catch.reset].state
    x = np.stack([elites[0].x[0], disturbed_start(elites[0], seed)])
    course, bars, begin = [], [0.0], 0.0
    for number in range(swings):
        task, exchanged = number % len(elites), bool(number % 2)
        elite = elites[task]
        if (task, exchanged) not in models:
            models[task, exchanged] = dynamics_before_mujoco(elite, len(x))
            _dress(models[task, exchanged][0], exchanged)
        model, f = models[task, exchanged]
        end = float(elite.time[-1])
        first = math.ceil(begin * RATE) / RATE - begin
        time = np.append(np.arange(first, end, 1 / RATE), end)
        motion = motions(FunnelInterpolant.of(elite), f, x, time)
        course.append(Swing(folders[task].name, bars[-1], model, begin, motion))
        x = np.asarray(reset(elite.parameters, jnp.asarray(course[-1].motions.x[-1].T))).T
        bars.append(bars[-1] + float(brachiation.hook(elite.parameters, jnp.asarray(elite.x_goal))[0]))
        begin += end
    return course, np.array([2 * bars[0] - bars[1], *bars])


def _dress(model: Any, exchanged: bool) -> None:
    """Hides what stands in the world, its bars, since all bars are drawn; where the arms have changed places, the
    materials `first` and `second`, if there are such, have each other's color.
    """
    fixed = model.geom_bodyid == 0
    model.geom_matid[fixed], model.geom_rgba[fixed, 3] = -1, 0
    names = [model.mat(i).name for i in range(model.nmat)]
    if exchanged and {"first", "second"} <= {*names}:
        pair = [names.index("first"), names.index("second")]
        model.mat_rgba[pair] = model.mat_rgba[pair[::-1]]


def _frames(course: Sequence[Swing], bars: Float[np.ndarray, " bars"], frames: int) -> Iterator["Image"]:
    from PIL import Image

    width, middle = ROOM * (bars[-1] - bars[0]), (bars[-1] + bars[0]) / 2
    with contextlib.ExitStack() as stack:
        models = {id(swing.model): swing.model for swing in course}
        cameras = {name: stack.enter_context(Camera(model, WIDTH, HEIGHT)) for name, model in models.items()}
        for k in range(frames):
            time = k / RATE
            number = max(i for i, swing in enumerate(course) if swing.begin <= time)
            swing = course[number]
            at = min(int(np.searchsorted(swing.motions.time, time - swing.begin - 1e-9)), len(swing.motions.time) - 1)
            camera = cameras[id(swing.model)]
            camera.look(middle - swing.bar, width * HEIGHT / WIDTH, DISTANCE * width)
            frame = Image.new("RGB", (WIDTH, 2 * HEIGHT + GAP), "white")
            for row, x in enumerate(swing.motions.x[at]):
                panel = Image.fromarray(camera.picture(x[: len(x) // 2], (bars - swing.bar).tolist()))
                kind = ("undisturbed", "disturbed start")[row]
                titles = f"swing {number + 1}: {swing.task}", kind
                write_on(panel, titles, time, float(swing.motions.ratio[at, row]))
                frame.paste(panel, (0, row * (HEIGHT + GAP)))
            yield frame
