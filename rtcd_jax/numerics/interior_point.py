"""Batched primal-dual interior-point SQP for trajectory optimisation with pinned ends and one free step length.

    minimise over x_1 .. x_{N-1}, u_0 .. u_{N-1}, h     sum_k h running(x_k, u_k)
    subject to   x_{k+1} = next(x_k, u_k, h),  x_0 and x_N given,  boxes on x, u and h

The method is IPOPT's (Waechter and Biegler, Math. Programming 106, 2006; equation numbers below are theirs) with the
exact Hessian of the Lagrangian and an O(N) factorisation of the KKT system (kkt.py). The batch is the last axis of
every array, see batched.py, and problems go through in lanes, see lanes.py.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rtcd_jax.numerics import kkt
from rtcd_jax.numerics.entries import dot, plus
from rtcd_jax.numerics.expansion import Expansion, expander
from rtcd_jax.numerics.lanes import solve_in_lanes

CACHE = 2**20
"""Second-level cache of a core [bytes]."""


VECTOR = 8
"""Lanes come in whole vectors: of the rest of a vector, a compiler may round sines and logarithms differently."""


class Settings(NamedTuple):
    """Tolerances and the constants of the method."""

    lanes: int = 32  # at most; whole vectors
    defect_tolerance: float = 1e-9
    dual_tolerance: float = 1e-4  # relative to 1 + max |multiplier|
    complementarity_tolerance: float = 1e-5  # likewise
    barrier_start: float = 0.3
    barrier_floor: float = 1e-8
    barrier_factor: float = 0.2  # kappa_mu, (7)
    barrier_power: float = 1.5  # theta_mu, (7)
    barrier_accuracy: float = 1000.0  # kappa_epsilon of algorithm A-2; their 10 is stricter than a warm filter needs
    boundary_fraction: float = 0.99  # tau_min, (8)
    regularization_start: float = 1.0
    regularization_factor: float = 4.0
    trials: int = 3  # few: a lane that backtracks keeps the others waiting, more regularization helps as well
    backtracking: float = 0.4
    filter_size: int = 16


DEFAULTS = Settings()


class ControlProblem(NamedTuple):
    """What to solve. The functions work elementwise on trailing axes.

    `interval(x [n ..], u [m ..], h, parameters)` is the next x, `running(x, u, parameters)` the cost per time of an
    interval, `rate(x, u, parameters)` the time derivative of x, both of tuples x and u of components. Derivatives are
    taken of one Runge-Kutta step of `rate`, a cheaper integration of the same dynamics. Its error decides how fast the
    iteration contracts (an inexact Newton method) and, to second order, how optimal its end is; defects are always
    measured by `interval`, so that the end is a solution of the accurate dynamics.
    """

    interval: Callable
    rate: Callable
    running: Callable
    start: np.ndarray
    goal: np.ndarray
    state_limits: np.ndarray
    input_limits: np.ndarray
    step_limits: tuple[float, float]


class Guess(NamedTuple):
    """Where a solve starts; the ends of `xs` are overwritten by the pinned states."""

    xs: Float[Array, "N+1 n *P"]
    us: Float[Array, "N m *P"]
    h: Float[Array, "*P"]


class Solution(NamedTuple):
    """`solved` is true where defects, stationarity and complementarity reached their tolerances."""

    us: Float[Array, "N m P"]
    xs: Float[Array, "N+1 n P"]
    h: Float[Array, " P"]
    cost: Float[Array, " P"]
    defect: Float[Array, " P"]
    iterations: Int[Array, " P"]
    solved: Bool[Array, " P"]


class _Boxed(NamedTuple):
    """One value for each bounded variable: interior states with a finite limit, inputs, the step."""

    xs: Float[Array, "N-1 b P"]
    us: Float[Array, "N m P"]
    h: Float[Array, "1 P"]


class _Iterate(NamedTuple):
    xs: Float[Array, "N+1 n P"]
    us: Float[Array, "N m P"]
    h: Float[Array, " P"]
    multipliers: Float[Array, "N n P"]
    duals: _Boxed  # each with a leading axis (lower, upper)
    barrier: Float[Array, " P"]
    regularization: Float[Array, " P"]
    last_regularization: Float[Array, " P"]
    filter: Float[Array, "F 2 P"]
    filtered: Int[Array, " P"]
    violation_start: Float[Array, " P"]
    rejections: Int[Array, " P"]
    iterations: Int[Array, " P"]
    cost: Float[Array, " P"]
    defects: Float[Array, "N n P"]
    solved: Bool[Array, " P"]


def _total(a):
    return jnp.sum(a, tuple(range(a.ndim - 1)))


def _largest(a):
    return jnp.max(jnp.abs(a), tuple(range(a.ndim - 1)), initial=0.0)


def _least(a):
    return jnp.min(a, tuple(range(a.ndim - 1)), initial=jnp.inf)


def _sum_over(boxed):
    return sum(_total(leaf) for leaf in boxed)


class _Solver:
    """The problem with its constants at hand; all methods are pure."""

    def __init__(self, problem: ControlProblem, settings: Settings, dtype):
        self.problem, self.settings, self.dtype = problem, settings, dtype
        self.n, self.m = len(problem.start), len(problem.input_limits)
        self.boxed = np.flatnonzero(np.isfinite(problem.state_limits))
        x_limit = problem.state_limits[self.boxed]
        low, high = problem.step_limits
        as_column = lambda a: jnp.asarray(np.asarray(a, float), dtype)[:, None]  # noqa: E731
        self.lower = _Boxed(as_column(-x_limit), as_column(-problem.input_limits), as_column([low]))
        self.upper = _Boxed(as_column(x_limit), as_column(problem.input_limits), as_column([high]))
        travel = np.maximum(1.0, np.abs(problem.start - problem.goal))
        scale_x = np.where(np.isfinite(problem.state_limits), problem.state_limits, travel)
        self.scaling = [float(s) for s in (*1 / scale_x**2, 0.0, *1 / problem.input_limits**2)]
        self.step_scaling = 4 / (high - low) ** 2

    # ---- the model

    def simulate(self, xs, us, h, parameters):
        """Defects [N n P] and the objective [P]."""
        x, u = jnp.moveaxis(xs[:-1], 0, 1), jnp.moveaxis(us, 0, 1)
        nexts = self.problem.interval(x, u, h, parameters)
        return jnp.moveaxis(nexts, 1, 0) - xs[1:], h * jnp.sum(self.problem.running(tuple(x), tuple(u), parameters), 0)

    def expand(self, xs, us, h, multipliers, parameters) -> Expansion:
        """The model's slopes and curvature; entries [N P] or numbers."""
        expand = expander(self.problem.rate, self.problem.running, self.n, self.m, parameters)
        stages = (xs[:-1], us, multipliers)

        def one(stage):
            return expand(*(tuple(part) for part in stage[:2]), h, tuple(stage[2]), parameters)

        def packed(stage):
            return jnp.stack(jax.tree.leaves(eqx.filter(one(stage), eqx.is_array)))

        layout = eqx.filter_eval_shape(one, jax.tree.map(lambda leaf: leaf[0], stages))
        numbers = jax.tree.map(lambda leaf: leaf if isinstance(leaf, float) else None, layout)
        # One knot after another stays in a core's cache; other devices want all knots at once.
        arrays = iter(
            jax.lax.platform_dependent(
                stages,
                cpu=lambda stages: jnp.moveaxis(jax.lax.map(packed, stages), 1, 0),
                default=lambda stages: packed(jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 1, 0), stages)),
            )
        )
        fill = lambda number: next(arrays) if number is None else number  # noqa: E731
        return jax.tree.map(fill, numbers, is_leaf=lambda leaf: leaf is None)

    def values(self, xs, us, h) -> _Boxed:
        return _Boxed(xs[1:-1, self.boxed], us, h[None])

    def slacks(self, values: _Boxed) -> _Boxed:
        return jax.tree.map(lambda v, lo, hi: jnp.stack([v - lo, hi - v]), values, self.lower, self.upper)

    # ---- one iteration

    def initial(self, guess: Guess, parameters) -> _Iterate:
        batch = guess.h.shape[-1]
        inside = jax.tree.map(_push_inside, self.values(*guess), self.lower, self.upper)
        pinned = lambda a: jnp.broadcast_to(jnp.asarray(a, self.dtype)[:, None], (self.n, batch))  # noqa: E731
        xs = guess.xs.at[1:-1, self.boxed].set(inside.xs)
        xs = xs.at[0].set(pinned(self.problem.start)).at[-1].set(pinned(self.problem.goal))
        full = lambda value: jnp.full((batch,), value, self.dtype)  # noqa: E731
        barrier = full(self.settings.barrier_start)
        zero = jnp.zeros((batch,), jnp.int32)
        defects, cost = self.simulate(xs, inside.us, inside.h[0], parameters)
        return _Iterate(
            xs=xs,
            us=inside.us,
            h=inside.h[0],
            multipliers=jnp.zeros_like(defects),
            duals=jax.tree.map(lambda slack: barrier / slack, self.slacks(inside)),
            barrier=barrier,
            regularization=full(self.settings.regularization_start),
            last_regularization=full(0.0),
            filter=jnp.full((self.settings.filter_size, 2, batch), jnp.inf, self.dtype),
            filtered=zero,
            violation_start=_total(jnp.abs(defects)),
            rejections=zero,
            iterations=zero,
            cost=cost,
            defects=defects,
            solved=jnp.zeros((batch,), bool),
        )

    def finished(self, it: _Iterate, allowance):
        return it.solved | (it.iterations >= allowance)

    def advance(self, it: _Iterate, parameters, allowance) -> _Iterate:
        """One interior-point iteration; lanes that are finished come back unchanged."""
        s = self.settings
        expansion = self.expand(it.xs, it.us, it.h, it.multipliers, parameters)
        slacks = self.slacks(self.values(it.xs, it.us, it.h))
        dual_error = self.stationarity(it, expansion)
        defect = _largest(it.defects)
        size = 1 + _largest(it.multipliers)
        gap = _complementarity(it.duals, slacks, 0.0)
        solved = (defect <= s.defect_tolerance) & (dual_error <= s.dual_tolerance * size)
        solved = solved & (gap <= s.complementarity_tolerance * size)
        barrier = self.update_barrier(it, slacks, jnp.maximum(dual_error, defect))
        reduced = barrier < it.barrier
        state = it._replace(
            barrier=barrier,
            filter=jnp.where(reduced, jnp.inf, it.filter),
            filtered=jnp.where(reduced, 0, it.filtered),
            iterations=it.iterations + 1,
            solved=solved,
        )
        subproblem = self.subproblem(state, slacks, expansion)
        moved = self.move(state, slacks, subproblem, parameters)
        # A lane that is solved keeps the point that was measured, one that had finished before keeps everything.
        moved = _where(solved, state, moved)
        return _where(self.finished(it, allowance), it, moved)

    def stationarity(self, it: _Iterate, expansion: Expansion):
        """Largest entry of the Lagrangian's gradient, over max(100, mean multiplier)/100: E_0 of (5)."""
        n = self.n
        multipliers = [it.multipliers[:, i] for i in range(n)]
        columns = zip(*expansion.jacobian, strict=True)
        slope = [plus(g, dot(column, multipliers)) for g, column in zip(expansion.gradient, columns, strict=True)]
        slope = self.stacked(slope, it)
        by_state = slope[1:, :n] - it.multipliers[:-1]
        by_state = by_state.at[:, self.boxed].add(it.duals.xs[1] - it.duals.xs[0])
        by_input = slope[:, n + 1 :] + it.duals.us[1] - it.duals.us[0]
        by_step = _total(slope[:, n]) + it.duals.h[1, 0] - it.duals.h[0, 0]
        error = jnp.maximum(jnp.maximum(_largest(by_state), _largest(by_input)), jnp.abs(by_step))
        count = it.multipliers[..., 0].size + sum(leaf[..., 0].size for leaf in it.duals)
        mean = (_total(jnp.abs(it.multipliers)) + _sum_over(it.duals)) / count
        return error / (jnp.maximum(100.0, mean) / 100.0)

    def update_barrier(self, it: _Iterate, slacks: _Boxed, error):
        """(7), repeated while the barrier problem is already solved well enough."""
        s, barrier = self.settings, it.barrier
        for _ in range(4):
            accurate = jnp.maximum(error, _complementarity(it.duals, slacks, barrier)) <= s.barrier_accuracy * barrier
            lower = jnp.maximum(s.barrier_floor, jnp.minimum(s.barrier_factor * barrier, barrier**s.barrier_power))
            barrier = jnp.where(accurate, lower, barrier)
        return barrier

    def subproblem(self, it: _Iterate, slacks: _Boxed, expansion: Expansion) -> kkt.Subproblem:
        """The quadratic model with the barrier's primal-dual terms and the regularization added: (13)."""
        n = self.n
        stiffness = jax.tree.map(lambda dual, slack: jnp.sum(dual / slack, 0), it.duals, slacks)
        force = jax.tree.map(lambda slack: it.barrier * (1 / slack[1] - 1 / slack[0]), slacks)
        hessian, gradient = [[*row] for row in expansion.hessian], [*expansion.gradient]
        for i, scaling in enumerate(self.scaling):
            hessian[i][i] += it.regularization * scaling
        for bounded, i in enumerate(self.boxed):
            hessian[i][i] += jnp.pad(stiffness.xs[:, bounded], ((1, 0), (0, 0)))
            gradient[i] += jnp.pad(force.xs[:, bounded], ((1, 0), (0, 0)))
        for i in range(self.m):
            hessian[n + 1 + i][n + 1 + i] += stiffness.us[:, i]
            gradient[n + 1 + i] += force.us[:, i]
        every = (it.us.shape[0], it.h.shape[-1])
        hessian = [[*row[:i], jnp.broadcast_to(row[i], every)] for i, row in enumerate(hessian)]
        return kkt.Subproblem(
            hessian=hessian,
            gradient=gradient,
            jacobian=expansion.jacobian,
            defects=it.defects,
            curvature=stiffness.h[0] + it.regularization * self.step_scaling,
            slope=force.h[0],
        )

    def stacked(self, row, it: _Iterate):
        """Entries as an array [N w P]."""
        return jnp.stack([jnp.broadcast_to(entry, (it.us.shape[0], it.h.shape[-1])) for entry in row], 1)

    def move(self, it: _Iterate, slacks: _Boxed, subproblem: kkt.Subproblem, parameters) -> _Iterate:
        """Newton step, fraction to the boundary, filter line search, new regularization."""
        s, n = self.settings, self.n
        step = kkt.solve(subproblem)
        finite = jnp.isfinite(_total(step.dxs) + _total(step.dus) + step.dh + _total(step.multipliers))
        usable = step.convex & finite
        step = jax.tree.map(lambda leaf: jnp.where(usable, leaf, 0), step)
        change = self.values(step.dxs, step.dus, step.dh)
        approach = jax.tree.map(lambda d: jnp.stack([d, -d]), change)
        dual_step = jax.tree.map(
            lambda dual, slack, d: it.barrier / slack - dual - dual / slack * d, it.duals, slacks, approach
        )
        fraction = jnp.maximum(s.boundary_fraction, 1 - it.barrier)
        longest = _boundary_step(slacks, approach, fraction)
        longest_dual = _boundary_step(it.duals, dual_step, fraction)
        gradient = self.stacked(subproblem.gradient, it)
        descent = (
            _total(gradient[:, :n] * step.dxs[:-1])
            + _total(gradient[:, n + 1 :] * step.dus)
            + (jnp.sum(gradient[:, n], 0) + subproblem.slope) * step.dh
        )
        search = self.line_search(it, slacks, step, longest, descent, usable, parameters)
        length = search.length
        xs, us, h = it.xs + length * step.dxs, it.us + length * step.dus, it.h + length * step.dh
        duals = jax.tree.map(
            lambda dual, d, slack: jnp.clip(
                dual + longest_dual * d, it.barrier / 1e10 / slack, 1e10 * it.barrier / slack
            ),
            it.duals,
            dual_step,
            self.slacks(self.values(xs, us, h)),
        )  # (16)
        point = it._replace(
            xs=xs, us=us, h=h, duals=duals, defects=search.defects, cost=search.cost,
            multipliers=it.multipliers + length * (step.multipliers - it.multipliers),
            last_regularization=jnp.where(it.regularization > 0, it.regularization, it.last_regularization),
        )  # fmt: skip
        return _where(search.taken, point, it)._replace(
            filter=search.filter,
            filtered=search.filtered,
            rejections=search.rejections,
            regularization=_regularize(it, s, search),
        )

    def line_search(self, it: _Iterate, slacks, step, longest, descent, usable, parameters) -> "_Search":
        """Backtrack to the first length that the filter accepts: algorithm A-5.

        After four failures in a row the filter is emptied and the last, short step taken: that replaces the restoration
        phase.
        """
        s = self.settings
        eps = float(jnp.finfo(self.dtype).eps)
        violation = _total(jnp.abs(it.defects))
        merit = it.cost - it.barrier * _log_sum(slacks)
        start = jnp.maximum(1.0, it.violation_start)
        slack_merit, slack_violation = 10 * eps * jnp.abs(merit), 10 * eps * it.defects[..., 0].size
        steep = jnp.where(descent < 0, -descent, 0.0)

        def attempt(length):
            xs, us, h = it.xs + length * step.dxs, it.us + length * step.dus, it.h + length * step.dh
            defects, cost = self.simulate(xs, us, h, parameters)
            trial_violation = _total(jnp.abs(defects))
            trial = cost - it.barrier * _log_sum(self.slacks(self.values(xs, us, h)))
            switching = (descent < 0) & (length * steep**2.3 > violation**1.1) & (violation <= 1e-4 * start)  # (19)
            armijo = trial <= merit + 1e-4 * length * descent + slack_merit  # (20)
            better = (trial_violation <= (1 - 1e-5) * violation + slack_violation) | (
                trial <= merit - 1e-5 * violation + slack_merit
            )  # (18)
            free = jnp.all((trial_violation <= it.filter[:, 0]) | (trial <= it.filter[:, 1] + slack_merit), 0)
            finite = jnp.isfinite(trial) & jnp.isfinite(trial_violation)
            accepted = finite & (trial_violation <= 10 * start) & free & jnp.where(switching, armijo, better)
            return accepted, _Trial(defects, cost, finite, ~(switching & armijo))

        def backtrack(state):
            count, length, accepted, trial = state
            length = jnp.where(accepted | (count == 0), length, length * s.backtracking)
            good, fresh = attempt(length)
            return count + 1, length, accepted | good, _where(accepted, trial, fresh)

        none = jnp.zeros_like(usable)
        state = (0, longest, ~usable | it.solved, _Trial(it.defects, it.cost, none, none))
        _, length, accepted, trial = jax.lax.while_loop(
            lambda state: (state[0] < s.trials) & jnp.any(~state[2]), backtrack, state
        )
        accepted = accepted & usable
        rejections = jnp.where(accepted, 0, it.rejections + usable)
        forced = usable & ~accepted & (rejections >= 4) & trial.finite
        add = accepted & trial.augment
        slot = (jnp.arange(s.filter_size)[:, None] == it.filtered % s.filter_size) & add
        entry = jnp.stack([(1 - 1e-5) * violation, merit - 1e-5 * violation])  # (22)
        return _Search(
            length=length,
            taken=accepted | forced,
            forced=forced,
            defects=trial.defects,
            cost=trial.cost,
            filter=jnp.where(forced, jnp.inf, jnp.where(slot[:, None], entry, it.filter)),
            filtered=jnp.where(forced, 0, it.filtered + add),
            rejections=jnp.where(forced, 0, rejections),
        )


class _Trial(NamedTuple):
    defects: Float[Array, "N n P"]
    cost: Float[Array, " P"]
    finite: Bool[Array, " P"]
    augment: Bool[Array, " P"]


class _Search(NamedTuple):
    length: Float[Array, " P"]
    taken: Bool[Array, " P"]
    forced: Bool[Array, " P"]
    defects: Float[Array, "N n P"]
    cost: Float[Array, " P"]
    filter: Float[Array, "F 2 P"]
    filtered: Int[Array, " P"]
    rejections: Int[Array, " P"]


def _where(condition, yes, no):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _push_inside(value, low, high, share=1e-2):
    """Section 3.6: strictly inside the box, by a share of the bound's size or of the box."""
    below = jnp.minimum(share * jnp.maximum(1.0, jnp.abs(low)), share * (high - low))
    above = jnp.minimum(share * jnp.maximum(1.0, jnp.abs(high)), share * (high - low))
    return jnp.clip(value, low + below, high - above)


def _complementarity(duals: _Boxed, slacks: _Boxed, barrier):
    errors = [_largest(dual * slack - barrier) for dual, slack in zip(duals, slacks, strict=True)]
    return jnp.maximum(jnp.maximum(errors[0], errors[1]), errors[2])


def _log_sum(slacks: _Boxed):
    return sum(_total(jnp.log(slack[0] * slack[1])) for slack in slacks)


def _boundary_step(values: _Boxed, steps: _Boxed, fraction):
    """Largest step <= 1 that keeps values + step above (1 - fraction) values: (15)."""
    room = [
        _least(jnp.where(d < 0, -fraction * v / jnp.where(d < 0, d, -1.0), jnp.inf))
        for v, d in zip(values, steps, strict=True)
    ]
    return jnp.minimum(1.0, jnp.minimum(jnp.minimum(room[0], room[1]), room[2]))


def _regularize(it: _Iterate, s: Settings, search: _Search):
    """Up after a failed factorization or a short step, down after a long one, as it was after a forced one."""
    now, factor = it.regularization, s.regularization_factor
    up = jnp.where(now == 0, jnp.maximum(1e-2, it.last_regularization / factor), now * factor)
    down = jnp.where(now / factor < 1e-7, 0.0, now / factor)
    changed = jnp.where(search.length > 0.5, down, jnp.where(search.length < 0.1, up, now))
    return jnp.minimum(jnp.where(search.forced, now, jnp.where(search.taken, changed, up)), 1e8)


def _lanes_in_cache(intervals: int, w: int) -> int:
    """Lanes whose Hessians fill a core's cache; more wait for memory, fewer for calls."""
    return max(1, CACHE // (8 * intervals * w * w) // VECTOR) * VECTOR


def solve(
    problem: ControlProblem, parameters, guess: Guess, allowance: Int[Array, " P"], settings: Settings = DEFAULTS
) -> Solution:
    """Solve every problem of the batch from one guess, within `allowance` iterations.

    `parameters` is a pytree with P on the last axis of every leaf; so do the solutions come back. The guess has no
    batch. A problem whose allowance is zero costs nothing; all that is said of it is that it is not solved.
    """
    count = allowance.shape[0]
    solver = _Solver(problem, settings, guess.xs.dtype)
    order = jnp.argsort(allowance == 0)  # stable: those that are wanted come first
    place = jnp.argsort(order)

    def load(indices):
        rows = order[indices]
        chosen = jax.tree.map(lambda leaf: leaf[..., rows], parameters)
        start = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf[..., None], (*leaf.shape, *rows.shape)), guess)
        return solver.initial(start, chosen), chosen, allowance[rows]

    def advance(state):
        iterate, chosen, allowed = state
        return solver.advance(iterate, chosen, allowed), chosen, allowed

    def extract(state):
        it = state[0]
        return Solution(it.us, it.xs, it.h, it.cost, _largest(it.defects), it.iterations, it.solved)

    def finished(state):
        return solver.finished(state[0], state[2])

    wanted = jnp.sum(allowance > 0)
    width = min(
        settings.lanes, _lanes_in_cache(guess.us.shape[0], solver.n + 1 + solver.m), -(-count // VECTOR) * VECTOR
    )
    solution = solve_in_lanes(load, advance, finished, extract, count, width, wanted)
    return jax.tree.map(lambda leaf: leaf[..., place], solution)
