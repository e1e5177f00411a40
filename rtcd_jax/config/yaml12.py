"""YAML as version 1.2's core schema reads it: plain text to mappings with text keys, lists, numbers and texts.

PyYAML follows version 1.1, where `1:30` is 90, `yes` is true and `2020-09-09` is a date; here these are texts, and
`1e-3` is a number. What cannot be meant is refused by its place in the text: tags, keys that are no text or
are given twice, numbers that no double holds, and whatever would take more than its share of time or memory.
"""

import re
import sys
from typing import Any, ClassVar

import yaml

LARGEST_FILE = 2**18
"""Bytes; a complete configuration has some 2,000."""
DEEPEST = 32
"""Mappings and lists inside each other; a configuration has 4."""
MOST_NODES = 100_000
"""Keys and values, each alias counted as if it were written out."""

_INTEGER = re.compile(r"[-+]?[0-9]+$|0o[0-7]+$|0x[0-9a-fA-F]+$")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$")
_PREFIXED = {"0o": 8, "0x": 16}


class NotYaml(ValueError):
    """The text is no YAML, or none that is read here: one line with the place."""


def read(text: str | bytes) -> Any:
    """What a YAML text says: mappings, lists, texts, numbers, true, false and null.

    Raises:
        NotYaml: naming line and column.
    """
    if len(text) > LARGEST_FILE:
        raise NotYaml(f"more than {LARGEST_FILE} bytes: no configuration is that long")
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"line {mark.line + 1}, column {mark.column + 1}: " if mark else ""
        # "expected a single document …, but found another": the first half is the context's.
        context = f"{error.context}, " if str(error.problem).startswith("but ") else ""
        raise NotYaml(f"no valid YAML: {place}{context}{error.problem}") from None
    except yaml.reader.ReaderError as error:
        raise NotYaml(f"no valid YAML: unacceptable character at position {error.position}: {error.reason}") from None


def _refuse(problem: str, node: yaml.Node | yaml.Event):
    raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader with version 1.2's scalars."""

    yaml_implicit_resolvers: ClassVar = {}

    def __init__(self, stream: str | bytes):
        super().__init__(stream)
        self._depth = 0
        self._sizes: dict[int, int] = {}  # nodes below each node that is complete, itself included

    def compose_node(self, parent, index):
        event = self.peek_event()
        if getattr(event, "tag", None) is not None:
            _refuse(f"tags such as {event.tag.replace(_CORE, '!!')} are not read", event)
        if self._depth == DEEPEST:
            _refuse(f"more than {DEEPEST} mappings and lists inside each other", event)
        alias = self.check_event(yaml.AliasEvent)
        self._depth += 1
        node = super().compose_node(parent, index)
        assert node is not None
        self._depth -= 1
        if not alias:
            self._sizes[id(node)] = 1 + sum(self._sizes[id(child)] for child in _children(node))
        elif id(node) not in self._sizes:
            _refuse(f"*{event.anchor} contains itself", event)
        if self._sizes[id(node)] > MOST_NODES:
            _refuse(f"more than {MOST_NODES} keys and values, each alias counted as if written out", event)
        return node

    def construct_mapping(self, node, deep=False):
        keys = set()
        for key, _ in node.value:
            if key.tag not in (_TEXT, _MERGE):
                given = f", not {key.value}" if isinstance(key, yaml.ScalarNode) else ""
                _refuse(f"a key must be a text{given}; in quotes everything is one", key)
            if key.value in keys:
                _refuse(f"the key {key.value!r} is given twice", key)
            keys.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_integer(self, node):
        text = node.value
        base = _PREFIXED.get(text[:2], 10)
        # A double's largest value has 309 digits; Python itself refuses to read more than 4300.
        if len(text) > 400 or abs(int(text, base)) > sys.float_info.max:
            _refuse(f"a number of {len(text)} characters is too large", node)
        return int(text, base)

    def construct_float(self, node):
        text = node.value.lower()
        value = float(text.replace(".inf", "inf").replace(".nan", "nan"))
        digits, _, _ = text.partition("e")
        if value in (float("inf"), -float("inf")) and not text.endswith(".inf"):
            _refuse(f"{node.value} is too large for a double, whose largest is 1.8e308; .inf is infinity", node)
        if abs(value) < sys.float_info.min and re.search("[1-9]", digits):
            _refuse(f"{node.value} is too small for a double, whose smallest is 2.2e-308", node)
        return value

    def construct_text(self, node):
        if re.search("[\ud800-\udfff]", node.value):
            _refuse(f"{node.value!r} has half a character", node)
        return node.value


def _children(node: yaml.Node):
    if isinstance(node, yaml.MappingNode):
        return [part for pair in node.value for part in pair]
    return node.value if isinstance(node, yaml.SequenceNode) else []


_CORE = "tag:yaml.org,2002:"
_TEXT, _MERGE = f"{_CORE}str", f"{_CORE}merge"
for _tag, _pattern, _first in (
    ("bool", re.compile(r"(true|True|TRUE|false|False|FALSE)$"), "tTfF"),
    ("null", re.compile(r"(~|null|Null|NULL|)$"), ["~", "n", "N", ""]),
    ("int", _INTEGER, "-+0123456789"),
    ("float", _FLOAT, "-+.0123456789"),
    ("merge", re.compile(r"<<$"), "<"),
):
    _Loader.add_implicit_resolver(f"{_CORE}{_tag}", _pattern, list(_first))
for _tag, _construct in (
    ("str", _Loader.construct_text),
    ("int", _Loader.construct_integer),
    ("float", _Loader.construct_float),
):
    _Loader.add_constructor(f"{_CORE}{_tag}", _construct)
