"""Funnel -> volumes: exact ellipsoid volumes v_k = pi^(n/2) / Gamma(n/2 + 1) rho_k^(n/2) / sqrt(det S_k).

`VOLUMES` is the one list of what is made of them: a search maximizes any, records, tables and pages show all. The
configuration and the report read it without JAX, which is imported where it is needed.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rtcd_jax.types import Funnel, Volumes


class Volume(NamedTuple):
    """A number of the knots' ellipsoid volumes v [N+1], in the product of the states' units times `seconds` [s].

    `of(v, logs, dt)` is its formula, for arrays of JAX or numpy; `logs` are the logarithms of v.
    """

    meaning: str
    of: Callable[[Any, Any, Any], Any]
    seconds: int = 0


VOLUMES = {
    "sum": Volume("v_0 + … + v_N, the paper's", lambda v, logs, dt: v.sum()),
    "integral": Volume("trapezoid rule over time", lambda v, logs, dt: dt * ((v[1:] + v[:-1]).sum() / 2), seconds=1),
    "inlet": Volume("v_0 of the initial ellipsoid", lambda v, logs, dt: v[0]),
    "geometric_mean": Volume(
        "(v_0 … v_N)^(1 / (N+1)), which an empty knot brings to zero",
        lambda v, logs, dt: logs.__array_namespace__().exp(logs.mean()),
    ),
}


def funnel_volume(funnel: "Funnel") -> "Volumes":
    """All `VOLUMES`, zero for a funnel whose status is not OK."""
    import jax.numpy as jnp

    from rtcd_jax.numerics.batched import cholesky
    from rtcd_jax.numerics.ellipsoid import log_volume
    from rtcd_jax.types import Status, Volumes

    factor, _ = cholesky(jnp.moveaxis(funnel.policy.values, 0, -1))
    logs = jnp.where(funnel.status == Status.OK, log_volume(factor, funnel.levels), -jnp.inf)
    per_knot, dt = jnp.exp(logs), funnel.policy.trajectory.dt
    return Volumes(per_knot, {name: volume.of(per_knot, logs, dt) for name, volume in VOLUMES.items()})
