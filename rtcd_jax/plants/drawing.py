"""A robot as it is drawn without a renderer: its geoms as hulls of balls, and where its bodies are along a motion.

Seen from afar, a geom is the hull of its points, each as wide as the ball about it: exact for spheres, capsules and
boxes, and for meshes their convex hull.
"""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float, Int

RIM = 24
"""Points of a cylinder's rim."""
DIRECTIONS = 64
"""In which an ellipsoid or a mesh is cut down to its outermost points."""
THIN = 1 / 40
"""Radius of a line that stands for a body without a geom, over the robot's size."""
PARALLEL = 1e-6
_CLEAR = 0.05
"""Opacity from which on a geom is seen."""
_LINE = "#5b6876"


class Part(NamedTuple):
    """The hull of balls of `radius` [m] about `points` in the frame of a body, and its color #rrggbb."""

    body: int
    color: str
    radius: float
    points: Float[np.ndarray, "points 3"]


class Poses(NamedTuple):
    """Where the bodies are [m] and how they are turned, as unit quaternions (w, x, y, z)."""

    positions: Float[np.ndarray, "T bodies 3"]
    turns: Float[np.ndarray, "T bodies 4"]


def parts_of(model: mujoco.MjModel) -> list[Part]:
    """All geoms but planes and height fields; a moving body that has none is a line to its center and to its children.

    The last ones are as thin as the robot's size asks.
    """
    parts = [part for geom in range(model.ngeom) for part in _part(model, geom)]
    bare = set(range(1, model.nbody)) - {part.body for part in parts}
    thin = THIN * size_of(model)
    for body in sorted(bare):
        children = np.flatnonzero(model.body_parentid == body)
        ends = [model.body_ipos[body], *model.body_pos[children[children != body]]]
        parts += [Part(body, _LINE, thin, np.array([np.zeros(3), end])) for end in ends]
    return parts


def size_of(model: mujoco.MjModel) -> float:
    """The longest chain of bodies, and what sticks out of it, at most [m]."""
    reach = np.zeros(model.nbody)
    for body in range(1, model.nbody):
        reach[body] = reach[model.body_parentid[body]] + np.linalg.norm(model.body_pos[body])
    centers = reach + np.linalg.norm(model.body_ipos, axis=1)
    bounds = [reach[body] + np.linalg.norm(pos) for body, pos in zip(model.geom_bodyid, model.geom_pos, strict=True)]
    return float(max([*centers, *bounds, 1e-3]))


def poses(model: mujoco.MjModel, positions: Float[np.ndarray, "T q"]) -> Poses:
    """The bodies' poses at the joints' positions."""
    data = mujoco.MjData(model)
    places, turns = np.empty((len(positions), model.nbody, 3)), np.empty((len(positions), model.nbody, 4))
    for k, q in enumerate(positions):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        places[k], turns[k] = data.xpos, data.xquat
    return Poses(places, turns)


def view_of(model: mujoco.MjModel) -> Float[np.ndarray, "3 3"]:
    """From where the robot's motion is seen best: the picture's right, its up and the way back to the eye, as rows.

    A robot in a vertical plane is seen along its hinges' axis, from the side that -y is on, or -x; all others
    obliquely from above.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    hinges = data.xaxis[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]
    back = np.array([-0.5, -0.8, 0.4])
    if not len(hinges):
        back = np.array([0.0, -1.0, 0.0])
    elif np.all(np.linalg.norm(np.cross(hinges, hinges[0]), axis=1) < PARALLEL) and abs(hinges[0][2]) < PARALLEL:
        axis = hinges[0]
        back = -axis * np.sign(axis[np.flatnonzero(np.abs(axis) > PARALLEL)[-1]])
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back])


def _part(model: mujoco.MjModel, geom: int) -> Iterator[Part]:
    kinds, kind, size = mujoco.mjtGeom, int(model.geom_type[geom]), model.geom_size[geom]
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    radius = 0.0
    if kind == kinds.mjGEOM_SPHERE:
        points, radius = np.zeros((1, 3)), float(size[0])
    elif kind == kinds.mjGEOM_CAPSULE:
        points, radius = np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]), float(size[0])
    elif kind == kinds.mjGEOM_BOX:
        points = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T * size
    elif kind == kinds.mjGEOM_CYLINDER:
        angle = np.linspace(0, 2 * np.pi, RIM, endpoint=False)
        rim = size[0] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = np.concatenate([np.c_[rim, np.full(RIM, end)] for end in (-size[1], size[1])])
    elif kind == kinds.mjGEOM_ELLIPSOID:
        points = size * _directions()
    elif kind == kinds.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        vertices = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(float)
        points = vertices[_outermost(vertices)]
    else:
        return
    if rgba[3] < _CLEAR:
        return
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    color = "#" + "".join(f"{round(255 * float(np.clip(part, 0, 1))):02x}" for part in rgba[:3])
    yield Part(int(model.geom_bodyid[geom]), color, radius, model.geom_pos[geom] + points @ turn.reshape(3, 3).T)


def _directions() -> Float[np.ndarray, "directions 3"]:
    """Unit vectors evenly over the sphere, on a spiral."""
    place = np.arange(DIRECTIONS) + 0.5
    z, angle = 1 - 2 * place / DIRECTIONS, np.pi * (1 + np.sqrt(5)) * place
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def _outermost(points: Float[np.ndarray, "points 3"]) -> Int[np.ndarray, " kept"]:
    """Indices of those that are the farthest in some direction."""
    return np.unique(np.argmax(points @ _directions().T, axis=0))
