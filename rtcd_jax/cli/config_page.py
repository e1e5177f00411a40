"""The page of all configuration keys, made from their models: `python -m rtcd_jax.cli.config_page docs/config.md`."""

import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from rtcd_jax.config.load import Config
from rtcd_jax.config.plants import PLANTS, MjcfPlant, PlantConfig, PythonPlant
from rtcd_jax.config.schema import UNIT, Variable
from rtcd_jax.config.settings import Settings, bounds, unit, without_unit
from rtcd_jax.system.files import replace

HEAD = """\
# Every key of a configuration

Made from the models in `rtcd_jax/config/schema.py` by
`python -m rtcd_jax.cli.config_page docs/config.md`. Every key is also an
option of `rtcd optimize CONFIG`, as `--search.population 256`; with `--help` it lists them with the file's own values.
All numbers are in SI units, angles in rad; `-` is a number without unit. In the file, those of the task and of
variables may be arithmetic, as `2*pi` or `-asin(0.5)`. "the paper" is Girlanda et al., ICRA 2024.
"""
_HEADING = "| key | unit | default | range | meaning |\n|---|---|---|---|---|"


OWN = {"a robot of one's own, from its MJCF": MjcfPlant, "a robot of one's own, from its class": PythonPlant}


def reference() -> str:
    """The page, in Markdown: a table for every section of the configuration."""
    parts = [HEAD]
    for name, field in Config.model_fields.items():
        parts.append(f"## `{name}`: {field.description}\n")
        parts.extend(_section(name, field))
    parts.append("## Variables\n")
    parts.append(
        "Where a table says *a variable*, there is a mapping with these keys; its unit is that of the table.\n"
    )
    parts.append(_table(_rows("", Variable)))
    return "\n".join(parts)


def _section(name: str, field: FieldInfo) -> Iterator[str]:
    kind = field.annotation
    if kind is PlantConfig:
        for plant, model in PLANTS.items():
            yield f"### {plant}\n"
            yield f"States: {_named(model().states)}. Inputs: {_named(model().input_units)}.\n"
            yield _table(_rows(f"{name}.", model))
        for title, model in OWN.items():
            yield f"### {title}\n"
            yield _table(_rows(f"{name}.", model))
    elif get_origin(kind) is dict and get_args(kind)[1] is not Variable:
        yield _table(_rows(f"{name}.NAME.", _model(get_args(kind)[1])))
    elif get_origin(kind) is dict:
        for plant, model in PLANTS.items():
            yield f"### {plant}\n"
            yield _table(
                [(f"{name}.{key}", unit, "required", "", "a variable") for key, unit in model().design.items()]
            )
    else:
        yield _table(_rows(f"{name}.", _model(kind)))


def _rows(prefix: str, model: type[Settings]) -> Iterator[tuple[str, str, str, str, str]]:
    """Key, unit, default, range and meaning of every field, those of the sections inside included."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Settings):
            yield from _rows(f"{prefix}{name}.", kind)
            continue
        if listed := _listed(kind):
            yield from _rows(f"{prefix}{name}.I.", listed)
            continue
        meaning = without_unit(field)
        if Variable in _leaves(kind):
            listed = get_origin(kind) is tuple
            meaning += "; a list of variables" if listed else "; or a variable, then it is searched"
        yield f"{prefix}{name}", unit(field).replace(UNIT, "its own"), _default(field), _range(field), meaning


def _listed(kind: Any) -> type[Settings] | None:
    """The section of which a field is a list; None of other fields, and of variables."""
    entry = get_args(kind)[0] if get_origin(kind) is tuple else None
    if isinstance(entry, type) and issubclass(entry, Settings) and entry is not Variable:
        return entry
    return None


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    if field.default is None:
        return "none"
    return {True: "true", False: "false"}[field.default] if isinstance(field.default, bool) else f"{field.default}"


def _range(field: FieldInfo) -> str:
    """Its bounds or its names."""
    if get_origin(field.annotation) is Literal:
        return ", ".join(map(str, get_args(field.annotation)))
    return "true, false" if field.annotation is bool else bounds(field)


def _leaves(kind: Any) -> set[Any]:
    """The types that an annotation is made of."""
    if get_origin(kind) in (Union, UnionType, tuple):
        return {leaf for part in get_args(kind) for leaf in _leaves(part)}
    return {kind}


def _model(kind: Any) -> type[Settings]:
    if not (isinstance(kind, type) and issubclass(kind, Settings)):
        raise TypeError(f"a section of the configuration that the reference cannot show: {kind}")
    return kind


def _named(units: dict[str, str]) -> str:
    return ", ".join(f"{name} [{unit}]" for name, unit in units.items())


def _table(rows: Iterable[tuple[str, ...]]) -> str:
    lines = ("| " + " | ".join((f"`{key}`", *map(_cell, cells))) + " |" for key, *cells in rows)
    return "\n".join([_HEADING, *lines, ""])


def _cell(text: str) -> str:
    """Without Markdown's own signs."""
    return text.replace("|", r"\|").replace("*", r"\*").replace("_", r"\_")


if __name__ == "__main__":
    replace(Path(sys.argv[1]), reference().encode())
