"""Several processes on JAX's own runtime: one result, whoever is killed or asked to stop, and however it goes on."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys

import pytest

from rtcd_jax.cli.exits import Exit
from tests.paths import ROOT
from tests.run.small import Small
from tests.run.test_folder import driver, end, results
from tests.run.test_optimize import contents

SLOWLY = 0.5
"""Seconds of a generation: a signal to one process takes some time to reach all."""


def start(path, seconds=0.0, devices=1, processes=2, last_saves=(0, 0)):
    """The processes of one run, talking over the loopback; killable.py explains the words."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [str(word) for word in (path, "joint", seconds, devices, port, processes)]
    return [
        subprocess.Popen(
            [sys.executable, "-m", "tests.run.killable", *words, str(index), str(last_saves[index])],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for index in range(processes)
    ]


def after(process, generation):
    """Waits for a generation's line."""
    for line in process.stdout:
        if line == f"generation {generation}\n":
            return
    raise AssertionError(f"it ended before generation {generation}")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Results of an uninterrupted run of one process on one device."""
    path = tmp_path_factory.mktemp("whole") / "run"
    output = end(driver(path, "joint"))
    assert output.endswith("done\n"), output
    return results(path)


def finished_by_one(path, devices):
    output = end(driver(path, "joint", 0.0, devices))
    assert output.endswith("done\n"), output
    return int(re.search(r"^from (\d+)$", output, re.MULTILINE).group(1))


@pytest.mark.thorough
def test_two_processes_end_with_the_bytes_of_one(tmp_path, whole):
    outputs = [end(process) for process in start(tmp_path / "run")]
    assert all(output.endswith("done\n") for output in outputs), outputs
    assert results(tmp_path / "run") == whole


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("mpirun") is None, reason="needs Open MPI's mpirun")
def test_mpirun_tells_its_processes_by_itself(tmp_path, whole):
    words = [sys.executable, "-m", "tests.run.killable", str(tmp_path / "run"), "joint", "0"]
    root = {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    command = ["mpirun", "--oversubscribe", "-n", "2", *words]
    found = subprocess.run(command, cwd=ROOT, env={**os.environ, **root}, capture_output=True, text=True, timeout=300)
    assert found.stdout.count("done\n") == 2, found.stdout + found.stderr
    assert results(tmp_path / "run") == whole


@pytest.mark.thorough
@pytest.mark.parametrize("victim", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_if_one_is_killed_the_other_ends_soon_and_the_run_goes_on_exactly(tmp_path, whole, victim):
    """Process 0 holds the others together: without it they may be ended by JAX's runtime itself."""
    processes = start(tmp_path / "run", SLOWLY)
    after(processes[victim], 4)
    processes[victim].kill()
    output = end(processes[1 - victim])
    ends = {1: (Exit.LOST_PROCESS,), 0: (Exit.LOST_PROCESS, -signal.SIGABRT)}[victim]
    assert processes[1 - victim].returncode in ends, output
    assert "lost another process of this run" in output or "another task died" in output
    end(processes[victim])
    again = [end(process) for process in start(tmp_path / "run")]
    assert all(output.endswith("done\n") for output in again), again
    assert results(tmp_path / "run") == whole


@pytest.mark.thorough
def test_if_one_ends_while_a_state_is_saved_it_is_a_lost_process_and_no_damaged_disk(tmp_path):
    processes = start(tmp_path / "run", SLOWLY, last_saves=(0, 3))
    output = end(processes[0])
    end(processes[1])
    assert processes[0].returncode == Exit.LOST_PROCESS, output
    assert "lost another process of this run" in output


@pytest.mark.thorough
@pytest.mark.parametrize("devices", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_asked_to_stop_both_save_and_leave_and_one_process_goes_on_exactly(tmp_path, whole, devices):
    """On one device, or on four."""
    processes = start(tmp_path / "run", SLOWLY)
    after(processes[1], 4)
    processes[1].send_signal(signal.SIGTERM)
    outputs = [end(process) for process in processes]
    assert [process.returncode for process in processes] == [Exit.PREEMPTED, Exit.PREEMPTED], outputs
    (done,) = {int(re.search(r"^preempted (\d+)$", output, re.MULTILINE).group(1)) for output in outputs}
    assert 4 < done < 24
    assert finished_by_one(tmp_path / "run", devices) == done
    assert results(tmp_path / "run") == whole


@pytest.mark.slow
def test_asked_to_stop_a_process_alone_saves_and_leaves(tmp_path, whole):
    process = driver(tmp_path / "run", "joint", SLOWLY)
    after(process, 3)
    process.send_signal(signal.SIGTERM)
    output = end(process)
    assert process.returncode == Exit.PREEMPTED, output
    done = int(re.search(r"^preempted (\d+)$", output, re.MULTILINE).group(1))
    assert finished_by_one(tmp_path / "run", 2) == done
    assert results(tmp_path / "run") == whole


@pytest.mark.slow
def test_processes_with_different_configurations_are_refused(tmp_path):
    processes = start(tmp_path / "run")
    other = [*processes[1].args[:4], "nested", *processes[1].args[5:]]
    processes[1].kill()
    processes[1].communicate()
    processes[1] = subprocess.Popen(other, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    outputs = [end(process) for process in processes]
    assert all("started with different values of: configuration" in output for output in outputs), outputs


@pytest.mark.slow
def test_a_real_run_of_two_processes_ends_with_the_bytes_of_two_devices(tmp_path):
    small = Small(tmp_path)
    code, output, errors = small.optimize(tmp_path / "devices", "--cpu_devices", 2)
    assert code == 0, output + errors
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    shared = ("--coordinator", f"127.0.0.1:{port}", "--num_processes", 2, "--cpu_devices", 1)
    words = (small.config, "--run", tmp_path / "processes", *shared)
    processes = [small.start("optimize", *words, "--process_id", index) for index in range(2)]
    outputs = [process.communicate(timeout=600) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    assert "on 2 cpu devices of 2 processes" in outputs[0][0]
    assert "generation" not in outputs[1][0]
    assert contents(tmp_path / "processes") == contents(tmp_path / "devices")
