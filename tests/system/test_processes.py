"""Worker processes end with their parent, though it be killed in the middle of their tasks."""

import os
import signal
import subprocess
import sys
import time

import pytest

from rtcd_jax.system.processes import processes

PARENT = """
import multiprocessing, time
from rtcd_jax.system.processes import processes

with processes(2) as pool:
    busy = [pool.submit(time.sleep, 60) for _ in range(2)]
    while not all(each.running() for each in busy):
        time.sleep(0.01)
    print(*(child.pid for child in multiprocessing.active_children()), flush=True)
    busy[0].result()
"""


def runs(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="looks for processes in /proc")
@pytest.mark.parametrize("sign", [signal.SIGKILL, signal.SIGTERM])
def test_workers_end_with_a_killed_parent(sign):
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        workers = parent.stdout.readline().split()
        assert len(workers) == 2
        time.sleep(0.5)
        assert all(map(runs, workers))
        parent.send_signal(sign)
        parent.wait()
        ends = time.monotonic() + 10
        while any(map(runs, workers)) and time.monotonic() < ends:
            time.sleep(0.05)
        assert not any(map(runs, workers))


def test_a_process_that_leaves_at_once_leaves_no_word_of_its_queues():
    leaves = "import os; from rtcd_jax.system.processes import CONTEXT; steps = CONTEXT.Queue(); os._exit(85)"
    done = subprocess.run([sys.executable, "-c", leaves], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (85, "", "")


def test_every_worker_is_prepared():
    with processes(2, os.putenv, "RTCD_PREPARED", "1") as pool:
        assert list(pool.map(abs, [-1, 2])) == [1, 2]
