"""Processes that share out a task, and end with the process that began them, however that ends.

Ctrl-C reaches the whole terminal: they leave it to the process that began them.
"""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import wait
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.queues import Queue
from threading import Thread
from typing import Any


class _Worker(SpawnProcess):
    def start(self) -> None:
        """With SIGINT blocked from its first instruction on: what is blocked is inherited."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


_TIDY = "ignore:resource_tracker:UserWarning"


def _leave_tidying() -> None:
    """multiprocessing's own tidying process, which the first queue or pool begins, would count on stderr what a process
    that leaves at once has left to it.
    """
    warnings = os.environ.get("PYTHONWARNINGS", "")
    if _TIDY not in warnings:
        os.environ["PYTHONWARNINGS"] = f"{warnings},{_TIDY}".lstrip(",")


class _Context(SpawnContext):
    Process = _Worker

    def Queue(self, maxsize: int = 0) -> Queue:
        _leave_tidying()
        return super().Queue(maxsize)


CONTEXT = _Context()


@contextmanager
def processes(count: int, prepare: Callable[..., None] | None = None, *arguments: Any) -> Iterator[ProcessPoolExecutor]:
    """`count` processes, each of which first calls `prepare(*arguments)`; at the end, tasks that wait are dropped."""
    _leave_tidying()
    with ProcessPoolExecutor(count, CONTEXT, _begin, (prepare, *arguments)) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _begin(prepare: Callable[..., None] | None, *arguments: Any) -> None:
    Thread(target=_end_with_parent, daemon=True).start()
    if prepare is not None:
        prepare(*arguments)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def end_workers() -> None:
    """Ends those that this process has begun; for a process that ends at once and waits for none."""
    for worker in multiprocessing.active_children():
        worker.kill()
