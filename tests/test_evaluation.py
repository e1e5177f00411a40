"""A population's evaluation is that of its candidates, however they are chunked and spread."""

import dataclasses
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.evaluation import make_evaluate, resample, search_effort
from rtcd_jax.funnel import MARGIN
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.population import decode
from rtcd_jax.types import Status
from rtcd_jax.volume import funnel_volume
from tests import pipeline
from tests.pipeline import same

ROOT = Path(__file__).parents[1]
CLOSE = 1e-7
"""Programs of other sizes sum in another order, which the trajectory's stopping and the rollouts carry on."""


def _assert_close(left, right, rtol=CLOSE):
    for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        if jnp.issubdtype(a.dtype, jnp.floating):
            np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol)
        else:
            np.testing.assert_array_equal(a, b)


def _rechunked(chunk: int):
    found = pipeline.problem()
    search = found.config.search.model_copy(update={"chunk": chunk})
    config = found.config.model_copy(update={"search": search})
    return jax.jit(make_evaluate(dataclasses.replace(found, config=config)))


def test_the_parts_of_an_evaluation_belong_together():
    evaluation = pipeline.evaluated()
    np.testing.assert_array_equal(evaluation.genome, pipeline.genomes())
    decoded = jax.jit(jax.vmap(lambda genome: decode(pipeline.problem(), genome)))(pipeline.genomes())
    _assert_close(evaluation.candidate, decoded, rtol=1e-14)
    _assert_close(evaluation.volumes, jax.jit(jax.vmap(funnel_volume))(evaluation.funnel), rtol=1e-13)
    np.testing.assert_array_equal(evaluation.status, evaluation.funnel.status)
    statuses = [Status.OK] * 5
    statuses[pipeline.HARD] = Status.FUNNEL_EMPTY
    assert list(evaluation.status) == statuses


def test_the_same_key_gives_the_same_result_and_another_one_other_samples():
    again = pipeline.evaluate()(pipeline.genomes(), pipeline.GENERATION)
    other = pipeline.evaluate()(pipeline.genomes(), jax.random.key(1))
    assert same(again, pipeline.evaluated())
    assert same(other.funnel.policy, again.funnel.policy)
    fine = np.asarray(again.status) == Status.OK
    assert not np.any(np.asarray(other.volumes.total == again.volumes.total)[fine])
    np.testing.assert_allclose(other.volumes.total[fine], again.volumes.total[fine], rtol=0.03)


def test_neighbors_do_not_matter():
    """In another order, and beside a genome of NaN, every other candidate is what it was, bit by bit."""
    order = np.array([3, 1, 4, 0, 2])
    shuffled = pipeline.evaluate()(pipeline.genomes()[order], pipeline.GENERATION)
    assert same(shuffled, jax.tree.map(lambda leaf: leaf[order], pipeline.evaluated()))
    broken = pipeline.evaluate()(pipeline.genomes().at[2].set(jnp.nan), pipeline.GENERATION)
    others = np.array([0, 1, 3, 4])
    assert same(*(jax.tree.map(lambda leaf: leaf[others], e) for e in (broken, pipeline.evaluated())))
    assert broken.status[2] == Status.TRAJECTORY_NOT_SOLVED
    assert broken.volumes.total[2] == 0


def test_a_population_is_its_candidates_one_by_one():
    """The program for one is another one: equal but for rounding."""
    alone = jax.jit(make_evaluate(pipeline.problem()))
    for k in (pipeline.INITIAL, pipeline.RTCD, pipeline.HARD):
        row = jax.tree.map(lambda leaf, k=k: leaf[k : k + 1], pipeline.evaluated())
        _assert_close(alone(pipeline.genomes()[k : k + 1], pipeline.GENERATION), row)


@pytest.mark.slow
def test_a_resampled_funnel_is_about_the_same_policy():
    """With the same effort and key it is the same funnel, with another key other levels but where a box ends them."""
    row = jax.tree.map(lambda leaf: leaf[pipeline.RTC], pipeline.evaluated())
    again = jax.jit(partial(resample, pipeline.problem(), search_effort(pipeline.problem())))
    _assert_close(again(row, pipeline.GENERATION), row)
    other = again(row, jax.random.key(1))
    assert same(other.funnel.policy, row.funnel.policy)
    policy = row.funnel.policy
    sets = Ellipsoids.about(policy.trajectory.xs.T, jnp.moveaxis(policy.values, 0, -1))
    boxes = sets.radii_inside(jnp.asarray(pipeline.problem().state_limits)) ** 2
    at_box = np.isclose(row.funnel.levels, (1 - MARGIN) * boxes, rtol=1e-9)
    np.testing.assert_array_equal(other.funnel.levels == row.funnel.levels, at_box)
    assert not at_box.all()


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [1, 2])
def test_the_chunk_does_not_matter(chunk):
    """It bounds the memory: also one that does not divide the population."""
    _assert_close(_rechunked(chunk)(pipeline.genomes(), pipeline.GENERATION), pipeline.evaluated())


SHARED_OUT = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
from rtcd_jax.evaluation import spread
from tests.fake_evaluation import bowl
from tests.pipeline import same
key, devices = jax.random.key(0), jax.devices()
assert len(devices) == 4
for count in (1, 3, 4, 5, 8):
    genomes = jnp.asarray(np.random.default_rng(count).uniform(size=(count, 3)))
    alone = jax.jit(bowl)(genomes, key)
    for n in (1, 2, 4):
        many = spread(bowl, devices[:n])(genomes, key)
        assert many.genome.shape == genomes.shape, many.genome.shape
        assert same(jax.device_get(many), jax.device_get(alone)), (count, n)
print("equal")
"""

WHOLE = """
import jax
jax.config.update("jax_enable_x64", True)
from rtcd_jax.evaluation import make_evaluate, spread
from tests import pipeline
from tests.test_evaluation import _assert_close
evaluate, devices = make_evaluate(pipeline.problem()), jax.devices()

def on(n):
    return jax.device_get(spread(evaluate, devices[:n])(pipeline.genomes(), pipeline.GENERATION))

one, two, four = map(on, (1, 2, 4))
_assert_close(two, one)
_assert_close(four, one)
assert pipeline.same(on(4), four)
print("equal")
"""


def _on_four_devices(code: str) -> str:
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "4", "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=environment)
    assert process.returncode == 0, process.stderr
    return process.stdout


def test_candidates_are_shared_out_over_devices_and_come_back_in_order():
    """Bit by bit, also where the devices do not divide the population or are more than it."""
    assert _on_four_devices(SHARED_OUT) == "equal\n"


@pytest.mark.slow
def test_a_population_spread_over_devices_is_that_of_one_device():
    """Five candidates on 1, 2 and 4 devices: equal but for the rounding of programs of other sizes, the same devices
    give the same bits."""
    assert _on_four_devices(WHOLE) == "equal\n"
