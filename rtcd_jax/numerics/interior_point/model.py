"""The problem's functions, derivatives and boxes on arrays of all knots."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, PyTree

from rtcd_jax.numerics.entries import Row
from rtcd_jax.numerics.expansion import Expansion, expander
from rtcd_jax.numerics.interior_point.iterate import Boxed
from rtcd_jax.numerics.interior_point.problem import ControlProblem
from rtcd_jax.numerics.loops import on_gpu


class Model:
    """The problem with its constants at hand; all methods are pure."""

    def __init__(self, problem: ControlProblem, dtype: DTypeLike):
        self.problem, self.dtype = problem, dtype
        self.n, self.m = len(problem.state_limits), len(problem.input_limits)
        self.boxed = np.flatnonzero(np.isfinite(problem.state_limits))
        x_limit = problem.state_limits[self.boxed]
        low, high = problem.step_limits
        self.free_step = low < high  # else h is a number, no variable: no slack, no dual, no step
        as_column = lambda a: jnp.asarray(np.asarray(a, float), dtype)[:, None]  # noqa: E731
        self.lower = Boxed(as_column(-x_limit), as_column(-problem.input_limits), as_column([low] * self.free_step))
        self.upper = Boxed(as_column(x_limit), as_column(problem.input_limits), as_column([high] * self.free_step))
        travel = np.maximum(1.0, problem.travel)
        scale_x = np.where(np.isfinite(problem.state_limits), problem.state_limits, travel)
        self.scaling = [float(s) for s in (*1 / scale_x**2, 0.0, *1 / problem.input_limits**2)]
        self.step_scaling = 4 / (high - low) ** 2 if self.free_step else 0.0

    def simulate(
        self,
        xs: Float[Array, "knots n P"],
        us: Float[Array, "intervals m P"],
        h: Float[Array, " P"],
        parameters: PyTree,
    ) -> tuple[Float[Array, "intervals n P"], Float[Array, " P"]]:
        """Defects and the objective."""
        x, u = jnp.moveaxis(xs[:-1], 0, 1), jnp.moveaxis(us, 0, 1)
        nexts = self.problem.interval(x, u, h, parameters)
        return jnp.moveaxis(nexts, 1, 0) - xs[1:], h * jnp.sum(self.problem.running(tuple(x), tuple(u), parameters), 0)

    def expand(
        self,
        xs: Float[Array, "knots n P"],
        us: Float[Array, "intervals m P"],
        h: Float[Array, " P"],
        multipliers: Float[Array, "intervals n P"],
        parameters: PyTree,
    ) -> Expansion:
        """The model's slopes and curvature; entries [N P] or numbers."""
        expand = expander(self.problem.rate, self.problem.running, self.n, self.m, parameters)
        stages = (xs[:-1], us, multipliers)

        def one(stage):
            return expand(*(tuple(part) for part in stage[:2]), h, tuple(stage[2]), parameters)

        def packed(stage):
            return jnp.stack(jax.tree.leaves(eqx.filter(one(stage), eqx.is_array)))

        layout = eqx.filter_eval_shape(one, jax.tree.map(lambda leaf: leaf[0], stages))
        numbers = jax.tree.map(lambda leaf: leaf if isinstance(leaf, float) else None, layout)
        # One knot after another stays in a core's cache; a GPU wants all knots at once.
        if on_gpu():
            arrays = iter(packed(jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), stages)))
        else:
            arrays = iter(jnp.moveaxis(jax.lax.map(packed, stages), 1, 0))
        fill = lambda number: next(arrays) if number is None else number  # noqa: E731
        return jax.tree.map(fill, numbers, is_leaf=lambda leaf: leaf is None)

    def values(self, xs: Float[Array, "knots n P"], us: Float[Array, "intervals m P"], h: Float[Array, " P"]) -> Boxed:
        """The bounded variables of a point."""
        return Boxed(xs[1:-1, self.boxed], us, h[None] if self.free_step else h[None][:0])

    def slacks(self, values: Boxed) -> Boxed:
        """Their distances from the lower and the upper bounds, on a leading axis."""
        return jax.tree.map(lambda v, lo, hi: jnp.stack([v - lo, hi - v]), values, self.lower, self.upper)

    def stacked(
        self, row: Row, us: Float[Array, "intervals m P"], h: Float[Array, " P"]
    ) -> Float[Array, "intervals w P"]:
        """A row of entries [intervals P], or numbers, as an array."""
        return jnp.stack([jnp.broadcast_to(entry, (us.shape[0], h.shape[-1])) for entry in row], 1)
