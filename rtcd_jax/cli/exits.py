"""How a command ends: its exit codes, one line for whatever stopped it, interrupts, and streams that are closed.

A command ends within two seconds of Ctrl-C wherever it is: first KeyboardInterrupt unwinds the main thread; if that is
inside XLA, or the exception got lost in a callback, a watching thread ends the process. That tears nothing that is
written: files are replaced as a whole, JSON lines are cut back to their last whole one, and orbax commits by a rename.
"""

import contextlib
import enum
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor
from typing import NoReturn, Self

from rtcd_jax.system.errors import UserError, printable, printable_lines
from rtcd_jax.system.processes import end_workers

GRACE = 1.0
"""Seconds that the main thread has to end by itself once it is interrupted."""
_LONGEST = 400
STOPPED = "stopped; run the same command to go on"
_SHOW_CURSOR = b"\x1b[?25h"
_interrupted, _explained = threading.Event(), threading.Event()


class Exit(enum.IntEnum):
    """Exit codes, each with what it says."""

    meaning: str

    def __new__(cls, code: int, meaning: str) -> Self:
        member = int.__new__(cls, code)
        member._value_ = code
        member.meaning = meaning
        return member

    OK = 0, "done"
    REFUTED = 1, "a promise is refuted"
    WRONG_INPUT = 2, "the input is wrong, the line says what is right"
    BUG = 70, "an unexpected error; --debug shows the traceback"
    LOST_PROCESS = 75, "another process of the run has ended; the same command goes on"
    PREEMPTED = 85, "asked to stop (SIGTERM); all is saved, the same command goes on"
    INTERRUPTED = 130, "interrupted (Ctrl-C); the same command goes on"
    CUT_OFF = 141, "the output is closed"


class Terminated(Exception):
    """SIGTERM, between two steps that are kept."""


@contextlib.contextmanager
def heeding_sigterm() -> Iterator[None]:
    """SIGTERM raises Terminated meanwhile: for work of which a journal keeps every finished part."""

    def end(*_: object) -> NoReturn:
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def explain(error: BaseException, debug: bool = False) -> Exit:
    """Says in one line on stderr what ended a command, with the traceback before it if asked to; the exit code."""
    if _interrupted.is_set():  # whatever a library has made of it
        error = KeyboardInterrupt()
    if debug and not isinstance(error, BrokenPipeError):
        say("".join(traceback.format_exception(error)).rstrip())
    match error:
        case UserError():
            say(f"rtcd: {error}")
            return Exit.WRONG_INPUT
        case BrokenPipeError():  # the reader, say `head`, has had enough
            return Exit.CUT_OFF
        case OSError():  # no bug's: a path that may not be read, a disk that is full
            where = f"{error.filename}: " if error.filename else ""
            say(f"rtcd: {where}{error.strerror or error}")
            return Exit.WRONG_INPUT
        case BrokenExecutor():
            say("rtcd: a worker process was ended from outside, for want of memory perhaps: try fewer")
            return Exit.LOST_PROCESS
        case Terminated():
            say("asked to stop (SIGTERM): what is finished is kept; the same command goes on")
            return Exit.PREEMPTED
        case KeyboardInterrupt():
            _explained.set()
            say(STOPPED)
            return Exit.INTERRUPTED
    if _about_devices(error):
        say(f"rtcd: JAX_PLATFORMS = {os.environ.get('JAX_PLATFORMS', '')}: no such device here; unset it, or use cpu")
        return Exit.WRONG_INPUT
    reason = printable(f"{type(error).__name__}: {error}".rstrip(": "), _LONGEST)
    say(f"rtcd: unexpected error: {reason}" + ("" if debug else "; run again with --debug for the traceback"))
    return Exit.BUG


def _about_devices(error: BaseException) -> bool:
    """Whether JAX did not get the devices of JAX_PLATFORMS: its own code raised, sometimes a bare AssertionError."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames and os.environ.get("JAX_PLATFORMS")) and frames[-1].filename.endswith("xla_bridge.py")


def say(text: str) -> None:
    """Lines on stderr, printable whatever they quote; nothing where the stream is closed."""
    with contextlib.suppress(OSError, ValueError):
        print(printable_lines(text), file=sys.stderr, flush=True)


def _leave(code: int) -> NoReturn:
    """Ends this process at once: waits neither for what its devices and threads still compute nor for others."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    end_workers()
    os._exit(code)


def as_process(command: Callable[[], int]) -> int:
    """Runs a command as all that this process does; returns its exit code, or leaves with that of an early end.

    Streams take what they can show and are there even if they were closed; an interrupt is heeded wherever it arrives.
    """
    _open_streams()
    _watch_interrupts()
    try:
        code = command()
        sys.stdout.flush()
        if _interrupted.is_set() and not _explained.is_set():  # and the exception was lost
            code = explain(KeyboardInterrupt())
    except BrokenPipeError:
        code = Exit.CUT_OFF
    except KeyboardInterrupt as error:  # behind the command's own last line
        code = explain(error)
    if code in (Exit.OK, Exit.REFUTED):
        return code
    _leave(code)


def _open_streams() -> None:
    """stdin, stdout and stderr, on the null device where the caller has closed one, so that no file gets its number."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number, which is this one
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 (open until the process ends)
        getattr(sys, name).reconfigure(errors="backslashreplace")


def _watch_interrupts() -> None:
    """From now on a SIGINT ends this process soon, whatever its main thread is in.

    Python's own handler waits for the main thread; the system's writes to a pipe at once, on which a thread waits.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:  # ignored, as a shell's background jobs do
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, _interrupt)
    threading.Thread(target=_end_after_interrupt, args=(reading,), daemon=True).start()
    show = sys.unraisablehook
    sys.unraisablehook = lambda lost: None if isinstance(lost.exc_value, KeyboardInterrupt) else show(lost)


def _interrupt(*_: object) -> NoReturn:
    _interrupted.set()
    raise KeyboardInterrupt


def _end_after_interrupt(pipe: int) -> NoReturn:
    while signal.SIGINT not in os.read(pipe, 64):
        pass
    if not _explained.wait(GRACE):
        # Past Python's buffers, whose locks the main thread may hold.
        with contextlib.suppress(OSError):
            os.write(2, f"{STOPPED}\n".encode())
            if os.isatty(1):
                os.write(1, _SHOW_CURSOR)
        end_workers()
    else:
        time.sleep(GRACE)
    os._exit(Exit.INTERRUPTED)
