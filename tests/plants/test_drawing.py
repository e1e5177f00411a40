"""Robots as they are drawn: MuJoCo's own places of the geoms, seen from where their motion shows."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import mujoco
import numpy as np
import pytest

from rtcd_jax.config.plants import PLANTS
from rtcd_jax.plants.drawing import DIRECTIONS, parts_of, poses, size_of, view_of

BODY = """<mujoco><compiler angle="radian" inertiafromgeom="auto"/>{asset}<worldbody><body name="a" pos="0 0 1">
<joint name="a" type="hinge" axis="{axis}"/><inertial mass="1" pos="0 0 -.2" diaginertia="1 1 1"/>{geoms}
<body name="b" pos="0 0 -.5"><joint name="b" type="{kind}" axis="{axis}"/>
<inertial mass="1" pos="0 0 -.3" diaginertia="1 1 1"/></body></body></worldbody></mujoco>"""


def model(geoms="", axis="0 1 0", kind="hinge", asset=""):
    return mujoco.MjModel.from_xml_string(BODY.format(geoms=geoms, axis=axis, kind=kind, asset=asset))


def support(part, turn, place, direction):
    """How far the part reaches in a direction of the world."""
    return np.max((place + part.points @ turn.T) @ direction) + part.radius


def reach_of_geom(model, data, geom, direction):
    """The same of MuJoCo's geom, by the formula of its kind."""
    local, size = data.geom_xmat[geom].reshape(3, 3).T @ direction, model.geom_size[geom]
    kinds = mujoco.mjtGeom
    return (
        data.geom_xpos[geom] @ direction
        + {
            kinds.mjGEOM_SPHERE: lambda: size[0],
            kinds.mjGEOM_CAPSULE: lambda: size[0] + size[1] * abs(local[2]),
            kinds.mjGEOM_BOX: lambda: size @ np.abs(local),
            kinds.mjGEOM_CYLINDER: lambda: size[0] * np.hypot(*local[:2]) + size[1] * abs(local[2]),
            kinds.mjGEOM_ELLIPSOID: lambda: np.linalg.norm(size * local),
        }[mujoco.mjtGeom(model.geom_type[geom])]()
    )


def compare(model, random, tolerance=0.01):
    """Every part reaches as far as its geom in random directions, at random positions; within a share of the size."""
    q = random.uniform(-3, 3, (4, model.nq))
    where, data, parts = poses(model, q), mujoco.MjData(model), parts_of(model)
    assert len(parts) == model.ngeom
    for k, pose in enumerate(q):
        data.qpos[:] = pose
        mujoco.mj_forward(model, data)
        for geom, part in enumerate(parts):
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, where.turns[k, part.body])
            for direction in random.normal(size=(20, 3)):
                direction /= np.linalg.norm(direction)
                far = support(part, turn.reshape(3, 3), where.positions[k, part.body], direction)
                assert far == pytest.approx(
                    reach_of_geom(model, data, geom, direction), abs=tolerance * model.geom_rbound[geom] + 1e-9
                )


@pytest.mark.parametrize("name", PLANTS)
def test_the_parts_of_a_packaged_robot_are_its_geoms(name):
    plant = PLANTS[name]()
    drawn = mujoco.MjModel.from_xml_string(plant.robot().xml)
    compare(drawn, np.random.default_rng(0))
    assert {part.body for part in parts_of(drawn)} >= set(range(1, drawn.nbody))


def test_ellipsoids_and_meshes_are_hulls_and_planes_are_not_drawn():
    geoms = '<geom type="ellipsoid" size=".3 .1 .05" pos=".1 0 0" euler="1 .3 .2"/>'
    (ellipsoid, *_) = parts_of(model(geoms))
    assert len(ellipsoid.points) == DIRECTIONS
    corners = "0 0 0  .2 0 0  0 .2 0  0 0 .2  .05 .05 .05"
    asset = f'<asset><mesh name="m" vertex="{corners}" inertia="convex"/></asset>'
    mesh = next(part for part in parts_of(model('<geom type="mesh" mesh="m"/>', asset=asset)) if part.body == 1)
    assert len(mesh.points) == 4  # the point inside is no corner of the hull
    floor = mujoco.MjModel.from_xml_string('<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>')
    assert parts_of(floor) == []


def test_a_body_without_a_geom_is_a_line_to_its_center_and_its_children():
    first, second, third = parts_of(model())
    np.testing.assert_allclose(
        [first.points[1], second.points[1], third.points[1]], [[0, 0, -0.2], [0, 0, -0.5], [0, 0, -0.3]]
    )
    assert [first.body, second.body, third.body] == [1, 1, 2]
    assert size_of(model()) == pytest.approx(1.8)
    assert first.radius == pytest.approx(size_of(model()) / 40)


@pytest.mark.parametrize(
    ("axis", "back"),
    [("0 1 0", (0, -1, 0)), ("0 -1 0", (0, -1, 0)), ("1 0 0", (-1, 0, 0)), ("1 1 0", (-1, -1, 0))],
)
def test_a_planar_robot_is_seen_along_its_hinges(axis, back):
    view = view_of(model(axis=axis))
    np.testing.assert_allclose(view @ view.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(view) == pytest.approx(1)
    np.testing.assert_allclose(view[2], np.array(back) / np.linalg.norm(back), atol=1e-12)
    assert view[1] == pytest.approx([0, 0, 1])


def test_a_robot_in_space_is_seen_obliquely_from_above():
    for spatial in (mujoco.MjModel.from_xml_string(PLANTS["furuta"]().robot().xml), model(axis="0 0 1")):
        view = view_of(spatial)
        assert view[2][2] > 0.3
        assert np.all(np.abs(view[2]) > 0.1)
