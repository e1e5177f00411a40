"""Funnel -> volumes: exact ellipsoid volumes v_k = pi^(n/2) / Gamma(n/2 + 1) rho_k^(n/2) / sqrt(det S_k)."""

import jax.numpy as jnp

from rtcd_jax.numerics.batched import cholesky
from rtcd_jax.numerics.ellipsoid import log_volume
from rtcd_jax.types import Funnel, Status, Volumes


def funnel_volume(funnel: Funnel) -> Volumes:
    """The four volumes, all zero for a funnel whose status is not OK."""
    factor, _ = cholesky(jnp.moveaxis(funnel.policy.values, 0, -1))
    logs = jnp.where(funnel.status == Status.OK, log_volume(factor, funnel.levels), -jnp.inf)
    per_knot = jnp.exp(logs)
    trapezoid = jnp.sum(per_knot[1:] + per_knot[:-1]) / 2
    return Volumes(
        per_knot=per_knot,
        total=jnp.sum(per_knot),
        integral=funnel.policy.trajectory.dt * trapezoid,
        inlet=per_knot[0],
        geometric_mean=jnp.exp(jnp.mean(logs)),
    )
