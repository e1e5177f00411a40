"""The continuous-time Riccati equation through the flow of its Hamiltonian system.

    -S' = A'S + S A - S G S + Q,        G = B R^-1 B'

The state x and the costate S x of the optimal feedback obey a linear system. Over a time interval its solution is

    x(end) = A x(start) - G p(end),     p(start) = Q x(start) + A' p(end)

with an `Interval` (A, G, Q); G and Q are positive semidefinite. Two neighboring intervals compose to one, and the
value at an interval's end maps to its start by S -> Q + A'S (I + G S)^-1 A. Nothing of this is stiff: gains of any
size, for which an explicit integrator of the Riccati equation blows up, stay positive definite (Davison and Maki
1973; the doubling of equal intervals is the structured doubling algorithm, Chu, Fan, Lin, Wang 2004).
Matrices have their two axes first and are elementwise over all axes behind them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from rtcd_jax.numerics.batched import cholesky, mm, mtm, solve_lower, transpose

SHORT = 1 / 32
"""Duration of a short interval over the time constant of the fastest mode: its third-order series is off by 5e-6."""

PERIODIC = 1e-8
"""Largest change of a periodic solution over one period, over its largest entry."""


class Interval(NamedTuple):
    """The Hamiltonian flow over one time interval; `definite` is false where a factorization failed."""

    transition: Float[Array, "n n *batch"]
    spread: Float[Array, "n n *batch"]
    cost: Float[Array, "n n *batch"]
    definite: Bool[Array, "*batch"]


def _identity(like):
    eye = jnp.eye(like.shape[0], dtype=like.dtype)
    return eye.reshape(*eye.shape, *(1,) * (like.ndim - 2))


def _symmetric(a):
    return 0.5 * (a + transpose(a))


def _damped(value, spread):
    """S (I + G S)^-1 = C (I + C'G C)^-1 C' with S = C C', and whether both factorizations exist."""
    factor, positive = cholesky(value)
    inner, definite = cholesky(_identity(value) + mtm(factor, mm(spread, factor)))
    root = solve_lower(inner, transpose(factor))
    return mtm(root, root), positive & definite


def compose(early: Interval, late: Interval) -> Interval:
    """The interval that covers both; `late` starts where `early` ends."""
    damped, definite = _damped(late.cost, early.spread)  # Q2 (I + G1 Q2)^-1
    through = early.transition - mm(early.spread, mm(damped, early.transition))  # (I + G1 Q2)^-1 A1
    narrowed = early.spread - mm(early.spread, mm(damped, early.spread))  # (I + G1 Q2)^-1 G1
    return Interval(
        transition=mm(late.transition, through),
        spread=_symmetric(late.spread + mm(late.transition, mm(narrowed, transpose(late.transition)))),
        cost=_symmetric(early.cost + mtm(early.transition, mm(damped, early.transition))),
        definite=early.definite & late.definite & definite,
    )


def propagate(
    interval: Interval, value: Float[Array, "n n *batch"]
) -> tuple[Float[Array, "n n *batch"], Bool[Array, "*batch"]]:
    """S at the interval's start from S at its end, and whether it stayed positive definite."""
    damped, definite = _damped(value, interval.spread)
    before = interval.cost + mtm(interval.transition, mm(damped, interval.transition))
    return _symmetric(before), definite & interval.definite


def mapped(interval: Interval, jump: Float[Array, "n n *batch"]) -> Interval:
    """The interval at whose end x jumps to J x, where no input acts and nothing is charged."""
    return interval._replace(
        transition=mm(jump, interval.transition), spread=_symmetric(mm(jump, mm(interval.spread, transpose(jump))))
    )


def short_interval(
    a: Float[Array, "n n *batch"],
    spread: Float[Array, "n n *batch"],
    cost: Float[Array, "n n *batch"],
    duration: Float[ArrayLike, "*#batch"],
) -> Interval:
    """The flow of constant A, G, Q over a `duration` short against the system's fastest mode.

    Taylor series of the interval's own Riccati equations to the third order in `duration`.
    """
    at = transpose(a)
    q1, g1 = cost, spread
    q2 = mm(at, cost) + mm(cost, a)
    g2 = mm(a, spread) + mm(spread, at)
    gq, qg = mm(spread, cost), mm(cost, spread)
    q3 = mm(at, q2) + mm(q2, a) - 2 * mm(cost, gq)
    g3 = mm(a, g2) + mm(g2, at) - 2 * mm(spread, qg)
    a2 = mm(a, a) - gq
    a3 = mm(a, a2) - mm(g2, cost) - 2 * mm(gq, a)
    t = jnp.asarray(duration, a.dtype)
    tt, ttt = t**2 / 2, t**3 / 6
    return Interval(
        transition=_identity(a) + t * a + tt * a2 + ttt * a3,
        spread=t * g1 + tt * g2 + ttt * g3,
        cost=t * q1 + tt * q2 + ttt * q3,
        definite=jnp.ones(a.shape[2:], bool),
    )


def constant_interval(
    a: Float[Array, "n n *batch"],
    spread: Float[Array, "n n *batch"],
    cost: Float[Array, "n n *batch"],
    duration: Float[ArrayLike, "*#batch"],
    doublings: Int[Array, ""] | int,
) -> Interval:
    """The flow of constant A, G, Q over `duration`, from 2^doublings equal short intervals."""
    return _double(short_interval(a, spread, cost, duration / 2.0**doublings), doublings)


def enough_doublings(
    a: Float[Array, "n n *batch"],
    spread: Float[Array, "n n *batch"],
    cost: Float[Array, "n n *batch"],
    duration: Float[ArrayLike, "*#batch"],
    most: int,
) -> Int[Array, ""]:
    """Doublings of `constant_interval` with which the fastest mode of the whole batch is resolved, `most` at most."""
    wanted = jnp.ceil(jnp.log2(jnp.max(_fastest(a, spread, cost) * duration) / SHORT))
    return jnp.where(jnp.isfinite(wanted), jnp.clip(wanted, 0, most), most).astype(int)


def _fastest(a, spread, cost):
    """A bound of the rates of the Hamiltonian system, in which A is |A|, and G and Q are sqrt(|G| |Q|)."""
    norm = jnp.sqrt(jnp.sum(spread**2, (0, 1)) * jnp.sum(cost**2, (0, 1))) ** 0.5
    return norm + jnp.sqrt(jnp.sum(a**2, (0, 1)))


def _double(interval: Interval, times: Int[Array, ""] | int) -> Interval:
    return jax.lax.fori_loop(0, times, lambda _, interval: compose(interval, interval), interval)


def periodic(period: Interval, doublings: int = 10) -> tuple[Float[Array, "n n *batch"], Bool[Array, "*batch"]]:
    """The stabilizing solution S = Q + A'S (I + G S)^-1 A at the start of a period without end, and whether it was
    reached; it is not where what repeats cannot be stabilized.
    """
    value = _double(period, doublings).cost
    before, definite = propagate(period, value)
    reached = jnp.max(jnp.abs(before - value), (0, 1)) <= PERIODIC * jnp.max(jnp.abs(value), (0, 1))
    return value, definite & reached


def infinite_horizon(
    a: Float[Array, "n n *batch"],
    spread: Float[Array, "n n *batch"],
    cost: Float[Array, "n n *batch"],
    doublings: int = 48,
) -> tuple[Float[Array, "n n *batch"], Bool[Array, "*batch"]]:
    """The stabilizing solution of the algebraic equation A'S + S A - S G S + Q = 0, and whether it was reached.

    The horizon doubles until further time changes nothing: convergence is quadratic for stabilizable (A, B), Q > 0.
    """
    interval = short_interval(a, spread, cost, 2e-4 / _fastest(a, spread, cost))
    interval = _double(interval, doublings)
    value = interval.cost
    residual = mtm(a, value) + mm(value, a) - mm(value, mm(spread, value)) + cost
    scale = jnp.max(jnp.abs(cost), (0, 1)) + jnp.max(jnp.abs(mtm(a, value)), (0, 1))
    reached = jnp.max(jnp.abs(residual), (0, 1)) <= 1e-6 * scale
    return value, interval.definite & reached
