"""The names in an MJCF, read without MuJoCo: what a configuration must know to refuse at once what cannot be meant.

MuJoCo itself compiles the text later (`plants.mjcf`), and its answer counts where the two should differ.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as Xml

LARGEST_FILE = 2**17
"""Bytes: a run's config.yaml, which has the text in it, must be small enough to be read."""
ELSEWHERE = ("include", "replicate", "attach", "composite", "flexcomp", "plugin", "extension")
"""Elements that put into a model what its text does not name."""


class NotMjcf(ValueError):
    """The text is no MJCF, or none that is read here: one line."""


class Joint(NamedTuple):
    """A joint by its name; `hinge` or slide."""

    name: str
    hinge: bool

    @property
    def units(self) -> tuple[str, str, str]:
        """Of its position, its velocity and its force."""
        return ("rad", "rad/s", "N m") if self.hinge else ("m", "m/s", "N")


class Motor(NamedTuple):
    """A motor on a joint; `limit` is its symmetric ctrlrange, None without one."""

    name: str
    joint: Joint
    limit: float | None


class Names(NamedTuple):
    """What a model consists of, in MuJoCo's own order."""

    bodies: tuple[str, ...]
    joints: tuple[Joint, ...]
    motors: tuple[Motor, ...]
    geoms: tuple[str, ...]

    def of(self, kind: str) -> tuple[str, ...]:
        """The names of all of a kind: body, joint, motor or geom."""
        if kind == "joint":
            return tuple(joint.name for joint in self.joints)
        if kind == "motor":
            return tuple(motor.name for motor in self.motors)
        return self.bodies if kind == "body" else self.geoms


def read_text(path: Path) -> str:
    """The text of an MJCF.

    Raises:
        NotMjcf: there is no such file, or it is too large or no text.
    """
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
        if len(content) > LARGEST_FILE:
            raise NotMjcf(f"has more than {LARGEST_FILE} bytes: no robot of hinges and slides is that long")
        return content.decode()
    except OSError as error:
        raise NotMjcf(f"cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise NotMjcf("is no text in UTF-8") from None


def read_names(text: str) -> Names:
    """What the model of an MJCF's text consists of.

    Raises:
        NotMjcf: it is no MJCF, has an element that draws on other files or names nothing, or a joint that is neither
            hinge nor slide; joints or motors without names, or with one name twice.
    """
    if "<!ENTITY" in text or "<!DOCTYPE" in text:
        raise NotMjcf("has a document type: write the model out")
    try:
        root = Xml.fromstring(text)
    except Xml.ParseError as error:
        raise NotMjcf(f"is no XML: {error}") from None
    if root.tag != "mujoco":
        raise NotMjcf(f"is no MJCF: its root is <{root.tag}>, must be <mujoco>")
    for tag in ELSEWHERE:
        if root.find(f".//{tag}") is not None:
            raise NotMjcf(f"has <{tag}>: write the model out in one file, as MuJoCo's `mj_saveLastXML` does")
    classes = dict(_classes(root))
    bodies: list[str] = []
    joints: list[Joint] = []
    for world in root.findall("worldbody"):
        for element, childclass in _tree(world, ""):
            bodies.append(element.get("name", ""))
            joints += _joints(element, childclass, classes)
    _require_names("joint", [joint.name for joint in joints])
    by_name = {joint.name: joint for joint in joints}
    motors = [_motor(element, by_name, classes) for part in root.findall("actuator") for element in part]
    _require_names("motor", [motor.name for motor in motors])
    if not joints:
        raise NotMjcf("has no joints")
    if not motors:
        raise NotMjcf('has no motors: <actuator><motor name="torque" joint="…"/></actuator>')
    geoms = tuple(element.get("name", "") for element in root.iterfind(".//worldbody//geom"))
    return Names(tuple(bodies), tuple(joints), tuple(motors), geoms)


def _require_names(kind: str, names: Sequence[str]) -> None:
    if "" in names:
        raise NotMjcf(f"{kind} number {names.index('')} has no name: states and inputs are called by theirs")
    if twice := [name for name in names if names.count(name) > 1]:
        raise NotMjcf(f"{kind} {twice[0]} is there twice")


Classes = Mapping[tuple[str, str], Mapping[str, str]]
"""The default attributes by class and element; the main class is the empty name."""


def _classes(root: Xml.Element) -> Iterator[tuple[tuple[str, str], dict[str, str]]]:
    def within(default: Xml.Element, inherited: Mapping[str, dict[str, str]], name: str):
        own = {tag: dict(values) for tag, values in inherited.items()}
        for element in default:
            if element.tag != "default":
                own[element.tag] = own.get(element.tag, {}) | element.attrib
        for tag, values in own.items():
            yield (name, tag), values
        for element in default.findall("default"):
            yield from within(element, own, element.get("class", ""))

    for default in root.findall("default"):
        yield from within(default, {}, "")


def _tree(parent: Xml.Element, childclass: str) -> Iterator[tuple[Xml.Element, str]]:
    """All bodies below an element, depth first, each with the class of its elements."""
    for element in parent:
        if element.tag in ("body", "frame"):
            own = element.get("childclass", childclass)
            if element.tag == "body":
                yield element, own
            yield from _tree(element, own)


def _joints(parent: Xml.Element, childclass: str, classes: Classes) -> Iterator[Joint]:
    for element in parent:
        if element.tag == "frame":
            yield from _joints(element, element.get("childclass", childclass), classes)
        elif element.tag == "freejoint":
            raise NotMjcf(f"joint {element.get('name', 'without name')} is free: use hinges and slides")
        elif element.tag == "joint":
            kind = _attribute(element, "type", childclass, classes) or "hinge"
            if kind not in ("hinge", "slide"):
                raise NotMjcf(f"joint {element.get('name', 'without name')} is a {kind}: use hinges and slides")
            yield Joint(element.get("name", ""), kind == "hinge")


def _motor(element: Xml.Element, joints: Mapping[str, Joint], classes: Classes) -> Motor:
    name, joint = element.get("name", ""), element.get("joint")
    if joint is None:
        raise NotMjcf(f"actuator {name or 'without name'} drives no joint")
    if joint not in joints:
        raise NotMjcf(f"actuator {name or 'without name'} drives joint {joint}, which is not there")
    span = (_attribute(element, "ctrlrange", "", classes) or "").split()
    try:
        low, high = (float(end) for end in span) if span else (0.0, 0.0)
    except ValueError:
        raise NotMjcf(f"motor {name}: ctrlrange = {' '.join(span)!r} must be two numbers") from None
    return Motor(name, joints[joint], high if high > 0 and low == -high else None)


def _attribute(element: Xml.Element, name: str, childclass: str, classes: Classes) -> str | None:
    """An element's attribute, or what its class has for it."""
    defaults = classes.get((element.get("class", childclass), element.tag), classes.get(("", element.tag), {}))
    return element.get(name, defaults.get(name))
