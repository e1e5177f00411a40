import functools

import cma
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from rtcd_jax.search import cmaes
from rtcd_jax.search.cmaes import Stop, Strategy

AXES = np.linalg.qr(np.random.default_rng(0).normal(size=(10, 10)))[0] * 10 ** np.linspace(0, 3, 10)


def ellipsoid(x, center):
    return jnp.sum(((x - center) @ AXES) ** 2, axis=-1)


def rastrigin(x):
    z = 8 * (x - 0.6)
    return jnp.sum(z**2 - 10 * jnp.cos(2 * jnp.pi * z) + 10, axis=-1)


ask, tell = (jax.jit(function, static_argnums=0) for function in (cmaes.ask, cmaes.tell))


def generation(strategy, cost, state, key):
    draw, anew = jax.random.split(key)
    state, points = cmaes.ask(strategy, state, draw)
    genomes = cmaes.clip(points)
    costs = cost(genomes)
    state = cmaes.tell(strategy, state, points, costs)
    reason = cmaes.stop(strategy, state)
    best = jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))
    return cmaes.restart(strategy, state, anew), (costs[best], genomes[best], reason, state)


@functools.partial(jax.jit, static_argnums=(0, 1, 3))
def run(strategy, cost, key, generations, mean):
    step = functools.partial(generation, strategy, cost)
    return jax.lax.scan(step, cmaes.start(strategy, mean), jax.random.split(key, generations))


def runs(strategy, cost, seeds, generations, mean):
    keys = jax.vmap(jax.random.key)(jnp.arange(seeds))
    return jax.vmap(lambda key: run(strategy, cost, key, generations, mean))(keys)


def told(strategy, state, costs, key=0):
    """One generation with costs that are given, whatever the points."""
    state, points = ask(strategy, state, jax.random.key(key))
    return tell(strategy, state, points, jnp.asarray(costs)), points


def same(left, right):
    pairs = zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


@pytest.mark.thorough
def test_ellipsoid_needs_at_most_twice_the_evaluations_of_pycma():
    strategy = Strategy(10, 10, 0.3)
    _, (costs, *_) = runs(strategy, lambda x: ellipsoid(x, 0.6), 5, 800, jnp.full(10, 0.3))
    reached = np.asarray(costs) < 1e-8
    assert reached.any(axis=1).all()
    ours = 10 * np.argmax(reached, axis=1)

    def pycma(seed):
        options = {"popsize": 10, "seed": seed, "verbose": -9, "ftarget": 1e-8}
        es = cma.CMAEvolutionStrategy([0.3] * 10, 0.3, options)
        es.optimize(lambda x: float(np.sum(((x - 0.6) @ AXES) ** 2)))
        assert es.result.fbest < 1e-8
        return es.result.evaluations

    assert np.median(ours) <= 2 * np.median([pycma(seed) for seed in range(1, 6)])


@pytest.mark.slow
def test_rotated_ellipsoid_with_its_optimum_on_the_bounds_is_solved_from_every_seed():
    center = np.linspace(-0.3, 1.2, 10)
    oracle = lsq_linear(AXES.T, AXES.T @ center, bounds=(0, 1), tol=1e-14)
    assert np.sum((oracle.x < 1e-6) | (oracle.x > 1 - 1e-6)) >= 2
    best = ellipsoid(oracle.x, center)
    _, (costs, genomes, *_) = runs(Strategy(10, 16, 0.3), lambda x: ellipsoid(x, center), 10, 600, jnp.full(10, 0.5))
    assert np.min(genomes) >= 0
    assert np.max(genomes) <= 1
    np.testing.assert_allclose(np.min(costs, axis=1), best, rtol=1e-6)


@pytest.mark.slow
def test_a_larger_population_solves_rastrigin_more_often():
    def solved(population):
        strategy = Strategy(5, population, 0.3)
        _, (costs, *_) = runs(strategy, rastrigin, 8, 80, jnp.full(5, 0.2))
        return np.sum(np.min(costs, axis=1) < 1e-6)

    assert solved(256) >= 7
    assert solved(8) <= 3


@pytest.mark.thorough
def test_restarts_find_what_one_search_misses():
    """Two wells; from this mean and step the search falls into the shallow one, whose floor it cannot leave."""

    def wells(x):
        return jnp.minimum(1 + jnp.sum((x - 0.2) ** 2, -1), 50 * jnp.sum((x - 0.85) ** 2, -1))

    strategy = Strategy(2, 8, 0.02)
    _, (costs, _, reasons, _) = runs(strategy, wells, 4, 900, jnp.full(2, 0.2))
    first = np.argmax(np.asarray(reasons) != Stop.NONE, axis=1)
    assert all(np.min(c[: k + 1]) >= 1 for c, k in zip(np.asarray(costs), first, strict=True))
    assert np.all(np.min(costs, axis=1) < 1e-8)


@pytest.mark.thorough
def test_the_first_population_has_the_mean_itself_as_its_first_member():
    strategy, mean = Strategy(3, 6, 0.3), jnp.array([0.0, 0.25, 1.0])
    state, points = ask(strategy, cmaes.start(strategy, mean), jax.random.key(1))
    assert np.array_equal(points[0], mean)
    assert not np.any(np.all(points[1:] == mean, axis=1))
    state = tell(strategy, state, points, rastrigin(points))
    _, points = ask(strategy, state, jax.random.key(2))
    assert not np.any(np.all(points == state.evolution.mean, axis=1))


@pytest.mark.thorough
@pytest.mark.parametrize("failure", [jnp.inf, jnp.nan, -jnp.inf])
def test_a_search_in_which_all_fails_stays_finite_near_the_box_and_starts_anew_elsewhere(failure):
    strategy = Strategy(3, 8, 0.3)
    state, (_, genomes, reasons, states) = run(
        strategy, lambda x: jnp.full(len(x), failure), jax.random.key(0), 200, jnp.full(3, 0.5)
    )
    assert all(np.all(np.isfinite(leaf)) for leaf in (states.evolution.mean, states.evolution.std, states.evolution.C))
    assert np.all(np.abs(states.evolution.mean - 0.5) < 3)
    assert set(np.unique(reasons)) == {Stop.NONE, Stop.NOTHING_FEASIBLE}
    assert state.restarts == np.sum(np.asarray(reasons) != Stop.NONE) == 200 // strategy.memory
    spread = np.asarray(genomes).std(axis=0)
    assert np.all(spread > 0.1)


@pytest.mark.thorough
def test_failures_rank_last_whatever_their_number():
    """Tied ranks would give failed points the weights of good ones; only the feasible half may move the mean."""
    strategy, mean = Strategy(2, 16, 0.05), jnp.full(2, 0.5)
    state, points = ask(strategy, cmaes.start(strategy, mean), jax.random.key(3))
    good = np.argsort(points[:, 0])[-8:]
    costs = np.full(16, np.nan)
    costs[good] = -np.asarray(points)[good, 0]
    after = tell(strategy, state, points, jnp.asarray(costs))
    assert after.evolution.mean[0] > np.median(points[:, 0])
    others = np.where(np.isnan(costs), 1e300, costs)
    assert same(tell(strategy, state, points, jnp.asarray(others)).evolution.mean, after.evolution.mean)


@pytest.mark.thorough
def test_tied_costs_take_every_weight_once():
    strategy = Strategy(4, 12, 0.3)
    begin = cmaes.start(strategy, jnp.full(4, 0.5))
    flat, _ = told(strategy, begin, jnp.zeros(12))
    ordered, _ = told(strategy, begin, 1e-13 * jnp.arange(12))
    assert jnp.all(jnp.isfinite(flat.evolution.C))
    inside = jnp.full(4, 0.5) * jnp.ones((12, 1)) + 0.01 * jax.random.normal(jax.random.key(0), (12, 4))
    flat, ordered = (tell(strategy, begin, inside, c) for c in (jnp.zeros(12), 1e-13 * jnp.arange(12)))
    assert same(flat.evolution, ordered.evolution)


@pytest.mark.thorough
def test_only_the_order_of_the_costs_matters_inside_the_box():
    strategy = Strategy(3, 8, 0.05)
    state, points = ask(strategy, cmaes.start(strategy, jnp.full(3, 0.5)), jax.random.key(0))
    assert jnp.all(points == cmaes.clip(points))
    costs = jnp.linspace(-4, 3, 8)[jax.random.permutation(jax.random.key(1), 8)]
    left, right = (tell(strategy, state, points, c).evolution for c in (costs, jnp.exp(costs) - 7))
    assert same((left.mean, left.std, left.C), (right.mean, right.std, right.C))


def test_a_point_outside_the_box_loses_against_its_equal_inside():
    strategy = Strategy(1, 4, 0.3)
    points = jnp.array([[1.4], [0.9], [1.2], [0.95]])
    after = tell(strategy, cmaes.start(strategy, jnp.ones(1)), points, jnp.zeros(4))
    assert after.evolution.mean[0] < 1


@pytest.mark.thorough
def test_vmapped_equals_looped():
    strategy, mean, cost = Strategy(3, 8, 0.3), jnp.full(3, 0.4), rastrigin
    batched, (costs, *_) = runs(strategy, cost, 3, 25, mean)
    for lane in range(3):
        single, (expected, *_) = run(strategy, cost, jax.random.key(lane), 25, mean)
        np.testing.assert_allclose(costs[lane], expected, rtol=1e-9)
        np.testing.assert_allclose(batched.evolution.C[lane], single.evolution.C, rtol=1e-9, atol=1e-12)


@pytest.mark.thorough
def test_a_lane_that_only_fails_leaves_its_neighbours_bit_equal():
    strategy = Strategy(2, 8, 0.3)
    keys = jax.random.split(jax.random.key(5), 20)

    def search(broken):
        return jax.lax.scan(
            functools.partial(generation, strategy, lambda x: jnp.where(broken, jnp.nan, rastrigin(x))),
            cmaes.start(strategy, jnp.full(2, 0.4)),
            keys,
        )[0]

    healthy, mixed = (jax.vmap(search)(jnp.array(flags)) for flags in ([False, False], [False, True]))
    lane = functools.partial(jax.tree.map, lambda leaf: leaf[0])
    assert same(lane(healthy), lane(mixed))


@pytest.mark.thorough
def test_the_carry_keeps_its_types_and_a_stored_state_goes_on_bit_equal():
    strategy = Strategy(3, 8, 0.3)
    begin = cmaes.start(strategy, jnp.full(3, 0.4))
    step = jax.jit(functools.partial(generation, strategy, rastrigin))
    keys = jax.random.split(jax.random.key(2), 6)
    state = begin
    for k, key in enumerate(keys):
        state, _ = step(state, key)
        assert jax.tree.map(lambda x: (x.shape, x.dtype, x.weak_type), state) == jax.tree.map(
            lambda x: (x.shape, x.dtype, x.weak_type), begin
        )
        if k == 2:
            stored = jax.tree.map(np.asarray, state)
    for key in keys[3:]:
        stored, _ = step(stored, key)
    assert same(stored, state)


def with_evolution(state, **changes):
    return eqx.tree_at(lambda s: s.evolution, state, state.evolution.replace(**changes))


def after_one(strategy):
    state, _ = told(strategy, cmaes.start(strategy, jnp.full(2, 0.5)), jnp.arange(8.0))
    assert cmaes.stop(strategy, state) == Stop.NONE
    return state


S = Strategy(2, 8, 0.3)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("reason", "below", "above"),
    [
        (Stop.NOT_FINITE, {"std": 1.0}, {"std": jnp.nan}),
        (Stop.NOT_FINITE, {"C": jnp.eye(2)}, {"C": jnp.eye(2).at[0, 1].set(jnp.inf)}),
        (Stop.CONDITION, {"std": 1e-5, "D": jnp.array([1, 0.9e7])}, {"std": 1e-5, "D": jnp.array([1, 1.1e7])}),
        (Stop.GROWTH, {"std": 0.29e4}, {"std": 0.31e4}),
        (Stop.TOLERANCE_X, {"std": 4e-13, "C": jnp.eye(2)}, {"std": 2e-13, "C": jnp.eye(2), "p_c": jnp.ones(2)}),
        (Stop.GENERATIONS, {"generation_counter": S.patience - 1}, {"generation_counter": S.patience}),
    ],
)
def test_a_stop_holds_on_one_side_of_its_threshold(reason, below, above):
    state = after_one(S)
    if reason == Stop.GROWTH:
        state = with_evolution(state, D=jnp.ones(2))
    assert cmaes.stop(S, with_evolution(state, **below)) == Stop.NONE
    assert cmaes.stop(S, with_evolution(state, **above)) == reason


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("reason", "costs"),
    [(Stop.FLAT, jnp.zeros(8)), (Stop.FLAT, jnp.linspace(0, 1e-13, 8)), (Stop.NOTHING_FEASIBLE, jnp.full(8, jnp.inf))],
)
def test_history_stops_come_after_the_memory_is_full_and_not_before(reason, costs):
    strategy = Strategy(2, 8, 0.01)
    state = cmaes.start(strategy, jnp.full(2, 0.5))
    for k in range(strategy.memory):
        assert cmaes.stop(strategy, state) == Stop.NONE
        state, _ = told(strategy, state, costs, key=k)
    assert cmaes.stop(strategy, state) == reason


def test_one_feasible_generation_within_the_memory_keeps_a_search_alive():
    strategy = Strategy(2, 8, 0.01)
    state, _ = told(strategy, cmaes.start(strategy, jnp.full(2, 0.5)), jnp.arange(8.0))
    for k in range(strategy.memory - 1):
        state, _ = told(strategy, state, jnp.full(8, jnp.inf), key=k)
        assert cmaes.stop(strategy, state) == Stop.NONE
    state, _ = told(strategy, state, jnp.full(8, jnp.inf))
    assert cmaes.stop(strategy, state) == Stop.NOTHING_FEASIBLE


@pytest.mark.thorough
def test_restart_touches_only_the_lanes_that_stopped():
    alive = after_one(S)
    dead = with_evolution(alive, std=jnp.asarray(jnp.nan))
    both = jax.tree.map(lambda a, b: jnp.stack([a, b]), alive, dead)
    keys = jax.random.split(jax.random.key(0), 2)
    restarted = jax.vmap(functools.partial(cmaes.restart, S))(both, keys)
    assert same(jax.tree.map(lambda leaf: leaf[0], restarted), alive)
    fresh = jax.tree.map(lambda leaf: leaf[1], restarted)
    expected = cmaes.start(S, fresh.evolution.mean)
    assert same(fresh, eqx.tree_at(lambda s: s.restarts, expected, alive.restarts + 1))
    assert jnp.all((fresh.evolution.mean > 0) & (fresh.evolution.mean < 1))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0, 8, 0.3), "at least 1 free variable, got 0"),
        ((2, 3, 0.3), "population of at least 4, got 3"),
        ((2, 8, 0.0), "positive, finite sigma, got 0.0"),
        ((2, 8, float("nan")), "positive, finite sigma, got nan"),
    ],
)
def test_a_strategy_refuses_what_cannot_work(arguments, message):
    with pytest.raises(ValueError, match=message):
        Strategy(*arguments)


@pytest.mark.thorough
def test_one_variable_and_the_smallest_population_work():
    _, (costs, *_) = run(Strategy(1, 4, 0.3), lambda x: (x[:, 0] - 0.7) ** 2, jax.random.key(0), 60, jnp.zeros(1))
    assert np.min(costs) < 1e-8


def test_single_precision_is_refused():
    strategy = Strategy(7, 5, 0.3)
    with jax.enable_x64(False), pytest.raises(ValueError, match="jax_enable_x64 is False"):
        cmaes.start(strategy, jnp.zeros(7))
