"""How JAX is set up before anything touches a device: precision, XLA, CPU parts, the cache, the GPUs of a job."""

import math
import os
import sys
import tempfile
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import user_cache

CPU_FLAGS = (
    "--xla_cpu_prefer_vector_width=512",  # twice as fast with AVX-512
    # Loops over knots are compiled whole: elsewhere every operation in them is a call of its own.
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000000",
)
"""XLA's options for the CPU."""
CACHE_SIZE = 4 * 2**30
"""Bytes of compiled programs that are kept; those that were used least lately go first."""
CGROUP = Path("/sys/fs/cgroup")
_SLURM_GPUS = ("SLURM_JOB_GPUS", "SLURM_GPUS_ON_NODE", "CUDA_VISIBLE_DEVICES")

GPU_FLAGS = (
    # Loops go into the CUDA graph of what is around them: an iteration is one launch, without the host.
    "--xla_gpu_enable_command_buffer=+WHILE,+CONDITIONAL,+DYNAMIC_SLICE_FUSION",
    "--xla_gpu_graph_min_graph_size=1",
)
"""XLA's options for GPUs."""


def prepare_jax(cpu_devices: int | None = None, cache: str | None = None) -> None:
    """Double precision; XLA's options for the CPU; that many CPU devices, or one for each core this process may use;
    compiled programs kept in the folder `cache`, by default `default_cache()`, nowhere if it is empty.

    What XLA_FLAGS, JAX_NUM_CPU_DEVICES and JAX_COMPILATION_CACHE_DIR say already is left as it is; only `cache` comes
    before the latter. Call it before anything else of JAX.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    ours = (flag for flag in (*CPU_FLAGS, *(GPU_FLAGS if _has_cuda() else ())) if flag.split("=")[0] not in flags)
    os.environ["XLA_FLAGS"] = " ".join([flags, *ours]).strip()
    import jax

    jax.config.update("jax_enable_x64", True)
    by_environment = "host_platform_device_count" in flags or "JAX_NUM_CPU_DEVICES" in os.environ
    if cpu_devices or not by_environment:
        jax.config.update("jax_num_cpu_devices", cpu_devices or cores())
    if cache is not None or "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        _keep_programs(default_cache() if cache is None else cache)


def memory_of(device: Any) -> float:
    """What a device of JAX has [bytes]; of a CPU's devices, each one's part of the host's."""
    stats = device.memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / cores()


def _has_cuda() -> bool:
    """Whether JAX's plugin for CUDA is installed: XLA ends a process for an option that it does not know."""
    return any(find_spec(f"jax_cuda{version}_plugin") for version in (12, 13))


def default_cache() -> str:
    """`xla` in the user's cache."""
    return str(user_cache() / "xla")


def _keep_programs(folder: str) -> None:
    import jax

    if not folder:
        jax.config.update("jax_compilation_cache_dir", None)
        return
    try:
        os.makedirs(folder, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):  # root may write where the mode says no, and a disk may be full
            pass
    except OSError as error:
        print(f"compiled programs are not kept: cannot write {folder}: {error.strerror}", file=sys.stderr)
        jax.config.update("jax_compilation_cache_dir", None)
        return
    jax.config.update("jax_compilation_cache_dir", folder)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    jax.config.update("jax_compilation_cache_max_size", CACHE_SIZE)


def require_devices() -> None:
    """Touches the devices, after `jax.distributed` if there are other processes.

    Raises:
        UserError: JAX_PLATFORMS names one that is not here, or Slurm gave GPUs and JAX finds none.
    """
    import jax

    wanted = os.environ.get("JAX_PLATFORMS", "")
    try:
        platform = jax.devices()[0].platform
    except (RuntimeError, AssertionError):  # the latter where JAX has no plugin for CUDA
        raise UserError(
            f"JAX_PLATFORMS = {wanted!r}: JAX finds no such device here; for CUDA install `rtcd-jax[cuda12]` or "
            "`[cuda13]` on a machine with a GPU, or set JAX_PLATFORMS=cpu"
        ) from None
    given = gpus_given(os.environ)
    if platform == "cpu" and given and "cpu" not in wanted.split(","):
        raise UserError(
            f"Slurm gave this job GPUs ({given}), but JAX finds none: install `rtcd-jax[cuda12]` or `[cuda13]`, or say "
            "JAX_PLATFORMS=cpu to use the CPU"
        )


def gpus_given(environment: Mapping[str, str]) -> str | None:
    """The variable by which Slurm says that this job has GPUs, as NAME=VALUE; None without Slurm or without GPUs."""
    if "SLURM_JOB_ID" not in environment:
        return None
    for name in _SLURM_GPUS:
        value = environment.get(name, "").strip()
        if value not in ("", "0" if name == "SLURM_GPUS_ON_NODE" else "NoDevFiles", "-1"):
            return f"{name}={value}"
    return None


def require_float64() -> None:
    """Raises UserError where JAX computes in single precision, in which no funnel is right."""
    import jax

    if not jax.config.read("jax_enable_x64"):
        raise UserError(
            "JAX is in float32: call rtcd_jax.prepare_jax() first, or set JAX_ENABLE_X64=1; trajectories, Riccati "
            "equations and funnels need float64"
        )


def cores(root: Path = CGROUP) -> int:
    """Those that this process may use: its affinity mask, and the quota of its control groups, rounded up."""
    mine = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.ceil(min(mine, quota(root))))


def quota(root: Path, groups: str | None = None) -> float:
    """CPUs that the control groups allow, version 1 or 2; infinite where nothing limits them.

    `groups` is the text of /proc/self/cgroup; every group on the way up to `root` counts.
    """
    if groups is None:
        groups = _text(Path("/proc/self/cgroup"))
    allowed = math.inf
    for line in groups.splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if controllers and "cpu" not in controllers.split(","):
            continue
        tops = (root / controllers, root / "cpu") if controllers else (root,)
        for top in tops:
            inner = top / path.lstrip("/")
            for folder in (inner, *inner.parents):
                if not folder.is_relative_to(top):
                    break
                allowed = min(allowed, _limit(folder))
    return allowed


def _limit(folder: Path) -> float:
    """One group's: `cpu.max` of version 2, `cpu.cfs_quota_us` over `cpu.cfs_period_us` of version 1."""
    words = _text(folder / "cpu.max").split() or [
        _text(folder / "cpu.cfs_quota_us").strip(), _text(folder / "cpu.cfs_period_us").strip(),
    ]  # fmt: skip
    try:
        granted, period = (float(word) for word in words)
    except ValueError:  # "max", or no such file
        return math.inf
    return granted / period if granted > 0 and period > 0 else math.inf


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""


def path_batch() -> int:
    """Paths that are followed together: on a CPU so many that they stay in its cache, elsewhere enough to fill it."""
    import jax

    return 1 << 11 if jax.default_backend() == "cpu" else 1 << 18
