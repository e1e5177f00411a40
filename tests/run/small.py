"""`rtcd` in processes of its own on one experiment that is small in every number."""

import os
import subprocess
import sys
from pathlib import Path

import yaml

from rtcd_jax.config import load as configuration
from tests.paths import ROOT

GENERATIONS = 5
SMALL = yaml.safe_load(configuration.EXAMPLE) | {
    "trajectory": {"knots": 16, "step": {"min": 0.05, "max": 0.25}, "substeps": 3},
    "funnel": {
        "rollouts": "closed_form",
        "directions": 8,
        "steps": 6,
        "trials": 16,
        "goal": {"directions": 16, "radii": 6, "horizon": 1.0, "step": 0.02},
    },
    "search": {"population": 6, "generations": GENERATIONS},
    "elites": {"count": 2, "trials": 200, "directions": 32, "mjx_states": 0, "keys": 2},
    "checkpoint": {"seconds": 0.0},
}


class Small:
    """Starts `rtcd` in processes of its own on one experiment; they share their compiled programs."""

    def __init__(self, folder: Path):
        self.config = folder / "small.yaml"
        self.config.write_text(yaml.safe_dump(SMALL))
        cache = {
            "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        devices = {"JAX_NUM_CPU_DEVICES": "2", "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
        self.environment = cache | os.environ | devices

    def start(self, verb: str, *arguments) -> subprocess.Popen:
        command = [sys.executable, "-u", "-m", "rtcd_jax", verb, *map(str, arguments)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen(command, cwd=ROOT, env=self.environment, **pipes)

    def call(self, verb: str, *arguments) -> tuple[int, str, str]:
        process = self.start(verb, *arguments)
        output, errors = process.communicate(timeout=600)
        return process.returncode, output, errors

    def optimize(self, folder: Path, *options) -> tuple[int, str, str]:
        return self.call("optimize", self.config, "--run", folder, *options)
