"""Half spaces and ellipsoids to keep out of: what they say of states and of ellipsoids, against geometry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.numerics.keep_out import Ellipsoid, HalfSpace, sets_of

ENDS = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0]])
STATED = [
    {"normal": [1.0, -2.0, 0.5], "offset": 3.0},
    {"center": [0.5, 3.0, 1.0], "semi_axes": [1.7, 2.5, 1.4]},
    {"center": [-4.0, 3.0, 1.0], "semi_axes": [1.0, None, 2.0]},
]
SETS = sets_of(STATED, ENDS)
RANDOM = np.random.default_rng(0)
EACH = pytest.mark.parametrize("each", SETS)


def _inside(stated, x):
    if "normal" in stated:
        return np.array(stated["normal"]) @ x > stated["offset"]
    axes = np.array([np.inf if axis is None else axis for axis in stated["semi_axes"]])
    return np.sum(((x.T - stated["center"]) / axes) ** 2, axis=1) < 1


@pytest.mark.parametrize(("stated", "each"), list(zip(STATED, SETS, strict=True)))
def test_a_state_is_inside_as_the_definitions_say(stated, each):
    """By all three answers: entered, a negative clearance, a fill above 1."""
    x = RANDOM.normal(size=(3, 3000)) * 3
    inside = _inside(stated, x)
    assert 20 < inside.sum() < 2900
    np.testing.assert_array_equal(each.entered(x), inside)
    np.testing.assert_array_equal(each.clearance(x) < 0, inside)
    np.testing.assert_array_equal(np.asarray(each.fill(jnp.asarray(x))) > 1, inside)


@EACH
def test_what_is_no_number_is_in_no_set_and_fills_none(each):
    x = np.full((3, 1), np.nan)
    assert not each.entered(x)
    assert np.isnan(each.fill(jnp.asarray(x)))


@EACH
def test_slopes_and_curvatures_are_the_derivatives(each):
    x = RANDOM.normal(size=3)
    np.testing.assert_allclose(each.slopes(x), jax.grad(lambda x: each.clearance(x))(x), rtol=1e-13)
    hessian = jax.hessian(lambda x: each.clearance(x) + 0 * x @ x)(x)
    np.testing.assert_allclose(np.diag(each.curvatures()), hessian, atol=1e-13)


@EACH
@pytest.mark.parametrize("share", [0.5, 0.9, 1.0])
def test_a_share_of_the_room_is_what_a_shrunk_set_leaves(each, share):
    x = RANDOM.normal(size=(3, 2000)) * 3
    np.testing.assert_array_equal(np.asarray(each.fill(jnp.asarray(x))) > share, each.shrunk(share).entered(x))


def test_the_room_is_that_of_the_nearest_end():
    assert SETS[0].room == pytest.approx(3.0)
    assert sets_of(STATED[:1], np.array([[2.0, 0, 0], [0, 0, 0]]))[0].room == pytest.approx(1.0)


def _ellipsoids():
    roots = RANDOM.normal(size=(40, 3, 3))
    values = roots @ roots.transpose(0, 2, 1) + 0.05 * np.eye(3)
    return Ellipsoids.about(jnp.asarray(3 * RANDOM.normal(size=(3, 40))), jnp.asarray(np.moveaxis(values, 0, -1)))


@EACH
def test_the_largest_clear_ellipsoid_touches_the_set(each):
    """A little smaller, a hyperplane lies between both sets; a little larger, they have a point in common."""
    sets = _ellipsoids()
    radii = np.asarray(each.radii_clear(sets))
    outside = ~np.asarray(each.entered(sets.centers))
    np.testing.assert_array_equal(radii > 0, outside)
    for k in np.flatnonzero(outside):
        center, value, radius = np.asarray(sets.centers[:, k]), np.asarray(sets.values[:, :, k]), radii[k]
        touching = _nearest(each, center, value)
        assert (touching - center) @ value @ (touching - center) == pytest.approx(radius**2, rel=1e-6)
        assert each.clearance(touching) == pytest.approx(0, abs=1e-7)
        normal = value @ (touching - center)  # outward of the ellipsoid, and so into the set
        slopes = -np.array(each.slopes(touching))
        assert normal @ slopes == pytest.approx(np.linalg.norm(normal) * np.linalg.norm(slopes), rel=1e-5)


def _nearest(each, center, value):
    """The point of the set's boundary with the least V, by Newton's method on its multiplier."""
    if isinstance(each, HalfSpace):
        normal = np.array(each.normal)
        step = np.linalg.solve(value, normal)
        return center + step * (each.offset - normal @ center) / (normal @ step)
    weights, middle = np.array(each.semi_axes) ** -2.0, np.array(each.center)

    def point(multiplier):
        return np.linalg.solve(value + multiplier * np.diag(weights), value @ center + multiplier * weights * middle)

    low, high = 0.0, 1.0
    while each.clearance(point(high)) > 0:
        high *= 2
    for _ in range(200):
        between = 0.5 * (low + high)
        low, high = (between, high) if each.clearance(point(between)) > 0 else (low, between)
    return point(high)


@EACH
def test_the_clear_radius_can_be_differentiated(each):
    sets = _ellipsoids()

    def radius(shift):
        return jnp.sum(each.radii_clear(Ellipsoids(sets.centers + shift, sets.values, sets.factors)))

    slope = (radius(1e-6) - radius(-1e-6)) / 2e-6
    assert jax.grad(radius)(0.0) == pytest.approx(float(slope), rel=1e-5)


def test_a_line_reaches_a_set_where_it_first_enters_it():
    x = RANDOM.normal(size=(3, 500)) * 2
    step = RANDOM.normal(size=(3, 500))
    for each in SETS:
        reach = each.reach(x, step)
        found = np.isfinite(reach) & ~each.entered(x)
        assert found.sum() > 20
        at = [x + sign * reach * step for sign in (-1, 1)]
        both = np.minimum(*(np.abs(each.clearance(where)) for where in at))
        np.testing.assert_allclose(both[found], 0, atol=1e-9)
        for share in np.linspace(-0.999, 0.999, 41):
            assert not np.any(each.entered(x + share * np.where(found, reach, 0) * step) & found)
    assert np.isinf(Ellipsoid((0.0, 0.0), (1.0, 1.0)).reach(np.array([[3.0], [0.0]]), np.array([[0.0], [1.0]])))
