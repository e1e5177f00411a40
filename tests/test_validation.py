"""Held-out samples are what they claim to be, and an inflated level does not survive them."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.stats

from rtcd_jax import rollout
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.validation import (
    Dynamics,
    Rollouts,
    SamplingBudget,
    _share,
    _uniform,
    compare_physics,
    validate_intervals,
    validate_paths,
)
from tests import linear_system as linear

COUNT = 20_000


def _ellipsoids(n: int, knots: int = 3):
    random = np.random.default_rng(n)
    roots = random.normal(size=(knots, n, n))
    values = roots @ np.swapaxes(roots, 1, 2) + np.eye(n)
    centers = random.normal(size=(knots, n))
    return centers, values, Ellipsoids.about(jnp.asarray(centers.T), jnp.moveaxis(jnp.asarray(values), 0, -1))


@pytest.mark.thorough
@pytest.mark.parametrize("n", [1, 2, 4])
def test_held_out_samples_are_uniform_in_their_ellipsoids(n):
    """V / rho of a uniform state is Beta(n/2, 1); its mean is the center, its covariance rho S^-1 / (n + 2)."""
    centers, values, sets = _ellipsoids(n)
    levels = np.array([0.2, 1.0, 3.0])
    x = np.asarray(_uniform(sets, jnp.asarray(levels), jax.random.key(0), COUNT))
    assert x.shape == (n, 3, COUNT)
    share = np.asarray(sets.level(jnp.asarray(x))) / levels[:, None]
    for k in range(3):
        assert scipy.stats.kstest(share[k], scipy.stats.beta(n / 2, 1).cdf).pvalue > 1e-3
        error = np.linalg.cholesky(values[k]).T @ (x[:, k] - centers[k][:, None]) / np.sqrt(levels[k] / (n + 2))
        # Five standard errors of a mean, and of a second moment whose fourth is below three.
        assert np.abs(error.mean(1)).max() < 5 / np.sqrt(COUNT)
        assert np.abs(error @ error.T / COUNT - np.eye(n)).max() < 5 * np.sqrt(2 / COUNT)


@pytest.mark.thorough
def test_knots_rounds_and_keys_have_states_of_their_own():
    _, _, sets = _ellipsoids(2)
    same = Ellipsoids(*(jnp.broadcast_to(leaf[..., :1], leaf.shape) for leaf in sets))
    x, again, other = (np.asarray(_uniform(same, jnp.ones(3), jax.random.key(seed), 50)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(x, again)
    assert len(np.unique(np.concatenate([x, other], 2)[0])) == 3 * 100


# ---- a linear robot whose levels are known

H, INTERVALS, LAST = 0.2, 6, 0.3
TRIALS = 4000
POLICY = linear.policy(np.zeros(INTERVALS), H)
KNOWN = LAST * linear.decay(H) ** -np.arange(INTERVALS, -1.0, -1.0)
"""Without boxes and saturation: the least V that the loop carries beyond the next level."""


def _budget(problem, rounds: int) -> SamplingBudget:
    """Batches that end amid a knot's samples, and the last one amid itself."""
    physics = rollout.closed_form(problem.plant)
    return SamplingBudget(problem.config.funnel, Dynamics(physics, physics), rounds, TRIALS, batch=900)


def _rollouts(problem) -> Rollouts:
    return Rollouts.of(problem, linear.candidate(), POLICY, problem.config.funnel)


PROBLEM = linear.problem_of([1e6, 1e6], intervals=INTERVALS, trials=TRIALS)


def _program(verb: str, rounds: int, problem=PROBLEM):
    validate = {"intervals": validate_intervals, "paths": validate_paths}[verb]

    @jax.jit
    def run(levels, key):
        return validate(_rollouts(problem), levels, key, _budget(problem, rounds))

    return lambda levels, seed=0: jax.tree.map(np.asarray, run(jnp.asarray(levels), jax.random.key(seed)))


@pytest.fixture(scope="module", params=["intervals", "paths"])
def verb(request):
    return request.param


@pytest.fixture(scope="module")
def patient(verb):
    return _program(verb, rounds=40)


@pytest.fixture(scope="module")
def hasty(verb):
    """One round; the paths' first stage, of a single state a knot, finds nothing."""
    trials = 1 if verb == "paths" else TRIALS
    return _program(verb, 1, linear.problem_of([1e6, 1e6], intervals=INTERVALS, trials=trials))


def _tried(verb: str) -> np.ndarray:
    """The knots with trials when nothing fails: no interval starts at the last one, but there paths to the goal do."""
    return np.array([TRIALS] * INTERVALS + [TRIALS if verb == "paths" else 0])


@pytest.mark.thorough
def test_known_levels_stand(verb, patient):
    """A thousandth below the level where the first state would fail, none does."""
    levels, trials = patient(0.999 * KNOWN)
    np.testing.assert_array_equal(levels, 0.999 * KNOWN)
    np.testing.assert_array_equal(trials, _tried(verb))


@pytest.mark.thorough
@pytest.mark.parametrize("knot", [0, 3])
def test_an_inflated_level_is_found_out(verb, patient, knot):
    """It ends below the known one, not far, and a clean pass stands behind every level."""
    inflated = 0.999 * KNOWN
    inflated[knot] *= 1.5
    levels, trials = patient(inflated)
    assert 0.9 * KNOWN[knot] < levels[knot] < KNOWN[knot]
    np.testing.assert_array_equal(levels[knot + 1 :], inflated[knot + 1 :])
    np.testing.assert_array_equal(trials, _tried(verb))


@pytest.mark.thorough
def test_a_shrunk_level_has_no_trials(verb, hasty):
    """One round cannot have tried what it has just made."""
    inflated = 0.999 * KNOWN
    inflated[3] *= 1.5
    levels, trials = hasty(inflated)
    assert levels[3] < inflated[3]
    assert trials[3] == 0
    # Shrinking a level fails states that came into it from before, none that start behind; paths' rounds count whole.
    np.testing.assert_array_equal(trials[4:], _tried(verb)[4:] if verb == "intervals" else 0)


@pytest.mark.thorough
def test_what_was_not_tried_has_no_trials(verb):
    levels, trials = _program(verb, rounds=0)(KNOWN)
    np.testing.assert_array_equal(levels, KNOWN)
    np.testing.assert_array_equal(trials, 0)


@pytest.mark.thorough
def test_the_validated_funnel_keeps_the_promise(verb, patient):
    """Levels that are all twice too large: of a million other states of the result fewer fail than the bound says."""
    levels, trials = patient(2 * KNOWN)
    assert np.all(trials[:-1] == TRIALS)
    sets = linear.ellipsoids(POLICY)
    x = _uniform(sets, jnp.asarray(levels), jax.random.key(99), 150_000)
    after = sets.part(slice(1, None)).level(jnp.einsum("ij,jkc->ikc", scipy.linalg.expm(linear.CLOSED * H), x[:, :-1]))
    rates = np.mean(np.asarray(after) > levels[1:, None], 1)
    assert np.all(rates <= 1 - 0.01 ** (1 / TRIALS))


# ---- saturation and boxes


@pytest.mark.thorough
def test_a_goal_level_that_saturates_is_found_out_by_paths_to_the_goal():
    """A state at rest beyond limit / 4 is lost: gravity wins over any force."""
    limit = 1.0
    problem = linear.problem_of([1e6, 1e6], limit, intervals=INTERVALS, trials=TRIALS)
    lost = linear.S[0, 0] * (limit / 4) ** 2
    levels, trials = _program("paths", 40, problem)(np.full(INTERVALS + 1, 1.5 * lost))
    assert np.all(levels < lost)
    assert np.all(trials == TRIALS)


@pytest.mark.thorough
def test_a_box_fails_the_states_beyond_it(verb):
    """Of an ellipsoid that sticks out of a box no state outside is left over, in whichever knot it was born."""
    box = 0.3
    problem = linear.problem_of([box, 1e6], intervals=INTERVALS, trials=TRIALS)
    touching = box**2 / np.linalg.inv(linear.S)[0, 0]
    levels, trials = _program(verb, 40, problem)(1.3 * touching * KNOWN / KNOWN[0])
    assert KNOWN[1] / KNOWN[0] * 1.3 < 1 < 1.3
    assert 0.9 * touching < levels[0] <= touching
    np.testing.assert_array_equal(trials, _tried(verb))


# ---- the share that other dynamics feel


@pytest.mark.parametrize(("share", "trials"), [(0.01, 64), (0.2, 64), (1.0, 8), (0.001, 16)])
def test_a_share_is_that_part_of_the_states(share, trials):
    funnel = PROBLEM.config.funnel.model_copy(update={"mjx_share": share, "trials": trials})
    knots = 50
    chosen = _share(jax.random.key(0), knots, funnel)
    where = np.asarray(chosen.knots)
    assert len(set(where.tolist())) == len(where)
    assert where.min() >= 0
    assert where.max() < knots
    assert chosen.states <= trials
    wanted = share * trials * knots
    assert len(where) * chosen.states == pytest.approx(wanted, rel=0.05, abs=1)


@pytest.mark.thorough
def test_a_share_with_other_dynamics_is_watched():
    """A motor that is not there in the share's dynamics fails states that the others would keep."""
    problem = linear.problem_of([1e6, 1e6], intervals=INTERVALS, trials=TRIALS, mjx_share=0.5)
    motorless = rollout.Dynamics(lambda design, x, u: problem.plant.dynamics(design, x, 0 * u), large=False)
    physics = rollout.closed_form(problem.plant)
    budget = dataclasses.replace(_budget(problem, 1), dynamics=Dynamics(physics, physics, motorless))
    levels = jnp.asarray(0.999 * KNOWN)
    shrunk, trials = jax.jit(partial(validate_intervals, _rollouts(problem), budget=budget))(levels, jax.random.key(0))
    touched = np.asarray(
        _share(jax.random.split(jax.random.fold_in(jax.random.key(0), 0))[1], INTERVALS, budget.funnel).knots
    )
    failed = np.flatnonzero(np.asarray(trials)[:-1] == 0)
    assert set(touched.tolist()) <= set(failed.tolist())
    assert np.all(np.asarray(shrunk)[touched] < np.asarray(levels)[touched])


# ---- MJX beside the closed form


STATES = 700


def _compared(other: rollout.Dynamics, problem=PROBLEM, levels=0.999 * KNOWN):
    program = jax.jit(partial(compare_physics, _rollouts(problem), states=STATES, mjx=lambda plant, drawn: other))
    return jax.device_get(program(jnp.asarray(levels), jax.random.key(3)))


@pytest.mark.thorough
def test_equal_physics_do_not_differ():
    found = _compared(rollout.closed_form(PROBLEM.plant))
    assert (found.states, found.failures, found.difference) == (STATES, 0, 0)


@pytest.mark.thorough
def test_the_largest_difference_is_that_of_the_state_it_names():
    """A force too large by one part in a thousand, on a problem whose motion is known: the same state, by expm."""
    problem = linear.problem_of([1e6, 1e6], intervals=INTERVALS, steps=40)
    stronger = rollout.Dynamics(lambda design, x, u: problem.plant.dynamics(design, x, 1.001 * u), large=False)
    found = _compared(stronger, problem)
    assert found.failures == 0
    knots = found.time / H - found.knot
    assert knots == pytest.approx(round(float(knots)), abs=1e-9)  # at a knot, before the horizon
    other = linear.A - 1.001 * linear.B @ linear.K
    ends = [scipy.linalg.expm(closed * H * knots) @ found.start for closed in (linear.CLOSED, other)]
    np.testing.assert_allclose(found.closed_form, ends[0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(found.mjx, ends[1], rtol=1e-6, atol=1e-9)
    error = found.mjx - found.closed_form
    level = 0.999 * KNOWN[found.knot + round(float(knots))]
    assert found.difference == pytest.approx(np.sqrt(error @ linear.S @ error / level), rel=1e-6)
    assert found.start @ linear.S @ found.start <= 0.999 * KNOWN[found.knot]


@pytest.mark.thorough
def test_failures_under_other_physics_are_counted():
    """Without a motor every state falls; one that is no number differs without limit."""
    motorless = rollout.Dynamics(lambda design, x, u: PROBLEM.plant.dynamics(design, x, 0 * u), large=False)
    assert _compared(motorless).failures > 0.9 * STATES
    lost = rollout.Dynamics(lambda design, x, u: jnp.nan * x, large=False)
    found = _compared(lost)
    assert found.failures == STATES
    assert found.difference == np.inf
