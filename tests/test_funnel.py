"""Funnels of a linear robot against linear algebra, of the saturated one against a dense grid, and their resolution."""

import dataclasses
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax import rollout
from rtcd_jax.confirmation import Dynamics, Effort
from rtcd_jax.evaluation import elite_effort, search_effort
from rtcd_jax.funnel import MARGIN, _crossings, _scan_rays, estimate_funnel
from rtcd_jax.types import Status
from tests import linear_system as linear
from tests import pipeline

RADII = np.array([0.1, 0.2, 0.4, 0.8])


def _crossing(ends, inside=True, target=1.0) -> float:
    ends = jnp.asarray(ends)[None]
    return _crossings(jnp.asarray(RADII)[None], ends, jnp.broadcast_to(jnp.asarray(inside), ends.shape), target).item()


def test_a_ray_without_a_failure_reaches_its_last_radius():
    assert _crossing([0.1, 0.2, 0.3, 1.0]) == RADII[-1]


def test_a_ray_that_fails_at_once_has_no_crossing():
    assert _crossing([1.1, 0.2, 0.3, 0.4]) == 0
    assert _crossing([0.1, 0.2, 0.3, 0.4], [False, True, True, True]) == 0


@pytest.mark.parametrize("factor", [1.6, 3.0, 20.0, 90.0])
def test_the_crossing_is_exact_where_v_grows_with_the_radius_squared(factor):
    assert _crossing(factor * RADII**2) == pytest.approx(1 / np.sqrt(factor), rel=1e-13)


def test_the_first_failure_of_a_ray_counts():
    """What is good again farther out is not connected with the center."""
    assert _crossing([0.5, 1.5, 0.5, 0.5]) < RADII[1]
    assert _crossing([0.5, 1.5, 0.5, 0.5]) > RADII[0]


@pytest.mark.parametrize("beyond", [np.nan, np.inf])
def test_a_state_that_is_not_finite_has_failed(beyond):
    """Where there are no boxes, it is its V alone that says so."""
    assert _crossing([0.1, 0.2, beyond, beyond]) == RADII[1]


@pytest.mark.parametrize("beyond", [np.nan, np.inf, 0.3])
def test_a_ray_that_leaves_the_boxes_ends_at_the_last_radius_inside(beyond):
    """Nothing is known between the radii there, and V of a state that has left means nothing."""
    assert _crossing([0.1, 0.2, beyond, beyond], [True, True, False, False]) == RADII[1]


def test_the_scan_is_the_recursion_over_the_knots():
    """With V_{k+1} = g_k r^2 on the worst ray, rho_k = (1 - margin) rho_{k+1} / g_k, up to the largest radius."""
    gains = np.array([3.0, 0.001, 2.0])
    radii = np.broadcast_to(np.geomspace(0.1, 2, 12), (3, 2, 12))
    ends = radii**2 * gains[:, None, None] * np.array([0.7, 1.0])[:, None]
    levels = _scan_rays(jnp.asarray(radii), jnp.asarray(ends), jnp.ones(ends.shape, bool), jnp.asarray(1.5))
    third = (1 - MARGIN) * 1.5 / 2
    second = (1 - MARGIN) * 4
    first = (1 - MARGIN) * second / 3
    np.testing.assert_allclose(levels, [first, second, third], rtol=1e-12)


def test_below_the_lowest_radius_v_is_continued_but_never_past_the_boxes():
    radii = np.broadcast_to(RADII, (1, 1, 4))
    ends = 400 * radii**2
    inside = np.ones(ends.shape, bool)
    for first, expected in ((True, (1 - MARGIN) / 400), (False, 0.0)):
        inside[..., 0] = first
        (level,) = _scan_rays(jnp.asarray(radii), jnp.asarray(ends), jnp.asarray(inside), jnp.asarray(1.0))
        assert level == pytest.approx(expected, rel=1e-12)


# ---- a linear robot


def _effort(problem, **changes) -> Effort:
    physics = rollout.closed_form(problem.plant)
    effort = Effort(problem.config.funnel, Dynamics(physics, physics), passes=3, rounds=0, follow=False)
    return dataclasses.replace(effort, **changes)


def _estimator(problem, **effort):
    estimate = partial(estimate_funnel, problem, linear.candidate(), effort=_effort(problem, **effort))
    return jax.jit(lambda policy: estimate(policy, jax.random.key(0)))


RESTING = linear.policy(np.zeros(10), 0.1)
BOX = np.array([1.0, 3.0])
LARGEST = np.min(BOX**2 / np.diag(np.linalg.inv(linear.S)))
"""The level of the largest ellipsoid inside the boxes about the origin."""


@cache
def _boxed():
    return _estimator(linear.problem_of(BOX), rounds=3, follow=True)


def test_without_saturation_only_the_boxes_limit_a_resting_funnel():
    """V falls from every state, so that each ellipsoid fills the boxes, and fresh states find nothing to shrink."""
    funnel = _boxed()(RESTING)
    np.testing.assert_allclose(funnel.levels, (1 - MARGIN) * LARGEST, rtol=1e-9)
    assert np.all(funnel.trials == 64)
    assert funnel.status == Status.OK


def test_a_moving_funnel_is_that_of_linear_algebra():
    """Some levels end at a box at their knot, some at a box behind it, some at the next level."""
    policy = linear.policy(np.random.default_rng(27).uniform(-6, 6, 10), 0.1)
    box = np.abs(np.asarray(policy.trajectory.xs)).max(0) + np.array([0.1, 0.3])
    problem = linear.problem_of(box, directions=96, radii=24)
    levels = np.asarray(_estimator(problem)(policy).levels)
    exact = linear.levels(policy, box, levels[-1], checks=problem.config.funnel.steps)
    by_knot = np.asarray(linear.ellipsoids(policy).radii_inside(jnp.asarray(box)))[:-1] ** 2
    by_next = exact[1:] / linear.decay(0.1)
    reasons = np.isclose(exact[:-1], [by_knot, by_next], rtol=1e-4)
    assert np.all(reasons.any(1))
    assert not np.all(reasons.any(0))
    # Where a box ends a ray behind the knot nothing is interpolated: the last radius inside is taken.
    assert np.all(levels <= 1.001 * exact)
    assert np.all(levels >= 0.96 * exact)


def _saturated(x, limit: float, duration: float, steps: int):
    """x [2 ...] after `duration` under u = clip(-K x)."""

    def rate(x):
        u = np.clip(-np.tensordot(linear.K, x, 1), -limit, limit)
        return np.tensordot(linear.A, x, 1) + np.tensordot(linear.B, u, 1)

    dt = duration / steps
    for _ in range(steps):
        k1 = rate(x)
        k2 = rate(x + dt / 2 * k1)
        k3 = rate(x + dt / 2 * k2)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(x + dt * k3))
    return x


def _value(x):
    return np.sum(x * np.tensordot(linear.S, x, 1), 0)


def test_a_saturated_funnel_is_that_of_a_dense_grid():
    """Each level is the lowest V of a state of the grid that fails; the goal's is finite though no box is near."""
    limit, far = 1.0, 40.0
    problem = linear.problem_of([far, far], limit, directions=96, radii=24, goal={"directions": 128, "radii": 24})
    funnel = _estimator(problem)(RESTING)
    turn = np.linspace(0, 2 * np.pi, 360)
    radii = np.concatenate([np.linspace(0.05, 0.6, 20), np.geomspace(0.6, 0.9, 800)[1:]])
    rays = np.linalg.solve(np.linalg.cholesky(linear.S).T, np.stack([np.cos(turn), np.sin(turn)]))
    grid, value = rays[:, :, None] * radii, np.broadcast_to(radii**2, (len(turn), len(radii)))
    lowest = [np.min(value[_value(_saturated(grid, limit, problem.config.funnel.goal.horizon, 80)) > value])]
    after = _value(_saturated(grid, limit, 0.1, 8))
    for _ in range(10):
        lowest.append(np.min(value[after > lowest[-1]]))
    assert 0.6**2 < min(lowest) <= max(lowest) < 0.9**2
    np.testing.assert_allclose(funnel.levels, lowest[::-1], rtol=0.02)
    assert funnel.status == Status.OK


def _with(policy, **leaves):
    for name, leaf in leaves.items():
        policy = eqx.tree_at(lambda p, name=name: getattr(p, name), policy, leaf)
    return policy


def test_a_motion_that_leaves_the_boxes_has_an_empty_funnel():
    policy = linear.policy(3 * np.sin(np.arange(10.0)), 0.1)
    policy = eqx.tree_at(lambda p: p.trajectory.xs, policy, policy.trajectory.xs.at[0, 0].set(1.01 * BOX[0]))
    assert _boxed()(policy).status == Status.FUNNEL_EMPTY


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_value_that_is_not_finite_is_said(number):
    assert _boxed()(_with(RESTING, values=RESTING.values.at[3, 0, 0].set(number))).status == Status.NOT_FINITE


@pytest.mark.parametrize("status", [Status.TRAJECTORY_NOT_SOLVED, Status.RICCATI_INDEFINITE])
def test_the_first_failure_is_kept(status):
    """Also where nothing behind it is finite."""
    failed = _with(RESTING, status=jnp.asarray(status, jnp.int32))
    assert _boxed()(failed).status == status
    assert _boxed()(_with(failed, values=jnp.nan * failed.values)).status == status


# ---- the pendulum


def _doubled(effort: Effort, part: str) -> Effort:
    """Twice the directions, or half the rollouts' step, also at the goal."""
    funnel, goal = effort.funnel, effort.funnel.goal
    if part == "directions":
        goal = goal.model_copy(update={"directions": 2 * goal.directions})
        changes = {"directions": 2 * funnel.directions, "goal": goal}
    else:
        changes = {"steps": 2 * funnel.steps, "goal": goal.model_copy(update={"step": goal.step / 2})}
    return dataclasses.replace(effort, funnel=funnel.model_copy(update=changes))


def _known_levels(effort: Effort) -> np.ndarray:
    """Of the paper's initial candidate and its published optima, about the policies of a generation."""
    evaluation, known = pipeline.evaluated(), np.array([pipeline.INITIAL, pipeline.RTC, pipeline.RTCD])
    assert np.all(np.asarray(evaluation.status)[known] == Status.OK)
    candidates, policies = jax.tree.map(lambda leaf: leaf[known], (evaluation.candidate, evaluation.funnel.policy))
    estimate = partial(estimate_funnel, pipeline.problem(), key=pipeline.GENERATION, effort=effort)
    return np.asarray(jax.jit(jax.vmap(estimate))(candidates, policies).levels)


@cache
def _generations_levels():
    return _known_levels(search_effort(pipeline.problem()))


def test_a_generations_levels_do_not_depend_on_the_rollouts_step():
    """Halved steps move none by 0.1 % (0.001 % measured)."""
    fine = _known_levels(_doubled(search_effort(pipeline.problem()), "steps"))
    np.testing.assert_allclose(fine, _generations_levels(), rtol=1e-3)


def test_a_generations_levels_are_resolved_well_enough_to_rank():
    """Doubled directions move none by 6 %, always downward where it is more than 1 % (4.8 % measured)."""
    fine = _known_levels(_doubled(search_effort(pipeline.problem()), "directions"))
    change = fine / _generations_levels() - 1
    assert np.all(change > -0.06)
    assert np.all(change < 0.01)


def test_the_elites_levels_are_resolved():
    """Doubled directions move none by 3 % (1.3 % measured, from the goal's level), before fresh states shrink them."""
    effort = dataclasses.replace(elite_effort(pipeline.problem()), rounds=0, follow=False)
    np.testing.assert_allclose(_known_levels(_doubled(effort, "directions")), _known_levels(effort), rtol=0.03)


def test_a_pendulum_that_steers_too_hard_has_an_empty_funnel():
    """r = 0.002 asks for gains that the torque limit cannot serve."""
    assert pipeline.evaluated().status[pipeline.HARD] == Status.FUNNEL_EMPTY
