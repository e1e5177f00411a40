"""The nouns. Each contains the one before it.

`*batch` is empty for one candidate; a population is the same pytree with a leading axis P. The tests check every shape
below where an object is made; what `jax.vmap` and `jax.tree.map` put together is not looked at. In `Trajectory`, `us`
stands before `xs` because jaxtyping reads in this order: it can evaluate `intervals+1` once `intervals` is bound.
"""

import enum
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class Status(enum.IntEnum):
    """Why a candidate has no funnel; `OK` if it has one. The first failure along the flow is kept."""

    OK = 0
    TRAJECTORY_NOT_SOLVED = 1
    RICCATI_INDEFINITE = 2
    FUNNEL_EMPTY = 3
    NOT_FINITE = 4
    TOO_STIFF = 5

    @property
    def message(self) -> str:
        return _MESSAGES[self]


_MESSAGES = {
    Status.OK: "has a funnel",
    Status.TRAJECTORY_NOT_SOLVED: "no start of the trajectory optimization reached the tolerances on defects and boxes",
    Status.RICCATI_INDEFINITE: "the Riccati equation has no positive definite solution along the trajectory, or "
    "around a cycle of tasks",
    Status.FUNNEL_EMPTY: "a knot's level fell below the smallest sampled level: some knot has no funnel; or "
    "a reset leads out of the next task's first ellipsoid",
    Status.NOT_FINITE: "a number of the candidate's evaluation is not finite",
    Status.TOO_STIFF: "the closed loop is too fast for the rollouts' steps: raise funnel.steps, lower funnel.goal.step",
}


def first_failure(*statuses: Int[Array, ""]) -> Int[Array, ""]:
    """The first status that is not `OK`, in the order of the flow."""
    first = jnp.asarray(statuses[0], jnp.int32)
    for status in statuses[1:]:
        first = jnp.where(first != Status.OK, first, jnp.asarray(status, jnp.int32))
    return first


class TaskNumbers(eqx.Module):
    """What of a task follows from the design: the motion's ends, state by state, and the robot's constants by name."""

    start: tuple[Float[Array, "*batch"], ...]
    goal: tuple[Float[Array, "*batch"], ...]
    constants: dict[str, Float[Array, "*batch"]]


class Candidate(eqx.Module):
    """What the search chooses: the robot's design, the diagonals of the cost weights Q and R, and what it is asked to
    choose of the policy's options, by name; the others are the configuration's numbers. Of a problem with several tasks
    a candidate is asked for one: `task` is its number. `own` is None where nothing of the task follows from the design.
    """

    design: eqx.Module
    q: Float[Array, "*batch n"]
    r: Float[Array, "*batch m"]
    policy: dict[str, Float[Array, "*batch"]] = eqx.field(default_factory=dict)
    task: Int[Array, "*batch"] | None = None
    own: TaskNumbers | None = None


class Uncertainty(eqx.Module):
    """Half widths of what a funnel must bear: of the robot's numbers and the input limits as shares [-], of a
    disturbance on the motors' axes [input's unit], of the measured state [states' units], the age of the oldest
    measurement that acts [s]; at the goal a motion may stay below the share `residual` of the region. None is no cost.
    `moving`: the parameters are constant in time, and every robot's funnel is about its own motion.
    """

    parameters: dict[str, Float[Array, "*batch"]]
    input_limit: Float[Array, "*batch"]
    input: Float[Array, "*batch"]
    noise: Float[Array, "*batch n"] | None
    age: Float[Array, "*batch"] | None
    residual: Float[Array, "*batch"]
    moving: bool = eqx.field(static=True, default=False)

    def times(self, factor: Float[Array, "*batch"] | float) -> "Uncertainty":
        """The box scaled by a factor; `residual` stays."""
        scaled = jax.tree.map(lambda width: width * factor, self)
        return eqx.tree_at(lambda each: each.residual, scaled, self.residual)


class Trajectory(eqx.Module):
    """A nominal motion on intervals of equal length `dt` [s], the input held inside each interval.

    `cost` is the transcription's objective, `defect` the largest one-interval residual
    |x_{k+1} - Phi(x_k, u_k, dt)|, `iterations` those of the start that was kept.
    """

    us: Float[Array, "*batch intervals m"]
    xs: Float[Array, "*batch intervals+1 n"]
    dt: Float[Array, "*batch"]
    cost: Float[Array, "*batch"]
    defect: Float[Array, "*batch"]
    iterations: Int[Array, "*batch"]
    status: Int[Array, "*batch"]


class Policy(eqx.Module):
    """u = clip(u*(t) - K(t) (x - x*(t))) about a trajectory; the last gain is the goal's own LQR.

    `values` are S(t_k) of the continuous Riccati equation, or of a refinement; V_k(x) = (x - x*_k)' S_k (x - x*_k).
    `value_rates` are S' at both ends of every interval where no Riccati equation says them.
    """

    trajectory: Trajectory
    gains: Float[Array, "*batch knots m n"]
    values: Float[Array, "*batch knots n n"]
    status: Int[Array, "*batch"]
    value_rates: Float[Array, "*batch intervals 2 n n"] | None = None


class Funnel(eqx.Module):
    """B_k = {x : V_k(x) <= levels_k}. `trials` held-out states of B_k were rolled out without a failure.

    `borne`, where something is uncertain: the share of the knots, from the last one backward, that have a level.
    `offsets`, where every robot of the uncertainty has its own center c in the place of x*: the largest sqrt(V_k(c)).
    """

    policy: Policy
    levels: Float[Array, "*batch knots"]
    trials: Int[Array, "*batch knots"]
    status: Int[Array, "*batch"]
    borne: Float[Array, "*batch"] | None = None
    offsets: Float[Array, "*batch knots"] | None = None


@jax.tree_util.register_pytree_with_keys_class
@dataclass(frozen=True)
class Volumes:
    """Exact ellipsoid volumes of a funnel, in the product of the states' units; `volumes["sum"]` and so on are made of
    those of the knots as `VOLUMES` in volume.py says.
    """

    per_knot: Float[Array, "*batch knots"]
    named: dict[str, Float[Array, "*batch"]]

    def __getitem__(self, name: str) -> Any:
        if name not in self.named:
            raise KeyError(f"no volume is called {name!r}; there are {', '.join(self.named)}")
        return self.named[name]

    def tree_flatten_with_keys(self) -> tuple[list, tuple[str, ...]]:
        names = ("per_knot", *(_STORED.get(name, name) for name in self.named))
        leaves = (self.per_knot, *self.named.values())
        return [(jax.tree_util.GetAttrKey(n), leaf) for n, leaf in zip(names, leaves, strict=True)], tuple(self.named)

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], leaves: Iterable) -> "Volumes":
        per_knot, *others = leaves
        volumes = object.__new__(cls)  # unchecked: JAX puts its own objects in the place of arrays
        vars(volumes).update(per_knot=per_knot, named=dict(zip(names, others, strict=True)))
        return volumes


_STORED = {"sum": "total"}
"""What checkpoints call a volume, where that is not its name."""


class Evaluation(eqx.Module):
    """Everything that is known of one genome after one pass along the flow."""

    genome: Float[Array, "*batch d"]
    candidate: Candidate
    funnel: Funnel
    volumes: Volumes
    status: Int[Array, "*batch"]

    @property
    def borne(self) -> Float[Array, "*batch"] | None:
        """The share of knots with a level under the uncertainty; None where nothing is uncertain."""
        return self.funnel.borne

    @property
    def tasks(self) -> None:
        """It is of one task."""
        return None

    def take(self, rows: Int[Array | np.ndarray, " E"]) -> "Evaluation":
        """Of a population's evaluation: the candidates at `rows`."""
        return jax.tree.map(lambda leaf: leaf[rows], self)


class TaskEvaluations(eqx.Module):
    """What is known of one genome on every one of several `tasks`, and what the search makes of it.

    `volumes` are those over the tasks, knot by knot too; `status` is that of the first task that failed. Of a cycle
    `after_reset` is the largest V / rho_0 in the next task's first ellipsoid, at most 1 if it is closed (reset.py);
    where elites are sampled again, `worst_at_resets` are the states before and after the reset that have it.
    """

    genome: Float[Array, "*batch d"]
    tasks: Evaluation
    volumes: Volumes
    status: Int[Array, "*batch"]
    after_reset: Float[Array, "*batch T"] | None = None
    worst_at_resets: Float[Array, "*batch T 2 n"] | None = None

    @property
    def borne(self) -> Float[Array, "*batch"] | None:
        """The mean over the tasks of the share of knots with a level under the uncertainty."""
        return None if self.tasks.borne is None else self.tasks.borne.mean(-1)

    def take(self, rows: Int[Array | np.ndarray, " E"]) -> "TaskEvaluations":
        """Of a population's evaluation: the candidates at `rows`."""
        return jax.tree.map(lambda leaf: leaf[rows], self)
