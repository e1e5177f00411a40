"""What a run says on a terminal and into a file."""

import io
import math
from dataclasses import replace

import pytest
from rich.console import Console as Terminal

from rtcd_jax.system.console import Console, Progress

NOW = Progress(
    generation=3,
    generations=60,
    best=123.4567,
    median=45.6,
    feasible=0.875,
    rate=512.3,
    elapsed=12.4,
    left=3725.0,
    failures={"TRAJECTORY_NOT_SOLVED": 3, "NOT_FINITE": 0, "FUNNEL_EMPTY": 13},
)
LINE = (
    "generation  3/60  best 123.46 (sampled)  median 45.6  feasible  88%  512 candidates/s  elapsed 0:12  left 1:02:05"
    "  failed: 3 trajectory_not_solved, 13 funnel_empty"
)


def test_plain_lines_into_a_file():
    stream = io.StringIO()
    with Console(stream) as console:
        console.message("compiling [1/2]")
        console.progress(NOW)
        console.progress(replace(NOW, generation=4, failures={}))
    first, second, third = stream.getvalue().splitlines()
    assert first == "compiling [1/2]"
    assert second == LINE
    assert third == LINE.replace(" 3/60", " 4/60").split("  failed")[0]


def test_a_line_reaches_the_file_at_once(tmp_path):
    path = tmp_path / "log"
    with path.open("w") as stream, Console(stream) as console:
        console.progress(NOW)
        assert path.read_text() == LINE + "\n"


def test_one_live_line_on_a_terminal():
    stream = io.StringIO()
    terminal = Terminal(file=stream, force_terminal=True, width=300, color_system=None)
    with Console(terminal=terminal) as console:
        for generation in (1, 2, 3):
            console.progress(replace(NOW, generation=generation))
        console.message("done")
    frames = stream.getvalue()
    assert frames.count("\n") < 6
    assert frames.index(" 1/60") < frames.index(" 3/60") < frames.index("done")
    assert "\x1b[2K" in frames, "the line is erased before it is drawn again"


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(0.4, "0:00"), (59.4, "0:59"), (59.6, "1:00"), (3599.6, "1:00:00"), (math.inf, "unknown"), (math.nan, "unknown")],
)
def test_durations(seconds, shown):
    assert f"left {shown}  failed" in str(replace(NOW, left=seconds))


def test_a_generation_that_compiled_says_nothing_of_the_others():
    assert "compiled  elapsed 0:12  left unknown" in str(replace(NOW, rate=math.nan, left=math.nan))


def test_nothing_feasible_yet():
    assert "best none (sampled)  median none  feasible   0%" in str(
        replace(NOW, best=math.nan, median=math.nan, feasible=0)
    )
