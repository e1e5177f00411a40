"""Linear algebra of many small matrices with the batch on the last axis.

A batch of 2 x 2 systems is vectorised over the batch, not over the 2: with the batch last, every
line below is one SIMD operation over all problems, and no problem's result depends on its neighbours.
"""

import jax.numpy as jnp


def mm(a, b):
    """A B for [i k P] and [k j P]."""
    return sum(a[:, k, None] * b[None, k] for k in range(a.shape[1]))


def mtm(a, b):
    """A' B for [k i P] and [k j P]."""
    return sum(a[k, :, None] * b[k, None, :] for k in range(a.shape[0]))


def mv(a, v):
    """A v for [i k P] and [k P]."""
    return sum(a[:, k] * v[k] for k in range(a.shape[1]))


def mtv(a, v):
    """A' v for [k i P] and [k P]."""
    return sum(a[k] * v[k] for k in range(a.shape[0]))


def spd_solve(a, b, floor=1e-12):
    """Solve A X = B for symmetric positive definite A [n n P], B [n j P] by Cholesky.

    Returns X [n j P] and a flag [P] that is false where a pivot fell to `floor` or below; X is finite
    but meaningless there.
    """
    n = a.shape[0]
    factor, ok = {}, True
    for j in range(n):
        pivot = a[j, j] - sum(factor[j, k] ** 2 for k in range(j))
        good = pivot > floor
        ok = ok & good
        factor[j, j] = jnp.sqrt(jnp.where(good, pivot, 1.0))
        for i in range(j + 1, n):
            factor[i, j] = (a[i, j] - sum(factor[i, k] * factor[j, k] for k in range(j))) / factor[j, j]
    forward = []
    for i in range(n):
        forward.append((b[i] - sum(factor[i, k] * forward[k] for k in range(i))) / factor[i, i])
    back = [None] * n
    for i in reversed(range(n)):
        back[i] = (forward[i] - sum(factor[k, i] * back[k] for k in range(i + 1, n))) / factor[i, i]
    return jnp.stack(back), ok
