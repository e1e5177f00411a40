import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.config.schema import ElitesConfig, NestedConfig, SearchConfig
from rtcd_jax.search import cmaes, search
from rtcd_jax.search.nesting import Nested
from rtcd_jax.search.search import NothingFeasible, Plan
from rtcd_jax.types import Status
from tests.search.fake_evaluation import bowl, population

INITIAL = (0.3, 0.5, 0.7)
DESIGN = (True, False, False)
PEAK = np.array([0.8, 0.6, 0.4])


def plan(mode="joint", initial=INITIAL, design=DESIGN, distance=0.02, **changes):
    settings = {"population": 32, "generations": 12, "nested": NestedConfig(designs=4, generations=3)}
    settings |= {"patience": 0} | changes
    return Plan(SearchConfig(mode=mode, **settings), ElitesConfig(count=4, distance=distance), initial, design)


def begin(plan, evaluate=bowl):
    genomes = jax.ShapeDtypeStruct((plan.settings.population, len(plan.initial)), jnp.float64)
    return search.start(plan, jax.eval_shape(evaluate, genomes, jax.random.key(0)))


def all_of(plan, evaluate=bowl, state=None):
    return list(search.run(plan, evaluate, begin(plan, evaluate) if state is None else state))


def same(left, right):
    pairs = zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def fails(status):
    def evaluate(genomes, key):
        return population(genomes, jnp.ones(len(genomes)), jnp.full(len(genomes), status))

    return evaluate


both_modes = pytest.mark.parametrize("mode", ["joint", "nested"])


@pytest.mark.thorough
@both_modes
def test_the_search_finds_the_known_optimum(mode):
    final, last = all_of(plan(mode, generations=60))[-1]
    assert last.best_so_far > 99.5
    np.testing.assert_allclose(final.elites.evaluation.genome[0], PEAK, atol=0.08)


@pytest.mark.thorough
@both_modes
@pytest.mark.parametrize("failed", [Status.FUNNEL_EMPTY, Status.TOO_STIFF])
def test_what_bears_more_knots_ranks_better_where_nothing_is_feasible(mode, failed):
    """The search comes to the only funnels there are, although no first candidate has one."""

    def narrow(genomes, key):
        distance = jnp.linalg.norm(genomes - PEAK, axis=1)
        feasible = distance < 0.1
        evaluation = population(genomes, 1 - distance, jnp.where(feasible, Status.OK, failed))
        borne = jnp.where(feasible, 1.0, 1 - distance / 2)
        return eqx.tree_at(lambda e: e.funnel.borne, evaluation, borne, is_leaf=lambda leaf: leaf is None)

    searched = [generation for _, generation in all_of(plan(mode, generations=40, sigma=0.1), narrow)]
    assert searched[0].feasible == 0
    assert searched[-1].best_so_far > 0.9


@pytest.mark.thorough
@both_modes
def test_the_initial_genome_is_the_first_that_is_evaluated(mode):
    _, first = all_of(plan(mode, generations=1))[0]
    np.testing.assert_array_equal(first.genomes[0], INITIAL)


@pytest.mark.thorough
@both_modes
def test_both_modes_spend_the_same_evaluations_on_whole_populations(mode):
    sizes = []

    def counting(genomes, key):
        sizes.append(genomes.shape)
        return bowl(genomes, key)

    chosen = plan(mode)
    final, last = all_of(chosen, counting, begin(chosen))[-1]
    assert sizes == [(32, 3)] * 12
    assert final.evaluations == last.evaluations == 32 * 12


@both_modes
def test_a_stored_state_goes_on_bit_equal_from_every_generation(mode):
    chosen = plan(mode, generations=7)
    states = [begin(chosen)] + [state for state, _ in all_of(chosen)]
    for k, state in enumerate(states):
        stored = jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)), state)
        rest = all_of(chosen, state=stored)
        assert [generation.index for _, generation in rest] == list(range(k, 7))
        assert not rest or same(rest[-1][0], states[-1])


@both_modes
def test_the_seed_decides_everything_and_each_generation_has_its_own_directions(mode):
    keys = []

    def listening(genomes, key):
        keys.append(tuple(np.asarray(jax.random.key_data(key))))
        return bowl(genomes, key)

    first, again, other = (
        all_of(plan(mode, seed=seed, generations=5), listening, begin(plan(mode))) for seed in (1, 1, 2)
    )
    assert same(first[-1][0], again[-1][0])
    assert not np.array_equal(first[0][1].genomes[1:], other[0][1].genomes[1:])
    assert keys[:5] == keys[5:10]
    assert len(set(keys)) == 10


@pytest.mark.thorough
@both_modes
def test_every_genome_is_in_the_box_even_when_the_optimum_is_not(mode):
    for _, generation in all_of(plan(mode, initial=(1.0, 0.0, 1.0), sigma=0.9)):
        assert generation.genomes.min() >= 0
        assert generation.genomes.max() <= 1


def test_nested_candidates_of_one_design_share_it_and_differ_in_their_weights():
    generations = [g.genomes.reshape(4, 8, 3) for _, g in all_of(plan("nested", generations=6))]
    designs = [g[..., 0] for g in generations]
    for k in range(6):
        assert np.all(designs[k] == designs[k][:, :1])
        assert all(len(np.unique(weights, axis=0)) > 1 for weights in generations[k][..., 1:])
    assert np.array_equal(designs[0], designs[1])
    assert np.array_equal(designs[0], designs[2])
    assert not np.array_equal(designs[2], designs[3])
    # Every inner search begins anew at the initial weights.
    for k in (0, 3):
        np.testing.assert_array_equal(generations[k][:, 0, 1:], np.tile(INITIAL[1:], (4, 1)))


@pytest.mark.thorough
def test_the_outer_search_is_told_the_best_of_each_inner_search():
    """Rebuilt by hand with `cmaes` alone from the recorded costs."""
    chosen = plan("nested", generations=3)
    records = all_of(chosen)
    final = records[-1][0].strategy
    best = -np.log(np.max([np.nanmax(g.volumes["sum"].reshape(4, 8), axis=1) for _, g in records], axis=0))
    np.testing.assert_allclose(final.best, best, rtol=1e-15)
    strategy = cmaes.Strategy(1, 4, 0.3)
    before = records[0][0].strategy.outer
    expected = cmaes.tell(strategy, before, final.designs, jnp.asarray(best))
    np.testing.assert_allclose(final.outer.evolution.mean, expected.evolution.mean, rtol=1e-12)
    np.testing.assert_allclose(final.outer.evolution.std, expected.evolution.std, rtol=1e-12)
    assert records[1][0].strategy.outer.evolution.generation_counter == 0
    assert final.outer.evolution.generation_counter == 1


@pytest.mark.thorough
def test_nested_searches_equal_looped_ones():
    """The inner search of one design, run alone on that design's recorded costs, asks for the same weights."""
    loop = Nested.plan(32, 4, 3, 0.3, INITIAL, DESIGN)
    ask, tell = (jax.jit(function, static_argnums=0) for function in (cmaes.ask, cmaes.tell))
    key, again = jax.random.split(jax.random.key(4))
    state, points, genomes = loop.ask(loop.start(), key)
    costs = jnp.sum((genomes - PEAK) ** 2, axis=1)
    after, _ = loop.tell(state, points, costs, again)
    for design in range(4):
        alone = cmaes.start(loop.inner, jnp.asarray(INITIAL[1:]))
        alone, asked = ask(loop.inner, alone, jax.random.split(key, 5)[1 + design])
        np.testing.assert_allclose(asked, points[design], rtol=1e-12)
        alone = tell(loop.inner, alone, asked, costs.reshape(4, 8)[design])
        np.testing.assert_allclose(after.inner.evolution.C[design], alone.evolution.C, rtol=1e-9)


@pytest.mark.thorough
def test_pinned_variables_are_not_in_the_genome_and_one_free_weight_is_enough():
    _, last = all_of(plan(initial=(0.1,), design=(False,)))[-1]
    assert last.genomes.shape == (32, 1)
    assert last.best_so_far > 99.9


@pytest.mark.thorough
def test_the_record_agrees_with_the_evaluation():
    seen = []

    def evaluate(genomes, key):
        statuses = jnp.where(genomes[:, 0] > 0.5, Status.FUNNEL_EMPTY, Status.OK)
        seen.append(population(genomes, 1 + genomes[:, 1], statuses))
        return seen[-1]

    chosen = plan(objective="inlet", generations=3)
    for k, (state, record) in enumerate(search.run(chosen, evaluate, begin(chosen, bowl))):
        evaluation = seen[k]
        good = np.asarray(evaluation.status) == Status.OK
        assert 0 < good.sum() < 32
        inlet = np.asarray(evaluation.volumes["inlet"])[good]
        assert (record.index, record.objective, record.evaluations) == (k, "inlet", 32 * (k + 1))
        assert record.best == inlet.max()
        assert record.median == np.median(inlet)
        assert record.best_so_far == state.elites.evaluation.volumes["inlet"][0] >= record.best
        assert record.feasible == good.mean()
        assert record.counts == {"OK": good.sum(), "FUNNEL_EMPTY": 32 - good.sum()}
        assert same(record.genomes, evaluation.genome)
        assert same(record.statuses, evaluation.status)
        for name, values in evaluation.volumes.named.items():
            np.testing.assert_array_equal(record.volumes[name], np.where(good, values, np.nan))
        evolution = state.strategy.evolution
        widest = np.sqrt(np.linalg.eigvalsh(evolution.std**2 * evolution.C)[-1])
        assert record.sigma == pytest.approx(widest, rel=1e-12)


def test_sigma_is_the_spread_of_the_population_however_the_covariance_is_scaled():
    """A search that has converged says so: its candidates are that close to one another."""
    records = [record for _, record in all_of(plan(generations=60, patience=0))]
    spread = np.linalg.svd(records[-1].genomes - records[-1].genomes.mean(0))[1][0] / np.sqrt(31)
    assert records[-2].sigma < 0.01 < records[0].sigma
    assert 0.3 < records[-2].sigma / spread < 3


@pytest.mark.thorough
@both_modes
def test_a_search_that_gains_nothing_ends_after_its_patience(mode):
    """Nothing is gained from the first generation on; nested, generations of the outer search count."""

    def flat(genomes, key):
        return population(genomes, jnp.ones(len(genomes)))

    chosen = plan(mode, generations=60, patience=4)
    patience = 4 * (chosen.settings.nested.generations if mode == "nested" else 1)
    assert len(all_of(chosen, flat)) == patience + 1
    assert len(all_of(plan(mode, generations=40, patience=0), flat)) == 40


def test_a_search_that_goes_on_ends_where_it_would_have_ended():
    chosen = plan(generations=60, patience=4)
    whole = [(state, record.best_so_far) for state, record in all_of(chosen)]
    assert 8 < len(whole) < 60
    state, best = whole[7][0], [volume for _, volume in whole[:8]]
    assert [record.best_so_far for _, record in search.run(chosen, bowl, state, best)] == [v for _, v in whole[8:]]
    assert search.settled(chosen.settings, [volume for _, volume in whole])
    assert not search.settled(chosen.settings, [volume for _, volume in whole[:-1]])


@pytest.mark.parametrize(("best", "over"), [([np.nan] * 9, False), ([np.nan] * 4 + [1.0], False), ([1.0] * 5, True),
                                            ([1.0] * 4 + [1.0011], False), ([1.0] * 4, False)])  # fmt: skip
def test_what_counts_as_no_gain(best, over):
    assert bool(search.settled(plan(patience=4).settings, best)) == over


@pytest.mark.thorough
def test_restarts_are_counted_and_their_reason_is_told():
    def flat(genomes, key):
        return population(genomes, jnp.ones(len(genomes)))

    chosen = plan(generations=30)
    records = [record for _, record in all_of(chosen, flat)]
    stopped = [record.index for record in records if record.stops]
    memory = cmaes.Strategy(3, 32, 0.3).memory
    assert stopped == [memory - 1, 2 * memory - 1]
    assert all(records[k].stops == {"FLAT": 1} for k in stopped)
    assert [records[k].restarts for k in (memory - 2, memory - 1, 29)] == [0, 1, 2]


@both_modes
def test_a_search_without_anything_feasible_stops_clearly_after_ten_generations(mode):
    records = search.run(plan(mode, generations=40), fails(Status.RICCATI_INDEFINITE), begin(plan(mode)))
    for _ in range(search.PATIENCE):
        _, record = next(records)
        assert record.feasible == 0
        assert np.isnan([record.best, record.median, record.best_so_far]).all()
    with pytest.raises(NothingFeasible, match="none of 320 candidates in 10 generations") as error:
        next(records)
    assert error.value.counts[Status.RICCATI_INDEFINITE] == 320
    assert "320 RICCATI_INDEFINITE: the Riccati equation has no positive definite" in str(error.value)
    assert "FUNNEL_EMPTY" not in str(error.value)


def test_a_short_search_without_anything_feasible_stops_at_its_end():
    records = search.run(plan(generations=2), fails(Status.FUNNEL_EMPTY), begin(plan()))
    assert [record.index for _, record in (next(records), next(records))] == [0, 1]
    with pytest.raises(NothingFeasible, match="in 2 generations"):
        next(records)


def test_one_feasible_candidate_keeps_the_search_going():
    def rare(genomes, key):
        statuses = jnp.where(jnp.arange(len(genomes)) == 5, Status.OK, Status.FUNNEL_EMPTY)
        return population(genomes, 1 + genomes[:, 0], statuses)

    assert len(all_of(plan(generations=12), rare)) == 12


@pytest.mark.thorough
def test_finish_reports_the_second_evaluation_alone_and_sorts_anew():
    final, _ = all_of(plan(distance=0.05))[-1]
    assert final.elites.count == 4
    volumes = jnp.array([1.0, 4.0, 2.0, 3.0])
    finished = search.finish(plan(), final, population(final.elites.evaluation.genome, volumes))
    np.testing.assert_array_equal(finished.evaluation.volumes["sum"], [4, 3, 2, 1])
    np.testing.assert_array_equal(finished.evaluation.genome, final.elites.evaluation.genome[jnp.array([1, 3, 2, 0])])
    np.testing.assert_array_equal(finished.generations, final.elites.generations[jnp.array([1, 3, 2, 0])])


@pytest.mark.thorough
def test_finish_drops_elites_that_fail_the_second_time_and_never_fills_empty_slots():
    def only_three(genomes, key):
        statuses = jnp.where(jnp.arange(len(genomes)) < 3, Status.OK, Status.FUNNEL_EMPTY)
        return population(genomes, 1.0 + jnp.arange(len(genomes)), statuses)

    chosen = plan(generations=1)
    final, _ = all_of(chosen, only_three)[-1]
    assert final.elites.count == 3

    volumes, statuses = jnp.array([5.0, 9.0, 1.0, 7.0]), jnp.array([0, Status.FUNNEL_EMPTY, 0, 0])
    again = population(final.elites.evaluation.genome, volumes, statuses)
    finished = search.finish(chosen, final, again)
    assert finished.count == 2
    np.testing.assert_array_equal(finished.evaluation.volumes["sum"][:2], [5, 1])


def test_elites_gather_over_all_generations():
    chosen = plan()
    best = -np.inf
    for state, record in search.run(chosen, bowl, begin(chosen)):
        best = max(best, record.best)
        assert record.best_so_far == best
        assert np.all(np.diff(state.elites.costs[: int(state.elites.count)]) >= 0)
        assert np.all(state.elites.generations[: int(state.elites.count)] <= record.index)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"initial": (0.5, 1.5, -0.1)}, r"leaves the unit box \[0, 1\] at 1: 1.5, 2: -0.1"),
        ({"initial": (0.5, float("nan"), 0.5)}, "at 1: nan"),
        ({"initial": (), "design": ()}, "at least 1 free variable, got 0"),
        ({"design": (True,)}, "design has 1 flags for 3 free variables"),
        ({"mode": "nested", "design": (False,) * 3}, "need a free design variable, but the design is pinned"),
        ({"mode": "nested", "design": (True,) * 3}, "need a free weight, but all weights are pinned"),
    ],
)
def test_a_plan_refuses_what_cannot_be_searched(change, message):
    with pytest.raises(ValueError, match=message):
        plan(**change)


def test_nested_loops_refuse_a_population_that_does_not_divide():
    with pytest.raises(ValueError, match="a multiple of the 5 designs, got 32"):
        Nested.plan(32, 5, 3, 0.3, INITIAL, DESIGN)
    with pytest.raises(ValueError, match="population of at least 4, got 2"):
        Nested.plan(32, 16, 3, 0.3, INITIAL, DESIGN)


def test_a_plan_is_a_value():
    assert plan() == plan()
    assert hash(plan()) == hash(plan())
    assert plan() != dataclasses.replace(plan(), initial=(0.1, 0.2, 0.3))
