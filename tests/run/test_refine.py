"""`rtcd refine` on a finished run: what becomes better is stored in order; a killed call goes on to the same bytes."""

import json
import shutil
import time

import numpy as np
import pytest

from rtcd_jax.elite.elite import Elite
from rtcd_jax.run.refine import PARTIAL

pytestmark = pytest.mark.slow  # three processes compile

ARGUMENTS = "--elites", "2", "--steps", "40"


@pytest.fixture(scope="module")
def whole(small, searched, tmp_path_factory):
    """A run whose elites were refined in one go, what it was before, and what was said."""
    before, folder = searched[0], tmp_path_factory.mktemp("refined") / "run"
    shutil.copytree(before, folder)
    code, output, errors = small.call("refine", folder, *ARGUMENTS)
    assert code == 0, errors
    return folder, before, output


def test_a_refined_elite_is_the_best_one_and_larger_than_before(whole):
    folder, before, output = whole
    old, new = Elite.read(before, 0), Elite.read(folder, 0)
    assert new.volumes["sum"] > 1.2 * old.volumes["sum"]
    befores = [Elite.read(before, name).volumes["sum"] for name in (0, 1)]
    assert min(abs(new.record["refinement"]["before"]["sum"] / volume - 1) for volume in befores) < 1e-9
    assert new.record["refinement"]["steps"] == 40
    assert "refining: step 90/90" in output
    assert "kept" in output


def test_elites_are_stored_best_first_and_those_before_stay_beside(whole):
    folder, before, _ = whole
    names = sorted(path.stem for path in (folder / "elites").glob("*.json"))
    sums = [Elite.read(folder, name).volumes["sum"] for name in names]
    assert sums == sorted(sums, reverse=True)
    for file in (before / "elites").iterdir():
        assert (folder / "unrefined" / file.name).read_bytes() == file.read_bytes()
    assert not (folder / PARTIAL).exists()


def test_a_killed_refinement_goes_on_to_the_same_elites(small, whole, tmp_path):
    folder, before, _ = whole
    other = tmp_path / "run"
    shutil.copytree(before, other)
    process = small.start("refine", other, *ARGUMENTS)
    while not (other / PARTIAL).exists() and process.poll() is None:
        time.sleep(0.05)
    process.kill()
    process.communicate()
    with np.load(other / PARTIAL) as stored:
        assert stored["done"] > 0
    code, _, errors = small.call("refine", other, *ARGUMENTS)
    assert code == 0, errors
    for file in (folder / "elites").iterdir():
        assert (other / "elites" / file.name).read_bytes() == file.read_bytes()


def test_what_cannot_be_refined_is_named(small, whole):
    code, _, errors = small.call("refine", whole[0], "--free", "gains,weights")
    assert code == 2
    assert "--free = gains,weights: must be one or more of gains, shapes" in errors
    assert json.loads((whole[0] / "elites" / "000.json").read_text())["refinement"]["free"] == ["gains", "shapes"]
