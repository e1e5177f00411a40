"""YAML that others hand in: read as version 1.2 means it, or refused in one line, whatever stands in it."""

import random
import re

import pytest
import yaml

from rtcd_jax.config import yaml12
from rtcd_jax.config.load import EXAMPLE, load, parse_yaml
from rtcd_jax.system.errors import ConfigError


def refusal(text):
    """The lines that a configuration's text is refused with; none if it is accepted."""
    try:
        parse_yaml(text, "x.yaml")
    except ConfigError as error:
        return str(error).splitlines()
    return []


def damped(value):
    """The example with a text in the place of the pendulum's damping."""
    return EXAMPLE.replace("{name: pendulum}", f"{{name: pendulum, damping: {value}}}")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1:30", "1:30"),
        ("190:20:30.15", "190:20:30.15"),
        ("yes", "yes"),
        ("Off", "Off"),
        ("2020-09-09", "2020-09-09"),
        ("1_000", "1_000"),
        ("0b11", "0b11"),
        ("0x_", "0x_"),
        ("=", "="),
        ("true", True),
        ("FALSE", False),
        ("~", None),
        ("", None),
        ("010", 10),
        ("0o17", 15),
        ("0xfF", 255),
        ("1e-3", 0.001),
        ("-1E+3", -1000.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("0e-400", 0.0),
        ("-.inf", -float("inf")),
    ],
)
def test_scalars_are_those_of_version_1_2(text, value):
    found = yaml12.read(f"a: {text}")["a"]
    assert (found, type(found)) == (value, type(value))


def test_aliases_and_merges_are_read():
    assert yaml12.read("a: &a {x: 1, y: 2}\nb: *a\nc: {<<: *a, y: 3}")["c"] == {"x": 1, "y": 3}


def laughs(levels):
    """Nine aliases of nine aliases of …"""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels)]
    return "\n".join([*lines, EXAMPLE])


@pytest.mark.parametrize(
    ("text", "words"),
    {
        "date that is none": (damped("2020-99-99"), "plant.damping = '2020-99-99': must be a number"),
        "sexagesimal": (damped("1:30"), "plant.damping = '1:30': must be a number"),
        "prefix alone": (damped("0x_"), "plant.damping = '0x_': must be a number"),
        "tag": (damped("!!int abc"), "no valid YAML: line 1, column 34: tags such as !!int are not read"),
        "python's tag": ("!!python/object/apply:os.system [ls]", "no valid YAML: line 1, column 1: tags such as"),
        "null key": ("~: 3", "no valid YAML: line 1, column 1: a key must be a text, not ~"),
        "key that is no number": (".nan: 3", "no valid YAML: line 1, column 1: a key must be a text, not .nan"),
        "number as a key": ("3: 4", "no valid YAML: line 1, column 1: a key must be a text, not 3"),
        "list as a key": ("? [1, 2]\n: 4", "no valid YAML: line 1, column 3: a key must be a text"),
        "yes as a key": (EXAMPLE + "yes: 3", "yes = 3: unknown key"),
        "5000 digits": (damped("9" * 5000), "no valid YAML: line 1, column 34: a number of 5000 characters is too"),
        "400 digits": (damped("-" + "9" * 399), "no valid YAML: line 1, column 34: a number of 400 characters is too"),
        "310 digits": (damped("9" * 310), "no valid YAML: line 1, column 34: a number of 310 characters is too large"),
        "no double is as small": (damped("1.0e-400"), "no valid YAML: line 1, column 34: 1.0e-400 is too small for"),
        "half the digits lost": (damped("1e-310"), "no valid YAML: line 1, column 34: 1e-310 is too small for"),
        "no double is as large": (damped("-1e400"), "no valid YAML: line 1, column 34: -1e400 is too large for"),
        "deep lists": ("[" * 5000 + "]" * 5000, "no valid YAML: line 1, column 33: more than 32 mappings and lists"),
        "deep mappings": ("{a: " * 5000, "no valid YAML: line 1, column 126: more than 32 mappings and lists"),
        "nine aliases of nine": (laughs(9), "no valid YAML: line 6, column 5: more than 100000 keys and values"),
        "alias of itself": ("a: &a [*a]", "no valid YAML: line 1, column 8: *a contains itself"),
        "half a character": ('"\\uD800": 1', "no valid YAML: line 1, column 1: '\\ud800' has half a character"),
        "two documents": (
            "a: 1\n---\nb: 1",
            "no valid YAML: line 2, column 1: expected a single document",
        ),
        "escape codes": (EXAMPLE + '"\\e[31mred\\a": 1', "\\x1b[31mred\\x07 = 1: unknown key"),
        "line breaks": (EXAMPLE + '"a\\nb": 1', "a\\nb = 1: unknown key"),
        "another encoding": ("pendülum: 1".encode("latin1"), "no valid YAML: unacceptable character at position 4"),
        "too long": (" " * (yaml12.LARGEST_FILE + 1), "more than 262144 bytes: no configuration is that long"),
    }.values(),
)
def test_refused_in_one_line(text, words):
    (line,) = refusal(text)
    assert line.startswith(f"x.yaml: {words}")
    assert line.isprintable()


@pytest.mark.thorough
def test_of_many_errors_twenty_are_shown():
    lines = refusal(EXAMPLE + "".join(f"k{i}: 1\n" for i in range(20_000)))
    assert lines[0] == "x.yaml: 20000 errors"
    assert len(lines) == 22
    assert lines[20].startswith("  k19 = 1: unknown key")
    assert lines[21] == "  and 19980 more"


def test_a_long_file_is_not_read_to_its_end(tmp_path):
    path = tmp_path / "long.yaml"
    with path.open("wb") as file:
        file.truncate(2**40)  # a hole: it takes no space on the disk, but all of the memory
    with pytest.raises(ConfigError, match="more than 262144 bytes"):
        load(path)


PIECES = [
    "~", "yes", "1:30", "2020-99-99", "!!int abc", "!!binary '%%'", "0x_", "9" * 400, "1e-400", "-1e308", "5e-324",
    ".nan", "-.inf", "1e19", "-1", "0", "{", "}", "[", "]", ": ", ",", "&a ", "*a", "<<: *a", "? ", "- ", "#", "|", ">",
    "'", '"', "\n", "\t", "\x00", "\x1b[31m", "\ud800", "\u202e", "{a: " * 40, "[" * 300, "%YAML 9.9\n", "---\n",
    "...", "null: 1, ", "1: 1, ",
]  # fmt: skip


def mutated(source, rng):
    """The text with one to four cuts, copies, exchanges or insertions, at the ends of words as often as inside."""
    text = source
    for _ in range(rng.randint(1, 4)):
        words = [match.span() for match in re.finditer(r"[\w.+-]+", text)] or [(0, len(text))]
        start, end = rng.choice(words) if rng.random() < 0.8 else sorted(rng.choices(range(len(text) + 1), k=2))
        there, other = text[start:end], rng.choice(words)
        new = rng.choice(["", there * 2, text[slice(*other)], rng.choice(PIECES), there + rng.choice(PIECES)])
        text = text[:start] + new + text[end:]
    return text


def test_a_thousand_mutated_configurations_are_read_or_refused():
    rng = random.Random(0)
    source = yaml.safe_dump(yaml.safe_load(EXAMPLE) | {"search": {"population": 8}, "policy": {"discount": 0.1}})
    refused = 0
    for _ in range(1000):
        data = mutated(rng.choice([EXAMPLE, source]), rng).encode("utf-8", "surrogatepass")
        if rng.random() < 0.1:
            place = rng.randrange(len(data))
            data = data[:place] + bytes([rng.randrange(256)]) + data[place + 1 :]
        lines = refusal(data)
        refused += bool(lines)
        assert all(line.isprintable() and len(line) < 1000 for line in lines), data
    assert 500 < refused < 1000
