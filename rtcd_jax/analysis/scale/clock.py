"""Wall and CPU time of a call, and this process' memory."""

import resource
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Timed:
    """One call: wall clock and CPU time of all threads [s]."""

    wall: float
    cpu: float


def timed(call: Callable[[], Any]) -> tuple[Any, Timed]:
    wall, cpu = time.perf_counter(), time.process_time()
    value = call()
    return value, Timed(time.perf_counter() - wall, time.process_time() - cpu)


def peak_memory() -> int:
    """Largest resident size of this process so far [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
