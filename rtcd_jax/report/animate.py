"""`rtcd animate`: the swing-up as MP4 and GIF, initial beside best, undisturbed above, disturbed below.

The disturbed start is drawn from the best funnel's first ellipsoid; both controllers get it.
"""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, final

import numpy as np

from rtcd_jax.config import Config
from rtcd_jax.errors import UserError
from rtcd_jax.files import writing
from rtcd_jax.report.motion import Motions, dynamics_before_mujoco, frame_times, motions
from rtcd_jax.report.render import Camera, choose_backend
from rtcd_jax.report.tube import Tube
from rtcd_jax.storage import elite_names, read_config, read_elite

if TYPE_CHECKING:
    from PIL.Image import Image

RATE, GIF_EVERY = 30, 2
"""Frames a second of the MP4; the GIF has every second one, at half the size."""
HOLD = 1.0
"""Seconds shown after the slower motion's end."""
SIDE = 420
"""Pixels of one panel's side."""
_INK, _GOOD, _BAD = (28, 39, 51), (0, 114, 80), (190, 60, 0)


class Console(Protocol):
    def message(self, text: str, /) -> None: ...
    def progress(self, now: Any, /) -> None: ...


@final
@dataclass(frozen=True)
class Rendered:
    """Frames done of all, as a console shows progress."""

    generation: int
    generations: int

    def __str__(self) -> str:
        return f"frame {self.generation} of {self.generations}"


@final
@dataclass(frozen=True)
class Column:
    """One candidate of the video."""

    label: str
    model: Any
    motions: Motions


def animate_run(folder: Path, to: Path | None, seed: int, console: Console) -> list[Path]:
    """Writes `swingup.gif` and `swingup.mp4` into `to`, by default the run's `animation/`; the files written.

    Without an ffmpeg there is no MP4, and a message says so.

    Raises:
        UserError: no run folder, a run without elites, nothing that draws without a display, or a folder that cannot
            be written.
    """
    config = read_config(folder)
    if not elite_names(folder):
        raise UserError(f"{folder} has no elites yet: finish the run first, by the command that began it")
    target = to or folder / "animation"
    with writing(target):
        target.mkdir(parents=True, exist_ok=True)
    backend = choose_backend()
    columns = _columns(folder, config, seed, console)
    console.message(f"rendering {len(columns[0].motions.time)} frames by MuJoCo ({backend})")
    frames = list(_frames(columns, console))
    written = [_write_gif(frames, target / "swingup.gif")]
    program = ffmpeg()
    if program:
        written.append(_write_mp4(frames, target / "swingup.mp4", program))
    else:
        console.message("no MP4: there is no ffmpeg; install it, or `pip install 'rtcd-jax[video]'`")
    for path in written:
        console.message(f"{path}, {path.stat().st_size / 1e6:.1f} MB")
    return written


def ffmpeg() -> str | None:
    """The program that writes MP4: that of the PATH, else imageio-ffmpeg's, else None."""
    found = shutil.which("ffmpeg")
    if found:
        return found
    with contextlib.suppress(ImportError, RuntimeError):
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    return None


def _columns(folder: Path, config: Config, seed: int, console: Console) -> list[Column]:
    """The initial candidate, if it has a funnel, and the best, from the same two starts."""
    tubes = {}
    for label, place, name in (("initial", folder, "initial"), ("best", folder / "elites", "000")):
        if label == "initial" and not (place / "initial.json").is_file():
            continue
        arrays, record = read_elite(place, name)
        if record["status"] == "OK":
            tubes[label] = Tube.of(arrays, record)
        else:
            console.message(f"{label}: nothing to show, it has no funnel ({record['status']})")
    if "best" not in tubes:
        raise UserError(f"{folder / 'elites'}: 000 has no funnel")
    _, disturbed = tubes["best"].elite.sample(1, np.random.default_rng(seed))
    starts = np.stack([np.array(config.task.start), disturbed[0]])
    time = frame_times(list(tubes.values()), HOLD, RATE)
    console.message(
        "disturbed start, from the best funnel's first ellipsoid: "
        + ", ".join(f"{name} = {value:.4g}" for name, value in zip(config.plant.states, disturbed[0], strict=True))
    )
    columns = []
    for label, tube in tubes.items():
        model, f = dynamics_before_mujoco(tube, len(starts))
        columns.append(Column(label, model, motions(tube, f, starts, time)))
    return columns


def _frames(columns: Sequence[Column], console: Console) -> Iterator["Image"]:
    from PIL import Image

    time = columns[0].motions.time
    with contextlib.ExitStack() as stack:
        cameras = [stack.enter_context(Camera(column.model, SIDE, SIDE)) for column in columns]
        for k in range(len(time)):
            frame = Image.new("RGB", (SIDE * len(columns), 2 * SIDE))
            for i, (column, camera) in enumerate(zip(columns, cameras, strict=True)):
                states = column.motions.x[k]
                for row, state in enumerate(states):
                    panel = Image.fromarray(camera.picture(state[: len(state) // 2]))
                    _write_on(panel, column, k, row)
                    frame.paste(panel, (i * SIDE, row * SIDE))
            yield frame
            if (k + 1) % RATE == 0 or k + 1 == len(time):
                console.progress(Rendered(k + 1, len(time)))


def _write_on(panel: "Image", column: Column, k: int, row: int) -> None:
    from PIL import ImageDraw, ImageFont

    draw = ImageDraw.Draw(panel)
    large, small = ImageFont.load_default(20), ImageFont.load_default(14)
    draw.text((12, 8), column.label, fill=_INK, font=large)
    draw.text((12, 34), ("undisturbed", "disturbed start")[row], fill=_INK, font=small)
    draw.text((SIDE - 12, 8), f"{column.motions.time[k]:.2f} s", fill=_INK, font=large, anchor="ra")
    fill = column.motions.fill[k, row]
    text, color = (f"in its funnel, V/ρ = {fill:.2f}", _GOOD) if fill <= 1 else ("outside its funnel", _BAD)
    draw.text((12, SIDE - 12), text, fill=color, font=small, anchor="ld")


def _write_gif(frames: Sequence["Image"], path: Path) -> Path:
    size = tuple(length // 2 for length in frames[0].size)
    small = [frame.resize(size).quantize(128) for frame in frames[::GIF_EVERY]]
    pause = 1000 * GIF_EVERY // RATE
    temporary = path.with_name(f".{path.name}.tmp")
    with writing(path):
        small[0].save(
            temporary, format="GIF", save_all=True, append_images=small[1:], duration=pause, loop=0, optimize=True
        )
        temporary.replace(path)
    return path


def _write_mp4(frames: Sequence["Image"], path: Path, program: str) -> Path:
    width, height = frames[0].size
    temporary = path.with_name(f".{path.name}.tmp")
    command = [
        program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}",
        "-r", f"{RATE}", "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", os.fspath(temporary),
    ]  # fmt: skip
    pixels = b"".join(frame.tobytes() for frame in frames)
    done = subprocess.run(command, input=pixels, capture_output=True)
    if done.returncode:
        raise UserError(f"{program} cannot write {path}: {done.stderr.decode(errors='replace').strip()}")
    with writing(path):
        temporary.replace(path)
    return path
