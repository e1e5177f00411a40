"""Lanes on a problem whose answer is known: the number of halvings that bring x below 1."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics.lanes import solve_in_lanes


class State(NamedTuple):
    x: jax.Array
    halvings: jax.Array
    scaled: jax.Array


def halve(starts, width, wanted=None):
    """Number of halvings [P] of every start, and [2 P] the last values, once and tripled."""
    starts = jnp.asarray(starts)

    def load(indices):
        x = starts[indices]
        return State(x, jnp.zeros_like(indices), jnp.stack([x, 3 * x]))

    def finished(state):
        return state.x < 1

    def advance(state):
        done = finished(state)
        return State(
            jnp.where(done, state.x, state.x / 2),
            state.halvings + ~done,
            jnp.where(done, state.scaled, state.scaled / 2),
        )

    def extract(state):
        return state.halvings, state.scaled

    return solve_in_lanes(load, advance, finished, extract, len(starts), width, wanted)


def halvings(starts):
    """x / 2^k < 1 first holds for the k of x = f 2^k with 1/2 <= f < 1."""
    return np.maximum(0, np.frexp(starts)[1])


@pytest.mark.parametrize(("count", "width"), [(1, 1), (1, 64), (7, 1), (7, 3), (8, 8), (9, 8), (50, 4), (50, 64)])
def test_every_problem_gets_its_own_answer_at_its_own_place(count, width):
    starts = 2.0 ** np.random.default_rng(count).uniform(-1, 30, count)
    counted, scaled = jax.jit(halve, static_argnums=1)(starts, width)
    np.testing.assert_array_equal(counted, halvings(starts))
    np.testing.assert_array_equal(scaled, np.array([[1.0], [3.0]]) * starts / 2.0 ** halvings(starts))


@pytest.mark.parametrize("wanted", [0, 1, 5, 12, 19, 20])
def test_only_those_wanted_are_solved(wanted):
    """One program for all: the number is data. Unwanted problems would never finish."""
    starts = np.where(np.arange(20) < wanted, 2.0 ** np.random.default_rng(0).uniform(-1, 30, 20), np.inf)
    counted, _ = jax.jit(halve, static_argnums=1)(starts, 4, wanted)
    np.testing.assert_array_equal(counted[:wanted], halvings(starts[:wanted]))
    np.testing.assert_array_equal(counted[wanted:], 0)


def test_stragglers_cost_only_themselves():
    """One problem takes 1000 advances and 60 take 20 each: the 60 share the other three lanes meanwhile."""
    advances = []

    def count(starts, width):
        def load(indices):
            return starts[indices], jnp.zeros(indices.shape, int)

        def advance(state):
            jax.debug.callback(lambda: advances.append(1))
            left, done = state
            return jnp.maximum(left - 1, 0), done + (left > 0)

        return solve_in_lanes(load, advance, lambda s: s[0] == 0, lambda s: s[1], len(starts), width)

    starts = jnp.array([*[20] * 30, 1000, *[20] * 30])
    work = np.asarray(jax.jit(count, static_argnums=1)(starts, 4))
    jax.effects_barrier()
    np.testing.assert_array_equal(work, starts)
    assert len(advances) <= 1000 + 30 // 3 * 20


def test_problems_that_are_finished_when_loaded():
    counted, _ = jax.jit(halve, static_argnums=1)(np.array([0.5, 8.0, 0.1, 0.2, 0.3, 2.0]), 2)
    np.testing.assert_array_equal(counted, [0, 4, 0, 0, 0, 2])


def test_types_are_kept():
    counted, scaled = jax.eval_shape(lambda starts: halve(starts, 4), jax.ShapeDtypeStruct((9,), jnp.float32))
    assert scaled == jax.ShapeDtypeStruct((2, 9), jnp.float32)
    assert jnp.issubdtype(counted.dtype, jnp.integer)
