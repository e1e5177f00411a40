"""A robot as data: an MJCF's text, which of its numbers are arithmetic of which names, and what the names mean."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from rtcd_jax.config.arithmetic import evaluate, names_of
from rtcd_jax.config.mjcf import Joint, Names
from rtcd_jax.system.errors import Problem, UserError, closest

Value = float | str
"""A number, or arithmetic of names."""

FIELDS: Mapping[str, Mapping[str, tuple[str, int]]] = {
    "body": {
        "mass": ("body_mass", 1),
        "ipos": ("body_ipos", 3),
        "inertia": ("body_inertia", 3),
        "pos": ("body_pos", 3),
    },
    "joint": {
        "damping": ("dof_damping", 1),
        "armature": ("dof_armature", 1),
        "stiffness": ("jnt_stiffness", 1),
        "pos": ("jnt_pos", 3),
    },
    "motor": {"gear": ("actuator_gear", 1)},
    "geom": {"pos": ("geom_pos", 3), "size": ("geom_size", 3)},
}
"""What may be arithmetic, by the kind of object: the compiled model's attribute, and of how many numbers."""
OPTION = "option"
"""Stands in `set` for the model's options, of which gravity alone may be arithmetic."""
SUFFIX = "_dot"
"""Of a velocity's name behind its joint's."""


class Edit(NamedTuple):
    """Numbers of one object of the model: `attribute` of the compiled model, `field` as `set` calls it."""

    kind: str
    object: str
    field: str
    values: tuple[Value, ...]

    @property
    def attribute(self) -> str:
        return "gravity" if self.kind == OPTION else FIELDS[self.kind][self.field][0]


class Named(NamedTuple):
    """A number of the robot by its name, the symbol that stored parameters call it by, and its unit."""

    name: str
    symbol: str
    unit: str


class Robot(NamedTuple):
    """A robot of hinges and slides; hashable, so that what is made of it is made once.

    `limits` are those of the motors, `derived` the constants that are arithmetic of the others and of the design.
    """

    name: str
    xml: str
    joints: tuple[Joint, ...]
    inputs: tuple[tuple[str, str], ...]
    limits: tuple[Value, ...]
    edits: tuple[Edit, ...]
    constants: tuple[Named, ...]
    derived: tuple[tuple[Named, Value], ...]
    design: tuple[Named, ...]
    convention: str

    @property
    def states(self) -> dict[str, str]:
        """Names with units: the joints' positions, then their velocities."""
        positions = {joint.name: joint.units[0] for joint in self.joints}
        return positions | {f"{joint.name}{SUFFIX}": joint.units[1] for joint in self.joints}

    def complete(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The numbers of design and constants by name, and with them those that follow."""
        known = dict(values)
        for named, value in self.derived:
            known[named.name] = value_of(value, known)
        return known

    def parameters(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Every number of the robot by its symbol, from those of design and constants by name."""
        known, derived = self.complete(values), (named for named, _ in self.derived)
        return {named.symbol: known[named.name] for named in (*self.design, *self.constants, *derived)}

    def numbers(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """Every number by name, from the stored parameters, which may say another one of what follows from others.

        Raises:
            UserError: one is missing.
        """
        stored = {named.name: parameters[named.symbol] for named, _ in self.derived if named.symbol in parameters}
        return self.complete(self.values(parameters)) | stored

    def values(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        """The inverse of `parameters`. Raises UserError if one is missing."""
        return {named.name: parameter(parameters, named.symbol) for named in (*self.design, *self.constants)}

    @property
    def units(self) -> dict[str, str]:
        """Of the parameters, by symbol."""
        return {named.symbol: named.unit for named in (*self.design, *self.constants, *(n for n, _ in self.derived))}


def parameter(parameters: Mapping[str, Any], symbol: str) -> Any:
    """One of an elite's stored parameters. Raises UserError if it is missing."""
    if symbol not in parameters:
        raise UserError(f"the elite's parameters lack {symbol!r}")
    return parameters[symbol]


def value_of(value: Value, names: Mapping[str, Any]) -> Any:
    """A number of the robot; `names` are complete."""
    return evaluate(value, names) if isinstance(value, str) else value


def read_edits(names: Names, settings: Mapping[str, Mapping[str, Sequence[Value]]]) -> Iterator[Edit | Problem]:
    """What `set` says, each entry as an edit or as what is wrong with it."""
    for name, fields in settings.items():
        for field, values in fields.items():
            kind = _kind(names, name, field)
            if isinstance(kind, Problem):
                yield kind
                continue
            size = 3 if kind == OPTION else FIELDS[kind][field][1]
            if len(values) != size:
                text = f"must have {size} number{'s' * (size > 1)}, has {len(values)}"
                yield Problem((name, field), text, list(values))
            else:
                yield Edit(kind, name.removeprefix(f"{kind}."), field, tuple(values))


def resolved_order(derived: Mapping[str, Value]) -> list[str]:
    """The derived constants, each behind those that it needs.

    Raises:
        ValueError: arithmetic that needs itself.
    """
    order: list[str] = []
    open_: list[str] = []

    def visit(name: str) -> None:
        if name in order:
            return
        if name in open_:
            raise ValueError(f"needs itself: {' -> '.join((*open_[open_.index(name) :], name))}")
        open_.append(name)
        for needed in needs(derived[name]):
            if needed in derived:
                visit(needed)
        open_.pop()
        order.append(name)

    for name in derived:
        visit(name)
    return order


def needs(value: Value) -> tuple[str, ...]:
    """The names in a number of the robot."""
    return names_of(value) if isinstance(value, str) else ()


def _kind(names: Names, name: str, field: str) -> str | Problem:
    """Of the object that `set` calls `name` and whose `field` it edits; `KIND.NAME` where a name says it not."""
    if name == OPTION:
        return OPTION if field == "gravity" else Problem((name, field), "unknown key; valid: gravity")
    prefix, _, rest = name.partition(".")
    if rest and prefix in FIELDS and rest in names.of(prefix):
        named = [prefix]
    else:
        named = [kind for kind in FIELDS if name in names.of(kind)]
    if not named:
        every = [each for kind in FIELDS for each in names.of(kind) if each]
        return Problem(
            (name,),
            f"is no body, joint, motor or geom of the MJCF; {closest(rest if prefix in FIELDS else name, every)}",
        )
    fitting = [kind for kind in named if field in FIELDS[kind]]
    if not fitting:
        valid = dict.fromkeys(each for kind in named for each in FIELDS[kind])
        return Problem((name, field), f"unknown key of a {' or '.join(named)}; {closest(field, tuple(valid))}")
    if len(fitting) > 1:
        say = " or ".join(f"{kind}.{name}" for kind in fitting)
        return Problem((name, field), f"is meant of which? The MJCF has {' and '.join(fitting)} {name}: say {say}")
    return fitting[0]
