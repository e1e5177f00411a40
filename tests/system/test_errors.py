"""What others wrote reaches a terminal as text alone."""

import pickle

import pytest

from rtcd_jax.system.errors import ConfigError, Problem, printable

HOSTILE = {
    "escape code": ("a\x1b[2J\x1b]0;title\x07b", r"a\x1b[2J\x1b]0;title\x07b"),
    "C1 control": ("a\x9b31mb", r"a\x9b31mb"),
    "line breaks": ("kept\nrtcd: PROVED\r\u2028\u2029\x85", r"kept\nrtcd: PROVED\r\u2028\u2029\x85"),
    "turned writing": ("a\u202eb\u2066c\u200fd", r"a\u202eb\u2066c\u200fd"),
    "nothing to see": ("a\u200b\ufeff\U000e0041b", r"a\u200b\ufeff\U000e0041b"),
    "half a character": ("a\ud800\udcffb", r"a\ud800\udcffb"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_a_terminal_would_obey_is_shown(case):
    text, shown = HOSTILE[case]
    assert printable(text) == shown
    assert printable(text).isprintable()


def test_all_other_text_stays():
    for text in ("", "theta_dot [rad/s]", "θ̇ ≤ 2π, ẋ = −x + x³", "ünï 漢字 👩 C:\\x"):
        assert printable(text) == text
    assert printable(3.5) == "3.5"


def test_long_text_ends_in_dots():
    assert printable("abcdef", 6) == "abcdef"
    assert printable("abcdefg", 6) == "abcde…"
    assert printable("\x1b" * 10**6, 6) == r"\x1b\…"
    assert len(printable("x" * 10**6, 60)) == 60


def test_an_error_names_a_hostile_key_on_its_own_line():
    error = ConfigError([Problem(("search", "\x1b[2J\nrtcd: all is well"), "unknown key", "\x1b]0;x\x07")], "x.yaml")
    assert str(error) == r"x.yaml: search.\x1b[2J\nrtcd: all is well = '\x1b]0;x\x07': unknown key"


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_comes_whole_out_of_a_worker_process(count):
    error = ConfigError([Problem(("search", "seed"), "must be >= 0", -1)] * count, "x.yaml")
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.problems, again.source) == (str(error), error.problems, error.source)
