"""What a verb says on a terminal and into a file."""

import io
import math
from threading import Event

import pytest

from rtcd_jax.system import console as consoles
from rtcd_jax.system.console import Clock, Console, Progress, duration, table, times
from tests.consoles import Output, Screen


def test_plain_lines_into_a_file():
    stream = io.StringIO()
    with Console(stream) as console:
        console.message("compiling [1/2]")
        console.progress(Progress(1, 2, "generation 1/2"))
        console.progress(Progress(2, 2, "generation 2/2"))
    assert stream.getvalue() == "compiling [1/2]\ngeneration 1/2\ngeneration 2/2\n"


def test_a_line_reaches_the_file_at_once(tmp_path):
    path = tmp_path / "log"
    with path.open("w") as stream, Console(stream) as console:
        console.progress(Progress(1, 2, "half"))
        assert path.read_text() == "half\n"


def test_what_others_wrote_is_shown_and_not_obeyed():
    screen = Screen()
    outside = "\x1b[31mred\x1b]0;title\x07\x9b2J\r\u202e"
    with screen.console as console:
        console.message(f"{outside}\nsecond line")
        console.progress(Progress(1, 2, outside))
    shown = r"\x1b[31mred\x1b]0;title\x07\x9b2J\r\u202e"
    assert f"{shown}\nsecond line\n" in screen.text
    assert screen.text.count(shown) >= 2
    assert not set("\x07\x9b\u202e") & set(screen.text)
    assert "\x1b[31m" not in screen.text


def test_one_live_line_on_a_terminal():
    screen = Screen()
    with screen.console as console:
        for done in (1, 2, 3):
            console.progress(Progress(done, 3, f"part {done}/3"))
        console.message("done")
    assert screen.text.count("\n") < 6
    assert screen.text.index(" 1/3") < screen.text.index(" 3/3") < screen.text.index("done")
    assert "\x1b[2K" in screen.text, "the line is erased before it is drawn again"


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [
        (0.4, "0:00"), (59.4, "0:59"), (59.6, "1:00"), (3599.6, "1:00:00"), (3725, "1:02:05"), (math.inf, "unknown"),
        (math.nan, "unknown"),
    ],
)  # fmt: skip
def test_durations(seconds, shown):
    assert duration(seconds) == shown
    assert times(12.4, seconds) == f"elapsed 0:12  left {shown}"


def test_what_an_earlier_call_did_says_nothing_about_the_time_that_is_left(monkeypatch):
    now = 100.0
    monkeypatch.setattr(consoles.time, "monotonic", lambda: now)
    clock = Clock(before=6)
    now = 110.0
    assert clock.times(6, 10) == "elapsed 0:10  left unknown"
    assert clock.times(8, 10) == "elapsed 0:10  left 0:10"
    assert clock.times(10, 10) == "elapsed 0:10  left 0:00"


def test_a_table_is_text_whatever_the_terminal_is(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "10")
    shown = table(("name", "value"), [("a", "1.5"), ("long name", "2 [m]"), ("short row",)], "title", left={"name"})
    assert "\x1b" not in shown
    lines = [line.rstrip() for line in shown.splitlines() if line.strip()]
    assert lines[0].strip() == "title"
    assert lines[-3:] == ["  a             1.5", "  long name   2 [m]", "  short row"]


def test_what_takes_long_says_so_again_and_again_until_it_is_over():

    seen = Event()

    class Heard(Screen):
        def write(self, text):
            written = super().write(text)
            if self.text.count("compiling  elapsed 0:0") >= 2:
                seen.set()
            return written

    stream = Heard()
    with stream.console.waiting("compiling", every=0.01):
        assert seen.wait(20)
    lines = stream.text.count("\n")
    seen.clear()
    assert not seen.wait(0.1)
    assert stream.text.count("\n") == lines


def test_a_pipe_gets_lines_whatever_the_environment_forces(monkeypatch):
    """A notebook sets FORCE_COLOR for all that it starts."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    output = Output()
    with output.console as console:
        console.progress(Progress(1, 2, "half"))
        console.message("done")
    assert output.lines == ["half", "done"]
