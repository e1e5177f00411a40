"""Tests run in float64 on the CPU, with a cache folder of their own, and check the annotated shapes."""

import os
import signal

import jax
import pytest
from jaxtyping import install_import_hook

CHECKED = (
    *("types", "problem", "genome", "trajectory", "policy", "rollout", "funnel", "validation", "volume", "evaluation"),
    "plants",
    "numerics",
)
"""Modules whose annotations hold at every call: beartype reads them, jaxtyping binds the axes' names."""

install_import_hook([f"rtcd_jax.{name}" for name in CHECKED], "beartype.beartype")

# What imports the package comes after the hook.
from tests.cli.terminal import in_terminal  # noqa: E402
from tests.paths import ROOT  # noqa: E402
from tests.run.small import Small  # noqa: E402

jax.config.update("jax_enable_x64", True)

# A shell starts its background jobs with interrupts ignored, and processes inherit that: the tests send some.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def _cache_of_its_own(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    return Small(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="session")
def searched(small, tmp_path_factory):
    """The folder of an uninterrupted search in a terminal, its exit code, and what the terminal was sent."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    return folder, *in_terminal("optimize", small.config, "--run", folder, folder=ROOT, **small.environment)


@pytest.fixture(scope="session")
def backend():
    """A way in which MuJoCo draws without a display."""
    from rtcd_jax.analysis.animate.camera import choose_backend
    from rtcd_jax.system.errors import UserError

    kept = os.environ.pop("MUJOCO_GL", None)
    try:
        return choose_backend()
    except UserError as error:
        pytest.skip(str(error))
    finally:
        os.environ.pop("MUJOCO_GL", None)
        if kept is not None:
            os.environ["MUJOCO_GL"] = kept
