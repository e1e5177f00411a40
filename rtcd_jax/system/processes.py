"""Processes that share out a task, and end with the process that began them, however that ends."""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import wait
from threading import Thread
from typing import Any

CONTEXT = multiprocessing.get_context("spawn")


@contextmanager
def processes(count: int, prepare: Callable[..., None] | None = None, *told: Any) -> Iterator[ProcessPoolExecutor]:
    """`count` processes, each of which first calls `prepare` with what it is told; what still waits is dropped."""
    with ProcessPoolExecutor(count, CONTEXT, _begin, (prepare, *told)) as pool:
        try:
            yield pool
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _begin(prepare: Callable[..., None] | None, *told: Any) -> None:
    Thread(target=_end_with_parent, daemon=True).start()
    if prepare is not None:
        prepare(*told)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
