"""What compilation shows: a line when nothing else is said for long, and XLA's errors without its banner."""

import io
import os
import re
import signal
import subprocess
import sys
import threading
import time

import jax
import jax.numpy as jnp
import pytest

from rtcd_jax.system.banner import without_banners
from rtcd_jax.system.compilation import announced, bannerless_stderr
from rtcd_jax.system.console import Console
from tests.paths import ROOT

STARS = "*" * 32
HINT = "If you want to file a bug, run with envvar XLA_FLAGS=--xla_dump_to=/tmp/foo and attach the results."
BANNER = f"""\
E1129 06:48:01.637219    9663 slow_operation_alarm.cc:73]{" "}
{STARS}
[Compiling module jit_f for CPU] Very slow compile? {HINT}
{STARS}
"""
"""As jaxlib 0.10.2 logs it while a program compiles, and once more when it is compiled."""
OVER = f"""\
E1129 06:50:14.406467    9658 slow_operation_alarm.cc:140] The operation took 4m12.769382563s

{STARS}
[Compiling module jit_f for CPU] Very slow compile? {HINT}
{STARS}
"""
ERROR = "E1129 06:50:14.406467    9658 cpu_compiler.cc:140] no such register\n"
FOLDING = """\
E1129 06:48:01.637219    9663 slow_operation_alarm.cc:73] Constant folding an instruction is taking > 1s:

  reduce.4
E1129 06:48:04.637219    9663 slow_operation_alarm.cc:140] The operation took 2.5s
Constant folding an instruction is taking > 1s:
"""


def filtered(text):
    return b"".join(without_banners(text.encode().splitlines(keepends=True))).decode()


@pytest.mark.parametrize("banner", [BANNER, OVER, BANNER + OVER, BANNER.replace("[Compiling", "a\n[Compiling")])
def test_the_banner_is_left_out_and_all_else_stays(banner):
    around = f"before\n{STARS}\n", f"{ERROR}{STARS}\nbehind\n{STARS}\nwithout an end"
    assert filtered(around[0] + banner + around[1]) == "".join(around)


@pytest.mark.parametrize(
    "text",
    [
        "",
        FOLDING,
        BANNER.splitlines()[0],
        BANNER[: BANNER.index("Very")],
        BANNER.replace(f"\n{STARS}\n", "\n", 1),
        BANNER.splitlines()[0] + "\n" + STARS + "\n" + 20 * "no end\n",
        BANNER.replace("slow_operation_alarm", "other"),
        f"{STARS}\nmine\n{STARS}\n",
    ],
)
def test_what_only_looks_like_it_stays(text):
    assert filtered(text) == text


def test_a_banner_that_breaks_off_hides_nothing_of_the_next():
    head = BANNER.splitlines(keepends=True)[0]
    assert filtered(head + ERROR + BANNER + "end\n") == head + ERROR + "end\n"


PROGRAM = f"""
import faulthandler, os, signal, subprocess, sys, time
from rtcd_jax.system.compilation import bannerless_stderr
faulthandler.enable()
with bannerless_stderr():
    os.write(2, {BANNER.encode()!r})
    os.write(2, {ERROR.encode()!r})
    sys.stderr.write("not yet "); sys.stderr.flush()
    time.sleep(0.5)
    print("begun", flush=True)
    exec(sys.argv[1])
    os.write(2, {OVER.encode()!r})
print("behind", file=sys.stderr)
"""
ENDS = {
    "end": ("pass", 0, r"behind\n"),
    "os._exit": ("os._exit(3)", 3, ""),
    "an exception": ("1 / 0", 1, r"Traceback (.*\n)*ZeroDivisionError: division by zero\n"),
    "abort": ("os.write(2, b'F1129 check.cc:1] failed\\n'); os.abort()", -signal.SIGABRT,
              r"F1129 check.cc:1\] failed\nFatal Python error: Aborted\n(.*\n)*"),
    "segmentation fault": ("import ctypes; ctypes.string_at(0)", -signal.SIGSEGV,
                           r"Fatal Python error: Segmentation fault\n(.*\n)*"),
    "interrupt": ("os.killpg(0, signal.SIGINT); time.sleep(60)", -signal.SIGINT,
                  r"Traceback (.*\n)*KeyboardInterrupt\n"),
    "another process": ("subprocess.run(['sh', '-c', 'echo child >&2'])", 0, r"child\nbehind\n"),
    "one that stays": ("subprocess.Popen(['sleep', '5'], stdout=subprocess.DEVNULL)", 0, r"behind\n"),
    "killed": ("os.kill(os.getpid(), signal.SIGKILL)", -signal.SIGKILL, ""),
}  # fmt: skip


@pytest.mark.parametrize("case", ENDS)
def test_however_a_process_ends_all_but_the_banner_is_shown(case):
    act, code, shown = ENDS[case]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, act],
        cwd=ROOT, capture_output=True, text=True, start_new_session=True, timeout=60,
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    assert re.fullmatch(re.escape(ERROR) + "not yet " + shown, done.stderr), done.stderr


def test_where_no_process_can_be_started_the_banner_is_shown(monkeypatch, capfd):
    monkeypatch.setattr(sys, "executable", "/nowhere")
    with bannerless_stderr():
        os.write(2, BANNER.encode())
    assert capfd.readouterr().err == BANNER


def compiled(length):
    """Compiles a program of so many operations that no cache has."""

    def chain(x):
        for k in range(length):
            x = jnp.sin(x @ x.T + k) + jnp.cumsum(x, axis=0)[::-1] + compiled.seed
        return x

    compiled.seed = time.time()
    return jax.jit(chain).lower(jnp.ones((3, 3))).compile()


def test_a_program_that_compiles_for_long_is_told_with_the_time():
    told = io.StringIO()
    with announced(Console(told), every=0.02, patience=0.05):
        compiled(40)
    assert re.fullmatch(r"(compiling  elapsed 0:\d\d\n)+", told.getvalue())


def test_nothing_is_told_where_something_else_is_or_nothing_compiles():
    told = io.StringIO()
    console = Console(told)
    with announced(console, every=5.0):
        compiled(10)
    with announced(console, every=0.01):
        time.sleep(0.1)
    assert not told.getvalue()


@pytest.mark.thorough
def test_the_banner_is_awaited_as_long_as_a_program_compiles(capfd):
    """What stands at descriptor 2 is another file then, and the same one before and behind."""

    def place():
        return os.fstat(2).st_ino, os.fstat(2).st_dev

    seen, over, mine = set(), threading.Event(), place()

    def look():
        while not over.wait(0.002):
            seen.add(place())

    looking = threading.Thread(target=look)
    with announced(Console(io.StringIO()), every=5.0, patience=0.05):
        looking.start()
        compiled(80)
        over.set()
        looking.join()
    assert place() == mine
    assert len(seen - {mine}) == 1
