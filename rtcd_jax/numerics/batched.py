"""Linear algebra of many small matrices with the batch on the last axis.

A batch of 2 x 2 systems is vectorized over the batch, not over the 2: with the batch last, every
line below is one SIMD operation over all problems, and no problem's result depends on its neighbors.
"""

from collections.abc import Iterable
from typing import cast

import jax
import jax.numpy as jnp


def _total(terms: Iterable[jax.Array]) -> jax.Array:
    """The sum of one term or more."""
    return cast(jax.Array, sum(terms))


def mm(a, b) -> jax.Array:
    """A B for [i k P] and [k j P]."""
    return _total(a[:, k, None] * b[None, k] for k in range(a.shape[1]))


def mtm(a, b) -> jax.Array:
    """A' B for [k i P] and [k j P]."""
    return _total(a[k, :, None] * b[k, None, :] for k in range(a.shape[0]))


def mv(a, v) -> jax.Array:
    """A v for [i k P] and [k P]."""
    return _total(a[:, k] * v[k] for k in range(a.shape[1]))


def mtv(a, v) -> jax.Array:
    """A' v for [k i P] and [k P]."""
    return _total(a[k] * v[k] for k in range(a.shape[0]))


def transpose(a):
    """A' for [i k ...]."""
    return jnp.swapaxes(a, 0, 1)


def cholesky(a, floor=0.0):
    """Lower factor L [n n P] with A = L L', and a flag [P] that is false where a pivot fell to `floor` or below.

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


def solve_lower(factor, b):
    """L^-1 B for lower L [n n P], B [n j P]."""
    rows = []
    for i in range(factor.shape[0]):
        rows.append((b[i] - sum(factor[i, k] * rows[k] for k in range(i))) / factor[i, i])
    return jnp.stack(rows)


def solve_lower_transposed(factor, b):
    """L'^-1 B for lower L [n n P], B [n j P]."""
    n = factor.shape[0]
    rows = [None] * n
    for i in reversed(range(n)):
        rows[i] = (b[i] - sum(factor[k, i] * rows[k] for k in range(i + 1, n))) / factor[i, i]
    return jnp.stack(rows)


def spd_solve(a, b, floor=1e-12):
    """A^-1 B for symmetric positive definite A [n n P], B [n j P]; the flag is that of `cholesky`."""
    factor, positive = cholesky(a, floor)
    return solve_lower_transposed(factor, solve_lower(factor, b)), positive
