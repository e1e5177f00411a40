"""A process of a run with a fake evaluation.

    python -m tests.run.killable FOLDER MODE SECONDS [DEVICES [PORT PROCESSES ID [SAVES]]]

SECONDS is the least time of a generation, DEVICES those of this process; PORT is where process 0 of PROCESSES
listens; srun tells these by itself. In its save number SAVES the process ends.
"""

import itertools
import os
import sys
import time
from pathlib import Path

import jax
from orbax.checkpoint import v1 as ocp

from rtcd_jax.cli.exits import Exit
from rtcd_jax.system.cluster import Cluster, Lost, initialize


def end_in_save(number):
    """Ends this process in its save of this number, a second late, when the others wait for it."""
    saves, save = itertools.count(1), ocp.training.Checkpointer.save

    def ending(self, *words, **options):
        if next(saves) == number:
            time.sleep(1)
            os._exit(1)
        return save(self, *words, **options)

    ocp.training.Checkpointer.save = ending


def main(path, mode, seconds, devices="1", port=None, processes="1", index="0", saves="0"):
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", int(devices))
    initialize(*(() if port is None else (f"127.0.0.1:{port}", int(processes), int(index))))
    from tests.search.search_driver import drive, experiment  # imports that touch a device

    cluster = Cluster.of()
    end_in_save(int(saves))
    cluster.handle_sigterm()
    try:
        cluster.barrier()
        drive(Path(path), experiment(mode), float(seconds), cluster)
    except Lost as error:
        print(error, flush=True)
        os._exit(Exit.LOST_PROCESS)


if __name__ == "__main__":
    main(*sys.argv[1:])
