"""A population's evaluation is that of its candidates, however they are chunked and spread."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.evaluation import in_batches, make_evaluate, resample, search_budget
from rtcd_jax.funnel import MARGIN
from rtcd_jax.genome import decode
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.policy import input_jumps
from rtcd_jax.types import Status
from rtcd_jax.volume import funnel_volume
from tests import pipeline
from tests.pipeline import same

CLOSE = 1e-7
"""Programs of other sizes sum in another order, which the trajectory's stopping and the rollouts carry on."""


def assert_close(left, right, rtol=CLOSE):
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


@pytest.mark.thorough
def test_the_parts_of_an_evaluation_belong_together():
    evaluation = pipeline.evaluated()
    np.testing.assert_array_equal(evaluation.genome, pipeline.genomes())
    decoded = jax.jit(jax.vmap(lambda genome: decode(pipeline.problem(), genome)))(pipeline.genomes())
    assert_close(evaluation.candidate, decoded, rtol=1e-14)

    @jax.jit
    @jax.vmap
    def volumes(candidate, funnel):
        return funnel_volume(funnel, input_jumps(pipeline.problem(), candidate, funnel.policy.trajectory))

    assert_close(evaluation.volumes, volumes(evaluation.candidate, evaluation.funnel), rtol=1e-13)
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
    assert not np.any(np.asarray(other.volumes["sum"] == again.volumes["sum"])[fine])
    np.testing.assert_allclose(other.volumes["sum"][fine], again.volumes["sum"][fine], rtol=0.03)


@pytest.mark.thorough
def test_neighbors_do_not_matter():
    """In another order, and beside a genome of NaN, every other candidate is what it was, bit by bit."""
    order = np.array([3, 1, 4, 0, 2])
    shuffled = pipeline.evaluate()(pipeline.genomes()[order], pipeline.GENERATION)
    assert same(shuffled, jax.tree.map(lambda leaf: leaf[order], pipeline.evaluated()))
    broken = pipeline.evaluate()(pipeline.genomes().at[2].set(jnp.nan), pipeline.GENERATION)
    others = np.array([0, 1, 3, 4])
    assert same(*(jax.tree.map(lambda leaf: leaf[others], e) for e in (broken, pipeline.evaluated())))
    assert broken.status[2] == Status.TRAJECTORY_NOT_SOLVED
    assert broken.volumes["sum"][2] == 0


@pytest.mark.parametrize("batch", [1, 3, 7, 8])
def test_batches_in_any_order_give_the_candidates_in_theirs(batch):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(7, 2)))
    seen = in_batches(jnp.cumsum, x, min(batch, 7), order=jnp.array([5, 0, 6, 2, 1, 4, 3]))
    np.testing.assert_array_equal(seen, np.cumsum(x, 1))


@pytest.mark.thorough
def test_a_search_for_the_goal_s_region_needs_no_motion():
    """The region is that at the end of a swing-up, but for what held-out samples took of it, followed to the goal."""
    config = pipeline.problem().config
    update = {
        "search": config.search.model_copy(update={"objective": "goal"}),
        "trajectory": config.trajectory.model_copy(update={"knots": 3}),
    }
    problem = dataclasses.replace(pipeline.problem(), config=config.model_copy(update=update))
    at_rest = jax.jit(make_evaluate(problem))(pipeline.genomes(), pipeline.GENERATION)
    moving, motion = pipeline.evaluated(), at_rest.funnel.policy.trajectory
    np.testing.assert_array_equal(motion.xs, np.broadcast_to(problem.goal, (5, 3, 2)))
    assert not np.any(motion.us)
    assert not np.any(motion.iterations)
    fine = np.asarray(moving.status) == Status.OK
    assert np.all(np.asarray(at_rest.status)[fine] == Status.OK)
    regions = [np.asarray(evaluation.volumes["goal"])[fine] for evaluation in (moving, at_rest)]
    assert np.all(regions[1] <= regions[0] * (1 + CLOSE))
    assert np.all(regions[1] > 0.9 * regions[0])
    np.testing.assert_array_equal(at_rest.funnel.trials[fine], problem.config.funnel.trials)


@pytest.mark.slow
def test_a_population_is_its_candidates_one_by_one():
    """The program for one is another one: equal but for rounding."""
    alone = jax.jit(make_evaluate(pipeline.problem()))
    for k in (pipeline.INITIAL, pipeline.RTCD, pipeline.HARD):
        row = jax.tree.map(lambda leaf, k=k: leaf[k : k + 1], pipeline.evaluated())
        assert_close(alone(pipeline.genomes()[k : k + 1], pipeline.GENERATION), row)


@pytest.mark.slow
def test_a_resampled_funnel_is_about_the_same_policy():
    """With the same budget and key it is the same funnel, with another key other levels but where a box ends them."""
    row = jax.tree.map(lambda leaf: leaf[pipeline.RTC], pipeline.evaluated())
    again = jax.jit(partial(resample, pipeline.problem(), search_budget))
    assert_close(again(row, pipeline.GENERATION), row)
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
    assert_close(_rechunked(chunk)(pipeline.genomes(), pipeline.GENERATION), pipeline.evaluated())
