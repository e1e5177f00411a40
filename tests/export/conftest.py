"""One export of every robot, shared by the tests that look at parts of it."""

import importlib.util
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rtcd_jax.certificate.prove.certify import certify_elite
from rtcd_jax.export import export_run, rate
from rtcd_jax.export.bundle import Bundle, read_bundle
from tests.consoles import Output
from tests.export.folders import ELITES, run_folder


class Export(NamedTuple):
    """A folder that was exported, what it was exported from, and its own controller module."""

    run: Path
    folder: Path
    bundle: Bundle
    module: Any


@pytest.fixture(scope="session", autouse=True)
def _few_states():
    """Control rates are found by a tenth of the states: what tests hold them to does not depend on their number."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rate, "STATES", 400)
        yield


@pytest.fixture(scope="session", params=list(ELITES))
def export(request, tmp_path_factory):
    """The export of one robot's elite 000, sampled."""
    path = tmp_path_factory.mktemp(request.param)
    return _exported(run_folder(path / "run", request.param), path / "lab")


@pytest.fixture(scope="session")
def proved(tmp_path_factory):
    """The export of a pendulum's elite 000 with its certificate."""
    path = tmp_path_factory.mktemp("proved")
    run = run_folder(path / "run", "pendulum")
    (run / "certificates").mkdir()
    certify_elite(run, "000", "proved", lambda step: None)
    return _exported(run, path / "lab")


def _exported(run, folder):
    export_run(run, 0, folder, Output().console)
    bundle = read_bundle(run, "000")
    return Export(run, folder, bundle, module(folder / f"{bundle.label}_controller.py"))


def module(path):
    """The exported file itself, not the template that it was copied from."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded
