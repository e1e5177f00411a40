"""How a process ends when it is sent a signal: what it still says, and the processor time it still takes."""

import os
import resource
import signal
import subprocess
import time
from pathlib import Path

import pytest

SECONDS = {signal.SIGINT: 2.0, signal.SIGTERM: 10.0}
"""Within which a command promises to end: SIGTERM saves first, and Slurm waits for 30 s."""
PATIENCE = 120.0
"""Seconds of a loaded machine's clock after which a process counts as hanging."""


def stop(process: subprocess.Popen, number: signal.Signals, send=os.kill) -> tuple[str | None, str | None]:
    """Sends the signal; what the process still wrote.

    It must end within its `SECONDS` by its own clock: other processes' load slows it down and takes none of its
    processor time, of which it can use no more than that on every core. One that sleeps on is found by the wall clock.
    """
    if not Path("/proc/self/stat").exists():
        pytest.skip("reads processor times in /proc")
    earlier = _seconds(resource.getrusage(resource.RUSAGE_CHILDREN))
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    before = sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")
    send(process.pid, number)
    begun = time.monotonic()
    told = process.communicate(timeout=PATIENCE)
    wall = time.monotonic() - begun
    used = _seconds(resource.getrusage(resource.RUSAGE_CHILDREN)) - earlier - before
    allowed = SECONDS[number] * len(os.sched_getaffinity(0))
    assert wall <= SECONDS[number] or used <= allowed, f"took {used:.1f} s of processor time and {wall:.1f} s to end"
    return told


def _seconds(usage: resource.struct_rusage) -> float:
    return usage.ru_utime + usage.ru_stime
