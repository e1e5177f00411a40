"""Shadows of ellipsoids hold them and touch them; outlines are their boundaries."""

import numpy as np
import pytest

from rtcd_jax.analysis.report.shapes import outlines, planes, projections
from tests.analysis.report.runs import KNOTS, random_values


@pytest.mark.parametrize(("n", "plane"), [(2, (0, 1)), (4, (0, 2)), (4, (1, 3))])
def test_the_shadow_holds_the_ellipsoid_and_touches_it(n, plane):
    S, rho = random_values(n)
    M = projections(S, rho, plane)
    # Any boundary point of the ellipsoid: x = sqrt(rho) L^-T y, |y| = 1, for S = L L'.
    y = np.random.default_rng(2).normal(size=(500, n))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    x = np.sqrt(rho)[:, None, None] * (y @ np.linalg.inv(np.linalg.cholesky(S)))
    np.testing.assert_allclose(np.einsum("ksi,kij,ksj->ks", x, S, x), rho[:, None] * np.ones(500))
    assert np.max(_level(M, x[..., list(plane)])) <= 1 + 1e-12
    # Farthest in a direction e of the plane is x = sqrt(rho / e' S^-1 e) S^-1 e: its shadow lies on the outline.
    e = np.zeros((60, n))
    e[:, list(plane)] = np.random.default_rng(3).normal(size=(60, 2))
    toward = e @ np.linalg.inv(S)
    x = np.sqrt(rho[:, None] / np.einsum("ksi,si->ks", toward, e))[..., None] * toward
    np.testing.assert_allclose(np.einsum("ksi,kij,ksj->ks", x, S, x), rho[:, None] * np.ones(60))
    np.testing.assert_allclose(_level(M, x[..., list(plane)]), 1)


def _level(M, d):
    return np.einsum("ksi,kij,ksj->ks", d, np.linalg.inv(M), d)


def test_an_outline_is_the_closed_boundary_about_its_center():
    S, rho = random_values(2)
    centers = np.random.default_rng(4).normal(size=(KNOTS, 2))
    curves = outlines(centers, projections(S, rho, (0, 1)))
    offsets = curves - centers[:, None]
    np.testing.assert_allclose(
        np.einsum("kpi,kij,kpj->kp", offsets, S, offsets), np.tile(rho[:, None], curves.shape[1])
    )
    np.testing.assert_allclose(curves[:, 0], curves[:, -1])
    x, y = np.moveaxis(offsets, -1, 0)
    area = 0.5 * np.sum(x[:, :-1] * y[:, 1:] - x[:, 1:] * y[:, :-1], axis=1)
    np.testing.assert_allclose(area, np.pi * rho / np.sqrt(np.linalg.det(S)), rtol=1e-3)


def test_planes_pair_every_coordinate_with_its_velocity():
    assert planes(2) == [(0, 1)]
    assert planes(4) == [(0, 2), (1, 3)]
    with pytest.raises(ValueError, match="got an odd number of them: 3"):
        planes(3)
