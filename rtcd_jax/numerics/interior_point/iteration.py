"""One interior-point iteration: Newton step on the barrier problem, then the filter's choice of its length."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from rtcd_jax.numerics import kkt
from rtcd_jax.numerics.entries import dot, plus
from rtcd_jax.numerics.expansion import Expansion
from rtcd_jax.numerics.interior_point.boxes import (
    Boxed,
    boundary_step,
    complementarity,
    largest,
    push_inside,
    room,
    sum_over,
    total,
)
from rtcd_jax.numerics.interior_point.inequalities import Linearized, kept, misfits, started
from rtcd_jax.numerics.interior_point.iterate import Iterate, where
from rtcd_jax.numerics.interior_point.line_search import Direction, Search, line_search
from rtcd_jax.numerics.interior_point.model import Model
from rtcd_jax.numerics.interior_point.problem import Guess, Settings


class Iteration:
    """The method on a model; all methods are pure."""

    def __init__(self, model: Model, settings: Settings):
        self.model, self.settings, self.sets = model, settings, model.problem.keep_out

    def initial(self, guess: Guess, parameters: PyTree) -> Iterate:
        batch = guess.h.shape[-1]
        inside = jax.tree.map(push_inside, self.model.values(*guess), self.model.lower, self.model.upper)
        ends = (jnp.asarray(end, self.model.dtype) for end in self.model.problem.ends(parameters))
        start, goal = (jnp.broadcast_to(end.reshape(self.model.n, -1), (self.model.n, batch)) for end in ends)
        xs = guess.xs.at[1:-1, self.model.boxed].set(inside.xs)
        xs = xs.at[0].set(start).at[-1].set(goal)
        full = lambda value: jnp.full((batch,), value, self.model.dtype)  # noqa: E731
        barrier = full(self.settings.barrier_start)
        zero = jnp.zeros((batch,), jnp.int32)
        h = inside.h[0] if self.model.free_step else guess.h
        defects, cost = self.model.simulate(xs, inside.us, h, parameters)
        it = Iterate(
            xs=xs,
            us=inside.us,
            h=h,
            multipliers=jnp.zeros_like(defects),
            duals=jax.tree.map(lambda slack: barrier / slack, self.model.slacks(inside)),
            barrier=barrier,
            regularization=full(self.settings.regularization_start),
            last_regularization=full(0.0),
            filter=jnp.full((self.settings.filter_size, 2, batch), jnp.inf, self.model.dtype),
            filtered=zero,
            violation_start=total(jnp.abs(defects)),
            rejections=zero,
            iterations=zero,
            cost=cost,
            defects=defects,
            solved=jnp.zeros((batch,), bool),
        )
        if not self.sets:
            return it
        inequalities = started(self.sets, xs, barrier)
        missed = total(jnp.abs(misfits(self.sets, inequalities.slacks, xs)))
        return it._replace(violation_start=it.violation_start + missed, inequalities=inequalities)

    def finished(self, it: Iterate, allowance: Int[Array, " P"]) -> Bool[Array, " P"]:
        return it.solved | (it.iterations >= allowance)

    def advance(self, it: Iterate, parameters: PyTree, allowance: Int[Array, " P"]) -> Iterate:
        """One interior-point iteration; lanes that are finished come back unchanged."""
        s = self.settings
        expansion = self.model.expand(it.xs, it.us, it.h, it.multipliers, parameters)
        slacks = self.model.slacks(self.model.values(it.xs, it.us, it.h))
        kept_out = self.linearized(it)
        dual_error = self.stationarity(it, expansion, kept_out)
        defect = largest(it.defects)
        size = 1 + largest(it.multipliers)
        gap = self.gap(it, slacks, 0.0)
        solved = (defect <= s.defect_tolerance) & (dual_error <= s.dual_tolerance * size)
        solved = solved & (gap <= s.complementarity_tolerance * size)
        if kept_out is not None:
            solved = solved & kept(kept_out, s.defect_tolerance)
            defect = jnp.maximum(defect, largest(kept_out.misfits))
        barrier = self.update_barrier(it, slacks, jnp.maximum(dual_error, defect))
        reduced = barrier < it.barrier
        state = it._replace(
            barrier=barrier,
            filter=jnp.where(reduced, jnp.inf, it.filter),
            filtered=jnp.where(reduced, 0, it.filtered),
            iterations=it.iterations + 1,
            solved=solved,
        )
        kept_out = kept_out and kept_out._replace(barrier=barrier)
        subproblem = self.subproblem(state, slacks, expansion, kept_out)
        moved = self.move(state, slacks, subproblem, kept_out, parameters)
        # A lane that is solved keeps the point that was measured, one that had finished before keeps everything.
        moved = where(solved, state, moved)
        return where(self.finished(it, allowance), it, moved)

    def linearized(self, it: Iterate) -> Linearized | None:
        """The inequalities where the iterate is; None of none."""
        return None if it.inequalities is None else Linearized.of(self.sets, it.inequalities, it.xs, it.barrier)

    def gap(self, it: Iterate, slacks: Boxed, barrier: Float[Array, " P"] | float) -> Float[Array, " P"]:
        """The largest |dual slack - barrier| of boxes and inequalities."""
        gap = complementarity(it.duals, slacks, barrier)
        if it.inequalities is None:
            return gap
        return jnp.maximum(gap, largest(it.inequalities.duals * it.inequalities.slacks - barrier))

    def stationarity(self, it: Iterate, expansion: Expansion, kept_out: Linearized | None) -> Float[Array, " P"]:
        """Largest entry of the Lagrangian's gradient, over max(100, mean multiplier)/100: E_0 of (5)."""
        n = self.model.n
        multipliers = [it.multipliers[:, i] for i in range(n)]
        columns = zip(*expansion.jacobian, strict=True)
        slope = [plus(g, dot(column, multipliers)) for g, column in zip(expansion.gradient, columns, strict=True)]
        slope = self.model.stacked(slope, it.us, it.h)
        by_state = slope[1:, :n] - it.multipliers[:-1]
        by_state = by_state.at[:, self.model.boxed].add(it.duals.xs[1] - it.duals.xs[0])
        if kept_out is not None:
            pulled = kept_out.pulled(kept_out.at.duals)
            by_state -= self.model.stacked(pulled, it.us[1:], it.h)
        by_input = slope[:, n + 1 :] + it.duals.us[1] - it.duals.us[0]
        error = jnp.maximum(largest(by_state), largest(by_input))
        if self.model.free_step:
            error = jnp.maximum(error, jnp.abs(total(slope[:, n]) + it.duals.h[1, 0] - it.duals.h[0, 0]))
        count = it.multipliers[..., 0].size + sum(leaf[..., 0].size for leaf in it.duals)
        sizes = total(jnp.abs(it.multipliers)) + sum_over(it.duals)
        if kept_out is not None:
            sizes, count = sizes + total(kept_out.at.duals), count + kept_out.at.duals[..., 0].size
        mean = sizes / count
        return error / (jnp.maximum(100.0, mean) / 100.0)

    def update_barrier(self, it: Iterate, slacks: Boxed, error: Float[Array, " P"]) -> Float[Array, " P"]:
        """(7), repeated while the barrier problem is already solved well enough."""
        s, barrier = self.settings, it.barrier
        for _ in range(4):
            accurate = jnp.maximum(error, self.gap(it, slacks, barrier)) <= s.barrier_accuracy * barrier
            lower = jnp.maximum(s.barrier_floor, jnp.minimum(s.barrier_factor * barrier, barrier**s.barrier_power))
            barrier = jnp.where(accurate, lower, barrier)
        return barrier

    def subproblem(
        self, it: Iterate, slacks: Boxed, expansion: Expansion, kept_out: Linearized | None
    ) -> kkt.Subproblem:
        """The quadratic model with the barrier's primal-dual terms and the regularization added: (13)."""
        n = self.model.n
        stiffness = jax.tree.map(lambda dual, slack: jnp.sum(dual / slack, 0), it.duals, slacks)
        force = jax.tree.map(lambda slack: it.barrier * (1 / slack[1] - 1 / slack[0]), slacks)
        hessian, gradient = [[*row] for row in expansion.hessian], [*expansion.gradient]
        for i, scaling in enumerate(self.model.scaling):
            hessian[i][i] += it.regularization * scaling
        for bounded, i in enumerate(self.model.boxed):
            hessian[i][i] += jnp.pad(stiffness.xs[:, bounded], ((1, 0), (0, 0)))
            gradient[i] += jnp.pad(force.xs[:, bounded], ((1, 0), (0, 0)))
        for i in range(self.model.m):
            hessian[n + 1 + i][n + 1 + i] += stiffness.us[:, i]
            gradient[n + 1 + i] += force.us[:, i]
        if kept_out is not None:
            for i, (row, entry) in enumerate(zip(kept_out.hessian(), kept_out.gradient(), strict=True)):
                hessian[i][: i + 1] = [plus(a, _from_second(b)) for a, b in zip(hessian[i], row, strict=False)]
                gradient[i] = plus(gradient[i], _from_second(entry))
        every = (it.us.shape[0], it.h.shape[-1])
        hessian = [[*row[:i], jnp.broadcast_to(row[i], every)] for i, row in enumerate(hessian)]
        if self.model.free_step:
            curvature, by_step = stiffness.h[0] + it.regularization * self.model.step_scaling, force.h[0]
        else:  # a fixed step is one that no slope moves
            curvature, by_step = jnp.full_like(it.h, jnp.inf), jnp.zeros_like(it.h)
        end = self.end_weights(it, expansion)
        return kkt.Subproblem(hessian, gradient, expansion.jacobian, it.defects, curvature, by_step, end)

    def end_weights(self, it: Iterate, expansion: Expansion) -> Float[Array, "n P"]:
        """Those of the pinned end's flag: large beside the model's curvature, in units of the boxes."""
        n = self.model.n
        scaling = jnp.asarray(self.model.scaling, self.model.dtype)[:, None]
        diagonal = self.model.stacked([row[i] for i, row in enumerate(expansion.hessian)], it.us, it.h)
        sizes = jnp.abs(jnp.delete(diagonal, n, 1)) / jnp.delete(scaling, n, 0)
        return self.settings.end_weight * (1 + largest(sizes)) * scaling[:n]

    def move(
        self,
        it: Iterate,
        slacks: Boxed,
        subproblem: kkt.Subproblem,
        kept_out: Linearized | None,
        parameters: PyTree,
    ) -> Iterate:
        """Newton step, fraction to the boundary, filter line search, new regularization."""
        s, model = self.settings, self.model
        step = kkt.solve(subproblem)
        finite = jnp.isfinite(total(step.dxs) + total(step.dus) + step.dh + total(step.multipliers))
        usable = step.convex & finite
        step = jax.tree.map(lambda leaf: jnp.where(usable, leaf, 0), step)
        approach = jax.tree.map(lambda d: jnp.stack([d, -d]), model.values(step.dxs, step.dus, step.dh))
        fraction = jnp.maximum(s.boundary_fraction, 1 - it.barrier)
        longest = boundary_step(slacks, approach, fraction)
        descent, steps = self.descent(it, subproblem, step), None
        if kept_out is not None:
            steps = kept_out.steps(step.dxs)
            longest = jnp.minimum(longest, room(kept_out.at.slacks, steps.slacks, fraction))
            descent += kept_out.descent(steps)
        direction = Direction(step, longest, descent, usable, steps and steps.slacks)
        search = line_search(model, s, it, slacks, direction, parameters)
        xs, us, h = direction.point(it, search.length)
        inequalities = steps and kept_out and kept_out.moved(steps, search.length, fraction)
        point = it._replace(
            xs=xs, us=us, h=h, defects=search.defects, cost=search.cost,
            duals=_moved_duals(it, slacks, approach, fraction, model.slacks(model.values(xs, us, h))),
            multipliers=it.multipliers + search.length * (step.multipliers - it.multipliers),
            last_regularization=jnp.where(it.regularization > 0, it.regularization, it.last_regularization),
            inequalities=inequalities,
        )  # fmt: skip
        return where(search.taken, point, it)._replace(
            filter=search.filter,
            filtered=search.filtered,
            rejections=search.rejections,
            regularization=_regularized(it, s, search),
        )

    def descent(self, it: Iterate, subproblem: kkt.Subproblem, step: kkt.Step) -> Float[Array, " P"]:
        """The slope of the barrier problem's objective along the step."""
        n = self.model.n
        gradient = self.model.stacked(subproblem.gradient, it.us, it.h)
        by_step = jnp.sum(gradient[:, n], 0) + subproblem.slope
        along = total(gradient[:, :n] * step.dxs[:-1]) + total(gradient[:, n + 1 :] * step.dus)
        return along + by_step * step.dh


def _from_second(entry):
    """An entry of the interior knots as one of all intervals' starts."""
    return entry if isinstance(entry, float) else jnp.pad(entry, ((1, 0), (0, 0)))


def _moved_duals(it: Iterate, slacks: Boxed, approach: Boxed, fraction, reached: Boxed) -> Boxed:
    """The duals after the primal-dual step, kept near barrier / slack at the slacks that are reached: (16)."""
    step = jax.tree.map(lambda dual, slack, d: it.barrier / slack - dual - dual / slack * d, it.duals, slacks, approach)
    longest = boundary_step(it.duals, step, fraction)
    return jax.tree.map(
        lambda dual, d, slack: jnp.clip(dual + longest * d, it.barrier / 1e10 / slack, 1e10 * it.barrier / slack),
        it.duals,
        step,
        reached,
    )


def _regularized(it: Iterate, s: Settings, search: Search):
    """Up after a failed factorization or a short step, down after a long one, as it was after a forced one."""
    now, factor = it.regularization, s.regularization_factor
    up = jnp.where(now == 0, jnp.maximum(1e-2, it.last_regularization / factor), now * factor)
    down = jnp.where(now / factor < 1e-7, 0.0, now / factor)
    changed = jnp.where(search.length > 0.5, down, jnp.where(search.length < 0.1, up, now))
    return jnp.minimum(jnp.where(search.forced, now, jnp.where(search.taken, changed, up)), 1e8)
