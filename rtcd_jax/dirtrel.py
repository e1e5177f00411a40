"""DIRTREL's measure of robustness, for comparison (Manchester and Kuindersma, RSS 2017; Autonomous Robots 43, 2019).

    l_w = sum_k tr((Q + K_k' R K_k) E_k),   E_0 = 0,   E_k+1 = A_k E_k A_k' + G_k D G_k'

A_k and G_k are the linearized closed loop's over an interval, for its state and a disturbance on the motors' axes that
is held there, D the square of its half width. DIRTREL also keeps u* away from the limits by what the feedback asks for
on the ellipsoids E_k: |u*| + sqrt((K E K')_ii) <= u_max, its robust input constraint.
"""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import expm
from jaxtyping import Array, Float

from rtcd_jax.numerics.batched import mm, transpose
from rtcd_jax.numerics.loops import packed_scan
from rtcd_jax.policy import linearize
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Policy


def dirtrel(problem: Problem, candidate: Candidate, policy: Policy) -> Float[Array, ""]:
    """1 / l_w, times the share min(1, (u_max - |u*|) / sqrt((K E K')_ii)) at the knot where that is least.

    The disturbance is that of the problem's uncertainty; without one it is 1 in the inputs' units, and the share is 1.
    """
    motion, uncertainty = policy.trajectory, problem.uncertainty
    us, gains = motion.us.T, jnp.moveaxis(policy.gains, 0, -1)[..., :-1]
    a, b = linearize(problem, candidate, motion.xs[:-1].T, us)
    m = b.shape[1]
    width = jnp.ones(()) if uncertainty is None else jnp.where(uncertainty.input > 0, uncertainty.input, 1.0)
    above = jnp.concatenate([a - mm(b, gains), b], 1)
    generators = jnp.concatenate([above, jnp.zeros_like(above[:m])])
    flow = jax.vmap(expm, in_axes=-1, out_axes=-1)(motion.dt * generators)
    n = a.shape[0]
    weight = jnp.diag(candidate.q)[..., None] + mm(transpose(gains), candidate.r[:, None, None] * gains)

    def onward(spread, interval):
        a, g, weight, gain = interval
        asked = jnp.diagonal(gain @ spread @ gain.T)
        return a @ spread @ a.T + g @ g.T * width**2, (jnp.sum(weight * spread), asked)

    stages = [jnp.moveaxis(each, -1, 0) for each in (flow[:n, :n], flow[:n, n:], weight, gains)]
    _, (costs, asked) = packed_scan(onward, jnp.zeros((n, n), a.dtype), tuple(stages))
    if uncertainty is None:
        return 1 / costs.sum()
    room = jnp.asarray(problem.input_limits(candidate.design)) - jnp.abs(motion.us)
    share = jnp.min(jnp.where(asked > 0, room / jnp.sqrt(jnp.where(asked > 0, asked, 1)), jnp.inf))
    share = jnp.where(uncertainty.input > 0, jnp.clip(share, 0, 1), 1.0)
    return share / costs.sum()
