"""A population over devices: every candidate's own result, whatever the devices, the chunks and the neighbors."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from rtcd_jax.run.sharding import ShardedEvaluate
from rtcd_jax.system.cluster import Cluster, Preempted
from rtcd_jax.system.errors import UserError
from tests.paths import ROOT
from tests.pipeline import same
from tests.search.fake_evaluation import bowl

KEY = jax.random.key(0)


def genomes_of(count):
    return np.random.default_rng(count).uniform(size=(count, 3))


@pytest.mark.parametrize("count", [1, 3, 4, 9])
def test_what_a_search_looks_at_is_that_of_the_evaluation(count):
    genomes = genomes_of(count)
    found, whole = ShardedEvaluate(bowl, Cluster.of(), 4)(genomes, KEY), jax.device_get(bowl(genomes, KEY))
    np.testing.assert_array_equal(found.genome, genomes)
    np.testing.assert_array_equal(found.status, whole.status)
    assert found.volumes.named.keys() == whole.volumes.named.keys()
    for name, values in whole.volumes.named.items():
        np.testing.assert_array_equal(found.volumes[name], values)


@pytest.mark.parametrize("rows", [[0], [8, 0, 3, 4], [5, 5], list(range(9))])
def test_records_are_taken_from_wherever_they_are(rows):
    genomes = genomes_of(9)
    found = ShardedEvaluate(bowl, Cluster.of(), 4)(genomes, KEY)
    assert same(found.take(np.array(rows)), jax.device_get(bowl(genomes, KEY)).take(np.array(rows)))


def test_between_chunks_a_request_to_stop_is_heard():
    cluster = Cluster.of()
    evaluate = ShardedEvaluate(bowl, cluster, 4)
    evaluate(genomes_of(9), KEY)
    cluster.ask_to_stop()
    with pytest.raises(Preempted):
        evaluate(genomes_of(9), KEY)


def test_more_devices_than_there_are_cannot_be_asked_for():
    with pytest.raises(UserError, match=r"--devices = 99: this process sees \d+ cpu"):
        Cluster.of(99)


FAKE = """
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
from rtcd_jax.system.cluster import Cluster
from rtcd_jax.run.sharding import ShardedEvaluate
from tests.search.fake_evaluation import bowl
from tests.paths import ROOT
from tests.pipeline import same
from tests.run.test_sharding import KEY, genomes_of
assert len(jax.devices()) == 4
for count in (1, 5, 16, 23):
    genomes, rows = genomes_of(count), np.arange(count)
    whole = jax.device_get(bowl(genomes, KEY))
    for devices in (1, 2, 4):
        many = ShardedEvaluate(bowl, Cluster.of(devices), 4)(genomes, KEY)
        assert same(many.take(rows), whole), (count, devices)
print("equal")
"""

REAL = """
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
from rtcd_jax.system.cluster import Cluster
from rtcd_jax.evaluation import make_evaluate
from rtcd_jax.run.sharding import ShardedEvaluate
from tests import pipeline
from tests.test_evaluation import assert_close
evaluate, rows = make_evaluate(pipeline.problem()), np.arange(5)

def on(devices, genomes):
    return ShardedEvaluate(evaluate, Cluster.of(devices), 1)(genomes, pipeline.GENERATION)

genomes = np.asarray(pipeline.genomes())
one, two, four = (on(devices, genomes).take(rows) for devices in (1, 2, 4))
assert pipeline.same(two, four)
assert pipeline.same(on(2, genomes[::-1]).take(rows[::-1]), two)
assert_close(one, two)
print("equal")
"""


def _on_four_devices(code: str) -> str:
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "4", "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=environment)
    assert process.returncode == 0, process.stderr
    return process.stdout


@pytest.mark.thorough
def test_candidates_are_shared_out_over_devices_and_come_back_in_order():
    """Bit by bit, also where the devices do not divide the population or are more than it."""
    assert _on_four_devices(FAKE) == "equal\n"


@pytest.mark.slow
def test_the_pipeline_gives_the_same_bits_on_two_devices_and_on_four():
    """In any order; on a single one XLA compiles another program, which rounds otherwise."""
    assert _on_four_devices(REAL) == "equal\n"
