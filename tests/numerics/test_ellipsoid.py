"""Ellipsoids against closed forms, geometry and counting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics import ellipsoid
from rtcd_jax.numerics.batched import cholesky


def random_ellipsoid(n, count=3):
    root = np.random.default_rng(n).normal(size=(n, n, count))
    matrix = np.einsum("ikp,jkp->ijp", root, root) + 0.2 * np.eye(n)[:, :, None]
    return jnp.asarray(matrix), cholesky(jnp.asarray(matrix))[0]


@pytest.mark.parametrize("n", [1, 2, 4])
def test_points_of_the_ball_land_on_their_level(n):
    matrix, factor = random_ellipsoid(n)
    y = jnp.asarray(np.random.default_rng(0).normal(size=(n, 3)))
    x = ellipsoid.from_ball(factor, y)
    levels = np.einsum("ip,ijp,jp->p", x, matrix, x)
    np.testing.assert_allclose(levels, np.sum(y**2, 0), rtol=1e-11)


@pytest.mark.parametrize(("n", "unit_ball"), [(1, 2), (2, np.pi), (3, 4 * np.pi / 3), (4, np.pi**2 / 2)])
def test_volume_is_the_unit_balls_times_the_half_axes(n, unit_ball):
    matrix, factor = random_ellipsoid(n)
    level = jnp.array([0.3, 1.0, 7.0])
    eigenvalues = np.linalg.eigvalsh(np.moveaxis(matrix, -1, 0))
    half_axes = np.sqrt(level[:, None] / eigenvalues)
    expected = np.log(unit_ball) + np.sum(np.log(half_axes), -1)
    np.testing.assert_allclose(ellipsoid.log_volume(factor, level), expected, rtol=1e-10, atol=1e-10)


def test_volume_is_the_share_of_a_box_that_is_inside():
    """4e5 points put a share of about 0.5 within 4 standard errors of 0.0008."""
    matrix, factor = random_ellipsoid(2, 1)
    widths = ellipsoid.half_widths(factor)
    x = widths * np.random.default_rng(1).uniform(-1, 1, (2, 400_000))
    share = np.mean(np.einsum("ip,ij,jp->p", x, matrix[..., 0], x) <= 1)
    volume = np.exp(ellipsoid.log_volume(factor, jnp.ones(1)))
    np.testing.assert_allclose(volume / np.prod(2 * widths), share, atol=4 * 0.0008)


def test_an_empty_ellipsoid_has_no_volume():
    _, factor = random_ellipsoid(2)
    np.testing.assert_array_equal(ellipsoid.log_volume(factor, jnp.zeros(3)), -np.inf)


@pytest.mark.parametrize("n", [1, 2, 4])
def test_half_widths_are_reached_and_never_passed(n):
    """x_i is largest on x' S x = 1 at S^-1 e_i / sqrt(e_i' S^-1 e_i)."""
    matrix, factor = random_ellipsoid(n)
    inverse = np.linalg.inv(np.moveaxis(matrix, -1, 0))
    widths = ellipsoid.half_widths(factor)
    np.testing.assert_allclose(widths.T, np.sqrt(np.diagonal(inverse, axis1=1, axis2=2)), rtol=1e-10)
    unit = jnp.asarray(np.random.default_rng(0).normal(size=(n, 5000, 1)))
    inside = ellipsoid.from_ball(factor[:, :, None], unit / jnp.linalg.norm(unit, axis=0))
    assert np.all(np.abs(inside) <= widths[:, None])


def random_row(n, count=4):
    matrix, _ = random_ellipsoid(n, count)
    centers = jnp.asarray(np.random.default_rng(7).normal(size=(n, count)))
    return ellipsoid.Ellipsoids.about(centers, matrix)


@pytest.mark.thorough
def test_points_of_a_row_lie_on_the_levels_they_were_asked_for():
    row = random_row(3)
    random = np.random.default_rng(0)
    radii = jnp.asarray(random.uniform(0, 2, (4, 5, 6)))
    y = jnp.asarray(random.normal(size=(3, 1, 1, 6)))
    x = row.points(radii, y)
    assert x.shape == (3, 4, 5, 6)
    np.testing.assert_allclose(row.level(x), radii**2 * np.sum(y**2, 0), rtol=1e-10, atol=1e-12)
    for k in range(4):
        error = x[:, k, 2, 3] - row.centers[:, k]
        assert float(row.level(x)[k, 2, 3]) == pytest.approx(float(error @ row.values[:, :, k] @ error), rel=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_way_to_the_ball_is_the_way_back_from_it(n):
    """points(radii, y) -> radii y, and |y|^2 = V of any x."""
    row = random_row(n)
    random = np.random.default_rng(0)
    radii = jnp.asarray(random.uniform(0.1, 2, (4, 5, 6)))
    y = jnp.asarray(random.normal(size=(n, 4, 5, 6)))
    np.testing.assert_allclose(row.to_ball(row.points(radii, y)), radii * y, rtol=1e-9, atol=1e-10)
    x = jnp.asarray(random.normal(size=(n, 4, 7)))
    np.testing.assert_allclose(np.sum(row.to_ball(x) ** 2, 0), row.level(x), rtol=1e-10)
    np.testing.assert_array_equal(row.to_ball(row.centers), 0)


def test_a_part_is_the_row_cut():
    row = random_row(2)
    radii, aim = jnp.array([0.5, 1.5]), jnp.array([[0.6], [-0.8]])
    points = row.part(slice(1, 3)).points(radii, aim)
    whole = row.points(jnp.array([9.0, 0.5, 1.5, 9.0]), aim)
    np.testing.assert_array_equal(points, whole[:, 1:3])


@pytest.mark.thorough
def test_the_largest_set_inside_the_box_touches_it_and_no_more():
    row, limits = random_row(3), jnp.array([2.5, 3.0, 3.5])
    radii = row.radii_inside(limits)
    assert np.all(radii > 0)
    reach = np.abs(row.centers) + radii * ellipsoid.half_widths(row.factors)
    np.testing.assert_allclose(np.max(reach / limits[:, None], 0), 1, rtol=1e-12)


@pytest.mark.thorough
def test_no_set_is_inside_a_box_without_its_center():
    row = random_row(2)
    outside = jnp.max(jnp.abs(row.centers), 1) * 0.99
    radii = row.radii_inside(outside)
    beyond = np.any(np.abs(row.centers) > outside[:, None], 0)
    assert np.any(beyond)
    np.testing.assert_array_equal(radii == 0, beyond)


def test_single_precision_stays_single():
    _, factor = random_ellipsoid(3)
    factor = factor.astype(jnp.float32)
    level = jnp.ones(3, jnp.float32)
    for f, *rest in (
        (ellipsoid.from_ball, jnp.ones((3, 3), jnp.float32)),
        (ellipsoid.log_volume, level),
        (ellipsoid.half_widths,),
    ):
        assert jax.eval_shape(f, factor, *rest).dtype == jnp.float32
