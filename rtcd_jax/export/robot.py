"""The optimal design as a robot description for other programs: MJCF and URDF, every number to its last digit."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np
from scipy.spatial.transform import Rotation

from rtcd_jax.plants.base import ModelEdits

_PLACES = {
    "body_mass": ("body", "inertial", "mass"),
    "body_ipos": ("body", "inertial", "pos"),
    "body_iquat": ("body", "inertial", "quat"),
    "body_inertia": ("body", "inertial", "diaginertia"),
    "body_pos": ("body", ".", "pos"),
    "body_quat": ("body", ".", "quat"),
    "dof_damping": ("joint", ".", "damping"),
    "dof_armature": ("joint", ".", "armature"),
    "jnt_stiffness": ("joint", ".", "stiffness"),
    "jnt_pos": ("joint", ".", "pos"),
    "actuator_gear": ("actuator/*", ".", "gear"),
    "geom_pos": ("geom", ".", "pos"),
    "geom_quat": ("geom", ".", "quat"),
    "geom_size": ("geom", ".", "size"),
}
"""Where an attribute of the model stands in an MJCF: the element by name, the path from there, the XML's attribute."""

_SLIDE, _HINGE = 2, 3
_SPHERE, _CAPSULE, _CYLINDER, _BOX = 2, 3, 5, 6


def mjcf(xml: str, edits: ModelEdits, input_limits: Sequence[float]) -> str:
    """The MJCF with a design's `edits` in it and its inputs limited to +- `input_limits`.

    Raises:
        ValueError: an edit of an attribute or of an element that cannot be found in the file.
    """
    root = Xml.fromstring(xml, Xml.XMLParser(target=Xml.TreeBuilder(insert_comments=True)))
    for attribute, edit in edits.items():
        if isinstance(edit, Mapping):
            for name, row in edit.items():
                element, key = _place(root, attribute, name)
                element.set(key, _numbers(row))
        else:
            _element(root, "option", attribute).set(attribute.removeprefix("opt."), _numbers(edit))
    for motor, limit in zip(_element(root, "actuator", "actuator"), input_limits, strict=True):
        motor.set("ctrllimited", "true")
        motor.set("ctrlrange", _numbers([-limit, limit]))
    return _text(root)


def urdf(name: str, model: Any, state_limits: Sequence[float], input_limits: Sequence[float]) -> str:
    """The URDF of a compiled MuJoCo `model` whose every moving body has one hinge or slide.

    A slide's limits are those of the state, a hinge turns on and on. Gravity is no part of a URDF.

    Raises:
        ValueError: a body whose joints, or a joint whose kind or place, a URDF cannot say.
    """
    robot = Xml.Element("robot", name=name)
    for body in range(model.nbody):
        robot.append(_link(model, body))
    motors = dict(zip(model.actuator_trnid[:, 0].tolist(), input_limits, strict=True))
    for body in range(1, model.nbody):
        robot.append(_joint(model, body, state_limits, motors))
    for motor, joint in enumerate(model.actuator_trnid[:, 0].tolist()):
        robot.append(_transmission(model.actuator(motor).name or f"motor_{motor}", model.joint(joint).name))
    return _text(robot)


def _place(root: Xml.Element, attribute: str, name: str) -> tuple[Xml.Element, str]:
    if attribute not in _PLACES:
        raise ValueError(f"an MJCF cannot be written with {attribute} edited; known: {', '.join(_PLACES)}")
    tag, path, key = _PLACES[attribute]
    return _element(root, f"{tag}[@name='{name}']/{path}", attribute), key


def _element(root: Xml.Element, path: str, attribute: str) -> Xml.Element:
    element = root.find(f".//{path}")
    if element is None:
        raise ValueError(f"{attribute} is edited, but the MJCF has no {path}")
    return element


def _link(model: Any, body: int) -> Xml.Element:
    link = Xml.Element("link", name=model.body(body).name)
    if body:  # the world weighs nothing
        inertial = Xml.SubElement(link, "inertial")
        inertial.append(_origin(model.body_ipos[body], model.body_iquat[body]))
        Xml.SubElement(inertial, "mass", value=_numbers(model.body_mass[body]))
        moments = dict(zip(("ixx", "iyy", "izz"), map(_numbers, model.body_inertia[body]), strict=True))
        Xml.SubElement(inertial, "inertia", moments | {"ixy": "0", "ixz": "0", "iyz": "0"})
    for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
        link.extend(_visual(model, geom))
    return link


def _visual(model: Any, geom: int) -> Iterator[Xml.Element]:
    """The geom, if a URDF has its shape; a capsule as the cylinder inside it."""
    size, kind = model.geom_size[geom], int(model.geom_type[geom])
    shapes = {
        _SPHERE: ("sphere", {"radius": _numbers(size[0])}),
        _CAPSULE: ("cylinder", {"radius": _numbers(size[0]), "length": _numbers(2 * size[1])}),
        _CYLINDER: ("cylinder", {"radius": _numbers(size[0]), "length": _numbers(2 * size[1])}),
        _BOX: ("box", {"size": _numbers(2 * size)}),
    }
    if kind in shapes:
        visual = Xml.Element("visual")
        visual.append(_origin(model.geom_pos[geom], model.geom_quat[geom]))
        Xml.SubElement(Xml.SubElement(visual, "geometry"), *shapes[kind])
        material = int(model.geom_matid[geom])
        color = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
        named = Xml.SubElement(visual, "material", name=f"{model.body(model.geom_bodyid[geom]).name}_{geom}")
        Xml.SubElement(named, "color", rgba=_numbers(np.round(color.astype(float), 4)))
        yield visual


def _joint(model: Any, body: int, state_limits: Sequence[float], motors: Mapping[int, float]) -> Xml.Element:
    name, first = model.body(body).name, int(model.body_jntadr[body])
    kind = int(model.jnt_type[first]) if model.body_jntnum[body] == 1 else None
    if kind not in (_SLIDE, _HINGE) or np.any(model.jnt_pos[first]):
        raise ValueError(f"body {name}: a URDF wants one hinge or slide at the body's origin")
    joint = Xml.Element("joint", name=model.joint(first).name, type={_SLIDE: "prismatic", _HINGE: "continuous"}[kind])
    Xml.SubElement(joint, "parent", link=model.body(model.body_parentid[body]).name)
    Xml.SubElement(joint, "child", link=name)
    joint.append(_origin(model.body_pos[body], model.body_quat[body]))
    Xml.SubElement(joint, "axis", xyz=_numbers(model.jnt_axis[first]))
    Xml.SubElement(joint, "dynamics", damping=_numbers(np.ravel(model.dof_damping[model.jnt_dofadr[first]])[0]))
    position, velocity = state_limits[first], state_limits[model.njnt + first]
    # A URDF must name a speed: one that no motor has stands for none.
    limit = {"effort": _numbers(motors.get(first, 0.0)), "velocity": _numbers(min(velocity, 1e3))}
    if kind == _SLIDE:
        reach = min(position, 1e3)
        limit |= {"lower": _numbers(-reach), "upper": _numbers(reach)}
    Xml.SubElement(joint, "limit", limit)
    return joint


def _transmission(motor: str, joint: str) -> Xml.Element:
    """A motor without gears on a joint: where Drake and ROS look for a robot's inputs."""
    transmission = Xml.Element("transmission", name=f"{motor}_transmission")
    Xml.SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    driven = Xml.SubElement(transmission, "joint", name=joint)
    Xml.SubElement(driven, "hardwareInterface").text = "hardware_interface/EffortJointInterface"
    actuator = Xml.SubElement(transmission, "actuator", name=motor)
    Xml.SubElement(actuator, "hardwareInterface").text = "hardware_interface/EffortJointInterface"
    Xml.SubElement(actuator, "mechanicalReduction").text = "1"
    return transmission


def _origin(position: np.ndarray, quaternion: np.ndarray) -> Xml.Element:
    with warnings.catch_warnings():  # upright axes lock the gimbal: then one angle of many is as good as any other
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("xyz")
    return Xml.Element("origin", xyz=_numbers(position), rpy=_numbers(angles))


def _numbers(values: Any) -> str:
    """As short as they can be read back exactly."""
    return " ".join(map(repr, np.ravel(values).astype(float).tolist()))


def _text(root: Xml.Element) -> str:
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode") + "\n"
