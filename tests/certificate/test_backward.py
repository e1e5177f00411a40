"""Ellipsoids that grow fastest backward: the inequality they are made for, and level sets that take over from them."""

import numpy as np
import pytest
from scipy.linalg import expm

from rtcd_jax.certificate.enlarge import knot_by_knot as backward
from rtcd_jax.certificate.prove.levels import DECAY_MARGIN, leveled, merit, unit_directions
from tests.certificate.test_joint import DIRECTIONS, loop_of


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    """Two states have polynomials of a higher order."""
    monkeypatch.setattr(backward, "WIDEST", 2.0)


@pytest.fixture(scope="module")
def funnel():
    return leveled(loop_of(), DIRECTIONS)


def test_attraction_weighs_the_narrow_directions():
    """G^-a with trace n: none at 0; the more, the more the largest level set of V inside the ellipsoid counts."""
    g = np.array([[4.0, 1.0], [1.0, 0.5]])
    np.testing.assert_allclose(backward.importance(g, 0.0), np.eye(2), atol=1e-12)
    inverse = np.linalg.inv(g)
    np.testing.assert_allclose(backward.importance(g, 1.0), 2 * inverse / np.trace(inverse), rtol=1e-12)
    least = np.linalg.eigh(g)[1][:, 0]
    np.testing.assert_allclose(backward.importance(g, 40.0), 2 * np.outer(least, least), atol=1e-9)


def test_free_shapes_obey_the_sampled_inequality(funnel):
    """y'W y >= g on the sphere, and the trace is the least: the Riccati equation's own W has a larger one."""
    directions = unit_directions(2)[:, ::4]
    axes, _ = funnel.axes(2, 1.0, 1.0, 0.0)
    w = backward.fastest_growth(funnel, 2, axes, backward.ShapeObjective(0.0, 0.0), directions)
    for share in (0.0, 0.5, 1.0):
        here = axes @ expm(-w * (1 - share) * funnel.dt)
        growth = np.sum(directions * (w @ directions), axis=0) - funnel.drift(2, share, here, directions)
        assert growth.min() > 0
    usual = funnel.growth(2, 1.0, 1.0, directions)
    _, rates = funnel.axes(2, 1.0, 1.0, usual)
    assert np.trace(w) < np.trace(np.linalg.solve(axes, rates)) + 0.05


def test_its_value_function_has_those_ellipsoids(funnel):
    """P = (L L')^-1 with the rates that belong to L' = L W: on the boundary V falls, by the decay margin at least."""
    first, free = backward.fastest(funnel, backward.ShapeObjective(0.0, 0.0))
    assert first == 0
    for k in range(len(funnel.u)):
        for share in (0.0, 1.0):
            assert -1 < free.growth(k, share, 1.0, DIRECTIONS) < -DECAY_MARGIN


def test_level_sets_take_over_from_free_shapes_inside_them(funnel):
    """Before the knot P is a multiple of S again; its level set there touches the free ellipsoid from inside."""
    _, free = backward.fastest(funnel, backward.ShapeObjective(0.3, 0.0))
    mixed = backward.taken_over(funnel, free, 2)
    np.testing.assert_array_equal(mixed.values[2:], free.values[2:])
    shares = mixed.values[:2] / funnel.values[:2]
    np.testing.assert_allclose(shares, shares[0, 0, 0])
    held = funnel.values[2] * shares[0, 0, 0]
    assert np.linalg.eigvalsh(held - free.values[2])[0] == pytest.approx(0, abs=1e-9)
    assert backward.taken_over(funnel, free, 0) is free
    assert np.isfinite(merit(leveled(mixed, DIRECTIONS)))


@pytest.mark.thorough
def test_the_largest_funnel_of_all_is_taken(funnel, monkeypatch):
    grown = backward.grown(funnel, DIRECTIONS)
    assert merit(grown) > merit(funnel) + 0.05
    monkeypatch.setattr(backward, "merit", lambda loop: -merit(loop))
    assert merit(backward.grown(funnel, DIRECTIONS)) <= merit(funnel)
