"""What a search makes of several tasks: one order of the candidates, and a state that goes on bit by bit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.config.schema import SearchConfig
from rtcd_jax.evaluation import over_tasks
from rtcd_jax.run.folder import RunFolder
from rtcd_jax.run.sharding import ShardedEvaluate
from rtcd_jax.search import archive, search
from rtcd_jax.system.cluster import Cluster
from rtcd_jax.types import Status
from tests import pipeline
from tests.search import search_driver
from tests.search.fake_evaluation import bowl, population

NAMES = ("here", "there")
FAILED, EMPTY = Status.TRAJECTORY_NOT_SOLVED, Status.FUNNEL_EMPTY


def evaluations(volumes, statuses=None, how="geometric_mean"):
    """Of candidates with these volumes [P T] on their tasks."""
    volumes = np.asarray(volumes, float)
    statuses = np.zeros(volumes.shape, int) if statuses is None else np.asarray(statuses)
    genomes = np.linspace(0, 1, len(volumes))[:, None]
    each = [population(genomes, *pair) for pair in zip(volumes.T, statuses.T, strict=True)]
    return over_tasks(jax.tree.map(lambda *leaves: jnp.stack(leaves, 1), *each), how)


def order(volumes, statuses=None, **settings):
    settings = SearchConfig(**settings)
    return np.argsort(archive.cost(evaluations(volumes, statuses, settings.over_tasks), settings)).tolist()


def test_candidates_are_ranked_by_the_mean_or_by_the_smallest():
    volumes = [[100.0, 1.0], [8.0, 8.0], [9.0, 4.0]]
    assert order(volumes) == [0, 1, 2]
    assert order(volumes, over_tasks="min") == [1, 2, 0]
    swapped = [row[::-1] for row in volumes]
    for how in ("geometric_mean", "min"):
        assert order(swapped, over_tasks=how) == order(volumes, over_tasks=how)


def test_equals_in_the_smallest_are_ranked_by_the_mean():
    assert order([[3.0, 4.0], [3.0, 9.0], [5.0, 3.0], [3.0001, 3.0001]], over_tasks="min") == [3, 1, 2, 0]


def test_a_candidate_that_fails_in_one_task_is_last_and_tells_the_first_failure():
    volumes, statuses = [[9.0, 9.0], [50.0, 0.0], [0.0, 0.0]], [[0, 0], [0, EMPTY], [EMPTY, FAILED]]
    np.testing.assert_array_equal(evaluations(volumes, statuses).status, [Status.OK, EMPTY, EMPTY])
    assert evaluations([[0.0, 0.0]], [[FAILED, EMPTY]]).status.tolist() == [FAILED]
    for how in ("geometric_mean", "min"):
        costs = archive.cost(evaluations(volumes, statuses, how), SearchConfig(over_tasks=how))
        np.testing.assert_array_equal(np.isfinite(costs), [True, False, False])


def test_demands_hold_for_the_worst_task():
    assert order([[90.0, 2.0], [6.0, 6.0]], at_least={"sum": 5.0}) == [1, 0]


@jax.jit
def two_bowls(genomes, key):
    """The second one's best is at the other end; both are infeasible in their corners."""
    each = bowl(genomes, key), bowl(1 - genomes, key)
    return over_tasks(jax.tree.map(lambda *leaves: jnp.stack(leaves, 1), *each), "geometric_mean")


def generations(path, config, until=None):
    """Runs a search in a folder and stops before generation `until`; its state and the lines of all generations."""
    plan = search.Plan(config.search, config.elites, (0.3, 0.5, 0.7), (True, False, False), NAMES)
    example = jax.eval_shape(two_bowls, jnp.zeros((plan.settings.population, 3)), jax.random.key(0))
    evaluate = ShardedEvaluate(two_bowls, Cluster.of(), search_driver.CHUNK)
    with RunFolder.open(path, config) as folder:
        begun = state = folder.restore(search.start(plan, example))
        for state, record in search.run(plan, evaluate, begun):  # noqa: B007 (the last one is saved)
            folder.append(record.record())
            if record.index + 1 == until:
                break
        folder.save(state, int(state.generation))
    return jax.device_get(state), (path / "generations.jsonl").read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    config = search_driver.experiment(generations=6, population=8)
    return config, *generations(tmp_path_factory.mktemp("runs") / "whole", config)


@pytest.mark.thorough
def test_a_search_for_two_tasks_goes_on_bit_by_bit(whole, tmp_path):
    config, state, lines = whole
    generations(tmp_path / "run", config, until=2)
    again, appended = generations(tmp_path / "run", config)
    assert pipeline.same(again, state)
    assert appended == lines


@pytest.mark.thorough
def test_elites_keep_what_they_are_worth_on_every_task(whole):
    _, state, _ = whole
    elites = state.elites
    assert int(elites.count) == 3
    for k in range(3):
        each = [
            float(bowl(genomes, jax.random.key(0)).volumes["sum"][0])
            for genomes in (elites.evaluation.genome[k : k + 1], 1 - elites.evaluation.genome[k : k + 1])
        ]
        np.testing.assert_allclose(elites.evaluation.tasks.volumes["sum"][k], each, rtol=0.02)  # its noise
    np.testing.assert_allclose(np.exp(-elites.costs), elites.evaluation.volumes["sum"])
