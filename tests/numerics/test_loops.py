"""What a GPU's loops compute is what a CPU's compute."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.numerics import kkt
from rtcd_jax.numerics.loops import compiled_for, on_gpu, packed_scan, repeat, short_scan
from tests.numerics.test_kkt import entries, random_subproblem


def step(carry, x):
    (matrix, flag, count), (shift, wanted) = carry, x
    matrix = matrix @ matrix / 2 + shift
    return (matrix, flag & wanted, count + 1), {"trace": jnp.trace(matrix), "row": matrix[0], "odd": count % 2 == 1}


INPUTS = np.linspace(-1, 1, 7), np.arange(7) != 4
START = np.array([[0.3, 0.1], [-0.2, 0.5]]), np.array(True), np.array(0)


def run(platform, **options):
    with compiled_for(platform):
        return jax.jit(lambda start, xs: packed_scan(step, start, xs, **options))(START, INPUTS)


@pytest.mark.parametrize("options", [{}, {"reverse": True}, {"carry": False}, {"unroll": 3, "reverse": True}])
def test_a_packed_scan_is_the_scan(options):
    reverse = options.get("reverse", False)
    expected = jax.jit(lambda start, xs: jax.lax.scan(step, start, xs, reverse=reverse))(START, INPUTS)
    found = run("cuda", **options)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=1e-14, atol=0)


def test_a_packed_scan_without_outputs():
    with compiled_for("cuda"):
        total, nothing = packed_scan(lambda carry, x: (carry + x, None), 0.0, jnp.arange(4.0))
    assert (total, nothing) == (6.0, None)


def test_shared_axes_stay_and_numbers_are_broadcast_to_them():
    with compiled_for("cuda"):
        end, ys = packed_scan(
            lambda c, x: ([c[0] + x, 1.0], [c[1], x]), [jnp.zeros(3), 2.0], jnp.ones((4, 3)), shared=1
        )
    np.testing.assert_array_equal(end[0], [4, 4, 4])
    np.testing.assert_array_equal(ys[0], [[2, 2, 2], [1, 1, 1], [1, 1, 1], [1, 1, 1]])


def test_short_loops_are_written_out_on_a_gpu_alone():
    def double(x):
        return repeat(3, lambda y: 2 * y, short_scan(lambda y, _: (2 * y, None), x, length=2)[0])

    for platform, loops in (("cpu", 2), ("cuda", 0)):
        with compiled_for(platform):
            assert on_gpu() == (platform == "cuda")
            program = jax.jit(lambda x: double(x)).trace(1.0).lower().as_text()
            assert program.count("stablehlo.while") == loops
            assert double(1.0) == 32


@pytest.mark.thorough
def test_the_kkt_sweep_of_a_gpu_solves_the_same_system(monkeypatch):
    monkeypatch.setattr(kkt, "UNROLLED_STATES", 1)  # written out it takes a CPU's compiler a minute
    dense = random_subproblem()

    def solve(dense):
        hessian, gradient, jacobian = entries(dense.hessians), entries(dense.gradients), entries(dense.jacobians)
        return kkt.solve(kkt.Subproblem(hessian, gradient, jacobian, *dense[3:]))

    expected = jax.jit(solve)(dense)
    with compiled_for("cuda"):
        found = jax.jit(lambda dense: solve(dense))(dense)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
