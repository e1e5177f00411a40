"""Frozen pydantic models that say what is wrong with their data in the words of `errors`."""

import re
from collections.abc import Iterable, Iterator
from typing import Literal, Self, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from rtcd_jax.system.errors import NO_VALUE, Problem, closest

_KINDS = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": "a text",
    "tuple_type": "a list",
    "dict_type": "a mapping",
    "finite_number": "finite",
}
_BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}
_UNIT = re.compile(r"\s*\[([^\[\]]+)\]")
_BOUND_ERRORS = ("greater_than", "greater_than_equal", "less_than", "less_than_equal")


class Settings(BaseModel):
    """A frozen section of the configuration: no unknown keys, no coercion but int to float, no NaN."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, ser_json_inf_nan="constants"
    )

    def problems(self) -> Iterator[Problem]:
        """What is wrong between fields that are valid one by one; paths start at this section."""
        return iter(())

    @model_validator(mode="wrap")
    @classmethod
    def _teach(cls, data, handler) -> Self:
        try:
            settings = handler(data)
        except ValidationError as error:
            problems = [_taught(cls, details) for details in error.errors()]
            raise invalid({(p.path, p.text): p for p in problems}.values()) from None  # a union's kinds say one thing
        problems = tuple(settings.problems())
        if problems:
            raise invalid(problems)
        return settings


def invalid(problems: Iterable[Problem]) -> ValidationError:
    """The problems as one pydantic error; an enclosing model prepends its own path to theirs."""
    return ValidationError.from_exception_data("configuration", [_line(problem) for problem in problems])


def refusal(text: str, shown: bool = True) -> PydanticCustomError:
    """What a field's validator raises to say in its own words what is wrong with a value, shown or not."""
    # The text travels in the context: pydantic would expand braces in a message template.
    return PydanticCustomError("problem", "{text}", {"text": text, "shown": shown})


def problems_of(error: ValidationError) -> list[Problem]:
    """The inverse of `invalid`."""
    return [_problem(details) for details in error.errors()]


def bounds(field: FieldInfo) -> str:
    """The field's own range or, of a list, that of its entries, such as `> 0 and <= 1`; empty if it has none."""
    entries = (item for kind in get_args(field.annotation) for item in getattr(kind, "__metadata__", ()))
    metadata = (*field.metadata, *(limit for entry in entries for limit in getattr(entry, "metadata", ())))
    limits = ((sign, getattr(item, name, None)) for item in metadata for name, sign in _BOUNDS.items())
    return " and ".join(f"{sign} {_number(limit)}" for sign, limit in limits if limit is not None)


def unit(field: FieldInfo) -> str:
    """The unit in brackets in the field's description; empty if it has none."""
    match = _UNIT.search(str(field.description))
    return match.group(1) if match else ""


def without_unit(field: FieldInfo) -> str:
    """The field's description but for its unit."""
    return _UNIT.sub("", str(field.description), count=1)


def _number(limit: float) -> str:
    return str(limit) if isinstance(limit, int) else f"{limit:g}"


def _line(problem: Problem) -> InitErrorDetails:
    shown = problem.value is not NO_VALUE
    return InitErrorDetails(type=refusal(problem.text, shown), loc=problem.path, input=problem.value if shown else None)


def _problem(details: ErrorDetails) -> Problem:
    context = details.get("ctx", {})
    return Problem(details["loc"], context["text"], details["input"] if context["shown"] else NO_VALUE)


def _taught(model: type[Settings], details: ErrorDetails) -> Problem:
    """pydantic's error in the words of `model`, whose validation raised it; deeper models have already taught."""
    kind, path = details["type"], details["loc"]
    if kind == "problem":
        return _problem(details)
    if not path:
        return Problem(path, f"must be a mapping with the keys {', '.join(model.model_fields)}", details["input"])
    if kind == "extra_forbidden":
        return Problem(path, f"unknown key; {closest(path[0], tuple(model.model_fields))}", details["input"])
    field = model.model_fields[str(path[0])]
    if names := _names_beside_numbers(field):
        return Problem(path[:1], f"must be {bounds(field)}, or {names}; {field.description}", details["input"])
    if kind == "literal_error":
        return Problem(path, f"unknown name; {closest(details['input'], get_args(field.annotation))}", details["input"])
    meaning = f"; {field.description}" if field.description else ""
    if kind == "missing":
        return Problem(path, f"is missing{meaning}")
    return Problem(path, f"{_expectation(field, details)}{meaning}", details["input"])


def _names_beside_numbers(field: FieldInfo) -> str:
    """Of a field that takes a number or one of some names, the names."""
    kinds = [kind for kind in get_args(field.annotation) if get_origin(kind) is Literal]
    return " or ".join(repr(name) for kind in kinds for name in get_args(kind))


def _expectation(field: FieldInfo, details: ErrorDetails) -> str:
    kind, context = details["type"], details.get("ctx", {})
    if kind in _KINDS:
        return f"must be {_KINDS[kind]}"
    if kind in _BOUND_ERRORS:
        ((name, limit),) = ((name, limit) for name, limit in context.items() if name in _BOUNDS)
        return f"must be {bounds(field) or f'{_BOUNDS[name]} {_number(limit)}'}"
    return str(details["msg"])
