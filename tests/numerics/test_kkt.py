"""The Riccati sweep against the dense KKT matrix, and its flag against the reduced Hessian's eigenvalues."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from rtcd_jax.numerics import kkt

N, n, m, P = 6, 3, 2, 4
w = n + 1 + m


class Dense(NamedTuple):
    """A subproblem as whole arrays."""

    hessians: np.ndarray
    gradients: np.ndarray
    jacobians: np.ndarray
    defects: np.ndarray
    curvature: np.ndarray
    slope: np.ndarray
    end: np.ndarray


def entries(array):
    """[N i j .. P] as nested lists of [N P]."""
    return [entries(array[:, i]) for i in range(array.shape[1])] if array.ndim > 2 else jnp.asarray(array)


@jax.jit
def solve(dense):
    hessian, gradient, jacobian = entries(dense.hessians), entries(dense.gradients), entries(dense.jacobians)
    return kkt.solve(kkt.Subproblem(hessian, gradient, jacobian, *dense[3:]))


def random_subproblem(seed=0, P=P):
    random = np.random.default_rng(seed)
    root = random.normal(size=(N, w, w, P))
    return Dense(
        hessians=np.einsum("kijp,kljp->kilp", root, root) + 0.1 * np.eye(w)[:, :, None],
        gradients=random.normal(size=(N, w, P)),
        jacobians=random.normal(size=(N, n, w, P)),
        defects=random.normal(size=(N, n, P)),
        curvature=random.uniform(1, 2, P),
        slope=random.normal(size=P),
        end=np.full((n, P), 1e4),
    )


def selector(k):
    """w_k = (dx_k, dh, du_k) out of all unknowns (dx_1 .. dx_{N-1}, dh, du_0 .. du_{N-1})."""
    chosen = np.zeros((w, (N - 1) * n + 1 + N * m))
    if k > 0:
        chosen[:n, (k - 1) * n : k * n] = np.eye(n)
    chosen[n, (N - 1) * n] = 1
    inputs = (N - 1) * n + 1 + k * m
    chosen[n + 1 :, inputs : inputs + m] = np.eye(m)
    return chosen


def dense(problem, p):
    """Hessian, gradient, constraint matrix and constraint offsets of problem p."""
    chosen = [selector(k) for k in range(N)]
    hessian = sum(c.T @ problem.hessians[k, ..., p] @ c for k, c in enumerate(chosen))
    gradient = sum(c.T @ problem.gradients[k, :, p] for k, c in enumerate(chosen))
    hessian[(N - 1) * n, (N - 1) * n] += problem.curvature[p]
    gradient[(N - 1) * n] += problem.slope[p]
    rows = [problem.jacobians[k, ..., p] @ chosen[k] for k in range(N)]
    for k in range(N - 1):
        rows[k] = rows[k] - chosen[k + 1][:n]
    return hessian, gradient, np.concatenate(rows), problem.defects[..., p].ravel()


def unknowns(step, p):
    parts = (step.dxs[1:-1, :, p], step.dh[p], step.dus[..., p])
    return np.concatenate([np.ravel(part) for part in parts])


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(3))
def test_the_step_leaves_no_residual_in_the_dense_system(seed):
    problem = random_subproblem(seed)
    step = solve(problem)
    assert np.all(step.convex)
    for p in range(P):
        hessian, gradient, constraints, offsets = dense(problem, p)
        z, multipliers = unknowns(step, p), np.ravel(step.multipliers[..., p])
        size = 1 + np.max(np.abs(multipliers))
        np.testing.assert_allclose(constraints @ z + offsets, 0, atol=1e-9 * size)
        np.testing.assert_allclose(hessian @ z + gradient + constraints.T @ multipliers, 0, atol=1e-9 * size)


@pytest.mark.thorough
def test_the_step_is_the_dense_solution():
    problem = random_subproblem()
    step = solve(problem)
    for p in range(P):
        hessian, gradient, constraints, offsets = dense(problem, p)
        matrix = np.block([[hessian, constraints.T], [constraints, np.zeros((N * n, N * n))]])
        exact = np.linalg.solve(matrix, -np.concatenate([gradient, offsets]))
        ours = np.concatenate([unknowns(step, p), np.ravel(step.multipliers[..., p])])
        np.testing.assert_allclose(ours, exact, rtol=1e-7, atol=1e-9 * np.max(np.abs(exact)))


@pytest.mark.thorough
def test_known_numbers_are_entries_like_others():
    """Structure of a robot: a column of the slopes that is zero, a slope of one, a Hessian with zeros."""
    problem = random_subproblem()
    for array, where, number in (
        (problem.jacobians, (slice(None), slice(None), 0), 0.0),
        (problem.jacobians, (slice(None), 0, 0), 1.0),
        (problem.hessians, (slice(None), 0, slice(1, None)), 0.0),
        (problem.hessians, (slice(None), slice(1, None), 0), 0.0),
        (problem.gradients, (slice(None), 1), 0.0),
    ):
        array[where] = number

    def number(entry):
        return float(entry[0, 0]) if np.all(entry == entry[0, 0]) else jnp.asarray(entry)

    lists = (jax.tree.map(number, entries(a)) for a in (problem.hessians, problem.gradients, problem.jacobians))
    structured = kkt.solve(kkt.Subproblem(*lists, *problem[3:]))
    for ours, theirs in zip(structured, solve(problem), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-10)


def test_both_ends_stay_pinned_exactly():
    step = solve(random_subproblem())
    np.testing.assert_array_equal(step.dxs[0], 0)
    np.testing.assert_array_equal(step.dxs[-1], 0)


@pytest.mark.parametrize("nudge", [-1e-3, 1e-3])
def test_the_flag_says_convex_on_one_side_of_singular_only(nudge):
    """Curvature is taken off dh until the Hessian on the constraints' null space is singular, a little less and more.

    The stages' own Hessians are positive definite, so every other pivot is positive on both sides.
    """
    problem = random_subproblem()
    critical = np.empty(P)
    for p in range(P):
        hessian, _, constraints, _ = dense(problem, p)
        basis = scipy.linalg.null_space(constraints)
        reduced = basis.T @ hessian @ basis
        by_step = basis[(N - 1) * n]
        # The smallest c for which reduced + c v v' is definite is -1 / (v' reduced^-1 v).
        critical[p] = -1 / (by_step @ np.linalg.solve(reduced, by_step))
        smallest = np.linalg.eigvalsh(reduced + (critical[p] + nudge) * np.outer(by_step, by_step))[0]
        assert np.sign(smallest) == np.sign(nudge)
    step = solve(problem._replace(curvature=problem.curvature + critical + nudge))
    np.testing.assert_array_equal(step.convex, nudge > 0)


def indefinite_stages(shift, count=64):
    """Curvature is taken off all stages alike: some of the problems stay convex on the constraints' null space."""
    problem = random_subproblem(P=count)
    return problem._replace(
        hessians=problem.hessians - shift * np.eye(w)[:, :, None],
        jacobians=0.3 * problem.jacobians + np.eye(w)[:n, :, None],
    )


@pytest.mark.thorough
@pytest.mark.parametrize(("shift", "units"), [(0.6, 1.0), (1.0, 1.0), (1.5, 1.0), (1.0, 1e3)])
def test_the_flag_is_that_of_the_pinned_end_where_stages_are_indefinite(shift, units):
    """Also in other units of the first state."""
    problem = indefinite_stages(shift)
    convex = []
    for p in range(64):
        hessian, _, constraints, _ = dense(problem, p)
        basis = scipy.linalg.null_space(constraints)
        convex.append(np.linalg.eigvalsh(basis.T @ hessian @ basis)[0] > 0)
    assert 0 < np.sum(convex) < 64
    here = np.r_[units, np.ones(w - 1)]
    scaled = problem._replace(
        hessians=problem.hessians / here[:, None, None] / here[:, None],
        gradients=problem.gradients / here[:, None],
        jacobians=problem.jacobians * here[:n, None, None] / here[:, None],
        defects=problem.defects * here[:n, None],
        end=problem.end / here[:n, None] ** 2,
    )
    np.testing.assert_array_equal(solve(scaled).convex, convex)


@pytest.mark.parametrize("weight", [0.0, 1.0, 1e6])
def test_the_weights_of_the_pinned_end_change_no_step(weight):
    problem = random_subproblem()
    for ours, theirs in zip(solve(problem._replace(end=np.full((n, P), weight))), solve(problem), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-8)


def test_the_flag_falls_where_one_stage_is_concave_in_its_input():
    problem = random_subproblem()
    hessians = problem.hessians.copy()
    hessians[N - 1, n + 1 :, n + 1 :, 2] -= 1e3 * np.eye(m)
    np.testing.assert_array_equal(solve(problem._replace(hessians=hessians)).convex, np.arange(P) != 2)


def test_the_flag_falls_where_the_end_cannot_be_reached():
    problem = random_subproblem()
    jacobians = problem.jacobians.copy()
    jacobians[:, 0, :, 1] = 0
    np.testing.assert_array_equal(solve(problem._replace(jacobians=jacobians)).convex, np.arange(P) != 1)


def test_a_bad_problem_leaves_the_others_bit_equal():
    problem = random_subproblem()
    gradients, hessians = problem.gradients.copy(), problem.hessians.copy()
    gradients[2, 1, 3] = hessians[2, 1, 1, 3] = np.nan
    clean, beside = solve(problem), solve(problem._replace(gradients=gradients, hessians=hessians))
    for ours, theirs in zip(beside, clean, strict=True):
        np.testing.assert_array_equal(ours[..., :3], theirs[..., :3])
    assert clean.convex[3]
    assert not beside.convex[3]


def test_batch_is_one_by_one():
    problem = random_subproblem()
    together = solve(problem)
    for p in range(P):
        alone = solve(jax.tree.map(lambda leaf, p=p: leaf[..., p : p + 1], problem))
        for ours, theirs in zip(alone, together, strict=True):
            np.testing.assert_allclose(ours[..., 0], theirs[..., p], rtol=1e-9, atol=1e-10)


def test_single_precision_stays_single():
    single = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, jnp.float32), random_subproblem())
    step = jax.eval_shape(solve, single)
    assert [leaf.dtype for leaf in step] == [jnp.float32] * 4 + [jnp.bool]
