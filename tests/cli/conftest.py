"""A finished run that every verb can read in as little time as it can, and verbs that are run inside the tests."""

import os

import numpy as np
import pytest

from tests.analysis.report import runs
from tests.certificate import swing
from tests.export.folders import UNITS


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A run folder of five knots."""
    config = runs.experiment()
    arrays, record = swing.elite()
    volumes = {"sum": 2.0, "integral": 0.4, "inlet": 0.3, "geometric_mean": 0.4}
    arrays |= {f"volumes_{name}": np.array(value) for name, value in volumes.items()}
    told = {"units": UNITS["pendulum"], "config_hash": "0123456789ab"}
    elite = arrays, runs.candidate(config)[1] | record | told
    return runs.run_folder(tmp_path_factory.mktemp("runs") / "whole", config, elite, elite)


@pytest.fixture
def as_in_a_process(monkeypatch):
    """Lets a verb prepare JAX here: it keeps the devices and the cache that the tests have, and its flags go again."""
    for name, value in {"JAX_NUM_CPU_DEVICES": "1", "JAX_COMPILATION_CACHE_DIR": "", "XLA_FLAGS": ""}.items():
        monkeypatch.setenv(name, os.environ.get(name, value))
