"""The `plant` section: a packaged robot by its name, an MJCF of one's own, or a class of one's own."""

import importlib
import inspect
import math
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path, PurePath
from typing import Annotated, Any, ClassVar, Literal, Self, cast

from pydantic import BeforeValidator, Field, PlainSerializer, PlainValidator, ValidationError, create_model

from rtcd_jax.config import yaml12
from rtcd_jax.config.arithmetic import calls_functions
from rtcd_jax.config.mjcf import Names, NotMjcf, read_names
from rtcd_jax.config.robot import Edit, Named, Robot, Value, needs, parameter, read_edits, resolved_order
from rtcd_jax.config.settings import Settings, invalid, problems_of, refusal
from rtcd_jax.system.errors import ConfigError, Problem, UserError, closest

ROBOTS = Path(__file__).parents[1] / "robots"
LARGEST = 1e9
_IDENTIFIER = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,63}")


class PlantConfig(Settings):
    """A robot. States and inputs are in the plant's order, the design by name; all with units."""

    name: str

    @property
    def states(self) -> dict[str, str]:
        raise NotImplementedError

    @property
    def input_units(self) -> dict[str, str]:
        raise NotImplementedError

    @property
    def design(self) -> dict[str, str]:
        """A robot of one's own leaves the units to the section `design`: here they are empty."""
        raise NotImplementedError

    @property
    def uncertain(self) -> dict[str, tuple[str, ...]]:
        """What may be uncertain of `design` and of the `plant`'s constants: all but the motors' limits."""
        raise NotImplementedError

    def values(self) -> dict[str, float]:
        """The constants' numbers by name."""
        raise NotImplementedError

    def edited(self, values: Mapping[str, float]) -> Self:
        """The same robot with other numbers for some of its constants; pydantic's error where one leaves its range."""
        raise NotImplementedError


class RobotPlant(PlantConfig):
    """A robot that an MJCF describes."""

    def robot(self, units: Mapping[str, str] | None = None) -> Robot:
        """The robot as data; `units` are those of a design that has none of its own."""
        raise NotImplementedError

    def with_parameters(self, parameters: Mapping[str, float]) -> "RobotPlant":
        """The same robot with the constants that these stored parameters say.

        Raises:
            UserError: one is missing, or no constants of this robot give them.
        """
        raise NotImplementedError

    @property
    def states(self) -> dict[str, str]:
        return self.robot().states

    @property
    def input_units(self) -> dict[str, str]:
        return dict(self.robot().inputs)

    @property
    def design(self) -> dict[str, str]:
        return {named.name: named.unit for named in self.robot().design}

    @property
    def uncertain(self) -> dict[str, tuple[str, ...]]:
        robot = self.robot()
        limits = {name for limit in robot.limits for name in needs(limit)}
        sections = {"design": robot.design, "plant": robot.constants}
        return {
            section: tuple(named.name for named in names if named.name not in limits)
            for section, names in sections.items()
        }


def _entries(value: Any) -> Any:
    return tuple(value) if isinstance(value, list | tuple) else (value,)


def _value(value: Any) -> Value:
    if isinstance(value, str):
        try:
            needs(value)
        except ValueError as error:
            raise refusal(str(error)) from None
        if calls_functions(value):
            raise refusal("must be numbers and names with + - * / ** and parentheses: functions are for a task's ends")
        return value
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise refusal(f"must be a number within +- {LARGEST:g}, or arithmetic")
    return float(value)


def _limit(value: Any) -> Value:
    value = _value(value)
    if not isinstance(value, str) and value <= 0:
        raise refusal("must be > 0, or arithmetic of constants and designs")
    return value


Number = Annotated[Any, PlainValidator(_value)]
"""A number or arithmetic."""
Entries = Annotated[tuple[Number, ...], BeforeValidator(_entries)]
"""Numbers or arithmetic, one of them without brackets."""
Edits = dict[str, dict[str, Entries]]


class InputConfig(Settings):
    """What the MJCF does not say of a motor."""

    limit: Annotated[Any, PlainValidator(_limit)] = Field(
        description="largest |u|, a number or arithmetic of constants and designs [input's unit]"
    )


class _DesignField(Settings):
    unit: str
    symbol: str = ""


class _Constant(_DesignField):
    value: Number
    min: float = 1e-6
    choices: dict[str, Number] = Field(default={})
    description: str


class _Packaged(Settings):
    """A file of `rtcd_jax/robots`."""

    description: str
    mjcf: str
    convention: str
    design: dict[str, _DesignField]
    constants: dict[str, _Constant]
    inputs: dict[str, InputConfig]
    set: Edits


class PackagedPlant(RobotPlant):
    """A robot of `rtcd_jax/robots`: its constants are fields."""

    name: str = ""
    packaged: ClassVar[_Packaged]
    xml: ClassVar[str]

    def values(self) -> dict[str, float]:
        return {name: getattr(self, name) for name, each in self.packaged.constants.items() if not each.choices}

    def edited(self, values: Mapping[str, float]) -> Self:
        return self.model_validate({**dict(self), **values})

    def robot(self, units: Mapping[str, str] | None = None) -> Robot:
        given = self.packaged
        chosen = {name: each.choices[getattr(self, name)] for name, each in given.constants.items() if each.choices}
        named = {name: Named(name, each.symbol or name, each.unit) for name, each in given.constants.items()}
        return _robot(
            name=self.name,
            xml=self.xml,
            limits={name: each.limit for name, each in given.inputs.items()},
            settings=given.set,
            constants=[named[name] for name in self.values()],
            derived={name: (named[name], value) for name, value in chosen.items()},
            design=[Named(name, each.symbol or name, each.unit) for name, each in given.design.items()],
            convention=given.convention.strip(),
        )

    def with_parameters(self, parameters: Mapping[str, float]) -> "PackagedPlant":
        plain = {named.name: parameter(parameters, named.symbol) for named in self.robot().constants}
        choices = [(name, each) for name, each in self.packaged.constants.items() if each.choices]
        found = self.model_construct(**{**dict(self), **plain})
        for name, each in choices:
            symbol, known = each.symbol or name, {}
            stored = parameter(parameters, symbol)
            for choice in each.choices:
                one = found.model_copy(update={name: choice})
                robot = one.robot()
                known[choice] = robot.parameters(robot.values(parameters))[symbol]
                if math.isclose(known[choice], stored, rel_tol=1e-6):
                    found = one
                    break
            else:
                raise UserError(f"{symbol} = {stored:g}: must be one of {known} [{each.unit}]")
        return found


class ConstantConfig(Settings):
    """A number of the robot that arithmetic may name."""

    value: Number = Field(description="a number or arithmetic of names")
    unit: str = Field(default="", description="its unit [-]")


def _constant(value: Any) -> Any:
    return {"value": value} if isinstance(value, int | float | str) and not isinstance(value, bool) else value


def _short(constant: ConstantConfig) -> Any:
    return constant.model_dump() if constant.unit else constant.value


class MjcfPlant(RobotPlant):
    """A robot of one's own: any tree of hinges and slides with smooth dynamics."""

    name: str = Field(description="what files and pages call the robot; by default the MJCF's file name")
    mjcf: str = Field(description="file of the MJCF, beside the configuration")
    xml: str = Field(default="", description="text of the MJCF; by default what stands in the file")
    constants: dict[str, Annotated[ConstantConfig, BeforeValidator(_constant), PlainSerializer(_short)]] = Field(
        default={}, description="numbers by name, or arithmetic of the design's and each other's names"
    )
    inputs: dict[str, InputConfig] = Field(
        default={}, description="limits of motors by name; by default the MJCF's symmetric ctrlrange"
    )
    set: Edits = Field(
        default={}, description="numbers of bodies, joints, motors and geoms as arithmetic of names; the rest stays"
    )

    def problems(self) -> Iterator[Problem]:
        if not _IDENTIFIER.fullmatch(self.name):
            yield Problem(("name",), "must be a letter and up to 63 letters, digits and _", self.name)
        elif self.name in PLANTS:
            yield Problem(("name",), f"is a packaged robot: say `plant: {{name: {self.name}}}`, or choose another name")
        try:
            names = read_names(self.xml)
        except NotMjcf as error:
            yield Problem(("mjcf",), str(error), self.mjcf)
            return
        yield from self._wrong_names(names)
        try:
            resolved_order(self._derived())
        except ValueError as error:
            yield Problem(("constants",), str(error))
        else:
            yield from self._limit_problems(names)

    def _wrong_names(self, names: Names) -> Iterator[Problem]:
        for name in self.inputs:
            if name not in names.of("motor"):
                yield Problem(("inputs", name), f"is no motor of the MJCF; {closest(name, names.of('motor'))}")
        for each in read_edits(names, self.set):
            if isinstance(each, Problem):
                yield each._replace(path=("set", *each.path))
        for name in self.constants:
            if not _IDENTIFIER.fullmatch(name) or name == "pi":
                yield Problem(("constants", name), "must be a letter and up to 63 letters, digits and _, and not pi")

    def _limit_problems(self, names: Names) -> Iterator[Problem]:
        for motor in names.motors:
            if motor.name not in self.inputs and motor.limit is None:
                text = "is missing: the MJCF's motor has no ctrlrange from -F to F, so say `limit: F`"
                yield Problem(("inputs", motor.name, "limit"), text)
        for name, each in self.inputs.items():
            if derived := [other for other in needs(each.limit) if other in self._derived()]:
                text = f"names {derived[0]}: a motor's limit is arithmetic of designs and of constants that are numbers"
                yield Problem(("inputs", name, "limit"), text, each.limit)

    def _derived(self) -> dict[str, str]:
        return {name: each.value for name, each in self.constants.items() if isinstance(each.value, str)}

    def values(self) -> dict[str, float]:
        given = {name: each.value for name, each in self.constants.items() if not isinstance(each.value, str)}
        own = {f"{name}_limit": each.limit for name, each in self.inputs.items() if not isinstance(each.limit, str)}
        of_mjcf = {
            f"{motor.name}_limit": motor.limit
            for motor in _names(self.xml).motors
            if motor.name not in self.inputs and motor.limit is not None
        }
        return given | own | of_mjcf

    def edited(self, values: Mapping[str, float]) -> Self:
        return self.model_validate(self.with_parameters(self.values() | dict(values)).model_dump())

    def robot(self, units: Mapping[str, str] | None = None) -> Robot:
        names, derived = _names(self.xml), self._derived()
        limits = {motor.name: cast(Value, f"{motor.name}_limit") for motor in names.motors}
        limits |= {name: each.limit for name, each in self.inputs.items() if isinstance(each.limit, str)}
        of_input = {f"{motor.name}_limit": motor.joint.units[2] for motor in names.motors}
        known = {name: of_input.get(name, "") for name in self.values()}
        known |= {name: each.unit for name, each in self.constants.items()}
        of_set = (value for fields in self.set.values() for values in fields.values() for value in values)
        arithmetic = (*of_set, *derived.values(), *limits.values())
        used = dict.fromkeys(name for value in arithmetic for name in needs(value) if name not in known)
        zeros = ", ".join(
            f"{joint.name} and {joint.name}_dot along its {'turning' if joint.hinge else 'sliding'} axis"
            for joint in names.joints
        )
        drives = ", ".join(f"{motor.name} along {motor.joint.name}" for motor in names.motors)
        return _robot(
            name=self.name,
            xml=self.xml,
            limits=limits,
            settings=self.set,
            constants=[Named(name, name, known[name]) for name in self.values()],
            derived={name: (Named(name, name, known[name]), derived[name]) for name in resolved_order(derived)},
            design=[Named(name, name, (units or {}).get(name, "")) for name in used],
            convention=f"Zero and positive are as in the MJCF: {zeros}; {drives}. Not wrapped: a full turn adds 2 pi.",
        )

    def with_parameters(self, parameters: Mapping[str, float]) -> "MjcfPlant":
        constants = {
            name: each
            if isinstance(each.value, str)
            else each.model_copy(update={"value": parameter(parameters, name)})
            for name, each in self.constants.items()
        }
        inputs = dict(self.inputs)
        for name in self.values():
            motor = name.removesuffix("_limit")
            if name not in self.constants:
                inputs[motor] = InputConfig(limit=parameter(parameters, name))
        return self.model_copy(update={"constants": constants, "inputs": inputs})


class PythonPlant(PlantConfig):
    """A robot whose dynamics no MJCF can say: a subclass of `rtcd_jax.plants.base.Plant` outside the package."""

    name: str = Field(description="what files and pages call the robot; by default the class's name")
    python: str = Field(description="the class, as package.module:Class")
    constants: dict[str, Annotated[float, Field(ge=-LARGEST, le=LARGEST)]] = Field(
        default={}, description="the class's own fields by name"
    )

    def problems(self) -> Iterator[Problem]:
        try:
            plant = self.plant()
        except Exception as error:  # whatever the user's own module raises
            yield Problem(("python",), f"{type(error).__name__}: {' '.join(str(error).split())}", self.python)
            return
        for name in self.constants:
            if name not in plant.__dataclass_fields__:
                known = tuple(plant.__dataclass_fields__)
                yield Problem(("constants", name), f"is no field of {self.python}; {closest(name, known)}")

    def plant(self) -> Any:
        """The class, a subclass of `plants.base.Plant`. Raises whatever its module does, and TypeError for others."""
        module, _, name = self.python.partition(":")
        found = getattr(importlib.import_module(module), name)
        known = "state_names", "state_units", "input_names", "input_units", "design_units", "Design", "dynamics", "xml"
        missing = [attribute for attribute in known if not hasattr(found, attribute)]
        if missing or inspect.isabstract(found):
            raise TypeError("must be a subclass of rtcd_jax.plants.base.Plant that has all of its parts")
        return found

    def values(self) -> dict[str, float]:
        return dict(self.constants)

    def edited(self, values: Mapping[str, float]) -> Self:
        return self.model_validate({**dict(self), "constants": self.constants | dict(values)})

    @property
    def states(self) -> dict[str, str]:
        plant = self.plant()
        return dict(zip(plant.state_names, plant.state_units, strict=True))

    @property
    def input_units(self) -> dict[str, str]:
        plant = self.plant()
        return dict(zip(plant.input_names, plant.input_units, strict=True))

    @property
    def design(self) -> dict[str, str]:
        return self.plant().design_units

    @property
    def uncertain(self) -> dict[str, tuple[str, ...]]:
        fields = self.plant().__dataclass_fields__
        return {"design": tuple(self.design), "plant": tuple(name for name in fields if not name.endswith("_limit"))}


@cache
def _names(xml: str) -> Names:
    return read_names(xml)


def _robot(
    name: str,
    xml: str,
    limits: Mapping[str, Value],
    settings: Edits,
    constants: list[Named],
    derived: Mapping[str, tuple[Named, Value]],
    design: list[Named],
    convention: str,
) -> Robot:
    names = _names(xml)
    return Robot(
        name=name,
        xml=xml,
        joints=names.joints,
        inputs=tuple((motor.name, motor.joint.units[2]) for motor in names.motors),
        limits=tuple(limits[motor.name] for motor in names.motors),
        edits=tuple(each for each in read_edits(names, settings) if isinstance(each, Edit)),
        constants=tuple(constants),
        derived=tuple(derived.values()),
        design=tuple(design),
        convention=convention,
    )


def _packaged(path: Path) -> type[PackagedPlant]:
    given = _Packaged.model_validate(yaml12.read(path.read_text()))
    fields: dict[str, Any] = {
        "name": (Literal[path.stem], Field(default=path.stem, description=given.description))  # pyright: ignore
    }
    for name, each in given.constants.items():
        if each.choices:
            kind = Literal[tuple(each.choices)]  # pyright: ignore
            fields[name] = (kind, Field(default=each.value, description=each.description))
        else:
            text = f"{each.description} [{each.unit}]"
            fields[name] = (float, Field(default=each.value, ge=each.min, le=1e6, description=text))
    model = create_model(f"{path.stem.title()}Config", __base__=PackagedPlant, **fields)
    model.packaged, model.xml = given, (path.parent / given.mjcf).read_text()
    return model


PLANTS: dict[str, type[PackagedPlant]] = {path.stem: _packaged(path) for path in sorted(ROBOTS.glob("*.yaml"))}
"""The packaged robots by name."""


def read_plant(data: Any) -> PlantConfig:
    """The robot that a section describes; pydantic's error for anything else."""
    if isinstance(data, PlantConfig):
        return data
    ways = [key for key in ("mjcf", "python") if isinstance(data, Mapping) and key in data]
    if not isinstance(data, Mapping) or ("name" not in data and not ways):
        text = f"must be a mapping with a `name`, or with `mjcf: FILE`; valid names: {', '.join(PLANTS)}"
        raise invalid([Problem((), text, data)])
    if ways:
        return _of_ones_own(ways[0], dict(data))
    name = data["name"]
    if not isinstance(name, str) or name not in PLANTS:
        raise invalid([Problem(("name",), f"unknown plant; {closest(name, tuple(PLANTS))}", name)])
    return PLANTS[name].model_validate(data)


def stored_plant(name: str, section: Mapping[str, Any] | None = None) -> PlantConfig:
    """The robot of a stored elite or claim: a packaged one by its name, or as its `section` describes it.

    Raises:
        UserError: there is none.
    """
    if section is None and name not in PLANTS:
        raise UserError(f"no plant is called {name!r}; {closest(name, tuple(PLANTS))}")
    try:
        return read_plant(section or {"name": name})
    except ValidationError as error:
        raise ConfigError(problems_of(error), f"the robot {name}") from None


def _of_ones_own(way: str, data: dict[str, Any]) -> PlantConfig:
    if not isinstance(data[way], str):
        raise invalid([Problem((way,), "must be a text", data[way])])
    if way == "python":
        module, _, name = data[way].partition(":")
        if not module or not name:
            raise invalid([Problem((way,), "must be package.module:Class", data[way])])
        return PythonPlant.model_validate({"name": name.lower(), **data})
    stem = re.sub(r"\W", "_", PurePath(data["mjcf"]).stem, flags=re.ASCII)
    if "xml" not in data:
        text = "is read where a configuration is loaded from its file; here its text must stand in `xml`"
        raise invalid([Problem(("mjcf",), text, data["mjcf"])])
    return MjcfPlant.model_validate({"name": stem, **data})
