"""MuJoCo's renderer without a display. Import mujoco only through this module's functions, after `choose_backend`."""

import os
import subprocess
import sys
from collections.abc import Sequence
from typing import Any, Self, final

import numpy as np
from jaxtyping import Float, UInt8

from rtcd_jax.system.errors import UserError

BACKENDS = ("egl", "osmesa")
_BAR, _STEEL = (0.016, 0.08, 0.0), (0.35, 0.38, 0.43, 1.0)
"""Radius and half the length [m] of a bar, and its color."""
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

    def look(self, middle: float, height: float, distance: float) -> None:
        """From in front at a point in the middle of the picture, `middle` [m] to the right of the origin, from such a
        `distance` that `height` [m] is all that it shows.
        """
        camera = self._model.camera(self._camera)
        camera.pos[0], camera.pos[1] = middle, -distance
        camera.fovy[:] = 2 * np.degrees(np.arctan(height / 2 / distance))

    def picture(
        self, positions: Float[np.ndarray, " q"], bars: Sequence[float] = ()
    ) -> UInt8[np.ndarray, "height width 3"]:
        """The robot at these joint positions, and bars across the picture's plane, so far to the right [m]."""
        self._pose(positions)
        self._renderer.update_scene(self._data, self._camera)
        for bar in bars:
            self._add_bar(bar)
        return self._renderer.render()

    def _add_bar(self, to_the_right: float) -> None:
        scene, across = self._renderer.scene, np.array([1, 0, 0, 0, 0, 1, 0, -1, 0], float)
        kind, place = self._mujoco.mjtGeom.mjGEOM_CYLINDER, np.array([to_the_right, 0, 0])
        self._mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom], kind, np.array(_BAR), place, across, np.array(_STEEL, np.float32)
        )
        scene.geoms[scene.ngeom].specular = 0
        scene.ngeom += 1

    def _pose(self, positions: np.ndarray) -> None:
        self._data.qpos[:] = positions
        self._mujoco.mj_forward(self._model, self._data)  # pyright: ignore[reportAttributeAccessIssue]
