import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.config.schema import SearchConfig
from rtcd_jax.search import archive as elites
from rtcd_jax.types import Status
from tests.search.fake_evaluation import population

CAPACITY, DISTANCE = 5, 0.05
BY_SUM = SearchConfig()


def random_population(seed, size=40, dimensions=2):
    rng = np.random.default_rng(seed)
    statuses = np.where(rng.random(size) < 0.3, rng.integers(1, len(Status), size), 0)
    return population(rng.random((size, dimensions)), rng.random(size) + 0.01, statuses)


def nothing(capacity=CAPACITY, dimensions=2):
    return elites.empty(capacity, random_population(0, dimensions=dimensions))


def merged(populations, capacity=CAPACITY, distance=DISTANCE, objective="sum"):
    archive = nothing(capacity, populations[0].genome.shape[1])
    for generation, evaluation in enumerate(populations):
        archive = elites.merge(archive, evaluation, SearchConfig(objective=objective), generation, distance)
    return archive


def same(left, right):
    assert jax.tree.structure(left) == jax.tree.structure(right)
    pairs = zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(5))
def test_sorted_apart_feasible_and_with_the_best_ever_seen(seed):
    populations = [random_population(100 * seed + k) for k in range(4)]
    archive = merged(populations)
    count = int(archive.count)
    assert count == CAPACITY
    assert np.all(np.diff(archive.costs) >= 0)
    assert np.all(archive.evaluation.status == Status.OK)
    genomes = np.asarray(archive.evaluation.genome)
    gaps = np.abs(genomes[:, None] - genomes[None]).max(-1)[~np.eye(count, dtype=bool)]
    assert gaps.min() >= DISTANCE
    best = max(float(jnp.max(jnp.where(p.status == 0, p.volumes["sum"], 0))) for p in populations)
    assert archive.evaluation.volumes["sum"][0] == best


@pytest.mark.thorough
def test_whatever_is_left_out_is_worse_than_the_last_or_next_to_a_better_one():
    evaluation = random_population(3, size=200)
    archive = merged([evaluation])
    costs = np.asarray(elites.cost(evaluation, BY_SUM))
    kept = np.asarray(archive.evaluation.genome)
    left_out = [k for k in range(200) if np.isfinite(costs[k]) and not np.any(np.all(evaluation.genome[k] == kept, 1))]
    assert left_out
    for k in left_out:
        gaps = np.abs(np.asarray(evaluation.genome)[k] - kept).max(-1)
        better_neighbor = np.any((gaps < DISTANCE) & (np.asarray(archive.costs) <= costs[k]))
        assert better_neighbor or costs[k] >= archive.costs[-1]


@pytest.mark.thorough
def test_each_elite_is_its_whole_record():
    populations = [random_population(k) for k in range(3)]
    archive = merged(populations)
    for slot in range(CAPACITY):
        source = populations[int(archive.generations[slot])]
        row = int(np.flatnonzero(np.all(source.genome == archive.evaluation.genome[slot], axis=1))[0])
        pick = jax.tree.map(lambda leaf, i=slot: leaf[i], archive.evaluation)
        assert same(pick, jax.tree.map(lambda leaf, i=row: leaf[i], source))


@pytest.mark.thorough
def test_without_neighbors_the_order_of_merges_does_not_matter():
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 6), np.linspace(0, 1, 6)), -1).reshape(-1, 2)
    volumes = np.random.default_rng(0).permutation(36) + 1.0
    parts = [population(grid[k::3], volumes[k::3]) for k in range(3)]
    at_once = merged([population(grid, volumes)])
    for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        archive = merged([parts[k] for k in order])
        assert same(archive.evaluation, at_once.evaluation)
        assert same(archive.costs, at_once.costs)


@pytest.mark.thorough
def test_merging_twice_changes_nothing():
    evaluation = random_population(1)
    once = elites.merge(nothing(), evaluation, BY_SUM, 4, DISTANCE)
    assert same(once, elites.merge(once, evaluation, BY_SUM, 9, DISTANCE))
    assert np.all(once.generations == 4)


@pytest.mark.thorough
@pytest.mark.parametrize(("gap", "count"), [(0.0499, 1), (0.0501, 2)])
def test_neighbors_are_merged_into_the_better_one_below_the_distance_and_not_above(gap, count):
    archive = merged([population([[0.5, 0.5], [0.5, 0.5 + gap]], [1.0, 2.0])])
    assert archive.count == count
    assert archive.evaluation.volumes["sum"][0] == 2.0


@pytest.mark.thorough
def test_an_elite_is_replaced_by_its_better_neighbor_and_not_by_a_worse_one():
    old, better, worse = (population([[0.5, 0.5 + s]], [v]) for s, v in ((0.0, 2.0), (0.01, 3.0), (0.02, 1.0)))
    archive = merged([old, worse, better])
    assert archive.count == 1
    assert archive.generations[0] == 2


@pytest.mark.thorough
def test_distance_zero_keeps_all_but_is_no_license_for_duplicates_of_one_row():
    evaluation = population([[0.5, 0.5], [0.5, 0.5001]], [1.0, 2.0])
    archive = merged([evaluation], distance=0.0)
    assert archive.count == 2


@pytest.mark.thorough
@pytest.mark.parametrize("status", [s for s in Status if s != Status.OK])
def test_a_failed_candidate_never_enters_however_large_its_volume(status):
    archive = merged([population([[0.1, 0.1], [0.9, 0.9]], [1e9, 1.0], [status, Status.OK])])
    assert archive.count == 1
    assert archive.evaluation.volumes["sum"][0] == 1.0


@pytest.mark.thorough
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_volume_that_is_not_positive_and_finite_never_enters(value):
    archive = merged([population([[0.1, 0.1]], [value])])
    assert archive.count == 0


def test_empty_slots_are_recognizable_and_survive_a_merge_of_failures():
    archive = merged([population([[0.1, 0.1], [0.3, 0.3]], [1.0, 2.0], [1, 2])])
    assert same(archive, nothing())
    assert np.all(archive.evaluation.status != Status.OK)
    assert np.all(archive.generations == -1)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("objective", "value"), [("sum", 3.0), ("integral", 6.0), ("inlet", 1 / 3), ("geometric_mean", 9.0), ("push", 0.03)]
)
def test_the_cost_is_the_negative_logarithm_of_the_named_volume(objective, value):
    evaluation = population([[0.1, 0.2]], [3.0])
    np.testing.assert_allclose(elites.cost(evaluation, SearchConfig(objective=objective)), [-np.log(value)], rtol=1e-15)


def test_the_objective_decides_the_order():
    evaluation = population([[0.1, 0.1], [0.9, 0.9]], [1.0, 2.0])
    by_sum, by_inlet = (merged([evaluation], objective=o).evaluation.volumes["sum"] for o in ("sum", "inlet"))
    assert (by_sum[0], by_inlet[0]) == (2.0, 1.0)


@pytest.mark.thorough
def test_what_lacks_a_demanded_volume_ranks_behind_what_has_it_by_how_much_it_lacks():
    """Whatever the objective says of them: 8 and 2 lack push, 8 less of it; 20 and 40 do not, and 40 is the larger."""
    evaluation = population(np.linspace(0, 1, 5)[:, None] * np.ones(2), [8.0, 40.0, 2.0, 20.0, 90.0], [0, 0, 0, 0, 3])
    demanding = SearchConfig(objective="inlet", at_least={"push": 0.1, "sum": 1.0})
    archive = elites.merge(nothing(), evaluation, demanding, 0, DISTANCE)
    assert archive.evaluation.volumes["sum"][:4].tolist() == [20.0, 40.0, 8.0, 2.0]
    assert int(archive.count) == 4
    np.testing.assert_allclose(elites.shortfall(evaluation, demanding), [0.1, 0, 0.4, 0, 0], atol=1e-12)
    graded = np.asarray(elites.graded_cost(evaluation, demanding))
    assert np.max(graded[:4]) < elites.FAILED
    assert np.isinf(graded[4])


def test_shapes_and_dtypes_stay():
    archives = merged([random_population(2)]), nothing()
    shapes = [jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype), archive) for archive in archives]
    assert shapes[0] == shapes[1]


def test_records_are_asked_for_only_where_one_enters():
    class Asked:
        def __init__(self, evaluation):
            self.genome, self.volumes, self.status = evaluation.genome, evaluation.volumes, evaluation.status
            self.borne, self.tasks = evaluation.borne, evaluation.tasks

        def take(self, rows):
            raise LookupError(rows)

    better, worse = population([[0.5, 0.5]], [2.0]), population([[0.5, 0.51]], [1.0])
    archive = merged([better])
    assert same(elites.merge(archive, Asked(worse), BY_SUM, 1, DISTANCE), archive)
    with pytest.raises(LookupError):
        elites.merge(merged([worse]), Asked(better), BY_SUM, 1, DISTANCE)


@pytest.mark.thorough
def test_single_precision_evaluations_are_kept_as_they_are():
    evaluation = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == jnp.float64 else leaf, random_population(2)
    )
    archive = elites.merge(elites.empty(CAPACITY, evaluation), evaluation, BY_SUM, 0, DISTANCE)
    assert archive.evaluation.genome.dtype == jnp.float32
    assert archive.costs.dtype == jnp.float64


def test_errors_name_the_value_and_what_would_have_been_right():
    with pytest.raises(
        KeyError, match="no volume is called 'hull'; there are sum, integral, inlet, geometric_mean, push"
    ):
        elites.cost(random_population(0), SearchConfig.model_construct(objective="hull"))
    with pytest.raises(ValueError, match="at least 1 elite, got 0"):
        elites.empty(0, random_population(0))
