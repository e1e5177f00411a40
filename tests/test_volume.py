"""Volumes of ellipsoids in closed form, the relations between the objectives, pushes, the published funnels."""

from math import gamma, pi
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.policy import input_jumps
from rtcd_jax.types import Funnel, Policy, Status, Trajectory, Volumes
from rtcd_jax.volume import VOLUMES, funnel_volume
from tests import pipeline

PUBLISHED = Path(__file__).parents[2] / "shared" / "reference"
DT = 0.07


def _funnel(values, levels, status=Status.OK) -> Funnel:
    values, levels = jnp.asarray(values, float), jnp.asarray(levels, float)
    knots, n = values.shape[:2]
    zero, ok = jnp.zeros(()), jnp.zeros((), jnp.int32)
    motion = Trajectory(jnp.zeros((knots - 1, 1)), jnp.zeros((knots, n)), jnp.asarray(DT), zero, zero, ok, ok)
    policy = Policy(motion, jnp.zeros((knots, 1, n)), values, ok)
    return Funnel(policy, levels, jnp.zeros(knots, jnp.int32), jnp.asarray(status, jnp.int32))


def _random_funnel(n: int, knots: int = 7, **changes) -> Funnel:
    random = np.random.default_rng(n)
    roots = random.normal(size=(knots, n, n))
    return _funnel(roots @ np.swapaxes(roots, 1, 2) + np.eye(n), random.uniform(0.1, 5, knots), **changes)


@jax.jit
def _volumes(funnel: Funnel) -> Volumes:
    """Those where a unit impulse moves the last state by one."""
    knots, n = funnel.policy.trajectory.xs.shape
    return funnel_volume(funnel, jnp.zeros((knots, n, 1)).at[:, -1].set(1))


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6])
def test_a_ball_has_the_balls_volume(n):
    """V = |x|^2 / a^2 <= rho is the ball of radius a sqrt(rho)."""
    a, rho = 0.3, np.array([0.5, 2.0])
    volumes = _volumes(_funnel(np.tile(np.eye(n) / a**2, (2, 1, 1)), rho))
    np.testing.assert_allclose(volumes.per_knot, pi ** (n / 2) / gamma(n / 2 + 1) * (a * np.sqrt(rho)) ** n, rtol=1e-13)


def test_one_two_and_four_dimensions_by_their_own_formulas():
    """An interval's length, an ellipse's pi a b, and in four dimensions pi^2 / 2 times the four semi-axes."""
    axes, rho = np.array([0.5, 2.0, 1.5, 0.1]), 1.7
    for n, unit in ((1, 2.0), (2, pi), (4, pi**2 / 2)):
        semi = axes[:n] * np.sqrt(rho)
        value = np.tile(np.diag(1 / axes[:n] ** 2), (2, 1, 1))
        np.testing.assert_allclose(_volumes(_funnel(value, [rho, rho]))["inlet"], unit * semi.prod(), rtol=1e-13)


@pytest.mark.parametrize("n", [2, 4])
def test_a_linear_map_scales_volumes_by_its_determinant(n):
    """x -> T x takes {x' S x <= rho} to {x' T^-T S T^-1 x <= rho}."""
    funnel = _random_funnel(n)
    map_ = np.random.default_rng(9).normal(size=(n, n))
    inverse = np.linalg.inv(map_)
    mapped = _funnel(inverse.T @ np.asarray(funnel.policy.values) @ inverse, funnel.levels)
    ratio = _volumes(mapped).per_knot / _volumes(funnel).per_knot
    np.testing.assert_allclose(ratio, abs(np.linalg.det(map_)), rtol=1e-10)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_four_volumes_follow_from_the_knots(n):
    volumes = _volumes(_random_funnel(n))
    knots = np.asarray(volumes.per_knot)
    np.testing.assert_allclose(volumes["sum"], knots.sum(), rtol=1e-14)
    np.testing.assert_allclose(volumes["integral"], np.trapezoid(knots, dx=DT), rtol=1e-14)
    np.testing.assert_allclose(volumes["geometric_mean"], knots.prod() ** (1 / len(knots)), rtol=1e-13)
    assert volumes["inlet"] == knots[0]
    assert volumes["geometric_mean"] < volumes["sum"] / len(knots)


def test_an_empty_knot_leaves_the_sum_and_kills_the_geometric_mean():
    whole = _random_funnel(2)
    levels = whole.levels.at[3].set(0.0)
    volumes, before = _volumes(_funnel(whole.policy.values, levels)), _volumes(whole)
    np.testing.assert_allclose(volumes["sum"], before["sum"] - before.per_knot[3], rtol=1e-13)
    assert volumes["geometric_mean"] == 0


@pytest.mark.parametrize("status", [status for status in Status if status != Status.OK])
def test_a_failed_candidate_has_no_volume(status):
    """Zero, not NaN, also where its numbers mean nothing."""
    funnel = _random_funnel(2, status=status)
    broken = _funnel(funnel.policy.values.at[2].set(jnp.nan), funnel.levels.at[4].set(-1.0), status)
    for volumes in (_volumes(funnel), _volumes(broken)):
        for volume in (*volumes.per_knot, *volumes.named.values()):
            assert volume == 0


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_push_margin_reaches_the_boundary_and_no_further(n):
    """x* + b J is on the boundary of the knot that allows the least, and inside all the others, for every input."""
    random, funnel = np.random.default_rng(n), _random_funnel(n)
    knots, m = len(funnel.levels), 2
    jumps = random.normal(size=(knots, n, m))
    margin = float(funnel_volume(funnel, jnp.asarray(jumps))["push"])
    v = np.einsum("kim,kij,kjm->km", margin * jumps, funnel.policy.values, margin * jumps)
    share = v / np.asarray(funnel.levels)[:, None]
    assert share.max() == pytest.approx(1, rel=1e-12)
    assert np.sum(share > 0.999) == 1


@pytest.mark.thorough
def test_an_impulse_changes_the_pendulum_s_speed_by_its_inertia():
    """m l^2 theta_dot jumps by J: the closed form's margin is m l^2 sqrt(rho / S_22)."""
    evaluation = pipeline.evaluated().take(np.array([pipeline.RTCD]))
    candidate, funnel = jax.tree.map(lambda leaf: leaf[0], (evaluation.candidate, evaluation.funnel))
    inertia = float(candidate.design.mass * candidate.design.length**2)
    expected = inertia * np.sqrt(funnel.levels / funnel.policy.values[:, 1, 1])
    margin = funnel_volume(funnel, input_jumps(pipeline.problem(), candidate, funnel.policy.trajectory))["push"]
    np.testing.assert_allclose(margin, np.min(expected), rtol=1e-12)
    np.testing.assert_allclose(evaluation.volumes["push"], np.min(expected), rtol=1e-12)


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the published funnels are not there")
@pytest.mark.parametrize(("name", "n", "published"), [("pendulum", 2, 156.9), ("cartpole", 4, 495.6)])
def test_the_published_initial_funnels_have_their_published_sums(name, n, published):
    """Four digits of the papers' authors' funnels, evaluated exactly."""
    rows = np.genfromtxt(PUBLISHED / f"{name}_initial.csv", delimiter=",", names=True)
    values = np.zeros((len(rows), n, n))
    for i, j in zip(*np.triu_indices(n), strict=True):
        values[:, i, j] = values[:, j, i] = rows[f"S{i + 1}{j + 1}"]
    assert float(_volumes(_funnel(values, rows["rho"]))["sum"]) == pytest.approx(published, abs=0.051)


def test_a_population_s_volumes_keep_their_order_and_the_checkpoints_names():
    """Orbax finds a leaf by its path: `total` is what checkpoints have called the sum from the first one on."""
    funnels = _funnel(jnp.stack([jnp.eye(2)] * 3), jnp.arange(1.0, 4.0))
    batch = jax.jit(jax.vmap(_volumes))(jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), funnels))
    assert list(batch.named) == list(VOLUMES)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(batch)[0]]
    assert paths == [".per_knot", ".total", ".integral", ".inlet", ".geometric_mean", ".push", ".goal"]
