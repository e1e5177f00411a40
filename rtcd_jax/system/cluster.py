"""The devices and processes of a run: one mesh `candidates` over all of them, on JAX's own distributed runtime.

Nothing else mentions devices. Every process holds the same search state and takes the same decisions; whatever could
differ between two machines (a clock, a signal, the last bits of an eigenvector) is process 0's, sent to the others.
"""

import contextlib
import os
import signal
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, final

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from rtcd_jax.system.devices import memory_of, require_devices
from rtcd_jax.system.errors import UserError

HEARTBEAT = 30
"""Seconds after which a process that is no longer heard of counts as lost."""
POLL = 0.1
"""Seconds between two looks at whether a process alone was asked to stop."""
SPLIT, WHOLE = PartitionSpec("candidates"), PartitionSpec()

Value = TypeVar("Value")


def initialize(coordinator: str | None = None, processes: int | None = None, index: int | None = None) -> None:
    """Makes this process one of the run's: as the arguments say, or srun or mpirun; otherwise it is alone."""
    places = {"coordinator_address": coordinator, "num_processes": processes, "process_id": index}
    started = (os.environ.get(name, "1") for name in ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE"))
    if coordinator is not None or any(count != "1" for count in started):
        jax.distributed.initialize(**places, heartbeat_timeout_seconds=HEARTBEAT)


def shutdown() -> None:
    """Leaves the other processes, all at once; does nothing for a process that is alone."""
    if jax.process_count() > 1:
        jax.distributed.shutdown()


class Preempted(Exception):
    """The system asked this run to stop (SIGTERM): what is done is to be saved."""


class Lost(Exception):
    """Another process of this run has ended, or the link to it has."""


def _raised_by_jax(error: BaseException) -> bool:
    """Where an array is fetched, a broken link is a ValueError, too."""
    raised_in = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
    return isinstance(error, jax.errors.JaxRuntimeError) or Path(jax.__file__).parent in raised_in.parents


@final
@dataclass
class Cluster:
    """The devices of all processes of a run, and what the processes agree on. Without other processes all is local."""

    devices: tuple[jax.Device, ...]
    _asked: bool = False

    @classmethod
    def of(cls, limit: int | None = None) -> "Cluster":
        """The first `limit` devices of each process, or all.

        Raises:
            UserError: there are fewer, or none of the kind that JAX_PLATFORMS or Slurm says.
        """
        require_devices()
        if limit is not None and limit > jax.local_device_count():
            have = f"{jax.local_device_count()} {jax.devices()[0].device_kind}"
            raise UserError(f"--devices = {limit}: this process sees {have} devices")
        chosen = (device for process in range(jax.process_count()) for device in jax.local_devices(process)[:limit])
        return cls(tuple(chosen))

    @property
    def memory(self) -> float:
        """What a device has [bytes], as process 0 sees its own."""
        return float(self.agreed(np.asarray(memory_of(jax.local_devices()[0]))))

    @property
    def processes(self) -> int:
        return jax.process_count()

    @property
    def first(self) -> bool:
        """Whether this is process 0, which speaks and writes."""
        return jax.process_index() == 0

    @property
    def mesh(self) -> Mesh:
        return Mesh(np.array(self.devices), ("candidates",), axis_types=(AxisType.Auto,))

    def __str__(self) -> str:
        count = f"{len(self.devices)} {self.devices[0].device_kind} device{'s' if len(self.devices) > 1 else ''}"
        return f"{count} of {self.processes} processes" if self.processes > 1 else count

    @contextlib.contextmanager
    def linked(self) -> Iterator[None]:
        """Around what needs the other processes.

        Raises:
            Lost: one of them has ended, or the link to it has. Other errors stay what they are.
        """
        try:
            yield
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            if self.processes == 1 or not _raised_by_jax(error):
                raise
            raise Lost(f"lost another process of this run ({str(error).splitlines()[0]})") from error

    def barrier(self) -> None:
        """Opens the links between the processes, while none has work yet: that waits for the others for seconds only,
        and later one may compile for minutes longer than another."""
        self.agreed(np.zeros(1))
        self.gathered(self.split(np.zeros(len(self.devices))))

    def agreed(self, value: Value) -> Value:
        """Process 0's numbers (a pytree of numpy's or Python's), on every process."""
        if self.processes == 1:
            return value
        with self.linked():
            return multihost_utils.broadcast_one_to_all(value)

    def on_first(self, act: Callable[[], Value]) -> Value | None:
        """Lets process 0 alone do something that the user may have to mend.

        Raises:
            UserError: on every process, if `act` raised it on process 0.
        """
        value = failure = None
        if self.first:
            try:
                value = act()
            except UserError as error:
                failure = error
        if self.agreed(np.asarray(failure is not None)):
            raise failure or UserError("stopped with process 0, which says why")
        return value

    def require_alike(self, what: str, mark: str) -> None:
        """Raises UserError unless all processes have the same `mark`, at most 64 ASCII characters."""
        mine = np.frombuffer(mark.ljust(64).encode()[:64], np.uint8)
        if self.processes == 1:
            return
        with self.linked():
            all_ = multihost_utils.process_allgather(mine)
        if not np.all(all_ == mine):
            raise UserError(f"the processes of this run were started with different values of: {what}")

    def gathered(self, tree: Any) -> Any:
        """Arrays that are split over the mesh, whole and in numpy, on every process."""
        if self.processes == 1:
            return jax.device_get(tree)
        with self.linked():
            return multihost_utils.process_allgather(tree, tiled=True)

    def replicated(self, tree: Any) -> Any:
        """Arrays that every process holds, as global arrays."""
        return jax.tree.map(partial(self._put, WHOLE), tree)

    def split(self, tree: Any) -> Any:
        """Arrays that every process holds, with their first axis split over the devices, of whose number it is a
        multiple."""
        return jax.tree.map(partial(self._put, SPLIT), tree)

    def _put(self, spec: PartitionSpec, leaf: Any) -> jax.Array:
        held = np.asarray(leaf)
        sharding = NamedSharding(self.mesh, spec)
        return jax.make_array_from_callback(held.shape, sharding, lambda index: held[index])

    def shared(self, function: Callable) -> Callable:
        """`function(split, whole) -> split`, jitted: every device runs it on its own part, in step with none."""
        mapped = jax.shard_map(function, mesh=self.mesh, in_specs=(SPLIT, WHOLE), out_specs=SPLIT, check_vma=False)
        return jax.jit(mapped)

    def handle_sigterm(self) -> None:
        """From now on SIGTERM asks this run to stop; JAX itself listens where there are several processes."""
        if self.processes == 1:
            signal.signal(signal.SIGTERM, lambda *_: self.ask_to_stop())

    def ask_to_stop(self) -> None:
        """Makes the next check raise."""
        self._asked = True

    def raise_if_preempted(self, step: int | None = None) -> None:
        """Raises Preempted if this run was asked to stop.

        Several processes agree on one of their checks, for which they need a `step` that grows from check to check:
        that of the checkpoint where one is saved, because orbax checks, too. Without a step only a process alone does.
        """
        together = self.processes > 1 and step is not None and multihost_utils.reached_preemption_sync_point(step)
        if self._asked or together:
            raise Preempted

    def interruptible(self, work: Callable[[], Value]) -> Value:
        """What `work` returns, done by a thread of its own: that may be inside XLA for minutes.

        A process alone that is asked to stop meanwhile raises Preempted at once; what `work` still does is lost.
        """
        pool = ThreadPoolExecutor(1)
        result = pool.submit(work)
        pool.shutdown(wait=False)
        while not wait([result], POLL).done:
            self.raise_if_preempted()
        return result.result()
