"""Numbers of a configuration may be arithmetic, and nothing but arithmetic."""

import math

import pytest

from rtcd_jax.config.arithmetic import arithmetic
from rtcd_jax.config.load import EXAMPLE, config_hash, parse_yaml
from rtcd_jax.system.errors import ConfigError


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("pi", math.pi),
        ("-pi/2", -math.pi / 2),
        ("2 * (1 + half)**2", 4.5),
        ("1e-3", 1e-3),
        ("+2**-1", 0.5),
        (" 3 ", 3),
        ("asin(half)", math.asin(0.5)),
        ("-sqrt(cos(0)**2 + 3)*half", -1.0),
    ],
)
def test_arithmetic_has_its_value(text, value):
    assert arithmetic(text, {"half": 0.5}) == value


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("two*pi", r"names two; there is pi, half"),
        ("1/0", r"has no finite value"),
        ("acos(4*half)", r"has no finite value"),
        ("sin(1, 2)", r"is no arithmetic"),
        ("sin", r"names sin; there is pi, half"),
        ("9e9**9e9", r"has no finite value"),
        ("(-1)**half", r"has no finite value"),
        ("1e999", r"has no finite value"),
        ("1+", r"is no arithmetic"),
        ("", r"is no arithmetic"),
        ("True", r"is no arithmetic"),
        ("pi.real", r"is no arithmetic"),
        ("abs(1)", r"is no arithmetic"),
        ("[1][0]", r"is no arithmetic"),
        ("'a'*3", r"is no arithmetic"),
        ("__import__('os')", r"is no arithmetic"),
        ("half if half else 1", r"is no arithmetic"),
        ("1 < 2", r"is no arithmetic"),
        ("1" + "+1" * 200, r"has 401 characters, at most 200 are read"),
    ],
)
def test_what_is_no_arithmetic_is_refused(text, words):
    with pytest.raises(ValueError, match=words):
        arithmetic(text, {"half": 0.5})


def test_a_task_and_a_box_in_arithmetic_are_those_in_numbers():
    plain = EXAMPLE.replace("initial: 0.4, min: 0.4", "initial: 0.5, min: 0.4")
    written = plain.replace("3.141592653589793", "pi").replace("6.283185307179586", "2*pi")
    written = written.replace("initial: 0.5", "initial: (0.4 + 0.6)/2")
    assert written.count("pi") == 2
    config = parse_yaml(written)
    assert config == parse_yaml(plain)
    assert config_hash(config) == config_hash(parse_yaml(plain))


def test_wrong_arithmetic_is_told_at_its_key():
    with pytest.raises(ConfigError) as caught:
        parse_yaml(EXAMPLE.replace("goal: [3.141592653589793", "goal: [po"))
    (problem,) = caught.value.problems
    assert problem.path == ("task", "goal", 0)
    assert str(caught.value).splitlines()[-1].endswith("names po; there is pi, mass, length")
