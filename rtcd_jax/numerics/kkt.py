"""The KKT system of a trajectory optimization step, solved by one Riccati sweep.

    minimize   sum_k  1/2 w_k' H_k w_k + g_k' w_k  +  1/2 curvature dh^2 + slope dh  +  1/2 sum_i end_i dx_N,i^2
    subject to dx_{k+1} = J_k w_k + c_k,   dx_0 = 0,   dx_N = 0,                         w_k = (dx_k, dh, du_k)

The step length dh is one unknown shared by all intervals: it rides along as a constant state. The pinned
end enters through its multiplier nu, which the sweep carries as a parameter: the cost-to-go from knot k is

    V_k(y, nu) = 1/2 y' P y + p' y + nu' (E y + e) - 1/2 nu' W nu,          y = (dx, dh)

so that hard end states need no penalty: two small solves at knot 0 give dh and nu. The term of `end` is zero on the
pinned end and changes neither the step nor the multipliers, but the pivots: without it they are positive only if the
problem with a *free* end is convex; with large weights, if and only if that with the pinned end is (Debreu,
Econometrica 20, 1952). All matrices are lists of entries [N P], see entries.py: numbers known beforehand, such as a
zero slope, are never computed with.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rtcd_jax.numerics.batched import spd_solve
from rtcd_jax.numerics.entries import Matrix, Row, dot, plus, times
from rtcd_jax.numerics.loops import packed_scan

UNROLLED_STATES = 20
"""States times knots in the body of a GPU's loop: fewer launches against a longer compilation."""


class Subproblem(NamedTuple):
    """The quadratic model above; entries [N P] or numbers, of the symmetric Hessians at least the lower half."""

    hessian: Matrix  # w w
    gradient: Row  # w
    jacobian: Matrix  # n w
    defects: Float[Array, "N n P"]
    curvature: Float[Array, " P"]
    slope: Float[Array, " P"]
    end: Float[Array, "n P"]


class Step(NamedTuple):
    """Its solution. `multipliers[k]` belongs to the constraint on dx_{k+1}; `convex` is false where a pivot failed."""

    dxs: Float[Array, "N+1 n P"]
    dus: Float[Array, "N m P"]
    dh: Float[Array, " P"]
    multipliers: Float[Array, "N n P"]
    convex: Bool[Array, " P"]


class _Value(NamedTuple):
    """Entries [P]; of symmetric matrices the lower half."""

    quadratic: Matrix  # P
    linear: Row  # p
    end: Matrix  # E
    end_offset: Row  # e
    end_curvature: Matrix  # W
    convex: Bool[Array, " P"]


def solve(problem: Subproblem, floor: float = 1e-12) -> Step:
    """Solve the KKT system in O(N); pivots at or below `floor` clear the flag `convex`."""
    n, batch = problem.defects.shape[1:]
    dtype = problem.defects.dtype
    zero = jnp.zeros((batch,), dtype)
    # Pinned in units of the weights: W is then of size one.
    units = jnp.sqrt(jnp.where(problem.end > 0, problem.end, 1.0))
    pinned: Matrix = [[units[i] if i == j else zero for j in range(n + 1)] for i in range(n)]
    last = _Value(
        quadratic=[[problem.end[i] if i == j < n else zero for j in range(i + 1)] for i in range(n + 1)],
        linear=[zero] * (n + 1),
        end=pinned,
        end_offset=[zero] * n,
        end_curvature=[[zero] * (i + 1) for i in range(n)],
        convex=jnp.ones((batch,), bool),
    )
    defects = [problem.defects[:, i] for i in range(n)]
    arrays, numbers = eqx.partition((problem.hessian, problem.gradient, problem.jacobian, defects), eqx.is_array)

    def eliminate_input(value: _Value, stage):
        hessian, gradient, jacobian, defect = eqx.combine(stage, numbers)
        before, policy = _eliminate_input(value, hessian, gradient, jacobian, defect, floor)
        return before, (policy, [*value.linear[:n]], _square(value.quadratic)[:n], [row[:n] for row in value.end])

    unroll = max(1, UNROLLED_STATES // n)
    first, (policy, slopes, rows, ends) = packed_scan(
        eliminate_input, last, arrays, shared=1, unroll=unroll, reverse=True
    )
    dh, nu, convex = _solve_first_knot(first, problem, floor)

    def roll(carry, stage):
        *dx, dh = carry
        (gain, offset, gain_end), slopes, defect = stage
        jacobian = eqx.combine(slopes, numbers[2])
        y = [*dx, dh]
        du = [-plus(dot(row, y), o, dot(end, nu)) for row, o, end in zip(gain, offset, gain_end, strict=True)]
        after = [plus(dot(row, [*y, *du]), c) for row, c in zip(jacobian, defect, strict=True)]
        return [*after, dh], (after, du)

    stages = policy, arrays[2], defects
    _, (dxs, dus) = packed_scan(roll, [zero] * n + [dh], stages, shared=1, unroll=unroll)
    # The sweep meets the pinned end up to rounding, which would add up over the iterations.
    multipliers = [
        plus(dot(row, [*dxs, dh]), p, dot(column, nu))
        for row, p, column in zip(rows, slopes, zip(*ends, strict=True), strict=True)
    ]
    exact = jnp.pad(jnp.stack(dxs, 1)[:-1], ((1, 1), (0, 0), (0, 0)))
    return Step(exact, jnp.stack(dus, 1), dh, jnp.stack(multipliers, 1), convex)


def _eliminate_input(value: _Value, hessian, gradient, jacobian, defect, floor):
    """The value one knot earlier, and K, k, G of the input's step du = -(K (dx, dh) + k + G nu)."""
    n, w = len(jacobian), len(gradient)
    y = n + 1
    flow = list(zip(*jacobian, [float(i == n) for i in range(w)], strict=True))  # columns
    square = _square(value.quadratic)
    through = [[dot(row, column) for row in square] for column in flow]
    curvature = [[plus(hessian[i][j], dot(flow[i], through[j])) for j in range(i + 1)] for i in range(w)]
    ahead = [plus(dot(row[:n], defect), p) for row, p in zip(square, value.linear, strict=True)]
    slope = [plus(g, dot(column, ahead)) for g, column in zip(gradient, flow, strict=True)]
    end = [[dot(row, column) for column in flow] for row in value.end]
    offset = [plus(e, dot(row[:n], defect)) for e, row in zip(value.end_offset, value.end, strict=True)]
    by_input = [[*curvature[a][:y], slope[a], *(row[a] for row in end)] for a in range(y, w)]
    solved, convex = _solve_definite([curvature[a][y:] for a in range(y, w)], by_input, floor)
    columns = list(zip(*by_input, strict=True))
    solution = list(zip(*solved, strict=True))
    less = lambda entry, i, j: plus(entry, times(-1.0, dot(columns[i], solution[j])))  # noqa: E731
    before = _Value(
        quadratic=[[less(curvature[i][j], i, j) for j in range(i + 1)] for i in range(y)],
        linear=[less(slope[i], i, y) for i in range(y)],
        end=[[less(end[i][j], y + 1 + i, j) for j in range(y)] for i in range(n)],
        end_offset=[less(offset[i], y + 1 + i, y) for i in range(n)],
        end_curvature=[
            [plus(value.end_curvature[i][j], dot(columns[y + 1 + i], solution[y + 1 + j])) for j in range(i + 1)]
            for i in range(n)
        ],
        convex=value.convex & convex,
    )
    return before, ([row[:y] for row in solved], [row[y] for row in solved], [row[y + 1 :] for row in solved])


def _solve_definite(lower: Matrix, right: Matrix, floor):
    """A^-1 B by L D L', and whether every pivot is above `floor`."""
    m = len(lower)
    factor, pivots, rows, positive = [], [], [], True
    for i in range(m):
        scaled = []
        for j in range(i):
            scaled.append(plus(lower[i][j], *(times(-1.0, times(scaled[k], factor[j][k])) for k in range(j))))
        factor.append([s / pivot for s, pivot in zip(scaled, pivots, strict=True)])
        pivot = plus(lower[i][i], times(-1.0, dot(scaled, factor[i])))
        positive = positive & (pivot > floor)
        pivots.append(jnp.where(pivot > floor, pivot, 1.0))
        rows.append(
            [plus(b, *(times(-1.0, times(factor[i][k], rows[k][c])) for k in range(i))) for c, b in enumerate(right[i])]
        )
    solution: list[list] = [[] for _ in range(m)]
    for i in reversed(range(m)):
        inverse = 1 / pivots[i]
        solution[i] = [
            plus(times(inverse, b), *(times(-1.0, times(factor[k][i], solution[k][c])) for k in range(i + 1, m)))
            for c, b in enumerate(rows[i])
        ]
    return solution, positive


def _square(lower: Matrix) -> Matrix:
    return [[lower[max(i, j)][min(i, j)] for j in range(len(lower))] for i in range(len(lower))]


def _solve_first_knot(first: _Value, problem: Subproblem, floor: float):
    """dh and nu from stationarity in both: the 2 x 2 block system eliminated through W."""
    n = len(first.end)
    curvature = jnp.stack([jnp.stack(row) for row in _square(first.end_curvature)])
    by_step = jnp.stack([row[n] for row in first.end])
    solution, independent = spd_solve(curvature, jnp.stack([by_step, jnp.stack(first.end_offset)], 1), floor)
    pivot = first.quadratic[n][n] + problem.curvature + jnp.sum(by_step * solution[:, 0], 0)
    convex = first.convex & independent & (pivot > floor)
    residual = -first.linear[n] - problem.slope - jnp.sum(by_step * solution[:, 1], 0)
    dh = residual / jnp.where(pivot > floor, pivot, 1.0)
    return dh, list(solution[:, 0] * dh + solution[:, 1]), convex
