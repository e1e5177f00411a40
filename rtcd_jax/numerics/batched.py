"""Linear algebra of many small matrices with the batch on the last axis.

A batch of 2 x 2 systems is vectorized over the batch, not over the 2: with the batch last, every
line below is one SIMD operation over all problems, and no problem's result depends on its neighbors.
"""

from collections.abc import Iterable
from typing import cast

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rtcd_jax.numerics.loops import repeat


def mm(a: Float[Array, "i k *#P"], b: Float[Array, "k j *#P"]) -> Float[Array, "i j *#P"]:
    """A B."""
    return _sum(a[:, k, None] * b[None, k] for k in range(a.shape[1]))


def mtm(a: Float[Array, "k i *#P"], b: Float[Array, "k j *#P"]) -> Float[Array, "i j *#P"]:
    """A' B."""
    return _sum(a[k, :, None] * b[k, None, :] for k in range(a.shape[0]))


def mv(a: Float[Array, "i k *#P"], v: Float[Array, "k *#P"]) -> Float[Array, "i *#P"]:
    """A v."""
    return _sum(a[:, k] * v[k] for k in range(a.shape[1]))


def mtv(a: Float[Array, "k i *#P"], v: Float[Array, "k *#P"]) -> Float[Array, "i *#P"]:
    """A' v."""
    return _sum(a[k] * v[k] for k in range(a.shape[0]))


def transpose(a: Float[Array, "i k *P"]) -> Float[Array, "k i *P"]:
    """A'."""
    return jnp.swapaxes(a, 0, 1)


def cholesky(a: Float[Array, "n n *P"], floor: float = 0.0) -> tuple[Float[Array, "n n *P"], Bool[Array, "*P"]]:
    """Lower factor L with A = L L', and a flag that is false where a pivot fell to `floor` or below.

    L is finite but meaningless there.
    """
    n = a.shape[0]
    factor = [[jnp.zeros_like(a[0, 0])] * n for _ in range(n)]
    positive = jnp.ones(a.shape[2:], bool)
    for j in range(n):
        pivot = a[j, j] - sum(factor[j][k] ** 2 for k in range(j))
        good = pivot > floor
        positive = positive & good
        factor[j][j] = jnp.sqrt(jnp.where(good, pivot, 1.0))
        for i in range(j + 1, n):
            factor[i][j] = (a[i, j] - sum(factor[i][k] * factor[j][k] for k in range(j))) / factor[j][j]
    return jnp.stack([jnp.stack(row) for row in factor]), positive


def solve_lower(factor: Float[Array, "n n *#P"], b: Float[Array, "n j *#P"]) -> Float[Array, "n j *#P"]:
    """L^-1 B for lower L."""
    rows = []
    for i in range(factor.shape[0]):
        rows.append((b[i] - sum(factor[i, k] * rows[k] for k in range(i))) / factor[i, i])
    return jnp.stack(rows)


def solve_lower_transposed(factor: Float[Array, "n n *#P"], b: Float[Array, "n j *#P"]) -> Float[Array, "n j *#P"]:
    """L'^-1 B for lower L."""
    n = factor.shape[0]
    rows: list = [None] * n
    for i in reversed(range(n)):
        rows[i] = (b[i] - sum(factor[k, i] * rows[k] for k in range(i + 1, n))) / factor[i, i]
    return jnp.stack(rows)


def spd_solve(
    a: Float[Array, "n n *#P"], b: Float[Array, "n j *#P"], floor: float = 1e-12
) -> tuple[Float[Array, "n j *#P"], Bool[Array, "*#P"]]:
    """A^-1 B for symmetric positive definite A; the flag is that of `cholesky`."""
    factor, positive = cholesky(a, floor)
    return solve_lower_transposed(factor, solve_lower(factor, b)), positive


def spectral_radius(a: Float[Array, "n n *P"], squarings: int = 10) -> Float[Array, "*P"]:
    """A bound of the largest |eigenvalue| from above, |A^k|^(1/k) with k = 2^squarings.

    Gelfand's formula: it exceeds the eigenvalue at most by the k-th root of n times their basis' condition number.
    """

    def square(carry):
        a, logarithm, share = carry
        size = jnp.sqrt(jnp.sum(a**2, (0, 1)))
        a = a / jnp.where(size > 0, size, 1)
        return mm(a, a), logarithm + share * jnp.log(size), share / 2

    start = a, jnp.zeros(a.shape[2:], a.dtype), jnp.ones((), a.dtype)
    last, logarithm, share = repeat(squarings, square, start)
    return jnp.exp(logarithm + share / 2 * jnp.log(jnp.sum(last**2, (0, 1))))


def _sum(terms: Iterable[Array]) -> Array:
    """The sum of one or more terms."""
    return cast(Array, sum(terms))
