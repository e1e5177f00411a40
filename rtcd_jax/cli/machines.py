"""The options of commands that run on many devices or processes."""

from dataclasses import dataclass
from typing import Annotated

from rtcd_jax.cli.checks import optional, require_at_least
from rtcd_jax.system.errors import UserError

_UNDER_SRUN = "as srun or mpirun say"


@dataclass(frozen=True)
class Machines:
    """The devices of this process, and the other processes of its run."""

    devices: Annotated[int | None, optional("INT", "devices to use of those each process sees [-]", "all")] = None
    cpu_devices: Annotated[int | None, optional("INT", "parts the CPU is split into [-]", "its cores")] = None
    cache: Annotated[str | None, optional("DIR", "of compiled programs, '' for none", "~/.cache/rtcd_jax/xla")] = None
    coordinator: Annotated[str | None, optional("HOST:PORT", "where process 0 listens", _UNDER_SRUN)] = None
    num_processes: Annotated[int | None, optional("INT", "processes of this run [-]", _UNDER_SRUN)] = None
    process_id: Annotated[int | None, optional("INT", "this one's number, from 0 [-]", _UNDER_SRUN)] = None

    def require_sense(self) -> None:
        """Raises `UserError` unless all of coordinator, number and id are given, or none, and all are in range."""
        require_at_least(self, devices=1, cpu_devices=1, num_processes=1, process_id=0)
        together = ("coordinator", "num_processes", "process_id")
        missing = [f"--{name}" for name in together if getattr(self, name) is None]
        if 0 < len(missing) < len(together):
            raise UserError(
                f"{', '.join(missing)}: must be given too; a process needs all of --{', --'.join(together)}"
            )
        if self.num_processes is not None and self.process_id is not None and self.process_id >= self.num_processes:
            raise UserError(f"--process_id = {self.process_id}: must be < --num_processes = {self.num_processes}")
