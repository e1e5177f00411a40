"""What a run ran on, so that it can be repeated."""

import contextlib
import datetime
import importlib.metadata
import platform
import subprocess
from pathlib import Path
from typing import Any

_PACKAGES = ("rtcd_jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "evosax", "equinox", "orbax-checkpoint", "numpy")


def provenance() -> dict[str, Any]:
    """Time, versions (None if not installed), the source's commit, device and precision of this process."""
    import jax
    import jax.numpy as jnp

    device = jax.devices()[0]
    return {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "versions": {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES},
        "platform": device.platform,
        "device": device.device_kind,
        "devices": jax.device_count(),
        "precision": str(jnp.zeros(()).dtype),
        "system": platform.platform(),
    }


def _version(package: str) -> str | None:
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version(package)
    return None


def _commit() -> str | None:
    """The commit of this package's source, with a `+` if it was changed; None outside a git checkout of it."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(Path(__file__).parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", Path(__file__).name)  # the checkout may be that of a virtual environment
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain", "--", ".") else "")
    except (OSError, subprocess.SubprocessError):
        return None
