"""What JAX's compilation shows: a line every ten seconds, and no banner of XLA's."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread, get_ident

from rtcd_jax.system.console import WAITING, Console, duration

PATIENCE = 60.0
"""Seconds of compilation from which on XLA's banner is waited for, which comes after 120."""
_COMPILES = "/jax/core/compile/backend_compile_duration"
_TICK = 1.0
_DRAINED = 1.0


@contextlib.contextmanager
def announced(console: Console, every: float = WAITING, patience: float = PATIENCE) -> Iterator[None]:
    """Around all that may compile, in any thread: while a program does, and nothing else is said, so many seconds after
    another `console` says for how long.

    Programs that compile for more than `patience` [s] do so without XLA's banner.
    """
    from jax import monitoring

    begun: dict[int, float] = {}  # by threads

    def begin(event: str, value: float, **kwargs: str | int) -> None:
        if event == _COMPILES:
            begun[get_ident()] = time.monotonic()

    def end(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == _COMPILES:
            begun.pop(get_ident(), None)

    def watch() -> None:
        with contextlib.ExitStack() as filtered:
            first, waiting = time.monotonic(), False
            while not over.wait(min(_TICK, every, patience)):
                now = time.monotonic()
                first = min([first, *begun.values()]) if begun else now
                if now - max(first, console.spoken) >= every:
                    console.message(f"compiling  elapsed {duration(now - first)}")
                if (now - first >= patience) != waiting:
                    waiting = not waiting
                    filtered.close()
                    if waiting:
                        filtered.enter_context(bannerless_stderr())

    over, watcher = Event(), Thread(target=watch, daemon=True)
    monitoring.register_scalar_listener(begin)
    monitoring.register_event_duration_secs_listener(end)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        monitoring.unregister_scalar_listener(begin)
        monitoring.unregister_event_duration_listener(end)
        watcher.join()


@contextlib.contextmanager
def bannerless_stderr() -> Iterator[None]:
    """Lets all that this process writes to file descriptor 2 go through a process of its own, which leaves out XLA's
    banner. It ends with the last process that writes to it, and shows what a crash or `os._exit` left behind.
    """
    with contextlib.ExitStack() as stack:
        stderr = os.dup(2)
        stack.callback(os.close, stderr)
        command = [sys.executable, "-I", "-S", str(Path(__file__).with_name("banner.py"))]
        try:
            # In a group of its own: Ctrl-C is not for it.
            reader = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stderr, stderr=stderr, process_group=0)
        except OSError:  # no memory for another process: then with the banner
            yield
            return
        assert reader.stdin is not None
        with reader.stdin as pipe:
            os.dup2(pipe.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            with contextlib.suppress(subprocess.TimeoutExpired):  # a worker may still hold its end
                reader.wait(_DRAINED)
