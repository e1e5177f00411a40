"""A verb's options: a pydantic model that tyro reads from the command line; one error names all that is wrong."""

import contextlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from inspect import cleandoc
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

import tyro
from pydantic import AfterValidator, ValidationError
from pydantic.fields import FieldInfo
from tyro.constructors import ConstructorRegistry, StructConstructorSpec, StructFieldSpec, StructTypeInfo

from rtcd_jax.config.schema import UNIT
from rtcd_jax.config.settings import Settings, bounds, problems_of, refusal
from rtcd_jax.system.errors import ConfigError, Problem, printable

OPTIMIZE_USAGE = "rtcd optimize CONFIG [--run FOLDER] [--KEY VALUE …]"


@dataclass(frozen=True)
class Branch:
    """A node of the tree of options: tyro parses its fields, `collect` gathers their values in a plain container."""

    fields: tuple[StructFieldSpec, ...]
    collect: Callable[..., Any] = dict


class Options(Settings):
    """Base of every verb's options. The docstring is the verb's help, a field's description and limits the option's.

    What tyro is to know beside them (a positional, a metavar) stands in the field's annotation.
    """

    @classmethod
    def defaults(cls, words: Sequence[str]) -> Mapping[str, Any]:
        """Defaults by name that depend on the words themselves; a Branch stands for options of its own."""
        return {}

    @classmethod
    def read(cls, words: Sequence[str], prog: str) -> Self:
        """The options that the words after `prog` give; tyro itself exits with 0 for help, 2 for an unknown option.

        Raises:
            ConfigError: everything that is wrong with their values.
        """
        branch = section(cls, cls.defaults(words))
        try:
            return cls.model_validate(_parsed(branch, words, prog, cleandoc(cls.__doc__ or "")))
        except ValidationError as error:
            problems = [_at_its_option(cls, problem) for problem in problems_of(error)]
        raise ConfigError(problems, "")


Positional = tyro.conf.Positional
FLAT = tyro.conf.arg(name="")
"""Of a field that is a model itself: its options have no prefix."""


def shown(metavar: str | None = None, otherwise: str | None = None, name: str | None = None) -> Any:
    """How help shows an option: its value, what holds where it is left away, in place of `(default: None)`, and its
    name where that is no name in Python.
    """
    hint = f"(default: {otherwise})" if otherwise else None
    return tyro.conf.arg(name=name, metavar=metavar, help_behavior_hint=hint)


Cache = Annotated[str | None, shown("DIR", "~/.cache/rtcd_jax/xla")]


def _run_folder(path: Path) -> Path:
    if path.is_file():
        raise refusal(f"is a file; must be a run folder, as `{OPTIMIZE_USAGE}` makes one")
    if not path.is_dir():
        raise refusal(f"no such run folder; `{OPTIMIZE_USAGE}` makes one")
    return path


def _number_of_elite(elite: int | str) -> int | str:
    if isinstance(elite, int) and elite < 0:
        raise refusal("must be >= 0, or initial")
    return elite


ExistingRun = Annotated[Path, AfterValidator(_run_folder)]
Run = Annotated[Positional[ExistingRun], shown("RUN")]
Elite = Annotated[int | Literal["initial"], AfterValidator(_number_of_elite), shown("K")]


def section(
    model: type[Settings], values: Mapping[str, Any], unit: str = "", branches: Mapping[str, Branch] | None = None
) -> Branch:
    """An option for each field of a model, with its limits in the help.

    Args:
        values: defaults by name in place of the fields' own.
        unit: of the model's numbers, in place of `UNIT` in their descriptions.
        branches: the options of some fields that are models; of the others they are made here.
    """
    values = {**values, **(branches or {})}
    fields = []
    for name, field in model.model_fields.items():
        value = values.get(name, tyro.MISSING if field.is_required() else field.default)
        if isinstance(value, Settings):
            value = section(type(value), vars(value), unit)
        if isinstance(value, Branch):
            kind, text = Branch, field.description
        else:
            kind, text = _kind(value, field), _help(field, unit)
        marked = Annotated[(kind, *field.metadata)] if field.metadata else kind
        fields.append(StructFieldSpec(name, cast(type, marked), value, text))
    return Branch(tuple(fields))


def _kind(value: Any, field: FieldInfo) -> Any:
    if isinstance(value, tuple) and any(isinstance(each, str) for each in value):
        return tuple[float | str, ...]  # the ends of a motion, which may be arithmetic
    return float if isinstance(value, float) else field.annotation


def _help(field: FieldInfo, unit: str) -> str:
    text = str(field.description).replace(UNIT, unit)
    limits = bounds(field)
    return f"{text} ({limits})" if limits else text


def _parsed(branch: Branch, words: Sequence[str], prog: str, description: str) -> dict[str, Any]:
    """The values of all options. tyro quotes words that it does not take: a terminal is to show them, not to obey."""
    parse = partial(parser(), Branch, prog=prog, description=description, default=branch)
    harmless = [printable(word) for word in words]
    if harmless == list(words):
        return cast(dict[str, Any], parse(args=words))
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            return cast(dict[str, Any], parse(args=words))
    except SystemExit as end:
        if end.code:
            parse(args=harmless)
        raise


def parser() -> Callable[..., Any]:
    """tyro's `cli`, which knows a Branch."""
    registry = ConstructorRegistry()
    registry.struct_rule(_as_struct)
    return partial(tyro.cli, registry=registry, use_underscores=True)


def _as_struct(info: StructTypeInfo) -> StructConstructorSpec | None:
    if isinstance(info.default, Branch):
        return StructConstructorSpec(info.default.collect, info.default.fields)
    return None


def _at_its_option(model: type[Options], problem: Problem) -> Problem:
    """The problem at the name of the option on the command line; a positional has none, and is its value."""
    if not problem.path:
        return problem
    name, *inner = problem.path
    marks = model.model_fields[str(name)].metadata
    if FLAT in marks:
        return problem._replace(path=(f"--{inner[0]}", *inner[1:]) if inner else ())
    if Positional in marks:
        return Problem((str(problem.value),), problem.text)
    if inner:  # one of several values
        return Problem((f"--{name} {problem.value}",), problem.text)
    if isinstance(problem.value, str):  # as it was typed, without quotes
        return Problem((f"--{name} = {problem.value}",), problem.text)
    return problem._replace(path=(f"--{name}",))
