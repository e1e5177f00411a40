"""Refined gains and shapes: levels against known roots and against the certificates' own, and what stays."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from rtcd_jax.certificate.prove.closed_loop import Loop
from rtcd_jax.certificate.prove.levels import leveled, unit_directions
from rtcd_jax.config import load as configuration
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import FunnelInterpolant
from rtcd_jax.policy import input_jumps, value_rates
from rtcd_jax.problem import Problem
from rtcd_jax.refinement import AGREEMENT, DECAY_MARGIN, SETTLING, Refinement
from rtcd_jax.run.format import arrays_of, evaluation_of, record_of
from rtcd_jax.types import Candidate, Policy, Trajectory
from rtcd_jax.volume import funnel_volume
from tests import pipeline
from tests.certificate.claims import claimed
from tests.linear_system import Nothing
from tests.pipeline import same
from tests.test_adversary import Scalar, uncertainty

BOTH = ("gains", "shapes")


def programs(refinement: Refinement):
    """Its methods, jitted."""
    methods = (refinement.start, refinement.begin, refinement.step, refinement.marched)
    return [jax.jit(methods[0], static_argnums=2), *map(jax.jit, methods[1:])]


def refined(jitted, total: int, candidate: Candidate, policy: Policy, free=BOTH):
    """The start, the state after all steps, and ln of the volumes by the levels then and by independent ones."""
    start_of, begin, step, march = jitted
    start = start_of(candidate, policy, free)
    state = begin(start)
    for index in range(total):
        state, estimate = step(start, state, index)
        assert bool(estimate.finite)
    return start, state, np.asarray(estimate.knots.logs), np.asarray(march(start, state, jax.random.key(3)).logs)


def marched(refinement: Refinement, start, state) -> np.ndarray:
    return np.asarray(jax.jit(refinement.marched)(start, state, jax.random.key(3)).logs)


# ---- one state: x' = -x + x^3 + w, and an input that can do nothing


PUSH = 0.3


@cache
def scalar() -> tuple[Refinement, list]:
    data = yaml.safe_load(configuration.EXAMPLE) | {"trajectory": {"knots": 5}}
    may = uncertainty(residual=0.5, noise=(0.0,), input=PUSH)
    zero = np.zeros(1)
    plant = Scalar(cubic=1.0, limit=1e-9)
    problem = Problem(configuration.parse(data), plant, zero, zero, np.array([1.5]), (), uncertainty=may)
    refinement = Refinement(problem, 40)
    return refinement, programs(refinement)


def at_rest() -> tuple[Candidate, Policy]:
    zero = jnp.zeros((), jnp.int32)
    rest = Trajectory(jnp.zeros((4, 1)), jnp.zeros((5, 1)), jnp.asarray(0.1), *jnp.zeros((2,)), zero, zero)
    policy = Policy(rest, jnp.full((5, 1, 1), 0.1), jnp.ones((5, 1, 1)), zero, jnp.zeros((4, 2, 1, 1)))
    return Candidate(Nothing(), jnp.ones(1), jnp.ones(1)), policy


@pytest.mark.thorough
def test_a_refinement_ends_at_the_largest_region_that_there_is():
    """V falls by 2 (1 - r^2) - 2 |w| / r, and no shape changes that: the length of {V <= rho} is that of the region."""
    roots = np.roots([1, 0, -1 + DECAY_MARGIN / 2, PUSH])
    largest = 2 * max(root.real for root in roots if abs(root.imag) < 1e-12)
    refinement, jitted = scalar()
    _, _, by_levels, by_march = refined(jitted, refinement.total, *at_rest())
    np.testing.assert_allclose(np.exp(by_march), largest, rtol=5e-3)
    np.testing.assert_allclose(np.exp(by_levels), largest, rtol=AGREEMENT)


@pytest.mark.thorough
@pytest.mark.parametrize(("free", "stays"), [(("gains",), "values"), (("shapes",), "gains")])
def test_what_is_not_free_stays(free, stays):
    (refinement, jitted), (candidate, policy) = scalar(), at_rest()
    start, state, _, _ = refined(jitted, SETTLING + 2, candidate, policy, free)
    after = refinement.policy(policy, start, state)
    np.testing.assert_array_equal(getattr(after, stays), getattr(policy, stays))
    assert ("shapes" in free) == np.any(np.asarray(after.values) != policy.values)


# ---- the pendulum


@cache
def problem(factor: float = 1.0) -> Problem:
    """The paper's pendulum that bears `factor` times a box of all kinds of uncertainty."""
    known = pipeline.problem()
    may = uncertainty(mass=0.02, length=0.01, damping=0.2, input_limit=0.02, input=0.05, age=0.002, noise=(0.01, 0.02))
    return dataclasses.replace(known, uncertainty=may.times(factor) if factor else None)


def rtcd():
    return jax.tree.map(lambda leaf: leaf[pipeline.RTCD], pipeline.evaluated())


@cache
def of_the_pendulum():
    evaluation, refinement = rtcd(), Refinement(problem(), 80)
    found = refined(programs(refinement), refinement.total, evaluation.candidate, evaluation.funnel.policy)
    return refinement, *found


@pytest.mark.slow
def test_levels_are_those_of_the_certificates():
    """Numpy's, in other directions and at other instants, without uncertainty."""
    known, evaluation = pipeline.problem(), rtcd()
    refinement = Refinement(problem(0.0), 1)
    start = refinement.start(evaluation.candidate, evaluation.funnel.policy, BOTH)
    ours = marched(refinement, start, refinement.begin(start))
    elite = Elite.of(arrays_of(known, evaluation), record_of(known, evaluation))
    loop = leveled(Loop(claimed(elite), elite), unit_directions(2)[:, ::2])
    theirs = np.log(np.pi) - 0.5 * np.linalg.slogdet(loop.values)[1]
    np.testing.assert_allclose(np.exp(ours).sum(), np.exp(theirs).sum(), rtol=0.02)


@pytest.mark.slow
def test_a_refinement_under_uncertainty_grows_the_funnel_and_is_no_fraud_of_its_own_levels():
    refinement, start, _, by_levels, by_march = of_the_pendulum()
    before = marched(refinement, start, refinement.begin(start))
    sums = [np.exp(logs).sum() for logs in (before, by_march, by_levels)]
    assert sums[1] > 1.5 * sums[0]
    assert by_march[0] > before[0] + np.log(100)
    assert abs(sums[2] - sums[1]) < 1.5 * AGREEMENT * sums[1]


@pytest.mark.slow
def test_more_uncertainty_leaves_smaller_levels():
    _, start, state, _, by_march = of_the_pendulum()
    smaller, larger = (marched(Refinement(problem(factor), 80), start, state) for factor in (0.0, 1.5))
    assert np.all(larger <= by_march + 1e-3)
    assert np.all(by_march <= smaller + 1e-3)
    assert larger[0] < by_march[0] - 0.1


@pytest.mark.thorough
def test_the_riccati_equation_s_rates_are_those_that_stored_elites_have():
    """JAX's and numpy's, of the same policy."""
    known, evaluation = pipeline.problem(), rtcd()
    elite = Elite.of(arrays_of(known, evaluation), record_of(known, evaluation))
    ours = value_rates(known, evaluation.candidate, evaluation.funnel.policy)
    np.testing.assert_allclose(ours, FunnelInterpolant.of(elite).value_rates, rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_a_refined_elite_is_stored_and_read_with_its_rates():
    """All verbs read them in the place of the Riccati equation's."""
    known, evaluation = pipeline.problem(), rtcd()
    refinement, start, state, _, _ = of_the_pendulum()
    policy = refinement.policy(evaluation.funnel.policy, start, state)
    evaluation = dataclasses.replace(evaluation, funnel=dataclasses.replace(evaluation.funnel, policy=policy))
    arrays, record = arrays_of(known, evaluation), record_of(known, evaluation, refinement={"free": BOTH})
    elite = Elite.of(arrays, record)
    assert elite.record["refinement"] == {"free": BOTH}
    np.testing.assert_array_equal(FunnelInterpolant.of(elite).value_rates, policy.value_rates)
    np.testing.assert_array_equal(Loop(claimed(elite), elite).slopes, policy.value_rates)
    again = evaluation_of(known, arrays, record)
    assert same(again.funnel.policy.value_rates, policy.value_rates)
    assert same(again.candidate, evaluation.candidate)
    expected = funnel_volume(evaluation.funnel, input_jumps(known, evaluation.candidate, policy.trajectory))
    np.testing.assert_allclose(again.volumes["sum"], expected["sum"], rtol=1e-12)
