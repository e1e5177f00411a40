"""A real Slurm of one node for tests, as root on Debian: munged, slurmctld and slurmd in a folder of their own.

Two partitions: jobs in `low` are requeued, after ten seconds of grace, for those in `high`.
"""

import os
import secrets
import shutil
import socket
import subprocess
import time
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "scontrol")

# What a job ends in; SIGNALING, COMPLETING, REQUEUED and the like only pass.
ENDS = ("COMPLETED", "CANCELLED", "FAILED", "TIMEOUT", "DEADLINE", "NODE_FAIL", "BOOT_FAIL", "OUT_OF_MEMORY")

CONFIGURATION = """
ClusterName=rtcdtest
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
CryptoType=crypto/munge
AuthInfo=socket={folder}/munge.sock
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
KillWait=5
JobRequeue=1
PreemptType=preempt/partition_prio
PreemptMode=REQUEUE
SchedulerParameters=batch_sched_delay=0,sched_interval=1,bf_interval=1,requeue_delay=1
AccountingStorageType=accounting_storage/none
MpiDefault=none
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} SocketsPerBoard=1 CoresPerSocket={cores} RealMemory=1000
PartitionName=low Nodes=ALL Default=YES MaxTime=INFINITE State=UP PriorityTier=1 PreemptMode=REQUEUE GraceTime=30
PartitionName=high Nodes=ALL MaxTime=INFINITE State=UP PriorityTier=10 PreemptMode=OFF
"""


def missing() -> str:
    """Why there can be no Slurm here; empty if there can."""
    absent = [program for program in PROGRAMS if not shutil.which(program)]
    if absent:
        return f"no Slurm: {', '.join(absent)} not found (Debian: slurmctld, slurmd, slurm-client, munge)"
    return "" if os.geteuid() == 0 else "no Slurm: its daemons need root"


class Slurm:
    """The daemons, from entering to leaving; `environment` is what its commands need."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.environment = os.environ | {"SLURM_CONF": str(folder / "slurm.conf")}
        self._daemons: list[subprocess.Popen] = []

    def __enter__(self) -> "Slurm":
        for name in ("state", "spool"):
            (self.folder / name).mkdir(parents=True)
        key = self.folder / "munge.key"
        key.write_bytes(secrets.token_bytes(128))
        key.chmod(0o600)
        self.folder.chmod(0o755)
        told = {"host": socket.gethostname(), "folder": self.folder, "ports": _free_ports(), "cores": os.cpu_count()}
        (self.folder / "slurm.conf").write_text(CONFIGURATION.format(**told))
        (self.folder / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
        files = {"socket": "munge.sock", "pid-file": "munged.pid", "log-file": "munged.log", "seed-file": "munge.seed"}
        places = [f"--{option}={self.folder / name}" for option, name in files.items()]
        self._start("munged", "--foreground", "--force", f"--key-file={key}", *places)
        self._wait(lambda: (self.folder / "munge.sock").exists())
        self._start("slurmctld", "-D")
        self._start("slurmd", "-D")
        self._wait(lambda: "idle" in self.call("sinfo", "-h", "-o", "%T", check=False))
        return self

    def __exit__(self, *_: object) -> None:
        for daemon in reversed(self._daemons):
            daemon.terminate()
            daemon.wait(timeout=30)

    def call(self, *command, check: bool = True, **environment: str) -> str:
        """The output of one of Slurm's commands."""
        told = self.environment | environment
        done = subprocess.run([*map(str, command)], env=told, capture_output=True, text=True, check=False)
        assert done.returncode == 0 or not check, done.stdout + done.stderr
        return done.stdout.strip()

    def job(self, number: str) -> dict[str, str]:
        """What Slurm says of a job."""
        return dict(word.split("=", 1) for word in self.call("scontrol", "show", "job", number).split() if "=" in word)

    def ended(self, number: str, seconds: float = 300) -> dict[str, str]:
        """Waits for a job's end, however often it is requeued; a requeued job starts at once."""
        begun = time.monotonic()
        while (job := self.job(number))["JobState"] not in ENDS:
            if job["JobState"] == "PENDING" and job["Restarts"] != "0":
                self.call("scontrol", "update", f"JobId={number}", "StartTime=now", check=False)
            assert time.monotonic() - begun < seconds, job
            time.sleep(0.5)
        return job

    def _start(self, *command: str) -> None:
        with (self.folder / f"{command[0]}.out").open("w") as output:
            self._daemons.append(subprocess.Popen(command, env=self.environment, stdout=output, stderr=output))

    def _wait(self, ready) -> None:
        begun = time.monotonic()
        while not ready():
            outputs = "\n".join(path.read_text() for path in self.folder.glob("*.out"))
            assert time.monotonic() - begun < 60, outputs
            assert all(daemon.poll() is None for daemon in self._daemons), outputs
            time.sleep(0.2)


def _free_ports() -> list[int]:
    with socket.socket() as one, socket.socket() as other:
        for free in (one, other):
            free.bind(("127.0.0.1", 0))
        return [one.getsockname()[1], other.getsockname()[1]]
