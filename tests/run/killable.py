"""A process of a run with a fake evaluation.

    python -m tests.run.killable FOLDER MODE SECONDS [DEVICES [PORT PROCESSES ID]]

SECONDS is the least time of a generation, DEVICES those of this process; PORT is where process 0 of PROCESSES
listens; srun tells these by itself.
"""

import os
import sys
from pathlib import Path

import jax

from rtcd_jax.cli.exits import Exit
from rtcd_jax.system.cluster import Cluster, Lost, initialize


def main(path, mode, seconds, devices="1", port=None, processes="1", index="0"):
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", int(devices))
    initialize(*(() if port is None else (f"127.0.0.1:{port}", int(processes), int(index))))
    from tests.search.search_driver import drive, experiment  # imports that touch a device

    cluster = Cluster.of()
    cluster.handle_sigterm()
    try:
        cluster.barrier()
        drive(Path(path), experiment(mode), float(seconds), cluster)
    except Lost as error:
        print(error, flush=True)
        os._exit(Exit.LOST_PROCESS)


if __name__ == "__main__":
    main(*sys.argv[1:])
