"""MuJoCo's renderer without a display. Import mujoco only through this module's functions, after `choose_backend`."""

import os
import subprocess
import sys
from typing import Any, Self, final

import numpy as np
from jaxtyping import Float, UInt8

from rtcd_jax.system.errors import UserError

BACKENDS = ("egl", "osmesa")
_PROBE = (
    "import mujoco; context = mujoco.GLContext(8, 8); context.make_current(); "
    "mujoco.MjrContext(mujoco.MjModel.from_xml_string('<mujoco/>'), 100)"
)


def choose_backend() -> str:
    """Sets MUJOCO_GL, unless the user has, to the first of `BACKENDS` that draws here; call it before mujoco loads.

    Each is tried in a process of its own: PyOpenGL binds itself to the first one for good.

    Raises:
        UserError: none draws.
    """
    chosen = os.environ.get("MUJOCO_GL")
    for backend in (chosen,) if chosen else BACKENDS:
        environment = os.environ | {"MUJOCO_GL": backend}
        if subprocess.run([sys.executable, "-c", _PROBE], env=environment, capture_output=True).returncode == 0:
            os.environ["MUJOCO_GL"] = backend
            return backend
    raise UserError(
        f"MuJoCo cannot draw here by {chosen or ' or '.join(BACKENDS)}: install one, on Debian and Ubuntu "
        "`apt-get install libegl1 libgl1-mesa-dri` or `apt-get install libosmesa6`, or set MUJOCO_GL"
    )


@final
class Camera:
    """Takes pictures of one model. A context manager: leaving it frees the graphics memory."""

    def __init__(self, model: Any, width: int, height: int, camera: str = "front"):
        import mujoco

        self._mujoco, self._model, self._camera = mujoco, model, camera
        self._data = mujoco.MjData(model)  # pyright: ignore[reportAttributeAccessIssue]
        self._renderer = mujoco.Renderer(model, height, width)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def reach(self, positions: Float[np.ndarray, "poses q"]) -> float:
        """How far the robot gets from the origin in the picture's plane, to each side and up and down [m]."""
        farthest, camera = 0.0, self._model.camera(self._camera).id
        for pose in positions:
            self._pose(pose)
            right_and_up = self._data.cam_xmat[camera].reshape(3, 3)[:, :2]
            across = np.abs(self._data.geom_xpos @ right_and_up).max(axis=1)
            farthest = max(farthest, float((across + self._model.geom_rbound).max()))
        return farthest

    def frame(self, height: float) -> None:
        """Lets the picture show `height` [m] above and below its middle."""
        camera = self._model.camera(self._camera)
        camera.fovy[:] = 2 * np.degrees(np.arctan(height / np.linalg.norm(camera.pos)))

    def picture(self, positions: Float[np.ndarray, " q"]) -> UInt8[np.ndarray, "height width 3"]:
        """The robot at these joint positions."""
        self._pose(positions)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()

    def _pose(self, positions: np.ndarray) -> None:
        self._data.qpos[:] = positions
        self._mujoco.mj_forward(self._model, self._data)  # pyright: ignore[reportAttributeAccessIssue]
