"""Funnel -> volumes: exact ellipsoid volumes v_k = pi^(n/2) / Gamma(n/2 + 1) rho_k^(n/2) / sqrt(det S_k), and pushes.

A push is an impulse J on one input [input's unit s], by which the state jumps by b J, b the input's column of B. It
leaves x*(t_k) inside B_k for |J| <= sqrt(rho_k / (b' S_k b)).

`VOLUMES` is the one list of what is made of them: a search maximizes any, records, tables and pages show all. The
configuration and the report read it without JAX, which is imported where it is needed.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from jaxtyping import Array, Float

    from rtcd_jax.types import Funnel, Volumes


class Knots(NamedTuple):
    """What the numbers of a funnel are made of, in arrays of JAX or numpy."""

    v: Any
    """Volumes of the ellipsoids [N+1], in the product of the states' units."""
    logs: Any
    """Their logarithms."""
    pushes: Any
    """Largest impulse on each input [N+1 m], in its unit times seconds."""
    dt: Any
    """Of an interval [s]."""


class Volume(NamedTuple):
    """A number of a funnel's `Knots`, made by `of`.

    Its unit is the product of the states' units times `seconds` [s] or, of a `push`, the input's unit times [s].
    """

    meaning: str
    of: Callable[[Knots], Any]
    seconds: int = 0
    push: bool = False


class Other(NamedTuple):
    """What a search may maximize that is no volume of the funnel; `unit` is its own."""

    meaning: str
    unit: str


GOAL = "goal"
"""Needs no motion: a search for it is about the funnels of robots at rest."""

VOLUMES = {
    "sum": Volume("v_0 + … + v_N, the paper's", lambda at: at.v.sum()),
    "integral": Volume("trapezoid rule over time", lambda at: at.dt * ((at.v[1:] + at.v[:-1]).sum() / 2), seconds=1),
    "inlet": Volume("v_0 of the initial ellipsoid", lambda at: at.v[0]),
    "geometric_mean": Volume(
        "(v_0 … v_N)^(1 / (N+1)), which an empty knot brings to zero",
        lambda at: at.logs.__array_namespace__().exp(at.logs.mean()),
    ),
    "push": Volume(
        "push margin: the largest impulse on any input, at any knot, that leaves x* + B J in the funnel",
        lambda at: at.pushes.min(),
        push=True,
    ),
    GOAL: Volume("v_N of the goal's region", lambda at: at.v[-1]),
}


DIRTREL = "dirtrel"
OTHERS = {DIRTREL: Other("1 / l_w of DIRTREL, for comparison: among candidates with a funnel", "1/cost")}
"""Objectives that only those runs know which search for them."""

OBJECTIVES = (*VOLUMES, *OTHERS)

LATER = ("push", GOAL)
"""Those that older runs lack."""

OVER_TASKS: dict[str, Callable[[Any], Any]] = {
    "geometric_mean": lambda v: v.__array_namespace__().exp(v.__array_namespace__().log(v).mean(-1)),
    "min": lambda v: v.min(-1),
}
"""What a search makes of the volumes [... T] of a candidate's tasks."""


def funnel_volume(funnel: "Funnel", jumps: "Float[Array, 'knots n m']") -> "Volumes":
    """All `VOLUMES`, zero for a funnel whose status is not OK; `jumps` are `policy.input_jumps`."""
    import jax.numpy as jnp

    from rtcd_jax.numerics.batched import cholesky
    from rtcd_jax.numerics.ellipsoid import log_volume
    from rtcd_jax.types import Status, Volumes

    factor, _ = cholesky(jnp.moveaxis(funnel.policy.values, 0, -1))
    whole = funnel.status == Status.OK
    logs = jnp.where(whole, log_volume(factor, funnel.levels), -jnp.inf)
    pushes = jnp.where(whole, largest_pushes(funnel.policy.values, funnel.levels, jumps), 0)
    at = Knots(jnp.exp(logs), logs, pushes, funnel.policy.trajectory.dt)
    return Volumes(at.v, {name: volume.of(at) for name, volume in VOLUMES.items()})


def largest_pushes(values: Any, levels: Any, jumps: Any) -> Any:
    """sqrt(rho_k / (b' S_k b)) [N+1 m] for S [N+1 n n], rho [N+1] and b [N+1 n m], in arrays of JAX or numpy."""
    grown = ((values[:, :, :, None] * jumps[:, None]).sum(2) * jumps).sum(1)
    return (levels[:, None] / grown) ** 0.5
