"""The launch scripts on a real Slurm: preempted, requeued, resumed, and the same result as without all that."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rtcd_jax.certificate import check
from rtcd_jax.elite.records import write_elite
from tests.certificate import swing
from tests.certificate.folder import folder_with
from tests.paths import ROOT
from tests.run import slurm
from tests.run.test_folder import driver, end, results

pytestmark = pytest.mark.skipif(bool(slurm.missing()), reason=slurm.missing())


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    with slurm.Slurm(tmp_path_factory.mktemp("slurm")) as running:
        yield running


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run"
    output = end(driver(path, "joint"))
    assert output.endswith("done\n"), output
    return results(path)


def submitted(cluster, folder: Path, tasks: int, seconds: float) -> str:
    """A job that runs tests/killable.py in the place of rtcd, through launch/slurm/run.sh; its number."""
    rtcd = folder / "rtcd"
    rtcd.write_text(f'#!/bin/sh\nexec "{sys.executable}" -u -m tests.run.killable "$@"\n')
    rtcd.chmod(0o755)
    script = folder / "job.sbatch"
    script.write_text(f"#!/bin/bash\nexec launch/slurm/run.sh {folder}/run joint {seconds}\n")
    options = ["--requeue", "--open-mode=append", f"--ntasks={tasks}", "--overcommit", "--signal=TERM@60"]
    places = [f"--chdir={ROOT}", f"--output={folder}/job.out", "--parsable", "--partition=low"]
    return cluster.call("sbatch", *options, *places, script, RTCD=str(rtcd), PYTHONPATH=str(ROOT))


def reached(folder: Path, generation: int) -> None:
    """Waits for a generation's line in the job's output."""
    begun = time.monotonic()
    output = folder / "job.out"
    while not output.exists() or f"generation {generation}\n" not in output.read_text():
        assert time.monotonic() - begun < 120, output.read_text() if output.exists() else "no output"
        time.sleep(0.1)


@pytest.mark.thorough
@pytest.mark.parametrize("tasks", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_a_preempted_job_is_requeued_and_ends_with_the_same_bytes(cluster, whole, tmp_path, tasks):
    number = submitted(cluster, tmp_path, tasks, seconds=0.5)
    reached(tmp_path, 4)
    urgent = cluster.call(
        "sbatch", "--parsable", "--partition=high", "--exclusive", "--output=/dev/null", "--wrap=sleep 1"
    )
    job = cluster.ended(number)
    output = (tmp_path / "job.out").read_text()
    assert (job["JobState"], job["Restarts"]) == ("COMPLETED", "1"), output
    assert cluster.ended(urgent)["JobState"] == "COMPLETED"
    (saved,) = set(re.findall(r"^preempted (\d+)$", output, re.MULTILINE))
    assert 4 < int(saved) < 24
    assert re.findall(r"^from (\d+)$", output, re.MULTILINE) == ["0"] * tasks + [saved] * tasks
    assert results(tmp_path / "run") == whole


@pytest.mark.slow
def test_a_cancelled_job_does_not_come_back(cluster, tmp_path):
    number = submitted(cluster, tmp_path, 1, seconds=0.5)
    reached(tmp_path, 3)
    cluster.call("scancel", number)
    assert cluster.ended(number)["JobState"] == "CANCELLED"
    assert "preempted" in (tmp_path / "job.out").read_text()
    time.sleep(3)
    assert cluster.job(number)["JobState"] == "CANCELLED"


def test_every_script_hands_its_arguments_to_rtcd(cluster, tmp_path):
    """With the nodes, tasks and GPUs of this one node in the place of theirs."""
    rtcd = tmp_path / "rtcd"
    rtcd.write_text('#!/bin/sh\necho "called: $*"\n')
    rtcd.chmod(0o755)
    small = ["--nodes=1", "--ntasks=1", "--ntasks-per-node=1", "--cpus-per-task=1", "--gpus-per-node=0", "--time=5"]
    for name in ("cpu", "gpu", "gpus"):
        output = tmp_path / f"{name}.out"
        number = cluster.call(
            "sbatch", *small, "--parsable", f"--chdir={ROOT}", f"--output={output}",
            f"launch/slurm/{name}.sbatch", "configs/smoke.yaml", "--run", "somewhere", RTCD=str(rtcd),
        )  # fmt: skip
        assert cluster.ended(number)["JobState"] == "COMPLETED", output.read_text()
        assert output.read_text().splitlines()[-1] == "called: optimize configs/smoke.yaml --run somewhere"
    output = tmp_path / "array.out"
    number = cluster.call(
        "sbatch", *small, "--array=3", "--parsable", f"--chdir={ROOT}", f"--output={output}",
        "launch/slurm/array.sbatch", "configs/sweep.yaml", RTCD=str(rtcd),
    )  # fmt: skip
    assert cluster.ended(f"{number}_3")["JobState"] == "COMPLETED", output.read_text()
    assert output.read_text().splitlines()[-1] == "called: sweep configs/sweep.yaml --case 3"
    number = cluster.call(
        "sbatch", *small, "--array=2", "--parsable", f"--chdir={ROOT}", f"--output={output}",
        "launch/slurm/certify.sbatch", "checkpoints/x", "--optimize_value", RTCD=str(rtcd),
    )  # fmt: skip
    assert cluster.ended(f"{number}_2")["JobState"] == "COMPLETED", output.read_text()
    called = "called: certify checkpoints/x --optimize_value --elite 2 --workers 1"
    assert output.read_text().splitlines()[-1] == called


@pytest.mark.slow
def test_proofs_over_an_array_are_stopped_and_go_on(cluster, tmp_path):
    """Two elites, a task each, on one run folder; the system stops both once, in their proofs' first intervals."""
    run, elites = tmp_path / "run", 2
    arrays, record = swing.elite()
    folder_with(run, arrays, record)
    write_elite(run / "elites", "001", {**arrays, "rho": arrays["rho"] / 2}, {"status": "OK", **record})
    rtcd = tmp_path / "rtcd"
    rtcd.write_text(f'#!/bin/sh\nexec "{sys.executable}" -u -m rtcd_jax "$@"\n')
    rtcd.chmod(0o755)
    number = cluster.call(
        "sbatch", "--array=0-1", "--parsable", "--time=10", "--oversubscribe", f"--chdir={ROOT}", "--partition=low",
        f"--output={tmp_path}/%a.out", "launch/slurm/certify.sbatch", run, RTCD=str(rtcd), PYTHONPATH=str(ROOT),
    )  # fmt: skip
    journals = [run / "certificates" / f".00{k}.partial.jsonl" for k in range(elites)]
    begun = time.monotonic()
    while not any(journal.exists() and b'"stretch"' in journal.read_bytes() for journal in journals):
        assert time.monotonic() - begun < 300, [path.read_text() for path in tmp_path.glob("*.out")]
        time.sleep(0.05)
    cluster.call("scancel", "--signal=TERM", number)
    jobs = [cluster.ended(f"{number}_{k}", seconds=300) for k in range(elites)]
    outputs = [(tmp_path / f"{k}.out").read_text() for k in range(elites)]
    assert [job["JobState"] for job in jobs] == ["COMPLETED"] * elites, (jobs, outputs)
    assert "1" in {job["Restarts"] for job in jobs}, outputs
    assert "asked to stop (SIGTERM): what is finished is kept" in "".join(outputs)
    for k in range(elites):
        check.check_file(run / "certificates" / f"00{k}.json")
    summary = json.loads((run / "certificates" / "summary.json").read_text())
    assert summary.keys() == {"000", "001"}
    written = [(run / "certificates" / f"00{k}.json").read_bytes() for k in range(elites)]
    done = subprocess.run([rtcd, "certify", run, "--elites", "2"], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("before") == elites, done.stdout
    assert [(run / "certificates" / f"00{k}.json").read_bytes() for k in range(elites)] == written
    assert json.loads((run / "certificates" / "summary.json").read_text()) == summary


def test_a_workstation_run_goes_on_in_the_background(tmp_path):
    (tmp_path / "rtcd").write_text('#!/bin/sh\necho "called: $*"\n')
    (tmp_path / "rtcd").chmod(0o755)
    command = [ROOT / "launch" / "local.sh", "a.yaml", "--run", "b"]
    told = os.environ | {"RTCD": str(tmp_path / "rtcd")}
    done = subprocess.run(command, cwd=tmp_path, env=told, capture_output=True, text=True, check=True)
    assert re.match(r"process \d+, output in rtcd.log", done.stdout)
    begun = time.monotonic()
    while "called: optimize a.yaml --run b\n" not in (tmp_path / "rtcd.log").read_text():
        assert time.monotonic() - begun < 10
        time.sleep(0.05)
