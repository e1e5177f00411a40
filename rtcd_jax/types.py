"""The nouns. Each contains the one before it; shapes are those of one candidate.

A population is the same pytree with a leading axis P. `us` stands before `xs` because jaxtyping
binds `N` at the first annotation and can evaluate `N+1` only afterwards.
"""

import enum
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Status(enum.IntEnum):
    """Why a candidate has no funnel; `OK` if it has one. The first failure along the flow is kept."""

    OK = 0
    TRAJECTORY_NOT_SOLVED = 1
    RICCATI_INDEFINITE = 2
    FUNNEL_EMPTY = 3
    NOT_FINITE = 4

    @property
    def message(self) -> str:
        return _MESSAGES[self]


_MESSAGES = {
    Status.OK: "has a funnel",
    Status.TRAJECTORY_NOT_SOLVED: "no start of the trajectory optimization reached the tolerances on defects and boxes",
    Status.RICCATI_INDEFINITE: "the Riccati equation has no positive definite solution along the trajectory",
    Status.FUNNEL_EMPTY: "a knot's level fell below the smallest sampled level: some knot has no funnel",
    Status.NOT_FINITE: "a number of the candidate's evaluation is not finite",
}


def first_failure(*statuses: Int[Array, ""]) -> Int[Array, ""]:
    """The first status that is not `OK`, in the order of the flow."""
    kept = jnp.asarray(statuses[0], jnp.int32)
    for status in statuses[1:]:
        kept = jnp.where(kept != Status.OK, kept, jnp.asarray(status, jnp.int32))
    return kept


class Candidate(eqx.Module):
    """What the search chooses: the robot's design, the diagonals of the cost weights Q and R, and what it is asked to
    choose of the policy's options, by name; the others are the configuration's numbers.
    """

    design: eqx.Module
    q: Float[Array, " n"]
    r: Float[Array, " m"]
    policy: dict[str, Float[Array, ""]] = eqx.field(default_factory=dict)


class Trajectory(eqx.Module):
    """A nominal motion on N intervals of equal length `dt` [s], the input held inside each interval.

    `cost` is the transcription's objective, `defect` the largest one-interval residual
    |x_{k+1} - Phi(x_k, u_k, dt)|, `iterations` those of the start that was kept.
    """

    us: Float[Array, "N m"]
    xs: Float[Array, "N+1 n"]
    dt: Float[Array, ""]
    cost: Float[Array, ""]
    defect: Float[Array, ""]
    iterations: Int[Array, ""]
    status: Int[Array, ""]


class Policy(eqx.Module):
    """u = clip(u*(t) - K(t) (x - x*(t))) about a trajectory; the last gain is the goal's own LQR.

    `values` are S(t_k) of the continuous Riccati equation; V_k(x) = (x - x*_k)' S_k (x - x*_k).
    """

    trajectory: Trajectory
    gains: Float[Array, "N+1 m n"]
    values: Float[Array, "N+1 n n"]
    status: Int[Array, ""]


class Funnel(eqx.Module):
    """B_k = {x : V_k(x) <= levels_k}. `trials` fresh states of B_k were rolled out without a failure."""

    policy: Policy
    levels: Float[Array, " N+1"]
    trials: Int[Array, " N+1"]
    status: Int[Array, ""]


@jax.tree_util.register_pytree_with_keys_class
@dataclass(frozen=True)
class Volumes:
    """Exact ellipsoid volumes of a funnel, in the product of the states' units; `volumes["sum"]` and so on are made of
    those of the knots as `VOLUMES` in volume.py says.
    """

    per_knot: Float[Array, " N+1"]
    named: dict[str, Float[Array, ""]]

    def __getitem__(self, name: str) -> Float[Array, ""]:
        if name not in self.named:
            raise KeyError(f"no volume is called {name!r}; there are {', '.join(self.named)}")
        return self.named[name]

    def tree_flatten_with_keys(self):
        names = ("per_knot", *(_STORED.get(name, name) for name in self.named))
        leaves = (self.per_knot, *self.named.values())
        return [(jax.tree_util.GetAttrKey(n), leaf) for n, leaf in zip(names, leaves, strict=True)], tuple(self.named)

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], leaves) -> "Volumes":
        per_knot, *others = leaves
        return cls(per_knot, dict(zip(names, others, strict=True)))


_STORED = {"sum": "total"}
"""What checkpoints call a volume, where that is not its name."""


class Evaluation(eqx.Module):
    """Everything that is known of one genome after one pass along the flow."""

    genome: Float[Array, " d"]
    candidate: Candidate
    funnel: Funnel
    volumes: Volumes
    status: Int[Array, ""]

    def take(self, rows) -> "Evaluation":
        """Of a population's evaluation: the candidates at `rows` [E]."""
        return jax.tree.map(lambda leaf: leaf[rows], self)
