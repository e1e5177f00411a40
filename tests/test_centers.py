"""Funnels about every robot's own motion: closed forms, the pendulum under a box, robots from inside it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from rtcd_jax.adversary import Constant, Drawn
from rtcd_jax.config import load as configuration
from rtcd_jax.config.load import config_hash, parse, resolved
from rtcd_jax.evaluation import elite_budget, search_budget
from rtcd_jax.funnel import MARGIN, estimate_funnel
from rtcd_jax.problem import Problem
from rtcd_jax.system.errors import ConfigError
from rtcd_jax.types import Candidate, Policy, Status, Trajectory, Uncertainty
from rtcd_jax.validation import OwnMotions, Rollouts, validate_paths
from tests import pipeline
from tests.linear_system import Nothing
from tests.test_adversary import LIMIT, Scalar, estimator, situation, uncertainty

KNOTS, DT = 17, 0.5


def moving(may: Uncertainty) -> Uncertainty:
    return dataclasses.replace(may, moving=True)


def decaying(may: Uncertainty):
    """The decay from x = 3 without control: problem, candidate, policy."""
    data = yaml.safe_load(configuration.EXAMPLE) | {"trajectory": {"knots": KNOTS}}
    problem = Problem(parse(data), Scalar(), np.array([3.0]), np.zeros(1), np.array([LIMIT]), (), uncertainty=may)
    xs = 3 * jnp.exp(-DT * jnp.arange(KNOTS, dtype=float))[:, None]
    zero = jnp.zeros((), jnp.int32)
    motion = Trajectory(jnp.zeros((KNOTS - 1, 1)), xs, jnp.asarray(DT), *jnp.zeros((2,)), zero, zero)
    policy = Policy(motion, jnp.zeros((KNOTS, 1, 1)), jnp.ones((KNOTS, 1, 1)), zero)
    return problem, Candidate(Nothing(), jnp.ones(1), jnp.ones(1)), policy


def test_robots_are_at_their_own_motions():
    """x_p(t) = 3 exp(-p t): the slowest one is farthest from x* at the end."""
    problem, candidate, policy = decaying(moving(uncertainty(noise=(0.0,), pace=0.2)))
    rollouts = Rollouts.of(problem, candidate, policy, problem.config.funnel)
    times = DT * np.arange(KNOTS)
    expected = 3 * np.exp(-np.array([1.0, 0.8, 1.2])[:, None] * times)
    np.testing.assert_allclose(rollouts.robots.scales["pace"], [1.0, 0.8, 1.2])
    np.testing.assert_allclose(rollouts.robots.centers[:, 0], expected, atol=2e-3)
    np.testing.assert_allclose(rollouts.offsets(), np.abs(expected - expected[0]).max(0), atol=2e-3)
    half = rollouts.robots.shifts[1, 0, 1, 0]  # of the slow one, in the middle of each interval's first step
    assert np.all((half >= -1e-6) & (half <= 3 * (np.exp(-0.8 * times) - np.exp(-times))[1:].max()))


@pytest.mark.thorough
def test_levels_are_those_of_the_slowest_robot_about_its_own_motion():
    """y' = -p y about each: a level is what the limits leave at the farthest robot, or what decays into the next."""
    problem, candidate, policy = decaying(moving(uncertainty(noise=(0.0,), pace=0.2)))
    funnel = estimate_funnel(problem, candidate, policy, jax.random.key(0), search_budget(problem))
    times = DT * np.arange(KNOTS)
    own = 3 * np.exp(-np.array([1.0, 0.8, 1.2])[:, None] * times)
    last = LIMIT - np.abs(own[:, -1] - own[0, -1]).max()
    assert funnel.status == Status.OK
    np.testing.assert_allclose(np.sqrt(funnel.levels[-1]), last, rtol=2 * MARGIN)
    boxes = LIMIT - own.max(0)
    expected = np.minimum(boxes, np.append((np.sqrt(funnel.levels) * np.exp(0.8 * DT))[1:], np.inf))
    np.testing.assert_allclose(np.sqrt(funnel.levels)[:-1], expected[:-1], rtol=3 * MARGIN)
    np.testing.assert_allclose(funnel.offsets, np.abs(own - own[0]).max(0), atol=2e-3)


def test_states_begin_about_their_own_robots_when_they_are_born():
    problem, candidate, policy = decaying(moving(uncertainty(noise=(0.0,), pace=0.2)))
    rollouts = Rollouts.of(problem, candidate, policy, problem.config.funnel)
    drawn = Drawn.of(problem.plant, problem.uncertainty, jax.random.key(0), 5)
    born = np.array([0, 3, 3, 9, KNOTS - 1])
    x = rollouts.sets.centers[:, born] + 0.5
    own = OwnMotions.of(rollouts, drawn, x, born)
    assert own.first(jnp.asarray(3)) == 0
    for k in range(KNOTS - 1):
        x = own.start(x, k)
        exact = 3 * np.exp(-np.asarray(drawn.scales["pace"]) * DT * k)
        np.testing.assert_allclose(own.centers[0], exact, atol=2e-3)
        np.testing.assert_allclose((x - own.centers)[0, born == k], 0.5)
        own = own.onward(rollouts, jnp.asarray(k))
    np.testing.assert_allclose((own.start(x, KNOTS - 1) - own.centers)[0, -1], 0.5)


# ---- the pendulum

NUMBERS = uncertainty(mass=0.05, length=0.02)


@pytest.mark.thorough
def test_without_width_it_is_the_nominal_funnel_and_a_wider_box_never_has_a_larger_one():
    estimate, nominal = estimator()
    zero, narrow, wide = (estimate(moving(NUMBERS.times(factor))) for factor in (0.0, 0.5, 1.0))
    np.testing.assert_allclose(zero.levels, nominal.funnel.levels, rtol=1e-3)
    np.testing.assert_allclose(zero.offsets, 0, atol=1e-3 * float(jnp.sqrt(zero.levels).min()))
    assert np.all(np.asarray(narrow.levels) <= np.asarray(zero.levels) * (1 + 1e-3))
    assert np.all(np.asarray(wide.levels) <= np.asarray(narrow.levels) * (1 + 1e-3))
    assert np.all(wide.offsets[1:] > narrow.offsets[1:])


@pytest.mark.thorough
def test_robots_from_inside_the_box_stay_about_their_own_motions():
    """Held-out robots of the box stay in the funnel; those of a box eight times as wide are found out."""
    estimate, nominal = estimator()
    problem = pipeline.problem()
    levels = estimate(moving(NUMBERS)).levels

    @jax.jit
    def validated(may):
        robust = dataclasses.replace(problem, uncertainty=may)
        rollouts = Rollouts.of(robust, nominal.candidate, nominal.funnel.policy, problem.config.funnel)
        budget = dataclasses.replace(elite_budget(robust), rounds=1, samples_per_knot=400, batch=900)
        return validate_paths(rollouts, levels, jax.random.key(1), budget)

    for factor, bears in ((1.0, True), (8.0, False)):
        after, samples = validated(moving(NUMBERS.times(factor)))
        assert (int(samples.min()) == 400) == bears
        assert np.array_equal(after, levels) == bears


def test_one_robot_of_the_box_has_no_choice_of_its_numbers():
    plant, at = pipeline.problem().plant, situation(4)
    robot, heavy = (plant.Design(jnp.asarray(mass), jnp.asarray(0.4)) for mass in (0.7, 0.7 * 1.05))
    found = jnp.stack(Constant(plant, {"mass": jnp.asarray(1.05)}).rate(robot, at))
    clipped = jnp.clip(at.asked, -at.bounds, at.bounds)
    np.testing.assert_allclose(found, plant.dynamics(heavy, jnp.stack(at.x), clipped), rtol=1e-12)


# ---- the configuration


def stated(**section) -> dict:
    return yaml.safe_load(configuration.EXAMPLE) | {"uncertainty": section}


def test_a_common_center_leaves_the_hash_of_a_configuration():
    before = config_hash(parse(stated(design={"mass": 0.02})))
    assert config_hash(parse(stated(design={"mass": 0.02}, center="common"))) == before
    assert config_hash(parse(stated(design={"mass": 0.02}, center="moving"))) != before
    assert "center" in resolved(parse(stated(input=0.1)))["uncertainty"]


def test_what_is_borne_says_about_what_motion():
    config = parse(stated(design={"mass": 0.02}, center="moving"))
    assert "each robot about its own motion" in config.uncertainty.in_words(config.plant)
    disturbed = parse(stated(input=0.1, center="moving"))
    assert "own motion" not in disturbed.uncertainty.in_words(disturbed.plant)


def test_another_center_is_refused():
    with pytest.raises(ConfigError, match=r"uncertainty.center = 'own': unknown name; valid: common, moving"):
        parse(stated(center="own"))
