"""The KKT system of a trajectory optimisation step, solved by one Riccati sweep.

    minimise   sum_k  1/2 w_k' H_k w_k + g_k' w_k  +  1/2 curvature dh^2 + slope dh,     w_k = (dx_k, dh, du_k)
    subject to dx_{k+1} = J_k w_k + c_k,   dx_0 = 0,   dx_N = 0

The step length dh is one unknown shared by all intervals: it rides along as a constant state. The pinned
end enters through its multiplier nu, which the sweep carries as a parameter: the cost-to-go from knot k is

    V_k(y, nu) = 1/2 y' P y + p' y + nu' (E y + e) - 1/2 nu' W nu,          y = (dx, dh)

so that hard end states need no penalty: two small solves at knot 0 give dh and nu. All arrays have the
batch on the last axis.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rtcd_jax.numerics.batched import mm, mtm, mtv, mv, spd_solve


class Subproblem(NamedTuple):
    """The quadratic model above."""

    hessians: Float[Array, "N w w P"]
    gradients: Float[Array, "N w P"]
    jacobians: Float[Array, "N n w P"]
    defects: Float[Array, "N n P"]
    curvature: Float[Array, " P"]
    slope: Float[Array, " P"]


class Step(NamedTuple):
    """Its solution. `multipliers[k]` belongs to the constraint on dx_{k+1}; `convex` is false where a pivot failed."""

    dxs: Float[Array, "N+1 n P"]
    dus: Float[Array, "N m P"]
    dh: Float[Array, " P"]
    multipliers: Float[Array, "N n P"]
    convex: Bool[Array, " P"]


class _Value(NamedTuple):
    quadratic: Float[Array, "y y P"]
    linear: Float[Array, "y P"]
    end: Float[Array, "n y P"]
    end_offset: Float[Array, "n P"]
    end_curvature: Float[Array, "n n P"]
    convex: Bool[Array, " P"]


def solve(problem: Subproblem, floor: float = 1e-12) -> Step:
    """Solve the KKT system in O(N); pivots at or below `floor` clear the flag `convex`."""
    n, batch = problem.defects.shape[1:]
    y = n + 1
    dtype = problem.defects.dtype
    keep_step = jnp.zeros((1, problem.gradients.shape[1], batch), dtype).at[0, n].set(1.0)

    def eliminate_input(value: _Value, stage):
        hessian, gradient, jacobian, defect = stage
        flow = jnp.concatenate([jacobian, keep_step])
        curvature = hessian + mtm(flow, mm(value.quadratic, flow))
        slope = gradient + mtv(flow, mv(value.quadratic[:, :n], defect) + value.linear)
        end = mm(value.end, flow)
        right = jnp.concatenate([curvature[y:, :y], slope[y:, None], jnp.swapaxes(end[:, y:], 0, 1)], 1)
        solution, convex = spd_solve(curvature[y:, y:], right, floor)
        gain, offset, gain_end = -solution[:, :y], -solution[:, y], -solution[:, y + 1 :]
        quadratic = curvature[:y, :y] + mtm(curvature[y:, :y], gain)
        before = _Value(
            quadratic=0.5 * (quadratic + jnp.swapaxes(quadratic, 0, 1)),
            linear=slope[:y] + mtv(curvature[y:, :y], offset),
            end=end[:, :y] + mm(end[:, y:], gain),
            end_offset=value.end_offset + mv(value.end[:, :n], defect) + mv(end[:, y:], offset),
            end_curvature=value.end_curvature - mm(end[:, y:], gain_end),
            convex=value.convex & convex,
        )
        return before, (gain, offset, gain_end, value.quadratic[:n], value.linear[:n], value.end[:, :n])

    last = _Value(
        quadratic=jnp.zeros((y, y, batch), dtype),
        linear=jnp.zeros((y, batch), dtype),
        end=jnp.broadcast_to(jnp.eye(n, y, dtype=dtype)[:, :, None], (n, y, batch)),
        end_offset=jnp.zeros((n, batch), dtype),
        end_curvature=jnp.zeros((n, n, batch), dtype),
        convex=jnp.ones((batch,), bool),
    )
    stages = (problem.hessians, problem.gradients, problem.jacobians, problem.defects)
    first, (gains, offsets, gains_end, rows, slopes, ends) = jax.lax.scan(eliminate_input, last, stages, reverse=True)
    dh, nu, convex = _solve_first_knot(first, problem, floor)

    def roll(dx, stage):
        gain, offset, gain_end, jacobian, defect = stage
        du = mv(gain[:, :n], dx) + gain[:, n] * dh + offset + mv(gain_end, nu)
        after = mv(jacobian[:, :n], dx) + jacobian[:, n] * dh + mv(jacobian[:, y:], du) + defect
        return after, (after, du)

    start = jnp.zeros((n, batch), dtype)
    _, (dxs, dus) = jax.lax.scan(roll, start, (gains, offsets, gains_end, problem.jacobians, problem.defects))
    multipliers = (
        jnp.sum(rows[:, :, :n] * dxs[:, None], 2) + rows[:, :, n] * dh + slopes + jnp.sum(ends * nu[None, :, None], 1)
    )
    # The sweep meets the pinned end up to rounding, which would add up over the iterations.
    pinned = jnp.concatenate([start[None], dxs[:-1], start[None]])
    return Step(pinned, dus, dh, multipliers, convex)


def _solve_first_knot(first: _Value, problem: Subproblem, floor: float):
    """dh and nu from stationarity in both: the 2 x 2 block system eliminated through W."""
    n = first.end.shape[0]
    by_step = first.end[:, n]
    solution, independent = spd_solve(first.end_curvature, jnp.stack([by_step, first.end_offset], 1), floor)
    pivot = first.quadratic[n, n] + problem.curvature + jnp.sum(by_step * solution[:, 0], 0)
    convex = first.convex & independent & (pivot > floor)
    residual = -first.linear[n] - problem.slope - jnp.sum(by_step * solution[:, 1], 0)
    dh = residual / jnp.where(pivot > floor, pivot, 1.0)
    return dh, solution[:, 0] * dh + solution[:, 1], convex
