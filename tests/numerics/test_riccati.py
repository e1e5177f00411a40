"""The Hamiltonian flow against matrix exponentials, scipy's algebraic Riccati solver and a stiff integrator."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp

from rtcd_jax.numerics import riccati

SIZES = [(2, 1, 1.0), (2, 1, 1e-3), (4, 2, 10.0), (6, 2, 1e-2)]
SYSTEMS = 3

infinite_horizon = jax.jit(riccati.infinite_horizon)
compose = jax.jit(riccati.compose)
propagate = jax.jit(riccati.propagate)


@partial(jax.jit, static_argnums=4)
def constant_interval(a, spread, cost, duration, doublings=8):
    return riccati.constant_interval(a, spread, cost, duration, doublings)


@partial(jax.jit, static_argnums=4)
def enough_doublings(a, spread, cost, duration, most):
    return riccati.enough_doublings(a, spread, cost, duration, most)


def random_systems(n, m, r):
    """A [n n P], B [n m P], G = B B' / r and a diagonal Q."""
    random = np.random.default_rng([n, m])
    a = 3 * random.normal(size=(n, n, SYSTEMS))
    b = 3 * random.normal(size=(n, m, SYSTEMS))
    cost = np.eye(n)[:, :, None] * random.uniform(1, 10, (n, 1, SYSTEMS))
    return a, b, np.einsum("ikp,jkp->ijp", b, b) / r, cost


def exact_interval(a, spread, cost, duration):
    """Transition, spread and cost of an interval, read off the exponential of the Hamiltonian matrix."""
    n = len(a)
    flow = scipy.linalg.expm(duration * np.block([[a, -spread], [-cost, -a.T]]))
    back = np.linalg.inv(flow[n:, n:])
    return flow[:n, :n] - flow[:n, n:] @ back @ flow[n:, :n], -flow[:n, n:] @ back, -back @ flow[n:, :n]


def assert_close_matrices(ours, exact, tolerance):
    assert np.max(np.abs(np.asarray(ours) - exact)) <= tolerance * np.max(np.abs(exact))


def assert_symmetric_positive_definite(values):
    """Of [n n P]; symmetric to the last bit."""
    np.testing.assert_array_equal(values, np.swapaxes(values, 0, 1))
    assert np.all(np.linalg.eigvalsh(np.moveaxis(values, -1, 0)) > 0)


@pytest.mark.thorough
@pytest.mark.parametrize(("n", "m", "r"), SIZES)
def test_infinite_horizon_is_scipys_algebraic_solution(n, m, r):
    a, b, spread, cost = random_systems(n, m, r)
    value, reached = infinite_horizon(a, spread, cost)
    assert np.all(reached)
    assert_symmetric_positive_definite(value)
    for p in range(SYSTEMS):
        exact = scipy.linalg.solve_continuous_are(a[..., p], b[..., p], cost[..., p], r * np.eye(m))
        assert_close_matrices(value[..., p], exact, 1e-8)
        closed_loop = a[..., p] - spread[..., p] @ value[..., p]
        assert np.max(np.linalg.eigvals(closed_loop).real) < 0


def test_infinite_horizon_of_one_state_is_the_quadratics_root():
    """s = (a + sqrt(a^2 + g q)) / g, over eight powers of ten of g."""
    a, g = np.array([-3.0, 0.0, 0.5, 3.0]), np.array([1e-3, 1.0, 1e2, 1e5])
    value, reached = infinite_horizon(*(np.reshape(v, (1, 1, 4)) for v in (a, g, np.full(4, 2.0))))
    assert np.all(reached)
    np.testing.assert_allclose(value[0, 0], (a + np.sqrt(a**2 + 2 * g)) / g, rtol=1e-9)


@pytest.mark.parametrize(("mode", "expected"), [(1.0, False), (-1.0, True)])
def test_infinite_horizon_exists_if_what_the_input_cannot_move_is_stable(mode, expected):
    value, reached = infinite_horizon(np.diag([mode, 2.0]), np.diag([0.0, 1.0]), np.eye(2))
    assert reached == expected
    if expected:
        np.testing.assert_allclose(value, np.diag([0.5, 2 + np.sqrt(5)]), rtol=1e-8)


@pytest.mark.parametrize(("n", "m", "r"), SIZES)
def test_an_interval_is_the_hamiltonians_exponential(n, m, r):
    a, _, spread, cost = random_systems(n, m, r)
    interval = constant_interval(a, spread, cost, 0.02, 10)
    assert np.all(interval.definite)
    for p in range(SYSTEMS):
        exact = exact_interval(a[..., p], spread[..., p], cost[..., p], 0.02)
        for ours, theirs in zip(interval[:3], exact, strict=True):
            assert_close_matrices(ours[..., p], theirs, 2e-7)


@pytest.mark.thorough
@pytest.mark.parametrize(("n", "m", "r"), SIZES)
@pytest.mark.parametrize("duration", [1e-5, 2e-3, 0.02])
def test_enough_doublings_are_as_exact_at_every_duration(n, m, r, duration):
    a, _, spread, cost = random_systems(n, m, r)
    doublings = enough_doublings(a, spread, cost, duration, 20)
    interval = constant_interval(a, spread, cost, duration, int(doublings))
    for p in range(SYSTEMS):
        exact = exact_interval(a[..., p], spread[..., p], cost[..., p], duration)
        for ours, theirs in zip(interval[:3], exact, strict=True):
            assert_close_matrices(ours[..., p], theirs, 2e-5)


def test_doublings_grow_with_the_duration_up_to_the_most():
    a, _, spread, cost = random_systems(4, 2, 1.0)
    counts = [int(enough_doublings(a, spread, cost, duration, 8)) for duration in (1e-9, 1e-3, 2e-3, 1e9, np.nan)]
    assert counts[0] == 0
    assert counts[2] == counts[1] + 1
    assert counts[3:] == [8, 8]


def test_a_short_interval_is_right_to_third_order():
    """Half the duration leaves a sixteenth of the error."""
    a, _, spread, cost = (v[..., 0] for v in random_systems(4, 2, 1.0))
    short = jax.jit(riccati.short_interval)
    errors = []
    for duration in (2e-3, 1e-3):
        exact = exact_interval(a, spread, cost, duration)
        ours = short(a, spread, cost, duration)[:3]
        errors.append([np.max(np.abs(mine - theirs)) for mine, theirs in zip(ours, exact, strict=True)])
    np.testing.assert_allclose(np.log2(np.divide(*errors)), 4, atol=0.25)


@pytest.mark.thorough
def test_neighbouring_intervals_compose_to_the_whole_in_any_grouping():
    a, _, spread, cost = random_systems(4, 2, 1.0)
    first, second, third = (constant_interval(s * a, spread, s * cost, 0.02) for s in (1.0, 0.5, 2.0))
    left = compose(compose(first, second), third)
    right = compose(first, compose(second, third))
    for ours, theirs in zip(left[:3], right[:3], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-11)
    whole = constant_interval(a, spread, cost, 0.04, 9)
    for ours, theirs in zip(compose(first, first)[:3], whole[:3], strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-11)


def test_propagation_through_a_composition_is_propagation_twice():
    a, _, spread, cost = random_systems(4, 2, 1.0)
    early, late = (constant_interval(s * a, spread, s * cost, 0.02) for s in (1.0, 0.5))
    end = 5 * cost
    once, _ = propagate(compose(early, late), end)
    twice, _ = propagate(early, propagate(late, end)[0])
    np.testing.assert_allclose(once, twice, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("r", [1.0, 1e-3])
def test_propagation_solves_the_differential_equation(r):
    """A stiff integrator of -S' = A'S + S A - S G S + Q at 1e-10; for r = 1e-3 its fastest pole is at 2000 a second."""
    a, _, spread, cost = (v[..., 0] for v in random_systems(4, 2, r))
    end = np.diag([1.0, 20.0, 3.0, 5.0])

    def backward(_, flat):
        s = flat.reshape(4, 4)
        return (a.T @ s + s @ a - s @ spread @ s + cost).ravel()

    value, definite = end, True
    for _ in range(5):
        value, good = propagate(constant_interval(a, spread, cost, 0.01), value)
        definite = definite and bool(good)
    exact = solve_ivp(backward, (0, 0.05), end.ravel(), method="Radau", rtol=1e-10, atol=1e-12).y[:, -1]
    assert definite
    assert_symmetric_positive_definite(np.asarray(value)[..., None])
    assert_close_matrices(value, exact.reshape(4, 4), 1e-6)


def test_the_algebraic_solution_stays_where_it_is():
    a, _, spread, cost = random_systems(4, 2, 1.0)
    value, _ = infinite_horizon(a, spread, cost)
    before, definite = propagate(constant_interval(a, spread, cost, 0.02), value)
    assert np.all(definite)
    np.testing.assert_allclose(before, value, rtol=1e-6, atol=1e-6 * np.max(np.abs(value)))


def test_an_indefinite_value_is_told():
    a, _, spread, cost = random_systems(2, 1, 1.0)
    interval = constant_interval(a, spread, cost, 0.02)
    ends = np.stack([np.diag([1.0, 1e-6]), np.diag([1.0, 0.0]), np.diag([1.0, -1e-6])], -1)
    np.testing.assert_array_equal(propagate(interval, ends)[1], [True, False, False])


@pytest.mark.parametrize("f", [infinite_horizon, partial(constant_interval, duration=0.02)])
def test_a_bad_problem_leaves_the_others_bit_equal(f):
    a, _, spread, cost = random_systems(4, 2, 1.0)
    spoilt = a.copy()
    spoilt[2, 1, 1] = np.nan
    clean, beside = f(a, spread, cost), f(spoilt, spread, cost)
    for ours, theirs in zip(jax.tree.leaves(beside), jax.tree.leaves(clean), strict=True):
        np.testing.assert_array_equal(ours[..., [0, 2]], theirs[..., [0, 2]])
    assert clean[-1][1]
    assert not beside[-1][1]


def test_single_precision_stays_single():
    matrix = jax.ShapeDtypeStruct((2, 2, 5), jnp.float32)
    duration = jax.ShapeDtypeStruct((5,), jnp.float32)
    interval = jax.eval_shape(constant_interval, matrix, matrix, matrix, duration)
    value, _ = jax.eval_shape(riccati.propagate, interval, matrix)
    algebraic, _ = jax.eval_shape(riccati.infinite_horizon, matrix, matrix, matrix)
    assert [leaf.dtype for leaf in (*interval[:3], value, algebraic)] == [jnp.float32] * 5
