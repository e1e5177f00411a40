"""The largest value of |f(y)|^2 on the unit sphere |y| = 1, by climbing. Vectors are [n ...], components first."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtcd_jax.numerics.batched import mtm, mtv, mv, spd_solve
from rtcd_jax.numerics.derivatives import value_and_jacobian
from rtcd_jax.numerics.loops import repeat, short_scan

PULLS = np.array([0.01, 0.1, 1.0])
"""How strongly a step is drawn back to where it starts: the better the quadratic model, the weaker the best one."""

BISECTIONS = 14


def climb(f: Callable, y: Float[Array, "n *batch"], steps: int) -> Float[Array, "n *batch"]:
    """Unit vectors from which |f|^2 is at least as large as from `y`, for f elementwise over the trailing axes.

    Each step goes to the maximum of |f(y) + J (z - y)|^2 on the sphere, drawn back to `y` more or less, whichever is
    best: where f saturates, the model's own maximum is often none of f.
    """

    def step(y, _):
        value, j = value_and_jacobian(f, y)
        tried = _largest_nearby(mtm(j, j), mtv(j, value - mv(j, y)), y)
        sizes = jnp.sum(f(tried) ** 2, 0)
        sizes = jnp.where(jnp.isfinite(sizes), sizes, -jnp.inf)
        highest = jnp.argmax(sizes, -1, keepdims=True)
        better = jnp.max(sizes, -1) > jnp.sum(value**2, 0)
        return jnp.where(better, jnp.take_along_axis(tried, highest[None], -1)[..., 0], y), None

    return short_scan(step, y, length=steps)[0]


def _largest_nearby(curvature, slope, y):
    """Unit vectors [n ... T] that nearly maximize z' H z + 2 p' z + 2 c y' z, a trailing axis of pulls c.

    z = (s I - H)^-1 (p + c y) with the multiplier s > lambda_max(H) for which |z| = 1, found by bisection: the
    trust-region problem on its boundary (More and Sorensen, SIAM J. Sci. Stat. Comput. 4, 1983).
    """
    n = y.shape[0]
    size = jnp.sqrt(jnp.sum(curvature**2, (0, 1)))
    pulled = slope[..., None] + size[..., None] * y[..., None] * PULLS.astype(y.dtype)
    eye = jnp.eye(n, dtype=y.dtype).reshape(n, n, *(1,) * y.ndim)

    def solve(s):
        z, positive = spd_solve(s * eye - curvature[..., None], pulled[:, None])
        return z[:, 0], positive

    def halve(bracket):
        low, high = bracket
        middle = 0.5 * (low + high)
        z, positive = solve(middle)
        inside = positive & (jnp.sum(z**2, 0) < 1)
        return jnp.where(inside, low, middle), jnp.where(inside, middle, high)

    high = size[..., None] + jnp.linalg.norm(pulled, axis=0)
    _, s = repeat(BISECTIONS, halve, (jnp.zeros_like(high), high))
    z, _ = solve(s)
    return z / jnp.linalg.norm(z, axis=0)
