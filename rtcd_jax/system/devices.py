"""How JAX is set up before anything touches a device: precision, XLA's options, the CPU's parts."""

import os
from typing import Any

CPU_FLAGS = (
    "--xla_cpu_prefer_vector_width=512",  # twice as fast with AVX-512
    # Loops over knots are compiled whole: elsewhere every operation in them is a call of its own.
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000000",
)
"""XLA's options for the CPU."""

GPU_FLAGS = (
    # Loops go into the CUDA graph of what is around them: an iteration is one launch, without the host.
    "--xla_gpu_enable_command_buffer=+WHILE,+CONDITIONAL,+DYNAMIC_SLICE_FUSION",
    "--xla_gpu_graph_min_graph_size=1",
)
"""XLA's options for GPUs."""


def prepare_jax(cpu_devices: int | None = None) -> None:
    """Double precision; XLA's options for the CPU; that many CPU devices, or one for each core this process may use.

    What XLA_FLAGS and JAX_NUM_CPU_DEVICES say already is left as it is.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    ours = (flag for flag in (*CPU_FLAGS, *GPU_FLAGS) if flag.split("=")[0] not in flags)
    os.environ["XLA_FLAGS"] = " ".join([flags, *ours]).strip()
    import jax

    jax.config.update("jax_enable_x64", True)
    by_environment = "host_platform_device_count" in flags or "JAX_NUM_CPU_DEVICES" in os.environ
    if cpu_devices or not by_environment:
        jax.config.update("jax_num_cpu_devices", cpu_devices or cores())


def cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def memory_of(device: Any) -> float:
    """What a device of JAX has [bytes]; of a CPU's devices, each one's part of the host's."""
    stats = device.memory_stats()
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / cores()
