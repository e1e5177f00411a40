"""Linear algebra with the batch last, against numpy on every problem of the batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics import batched

BATCH = 7


def random(*shape, seed=0):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(*shape, BATCH)))


def positive_definite(n):
    root = random(n, n, seed=n)
    return jnp.einsum("ikp,jkp->ijp", root, root) + 0.1 * np.eye(n)[:, :, None]


@pytest.mark.parametrize(
    ("ours", "shapes", "formula"),
    [
        (batched.mm, [(2, 3), (3, 4)], "ikp,kjp->ijp"),
        (batched.mtm, [(3, 2), (3, 4)], "kip,kjp->ijp"),
        (batched.mv, [(2, 3), (3,)], "ikp,kp->ip"),
        (batched.mtv, [(3, 2), (3,)], "kip,kp->ip"),
    ],
)
def test_products(ours, shapes, formula):
    a, b = (random(*shape, seed=seed) for seed, shape in enumerate(shapes))
    np.testing.assert_allclose(ours(a, b), np.einsum(formula, a, b), rtol=1e-14, atol=1e-14)


def test_transpose_leaves_the_batch_where_it_is():
    a = random(2, 3)
    np.testing.assert_array_equal(batched.transpose(a), np.swapaxes(a, 0, 1))


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_cholesky_is_lower_and_multiplies_back(n):
    a = positive_definite(n)
    factor, positive = jax.jit(batched.cholesky)(a)
    assert np.all(positive)
    np.testing.assert_array_equal(np.triu(np.moveaxis(factor, -1, 0), 1), 0)
    np.testing.assert_allclose(batched.mm(factor, batched.transpose(factor)), a, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(np.moveaxis(factor, -1, 0), np.linalg.cholesky(np.moveaxis(a, -1, 0)), rtol=1e-10)


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_triangular_and_definite_solves_leave_no_residual(n):
    a, b = positive_definite(n), random(n, 2, seed=9)
    factor, _ = jax.jit(batched.cholesky)(a)
    np.testing.assert_allclose(batched.mm(factor, jax.jit(batched.solve_lower)(factor, b)), b, atol=1e-12)
    np.testing.assert_allclose(batched.mtm(factor, jax.jit(batched.solve_lower_transposed)(factor, b)), b, atol=1e-12)
    solution, positive = jax.jit(batched.spd_solve)(a, b)
    assert np.all(positive)
    np.testing.assert_allclose(batched.mm(a, solution), b, atol=1e-11)


def test_flag_says_definite_on_one_side_of_singular_only():
    """[[1, a], [a, 1]] has the pivots 1 and 1 - a^2."""
    off = np.array([-1.01, -1.0, -0.99, 0.0, 0.99, 1.0, 1.01])
    a = np.array([[np.ones(7), off], [off, np.ones(7)]])
    factor, positive = batched.cholesky(jnp.asarray(a))
    np.testing.assert_array_equal(positive, np.abs(off) < 1)
    assert np.all(np.isfinite(factor))


def test_a_pivot_at_the_floor_is_refused():
    pivots = jnp.array([[[1e-3, np.nextafter(1e-3, 1)]]])
    np.testing.assert_array_equal(batched.cholesky(pivots, floor=1e-3)[1], [False, True])
    np.testing.assert_array_equal(batched.spd_solve(pivots, pivots, floor=1e-3)[1], [False, True])


@pytest.mark.parametrize("bad", [np.nan, -1.0])
def test_a_bad_problem_leaves_the_others_bit_equal(bad):
    a, b = positive_definite(3), random(3, 2)
    spoilt = a.at[1, 1, 4].set(bad)
    solve = jax.jit(batched.spd_solve)
    solution, positive = solve(a, b)
    solution_beside, positive_beside = solve(spoilt, b)
    others = np.arange(BATCH) != 4
    assert np.all(positive)
    np.testing.assert_array_equal(solution_beside[..., others], solution[..., others])
    np.testing.assert_array_equal(positive_beside, others)


def test_batch_is_one_by_one_and_any_number_of_axes():
    a, b = positive_definite(3), random(3, 2)
    together, _ = jax.jit(batched.spd_solve)(a, b)
    alone = [jax.jit(batched.spd_solve)(a[..., p : p + 1], b[..., p : p + 1])[0] for p in range(BATCH)]
    np.testing.assert_allclose(together, np.concatenate(alone, -1), rtol=1e-13)
    grid, positive = jax.jit(batched.spd_solve)(np.stack([a, 2 * a], 2), np.stack([b, b], 2))
    assert positive.shape == (2, BATCH)
    np.testing.assert_allclose(grid[:, :, 1], grid[:, :, 0] / 2, rtol=1e-12)


def test_single_precision_stays_single():
    a, b = positive_definite(3).astype(np.float32), random(3, 2).astype(np.float32)
    solution, _ = jax.jit(batched.spd_solve)(a, b)
    assert solution.dtype == jnp.float32


@pytest.mark.parametrize("n", [1, 2, 4])
def test_the_spectral_radius_is_bounded_from_above_and_closely(n):
    """Of modes that are apart by 1e6, real and complex, in a basis that is not orthogonal."""
    a = np.array(random(n, n, seed=n)) * np.logspace(-3, 3, n)[:, None, None]
    exact = np.array([np.max(np.abs(np.linalg.eigvals(a[..., p]))) for p in range(BATCH)])
    bound = np.asarray(batched.spectral_radius(jnp.asarray(a)))
    assert np.all(bound >= exact * (1 - 1e-12))
    np.testing.assert_allclose(bound, exact, rtol=0.1)


def test_the_spectral_radius_of_a_rotation_is_its_rate():
    turn = jnp.array([[0.0, 3.0], [-3.0, 0.0]])
    assert float(batched.spectral_radius(turn)) == pytest.approx(3.0, rel=0.01)
