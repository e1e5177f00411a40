"""Trajectories of random candidates: solutions of the dynamics, inside the boxes, each as if it were alone."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rtcd_jax import trajectory
from rtcd_jax.config import yaml12
from rtcd_jax.config.load import EXAMPLE, load, parse
from rtcd_jax.config.plants import PLANTS
from rtcd_jax.genome import decode, initial_genome
from rtcd_jax.numerics.integrate import rk4
from rtcd_jax.problem import initial_design, make_problem
from rtcd_jax.trajectory import plan
from rtcd_jax.types import Status
from tests.paths import CONFIGS

CONFIG = CONFIGS / "pendulum_rtcd.yaml"
POPULATION = 256


def take(tree, rows):
    return jax.tree.map(lambda leaf: leaf[rows], tree)


def assert_equal_trees(ours, theirs):
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.fixture(scope="module")
def problem():
    return make_problem(load(CONFIG))


@pytest.fixture(scope="module")
def optimize(problem):
    return jax.jit(partial(plan, problem))


@pytest.fixture(scope="module")
def draw(problem):
    """Random candidates of the configuration's box."""

    def candidates(count, seed=0):
        genomes = np.random.default_rng(seed).random((count, len(problem.free)))
        return jax.vmap(partial(decode, problem))(jnp.asarray(genomes))

    return candidates


@pytest.fixture(scope="module")
def candidates(draw):
    return draw(POPULATION)


@pytest.fixture(scope="module")
def planned(optimize, candidates):
    return optimize(candidates)


@pytest.fixture(scope="module")
def solved(candidates, planned):
    """Candidates and trajectories of those that were solved."""
    rows = np.flatnonzero(np.asarray(planned.status) == Status.OK)
    return take(candidates, rows), take(planned, rows)


def share_solved(trajectories):
    return np.mean(np.asarray(trajectories.status) == Status.OK)


@pytest.mark.thorough
def test_nearly_all_random_candidates_are_solved(planned):
    assert share_solved(planned) >= 0.99


@pytest.mark.slow
def test_nearly_all_of_a_thousand_random_candidates_are_solved(optimize, draw):
    assert share_solved(optimize(draw(1024, seed=1))) >= 0.99


@pytest.mark.thorough
def test_intervals_solve_the_dynamics_to_integration_accuracy(problem, solved):
    """Against an integration ten times finer than the transcription's own."""
    candidates, trajectories = solved
    steps = 10 * problem.config.trajectory.substeps

    def ends(candidate, trajectory):
        rate = partial(problem.plant.dynamics, candidate.design)
        return jax.lax.fori_loop(
            0, steps, lambda _, x: rk4(rate, x, trajectory.us.T, trajectory.dt / steps, 1), trajectory.xs[:-1].T
        ).T

    error = jax.jit(jax.vmap(ends))(candidates, trajectories) - trajectories.xs[:, 1:]
    assert np.max(np.abs(error)) < 1e-6
    assert np.max(trajectories.defect) <= 1e-9


@pytest.mark.thorough
def test_intervals_solve_the_equations_of_motion_as_scipy_integrates_them(problem, solved):
    """m l^2 theta'' = u - b theta' - m g l sin theta, written out once more."""
    candidate, trajectory = (take(tree, 0) for tree in solved)
    mass, length = float(candidate.design.mass), float(candidate.design.length)

    def rate(_, x, u):
        torque = u - problem.plant.damping * x[1] - mass * problem.plant.gravity * length * np.sin(x[0])
        return [x[1], torque / (mass * length**2)]

    xs, us, dt = (np.asarray(leaf) for leaf in (trajectory.xs, trajectory.us, trajectory.dt))
    for x, u, after in zip(xs[:-1], us[:, 0], xs[1:], strict=True):
        exact = solve_ivp(rate, (0, dt), x, args=(u,), rtol=1e-11, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(after, exact, atol=1e-6)


def test_ends_are_pinned_exactly(problem, planned):
    np.testing.assert_array_equal(planned.xs[:, 0], np.broadcast_to(problem.start, (POPULATION, 2)))
    np.testing.assert_array_equal(planned.xs[:, -1], np.broadcast_to(problem.goal, (POPULATION, 2)))


def test_boxes_hold_at_every_knot(problem, planned):
    limits, step = problem.state_limits, problem.config.trajectory.step
    assert np.all(np.abs(planned.xs) <= limits)
    assert np.all(np.abs(planned.us) <= problem.input_limits(initial_design(problem)))
    assert np.all((planned.dt >= step.min) & (planned.dt <= step.max))


def test_bobs_too_heavy_for_the_motor_are_swung_up(problem, solved):
    """The torque's work on a direct way to theta is at most u_max theta, and falls short of the weight's
    m g l (1 - cos theta) at theta = 2.33 if 0.7246 m g l > u_max: then the velocity must change its sign.
    """
    candidates, trajectories = solved
    weight = candidates.design.mass * problem.plant.gravity * candidates.design.length
    heavy = np.asarray(0.7246 * weight > problem.plant.torque_limit)
    assert np.any(heavy)
    assert np.all(np.min(trajectories.xs[heavy, :, 1], 1) < 0)


def test_the_cost_is_the_transcriptions(problem, solved):
    candidates, trajectories = solved
    error = trajectories.xs[:, :-1] - problem.goal
    running = 0.5 * (candidates.q[:, None] * error**2).sum((1, 2)) + 0.5 * (
        candidates.r[:, None] * trajectories.us**2
    ).sum((1, 2))
    expected = trajectories.dt * (running + problem.config.trajectory.time_weight * problem.intervals)
    np.testing.assert_allclose(trajectories.cost, expected, rtol=1e-12)


@pytest.mark.thorough
def test_a_candidate_does_not_notice_its_neighbours_while_lanes_are_refilled(optimize, candidates, planned):
    """70 solves on 32 lanes, in two orders, beside others and in another population: equal to the last bit."""
    rows = np.arange(70)
    few = optimize(take(candidates, rows))
    assert_equal_trees(few, take(planned, rows))
    order = np.random.default_rng(0).permutation(70)
    assert_equal_trees(optimize(take(candidates, order)), take(few, order))


@pytest.mark.thorough
@pytest.mark.parametrize("count", [1, 5])
def test_small_populations_agree_with_large_ones(optimize, candidates, planned, count):
    """Neighbours change no bit; fewer lanes are another program, and the compiler rounds it differently."""
    small = optimize(take(candidates, np.arange(count)))
    others = np.concatenate([[0], np.arange(100, 100 + count - 1)])
    assert_equal_trees(take(optimize(take(candidates, others)), 0), take(small, 0))
    for ours, theirs in zip(jax.tree.leaves(small), jax.tree.leaves(take(planned, np.arange(count))), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


@pytest.mark.thorough
def test_failures_are_told_and_leave_the_others_bit_equal(optimize, candidates, planned):
    """A NaN in a weight, a NaN in the design, and a bob that the torque cannot bring up within the longest time."""
    rows = np.arange(70)
    few = take(candidates, rows)
    few = eqx.tree_at(lambda c: c.q, few, few.q.at[3, 0].set(jnp.nan))
    few = eqx.tree_at(lambda c: c.design.length, few, few.design.length.at[11].set(jnp.nan))
    few = eqx.tree_at(lambda c: c.design.mass, few, few.design.mass.at[20].set(80.0))
    spoilt = optimize(few)
    others = np.setdiff1d(rows, [3, 11, 20])
    np.testing.assert_array_equal(spoilt.status[jnp.array([3, 11, 20])], Status.TRAJECTORY_NOT_SOLVED)
    assert_equal_trees(take(spoilt, others), take(planned, others))
    assert spoilt.defect[20] > 1e-9


def with_trajectory(problem, **changes):
    config = problem.config
    settings = config.trajectory.model_copy(update=changes)
    return make_problem(config.model_copy(update={"trajectory": settings}))


@pytest.mark.thorough
def test_the_cheaper_of_two_starts_is_kept(problem, candidates, planned):
    few = take(candidates, np.arange(64))
    both = jax.jit(partial(plan, with_trajectory(problem, starts=2)))(few)
    first = planned.cost[:64]
    assert np.all(both.cost <= first * (1 + 1e-9))
    assert np.any(both.cost < first * (1 - 1e-6))


@pytest.mark.thorough
@pytest.mark.parametrize("starts", [1, 2])
def test_where_the_first_starts_fail_others_follow(problem, candidates, monkeypatch, starts):
    """With few iterations the first starts fail for many; some are solved by others, which change nothing elsewhere."""
    few = take(candidates, np.arange(64))
    hurried = with_trajectory(problem, max_iterations=28, starts=starts)
    all_of_them = jax.jit(partial(plan, hurried))(few)
    monkeypatch.setattr(trajectory, "SHARES", trajectory.SHARES[:starts])
    first = jax.jit(partial(plan, hurried))(few)
    assert 0.1 < share_solved(first) < share_solved(all_of_them)
    rows = np.flatnonzero(np.asarray(first.status) == Status.OK)
    for ours, theirs in zip(*(jax.tree.leaves(take(tree, rows)) for tree in (all_of_them, first)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def test_shapes_are_those_of_the_nouns(planned, problem):
    assert planned.us.shape == (POPULATION, problem.intervals, 1)
    assert planned.xs.shape == (POPULATION, problem.intervals + 1, 2)
    for leaf in (planned.dt, planned.cost, planned.defect, planned.iterations, planned.status):
        assert leaf.shape == (POPULATION,)


@pytest.mark.slow
def test_a_motor_whose_limit_is_a_design_moves_as_one_of_that_limit():
    def planned(limit, **design):
        data = yaml12.read(EXAMPLE)
        arms = {"body.bob": {"ipos": [0, 0, "-length"], "mass": "mass", "inertia": [0, 0, 0]}}
        data["plant"] = {"mjcf": "own.xml", "xml": PLANTS["pendulum"].xml, "inputs": {"torque": limit}, "set": arms}
        data["design"] = {name: {**each, "unit": "-"} for name, each in (data["design"] | design).items()}
        problem = make_problem(parse(data))
        candidate = decode(problem, initial_genome(problem))
        if design:
            candidate = eqx.tree_at(lambda each: each.design.motor, candidate, jnp.asarray(2.0))
        return jax.jit(partial(plan, problem))(jax.tree.map(lambda leaf: leaf[None], candidate))

    designed = planned({"limit": "motor"}, motor={"initial": 2.5, "min": 1.0, "max": 3.0})
    given = planned({"limit": 2.0})
    assert designed.status == given.status == Status.OK
    assert 0.99 * 2.0 < np.max(np.abs(designed.us)) <= 2.0
    np.testing.assert_allclose(designed.cost, given.cost, rtol=1e-4)


@pytest.mark.thorough
def test_a_share_of_the_motor_is_left_to_the_controller(problem, draw):
    """The motion needs no more than its share, which costs; the controller's limit is the motor's."""
    candidates = draw(8)
    whole = jax.jit(partial(plan, problem))(candidates)
    spared = jax.jit(partial(plan, with_trajectory(problem, input_share=0.8)))(candidates)
    both = np.asarray((whole.status == Status.OK) & (spared.status == Status.OK))
    assert np.sum(both) >= 6
    limit = float(problem.input_limits(initial_design(problem))[0])
    assert np.max(np.abs(whole.us[both])) > 0.99 * limit
    assert np.max(np.abs(spared.us[both])) <= 0.8 * limit * (1 + 1e-9)
    assert np.all(spared.cost[both] >= whole.cost[both] * (1 - 1e-3))


@pytest.mark.slow
def test_a_given_duration_is_kept_to_the_last_bit(problem, draw):
    """The cost can only rise above that of the free step, whose box holds the fixed one."""
    candidates, step = draw(8), type(problem.config.trajectory.step)(min=0.07, max=0.07)
    free = jax.jit(partial(plan, problem))(candidates)
    held = jax.jit(partial(plan, with_trajectory(problem, step=step)))(candidates)
    assert (held.status == Status.OK).all()
    np.testing.assert_array_equal(held.dt, 0.07)
    assert np.max(held.defect) <= 1e-9
    assert np.all(held.cost >= free.cost * (1 - 1e-3))
