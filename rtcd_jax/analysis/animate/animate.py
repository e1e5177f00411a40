"""`rtcd animate`: the swing-up as MP4 and GIF, initial beside best, undisturbed above, disturbed below.

The disturbed start is drawn from the best funnel's first ellipsoid, near its boundary; both controllers get it.
"""

import contextlib
import shutil
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
from jaxtyping import Float

from rtcd_jax.analysis.animate.camera import Camera, choose_backend
from rtcd_jax.analysis.animate.motion import Motions, dynamics_before_mujoco, frame_times, motions
from rtcd_jax.config.load import Config
from rtcd_jax.elite.elite import Elite, initial_and_best
from rtcd_jax.elite.funnel import FunnelInterpolant
from rtcd_jax.elite.records import read_config, require_elites
from rtcd_jax.system.console import Clock, Console, Progress
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import make_folder, writing

if TYPE_CHECKING:
    from PIL.Image import Image

RATE, GIF_EVERY = 30, 2
"""Frames a second of the MP4; the GIF has every second one, at half the size."""
HOLD = 1.0
"""Seconds shown after the slower motion's end."""
SIDE, GAP = 420, 4
"""Pixels of one panel's side, and between panels; even, as video codecs want them."""
MARGIN = 1.15
"""Half the picture's height over the farthest that a robot reaches."""
NEAR = 0.9
"""V/rho of the disturbed start."""
_INK, _GOOD, _BAD = (28, 39, 51), (0, 114, 80), (190, 60, 0)


@final
@dataclass(frozen=True)
class Column:
    """One candidate of the video."""

    label: str
    model: Any
    motions: Motions

    @property
    def positions(self) -> Float[np.ndarray, "T starts q"]:
        """Of the joints."""
        return self.motions.x[..., : self.motions.x.shape[-1] // 2]


def animate_run(folder: Path, to: Path | None, seed: int, console: Console) -> list[Path]:
    """Writes `swingup.gif` and `swingup.mp4` into `to`, by default the run's `animation/`; the files written.

    Without an ffmpeg there is no MP4, and a message says so.

    Raises:
        UserError: no run folder, a run without elites, nothing that draws without a display, or a folder that cannot
            be written.
    """
    config = read_config(folder)
    require_elites(folder)
    target = to or folder / "animation"
    make_folder(target)
    backend = choose_backend()
    columns = _columns(folder, config, seed, console)
    console.message(f"rendering {len(columns[0].motions.time)} frames by MuJoCo ({backend})")
    size = SIDE * len(columns) + GAP * (len(columns) - 1), 2 * SIDE + GAP
    return write_videos(_frames(columns, size), len(columns[0].motions.time), size, target, console)


def write_videos(
    frames: Iterable["Image"], count: int, size: tuple[int, int], target: Path, console: Console
) -> list[Path]:
    """Writes so many frames of this size as `swingup.gif` and, with an ffmpeg, `swingup.mp4` into a folder."""
    program, clock = ffmpeg(), Clock()
    written = [target / "swingup.gif", target / "swingup.mp4"][: 1 + bool(program)]
    with mp4(written[1], size, program) if program else contextlib.nullcontext() as add:
        small = []
        for k, frame in enumerate(frames):
            if k % GIF_EVERY == 0:
                small.append(frame.resize((size[0] // 2, size[1] // 2)))
            if add:
                add(frame)
            if (k + 1) % RATE == 0 or k + 1 == count:
                console.progress(Progress(k + 1, count, f"frame {k + 1} of {count}  {clock.times(k + 1, count)}"))
        _write_gif(small, written[0])
    if not program:
        console.message("no MP4: there is no ffmpeg; install it, or `pip install -e '.[video]'`")
    for path in written:
        console.message(f"{path}, {path.stat().st_size / 1e6:.1f} MB")
    return written


def ffmpeg() -> str | None:
    """The program that writes MP4: that of the PATH, else imageio-ffmpeg's, else None."""
    if program := shutil.which("ffmpeg"):
        return program
    with contextlib.suppress(ImportError, RuntimeError):
        from imageio_ffmpeg import get_ffmpeg_exe  # pyright: ignore[reportMissingImports]

        return get_ffmpeg_exe()
    return None


def _columns(folder: Path, config: Config, seed: int, console: Console) -> list[Column]:
    """The initial candidate, if it has a funnel, and the best, from the same two starts."""
    elites, absence = initial_and_best(folder)
    if absence:
        console.message(f"{absence}: the best elite is shown alone")
    disturbed = disturbed_start(elites["best"], seed)
    time = frame_times(list(elites.values()), HOLD, RATE)
    console.message(
        "disturbed start, from the best funnel's first ellipsoid: "
        + ", ".join(f"{name} = {value:.4g}" for name, value in zip(config.plant.states, disturbed, strict=True))
    )
    columns = []
    for label, elite in elites.items():
        starts = np.stack([elite.x[0], disturbed])
        model, f = dynamics_before_mujoco(elite, len(starts))
        columns.append(Column(label, model, motions(FunnelInterpolant.of(elite), f, starts, time)))
    return columns


def disturbed_start(elite: Elite, seed: int) -> np.ndarray:
    """A state in a random direction from the first knot, near the boundary of its ellipsoid."""
    _, drawn = elite.sample(1, np.random.default_rng(seed))
    return elite.x[0] + np.sqrt(NEAR * elite.rho[0] / elite.value(0, drawn)) * (drawn[0] - elite.x[0])


def _frames(columns: Sequence[Column], size: tuple[int, int]) -> Iterator["Image"]:
    from PIL import Image

    with contextlib.ExitStack() as stack:
        cameras = [stack.enter_context(Camera(column.model, SIDE, SIDE)) for column in columns]
        paths = [column.positions.reshape(-1, column.positions.shape[-1]) for column in columns]
        reach = max(camera.reach(path) for camera, path in zip(cameras, paths, strict=True))
        for camera in cameras:
            camera.frame(MARGIN * reach)
        for k in range(len(columns[0].motions.time)):
            frame = Image.new("RGB", size, "white")
            for i, (column, camera) in enumerate(zip(columns, cameras, strict=True)):
                for row, positions in enumerate(column.positions[k]):
                    panel = Image.fromarray(camera.picture(positions))
                    titles = column.label, ("undisturbed", "disturbed start")[row]
                    write_on(panel, titles, float(column.motions.time[k]), float(column.motions.ratio[k, row]))
                    frame.paste(panel, (i * (SIDE + GAP), row * (SIDE + GAP)))
            yield frame


def write_on(panel: "Image", titles: tuple[str, str], time: float, ratio: float) -> None:
    """Titles, time [s], and whether the state is in its funnel, on a panel."""
    from PIL import ImageDraw

    draw, (large, small) = ImageDraw.Draw(panel), _fonts()
    draw.text((14, 8), titles[0], fill=_INK, font=large)
    draw.text((14, 36), titles[1], fill=_INK, font=small)
    draw.text((panel.width - 14, 8), f"{time:.2f} s", fill=_INK, font=large, anchor="ra")
    text, color = (f"in its funnel, V/ρ = {ratio:.2f}", _GOOD) if ratio <= 1 else ("outside its funnel", _BAD)
    draw.text((14, panel.height - 12), text, fill=color, font=small, anchor="ld")


@cache
def _fonts() -> tuple[Any, Any]:
    """matplotlib's own font, which has Greek letters, in two sizes."""
    import matplotlib
    from PIL import ImageFont

    path = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    return ImageFont.truetype(path, 20), ImageFont.truetype(path, 14)


def _write_gif(frames: Sequence["Image"], path: Path) -> None:
    first, *others = [frame.quantize(128) for frame in frames]
    temporary, pause = path.with_name(f".{path.name}.tmp"), 1000 * GIF_EVERY // RATE
    with writing(path):
        first.save(temporary, format="GIF", save_all=True, append_images=others, duration=pause, loop=0)
        temporary.replace(path)


@contextlib.contextmanager
def mp4(path: Path, size: tuple[int, int], program: str) -> Iterator[Callable[["Image"], None]]:
    """What takes the frames of a video; leaving it finishes the file. Raises UserError where ffmpeg fails."""
    temporary = path.with_name(f".{path.name}.tmp")
    command = [
        program, "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}",
        "-r", f"{RATE}", "-i", "-", "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", f"{temporary}",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE)

    def add(frame: "Image") -> None:
        # A program that has given up says why at the end.
        with contextlib.suppress(BrokenPipeError):
            assert process.stdin
            process.stdin.write(frame.tobytes())

    try:
        yield add
    finally:
        with contextlib.suppress(BrokenPipeError):
            _, complaint = process.communicate()
    if process.returncode:
        temporary.unlink(missing_ok=True)
        raise UserError(f"{program} cannot write {path}: {complaint.decode(errors='replace').strip()}")
    with writing(path):
        temporary.replace(path)
