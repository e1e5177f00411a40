"""Funnels under uncertainty: scalar systems against their roots, the greedy adversary against all corners of a box."""

import dataclasses
import itertools
import subprocess
import sys
from functools import cache, partial
from typing import ClassVar, final

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from rtcd_jax import rollout
from rtcd_jax.adversary import Drawn, Situation, Worst, closed_form_rate, scaled_rate
from rtcd_jax.config import load as configuration
from rtcd_jax.config.packaged import packaged
from rtcd_jax.evaluation import search_budget
from rtcd_jax.funnel import MARGIN, estimate_funnel
from rtcd_jax.problem import Problem, make_problem
from rtcd_jax.types import Candidate, Policy, Status, Trajectory, Uncertainty
from rtcd_jax.validation import Dynamics, Rollouts, SamplingBudget, validate_paths
from tests import pipeline
from tests.linear_system import Equations, Nothing


def uncertainty(residual=0.5, noise=(0.0, 0.0), age=0.0, input_limit=0.0, input=0.0, **parameters) -> Uncertainty:
    return Uncertainty(
        {name: jnp.asarray(width) for name, width in parameters.items()},
        *map(jnp.asarray, (input_limit, input, noise, age, residual)),
    )


# ---- one state: x' = -x + c x^3 + w


LIMIT = 10.0


@final
class Scalar(Equations):
    """x' = -pace x + cubic x^3 + u"""

    cubic: float = 0.0
    pace: float = 1.0
    limit: float = 1.0

    state_names: ClassVar = ("x",)
    state_units: ClassVar = ("m",)

    def dynamics(self, design, x, u):
        return jnp.stack([-self.pace * x[0] + self.cubic * x[0] ** 3 + u[0]])


@jax.jit
def scalar_funnel(cubic: float, may: Uncertainty):
    """That of the uncontrolled system at rest, within |x| <= LIMIT."""
    data = yaml.safe_load(configuration.EXAMPLE) | {"trajectory": {"knots": 4}}
    plant = Scalar(cubic=cubic, limit=1.0)
    problem = Problem(
        configuration.parse(data), plant, np.zeros(1), np.zeros(1), np.array([LIMIT]), (), uncertainty=may
    )
    zero = jnp.zeros((), jnp.int32)
    rest = Trajectory(jnp.zeros((3, 1)), jnp.zeros((4, 1)), jnp.asarray(0.1), *jnp.zeros((2,)), zero, zero)
    policy = Policy(rest, jnp.zeros((4, 1, 1)), jnp.ones((4, 1, 1)), zero)
    candidate = Candidate(Nothing(), jnp.ones(1), jnp.ones(1))
    return estimate_funnel(problem, candidate, policy, jax.random.key(0), search_budget(problem))


@pytest.mark.thorough
@pytest.mark.parametrize(("share", "status"), [(1.01, Status.OK), (0.99, Status.FUNNEL_EMPTY)])
def test_a_disturbance_is_borne_by_what_is_just_large_enough(share, status):
    """x' = -x + w with |w| <= r / share stays in |x| <= r for a share above 1 alone."""
    funnel = scalar_funnel(0.0, uncertainty(residual=0.999, noise=(0.0,), input=LIMIT / share))
    assert funnel.status == status
    if status == Status.OK:
        np.testing.assert_allclose(np.sqrt(funnel.levels), LIMIT, rtol=2 * MARGIN)


@pytest.mark.thorough
@pytest.mark.parametrize(("residual", "status"), [(0.5, Status.OK), (0.3, Status.FUNNEL_EMPTY)])
def test_a_region_lies_between_the_roots(residual, status):
    """x' = -x + x^3 + w falls for all |w| <= 0.3 where r - r^3 > 0.3; what is inside the lower root stays there."""
    low, high = sorted(root.real for root in np.roots([-1, 0, 1, -0.3]) if root.real > 0)
    assert 0.3 * high < low < 0.5 * high
    funnel = scalar_funnel(1.0, uncertainty(residual=residual, noise=(0.0,), input=0.3))
    assert funnel.status == status
    if status == Status.OK:
        np.testing.assert_allclose(np.sqrt(funnel.levels[-1]), high, rtol=5e-3)


# ---- the pendulum

BOX = uncertainty(mass=0.02, length=0.01, damping=0.2, input_limit=0.02, input=0.05, age=0.005)


def situation(samples: int) -> Situation:
    """Random states of a closed loop of the pendulum, some of them with a saturated input."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-4, 4, (2, samples))
    error = rng.normal(scale=0.3, size=(2, samples))
    gain = rng.uniform(0, 6, (1, 2, samples))
    asked = rng.uniform(-3, 3, (1, samples))
    cost = np.array([[3.0, 1.0], [1.0, 2.0]])[..., None]
    rate = rng.normal(size=(2, samples))
    arrays = map(jnp.asarray, (asked, gain, cost, rate, np.full((1, samples), 2.5)))
    return Situation(tuple(jnp.asarray(x)), list(jnp.asarray(error)), *arrays)


def growth(at: Situation, rate) -> jax.Array:
    """e'S x'."""
    return jnp.einsum("ij,j...,i...->...", at.cost[..., 0], jnp.stack(at.error), jnp.stack(rate))


def robot():
    """The paper's pendulum: plant and design."""
    plant = pipeline.problem().plant
    return plant, plant.Design(jnp.asarray(0.7), jnp.asarray(0.4))


def missed(may: Uncertainty) -> jax.Array:
    """By how much V could rise faster at the worst corner of the box than where the greedy adversary is, relatively."""
    return _missed(*robot(), may)


@jax.jit
def _missed(plant, design, may: Uncertainty) -> jax.Array:
    at, names = situation(300), list(may.parameters)
    x = jnp.stack(at.x)

    def at_corner(signs):
        strength, push, *corner = signs
        bounds = at.bounds * (1 + strength * may.input_limit)
        u = jnp.clip(at.asked, -bounds, bounds) + push * may.input
        scales = {name: 1 + sign * may.parameters[name] for sign, name in zip(corner, names, strict=True)}
        return growth(at, scaled_rate(plant, design, scales, x, u))

    corners = jnp.asarray(list(itertools.product((-1.0, 1.0), repeat=len(names) + 2)))
    largest = jax.vmap(at_corner)(corners).max(0)
    return (largest - growth(at, Worst(plant, may).rate(design, at))) / (1 + jnp.abs(largest))


def test_the_greedy_corner_is_the_worst_where_the_rate_is_affine():
    may = uncertainty(damping=0.2, input_limit=0.02, input=0.05)
    np.testing.assert_allclose(missed(may), 0, atol=1e-14)


def test_what_the_greedy_adversary_misses_is_of_second_order():
    """Half the widths leave a quarter."""
    may = uncertainty(mass=0.08, length=0.04, damping=0.2, input=0.05)
    whole, half = missed(may), missed(may.times(0.5))
    assert np.all(whole >= -1e-14)
    assert np.max(whole) > 1e-4
    assert np.max(half) < 0.35 * np.max(whole)


@jax.jit
def worst_and_greedy(plant, design, may: Uncertainty, at: Situation) -> tuple[jax.Array, jax.Array]:
    """x' of the adversary; and by the signs of V's slope in every number and input of every state, found without it."""
    x, slope = jnp.stack(at.x), jnp.einsum("ij...,j...->i...", at.cost, jnp.stack(at.error))
    low, high = (jnp.clip(at.asked, -at.bounds, at.bounds) + side * may.input for side in (-1, 1))
    ones = {name: jnp.ones_like(x[0]) for name in may.parameters}
    power = lambda scales, u: jnp.sum(slope * scaled_rate(plant, design, scales, x, u))  # noqa: E731
    slopes, push = jax.grad(power, (0, 1))(ones, (low + high) / 2)
    scales = {name: 1 + width * jnp.sign(slopes[name]) for name, width in may.parameters.items()}
    expected = scaled_rate(plant, design, scales, x, jnp.where(push > 0, high, low))
    return jnp.stack(Worst(plant, may).rate(design, at)), expected


def test_the_corner_is_that_of_the_slopes_in_the_numbers_themselves():
    """A cart-pole, whose numbers are lumped together in many ways."""
    problem = make_problem(configuration.load(packaged()["cartpole_rtcd"]))
    plant, rng = problem.plant, np.random.default_rng(1)
    design = plant.Design(*map(jnp.asarray, (0.2, 0.25)))
    x, error = jnp.asarray(rng.uniform(-2, 2, (4, 200))), jnp.asarray(rng.normal(scale=0.3, size=(4, 200)))
    half = rng.normal(size=(4, 4))
    arrays = rng.uniform(-9, 9, (1, 200)), rng.normal(size=(1, 4, 200)), (half @ half.T)[..., None]
    at = Situation(tuple(x), list(error), *map(jnp.asarray, arrays), jnp.zeros((4, 200)), jnp.full((1, 200), 6.0))
    names = {"pole_mass": 0.1, "pole_length": 0.1, "cart_mass": 0.05, "cart_damping": 0.2, "pivot_damping": 0.3}
    worst, expected = worst_and_greedy(plant, design, uncertainty(noise=(0.0,) * 4, input=0.3, **names), at)
    np.testing.assert_allclose(worst, expected, rtol=1e-12, atol=1e-12)


@partial(jax.jit, static_argnames="motion")
def rate_of(drawn: Drawn, design, at: Situation, motion=closed_form_rate) -> jax.Array:
    return jnp.stack(drawn._replace(motion=motion).rate(design, at))


def drawn(may: Uncertainty, samples: int) -> Drawn:
    """Without its motion, which is no number."""
    return Drawn.of(robot()[0], may, jax.random.key(0), samples)._replace(motion=None)


@pytest.mark.thorough
def test_no_width_is_the_nominal_loop():
    (plant, design), at = robot(), situation(100)
    u = jnp.clip(at.asked, -at.bounds, at.bounds)
    nominal = jax.jit(plant.dynamics)(design, jnp.stack(at.x), u)
    nothing = BOX.times(0.0)
    worst = jax.jit(lambda: jnp.stack(Worst(plant, nothing).rate(design, at)))()
    for rate in (worst, rate_of(drawn(nothing, 100), design, at)):
        np.testing.assert_allclose(rate, nominal, rtol=1e-14, atol=1e-14)  # sums of terms of up to 10


@pytest.mark.thorough
def test_drawn_robots_move_by_mjx_as_by_their_equations():
    """Each by edits of its own of the MJCF; 1 % off, they do not."""
    robots, at, (_, design) = drawn(BOX, 30), situation(30), robot()
    own = rate_of(robots, design, at)
    np.testing.assert_allclose(rate_of(robots, design, at, rollout.mjx_rate), own, rtol=1e-9, atol=1e-9)
    off = robots.parameters | {"mass": robots.parameters["mass"] + 0.5}
    heavier = robots._replace(parameters=off)
    assert np.max(np.abs(rate_of(heavier, design, at, rollout.mjx_rate) - own)) > 1e-2


@cache
def estimator():
    """Funnels of the published RTC-D pendulum by their box."""
    evaluated = pipeline.evaluated().take(np.array([pipeline.RTCD]))
    one = jax.tree.map(lambda leaf: leaf[0], evaluated)
    problem = pipeline.problem()

    @jax.jit
    def estimate(may: Uncertainty):
        robust = dataclasses.replace(problem, uncertainty=may)
        budget = search_budget(robust)
        return estimate_funnel(robust, one.candidate, one.funnel.policy, pipeline.GENERATION, budget)

    return estimate, one


@pytest.mark.thorough
def test_two_uncertain_numbers_of_a_cartpole_compile():
    """What the adversary chooses is computed once: written out wherever it is used, it took more than 20 GiB."""
    done = subprocess.run([sys.executable, "-m", "tests.compiling"], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()[-500:]


@pytest.mark.thorough
def test_a_larger_box_never_has_a_larger_level():
    """Zero widths have the nominal levels, the last box none at all."""
    estimate, nominal = estimator()
    funnels = [estimate(BOX.times(factor)) for factor in (0.0, 0.25, 0.5, 1.0, 4.0)]
    np.testing.assert_allclose(funnels[0].levels, nominal.funnel.levels, rtol=1e-9)
    for wide, narrow in itertools.pairwise(funnels):
        assert np.all(narrow.levels <= wide.levels * (1 + 1e-9))
    assert [int(funnel.status) for funnel in funnels] == [Status.OK] * 4 + [Status.FUNNEL_EMPTY]
    assert [float(funnel.borne) for funnel in funnels[:4]] == [1.0] * 4
    assert 0 < funnels[4].borne < 1


@pytest.mark.thorough
@pytest.mark.parametrize(("factor", "bears"), [(1.0, True), (2.0, False)])
def test_robots_of_the_box_stay_and_others_are_found_out(factor, bears):
    """A few hundred held-out samples a knot, each another robot with another disturbance."""
    estimate, nominal = estimator()
    problem = pipeline.problem()
    levels = estimate(BOX).levels

    @jax.jit
    def validated(may):
        physics = rollout.closed_form(problem.plant)
        robust = dataclasses.replace(problem, uncertainty=may)
        rollouts = Rollouts.of(robust, nominal.candidate, nominal.funnel.policy, problem.config.funnel)
        budget = SamplingBudget(problem.config.funnel, Dynamics(physics, physics), 1, 400, 900)
        return validate_paths(rollouts, levels, jax.random.key(1), budget)

    after, samples = validated(BOX.times(factor))
    assert (int(samples.min()) == 400) == bears
    assert np.array_equal(after, levels) == bears
