"""Genomes and candidates: the box's corners, its scales, and the way back."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.config.load import EXAMPLE, parse_yaml
from rtcd_jax.genome import decode, initial_genome
from rtcd_jax.problem import make_problem


def values(candidate):
    """A candidate's numbers in the order of the problem's variables."""
    return np.concatenate([jnp.stack(jax.tree.leaves(candidate.design)), candidate.q, candidate.r])


@pytest.fixture(scope="module")
def problem():
    return make_problem(parse_yaml(EXAMPLE))


@pytest.fixture(scope="module")
def pinned():
    """Length pinned by the word, the first weight by its box."""
    text = EXAMPLE.replace("max: 0.6}}", "max: 0.6, pinned: true}}").replace(
        "10, min: 1, max: 10}, ", "3, min: 3, max: 3}, "
    )
    return make_problem(parse_yaml(text))


def test_corners_of_the_unit_box_are_corners_of_the_box(problem):
    dimensions = len(problem.free)
    low, high = (values(decode(problem, corner * jnp.ones(dimensions))) for corner in (0, 1))
    np.testing.assert_allclose(low, [v.low for v in problem.variables], rtol=1e-14)
    np.testing.assert_allclose(high, [v.high for v in problem.variables], rtol=1e-14)


def test_the_middle_is_the_mean_of_a_design_and_the_geometric_mean_of_a_weight(problem):
    middle = values(decode(problem, jnp.full(len(problem.free), 0.5)))
    expected = [
        np.sqrt(v.low * v.high) if v.name.startswith("weights.") else (v.low + v.high) / 2 for v in problem.variables
    ]
    np.testing.assert_allclose(middle, expected, rtol=1e-14)


def test_the_initial_genome_is_the_initial_candidate(problem, pinned):
    for case in (problem, pinned):
        candidate = decode(case, jnp.asarray(initial_genome(case)))
        np.testing.assert_allclose(values(candidate), [v.initial for v in case.variables], rtol=1e-14)


def test_every_dimension_moves_its_own_variable_alone(problem):
    genome = np.full(len(problem.free), 0.3)
    middle = values(decode(problem, jnp.asarray(genome)))
    moved = np.stack([values(decode(problem, jnp.asarray(genome + step))) for step in 0.1 * np.eye(len(genome))])
    np.testing.assert_array_equal(moved > middle, np.eye(len(genome), dtype=bool))
    np.testing.assert_array_equal(moved < middle, False)


def test_pinned_variables_have_no_dimension_and_keep_their_value(pinned):
    names = [v.name for v in pinned.free]
    assert names == ["design.mass", "weights.q.1", "weights.r.0"]
    assert pinned.design_dims == (True, False, False)
    for corner in (0.0, 1.0):
        candidate = decode(pinned, jnp.full(3, corner))
        assert float(candidate.design.length) == 0.4
        assert float(candidate.q[0]) == 3
    assert initial_genome(pinned).shape == (3,)


@pytest.fixture(scope="module")
def optional():
    """The policy's options searched, the rest pinned."""
    searched = """
policy: {authority: {initial: 0.1, min: 0.04, max: 1}, discount: {initial: 0.5, min: 0, max: 2}}
search: {mode: nested, population: 32}
"""
    return make_problem(parse_yaml(EXAMPLE + searched))


def test_options_of_the_policy_are_dimensions_behind_the_weights(optional):
    """Authority on a log scale, the discount from zero on; both belong to the controller, not to the robot."""
    names = [v.name for v in optional.free]
    assert names[-2:] == ["policy.authority", "policy.discount"]
    assert optional.design_dims == (True, True, *[False] * 5)
    middle = decode(optional, jnp.full(7, 0.5))
    assert float(middle.policy["authority"]) == pytest.approx(0.2)
    assert float(middle.policy["discount"]) == pytest.approx(1)
    initial = decode(optional, jnp.asarray(initial_genome(optional)))
    assert (float(initial.policy["authority"]), float(initial.policy["discount"])) == pytest.approx((0.1, 0.5))


def test_fixed_options_are_the_configuration_s(problem):
    assert decode(problem, jnp.zeros(5)).policy == {}


def test_outside_the_unit_box_is_outside_the_box(problem):
    beyond = values(decode(problem, jnp.full(len(problem.free), 1.1)))
    assert np.all(beyond > [v.high for v in problem.variables])


def test_vmapped_is_one_by_one(problem):
    genomes = jnp.asarray(np.random.default_rng(0).random((4, len(problem.free))))
    together = jax.jit(jax.vmap(partial(decode, problem)))(genomes)
    for p, genome in enumerate(genomes):
        alone = decode(problem, genome)
        np.testing.assert_allclose(values(jax.tree.map(lambda leaf, p=p: leaf[p], together)), values(alone), rtol=1e-15)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_is_kept(problem, pinned, dtype):
    for case in (problem, pinned):
        candidate = decode(case, jnp.zeros(len(case.free), dtype))
        assert {leaf.dtype for leaf in jax.tree.leaves(candidate)} == {jnp.dtype(dtype)}
