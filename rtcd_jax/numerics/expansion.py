"""Derivatives of one Runge-Kutta step and its cost, assembled from the derivatives of the differential equation.

With k_i = h f(x_i, u), x_i = x + c_i k_{i-1} and Phi = x + (k_1 + 2 k_2 + 2 k_3 + k_4)/6, let Y_i be the derivative of
(x_i, u) by z = (x, h, u), and mu_i the derivative of lambda' Phi by k_i. Then

    d k_i = h (f_x f_u) Y_i + f e_h',   g_i = Y_i' (f_x f_u)' mu_i,
    H = sum_i  Y_i' (h sum_j mu_ij f_j,zz) Y_i + g_i e_h' + e_h g_i'

since k is linear in h and x_i in the k. Automatic differentiation is used on f alone, entry by entry: on a whole step
it makes a program of five times the time for four states.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from rtcd_jax.numerics.entries import Entry, Matrix, Row, dot, held, known, plus, times, unstacked

WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)
REACH = (0.0, 0.5, 0.5, 1.0)
"""c_i: how far along k_{i-1} stage i is evaluated."""


class Expansion(NamedTuple):
    """Of one interval in z = (x, h, u): slopes of Phi, of the cost, the lower half of the curvature of
    the cost plus lambda' Phi."""

    jacobian: Matrix
    gradient: Row
    hessian: Matrix


class Differentiated:
    """f(x, u, parameters) on tuples of components with its first and second derivatives, known numbers folded."""

    def __init__(self, f: Callable, n: int, m: int, parameters: PyTree):
        self.n, self.f = n, lambda z, p: f(z[:n], z[n:], p)
        p = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[:-1], leaf.dtype), parameters)
        one = jax.ShapeDtypeStruct((), jax.tree.leaves(parameters)[0].dtype)
        z = (one,) * (n + m)
        weights = (one,) * len(jax.eval_shape(self.f, z, p))
        self.known_slopes = known(self._slopes, z, p)
        self.known_curvature = known(self._curvature, z, weights, p)

    def slopes(self, z: tuple[Entry, ...], p: PyTree) -> Matrix:
        """df_i/dz_j."""
        return _fold(self._slopes(z, p), self.known_slopes)

    def curvature(self, z: tuple[Entry, ...], weights: tuple[Entry, ...], p: PyTree) -> Matrix:
        """The second derivatives of weights' f."""
        return _fold(self._curvature(z, weights, p), self.known_curvature)

    def _slopes(self, z, p) -> Matrix:
        columns = _partials(lambda z: self.f(z, p), z)
        return [list(row) for row in zip(*columns, strict=True)]

    def _curvature(self, z, weights, p) -> list[tuple[Entry, ...]]:
        def gradient(z):
            total, pull = jax.vjp(lambda z: sum(w * f for w, f in zip(weights, self.f(z, p), strict=True)), z)
            return pull(jnp.ones_like(total))[0]

        return _partials(gradient, z)


def _partials(f: Callable, z) -> list:
    """df/dz_j for every j; what does not depend on z_j is a zero that `known` recognizes."""

    def along(j):
        return jax.jvp(lambda zj: f((*z[:j], zj, *z[j + 1 :])), (z[j],), (jnp.ones(z[j].shape, z[j].dtype),))[1]

    return [along(j) for j in range(len(z))]


def _fold(matrix, numbers) -> Matrix:
    numbers = iter(numbers)
    return [[e if (number := next(numbers)) is None else number for e in row] for row in matrix]


def expander(rate: Callable, running: Callable, n: int, m: int, parameters: PyTree) -> Callable:
    """`expand(x, u, h, multipliers, parameters) -> Expansion` of one step, for tuples of components.

    The batch is the last axis of every parameter. `rate(x, u, parameters)` is f, as an array or a tuple; the step costs
    h `running(x, u, parameters)`.
    """
    f = Differentiated(unstacked(rate), n, m, parameters)
    cost = Differentiated(lambda x, u, p: (running(x, u, p),), n, m, parameters)

    def expand(x, u, h, multipliers, p) -> Expansion:
        jacobian, stages = _forward(f, x, u, h, p)
        hessian = _backward(f, stages, u, h, multipliers, p)
        z = (*x, *u)
        (slope,) = cost.slopes(z, p)
        price = cost.f(z, p)[0]
        curvature = [[times(h, e) for e in row] for row in cost.curvature(z, (jnp.ones_like(price),), p)]
        gradient = [times(h, e) for e in slope]
        hessian = _plus(hessian, _with_step(curvature, slope, n))
        return Expansion(jacobian, [*gradient[:n], price, *gradient[n:]], hessian)

    return expand


def _forward(f: Differentiated, x, u, h, p):
    """The step's slopes, and z_i, f_z, Y_i of every stage."""
    n, m = f.n, len(u)
    eye: Matrix = [[float(i == j) for j in range(n + 1 + m)] for i in range(n + 1 + m)]
    place, motion, stages, increments = x, eye[:n], [], []
    for reach in (*REACH[1:], None):
        z, by_z = (*place, *u), motion + eye[n + 1 :]
        slopes, rates = held((f.slopes(z, p), f.f(z, p)), jnp.sign(h))
        stages.append((z, slopes, by_z))
        columns = list(zip(*by_z, strict=True))
        increment = [[times(h, dot(row, column)) for column in columns] for row in slopes]
        for row, r in zip(increment, rates, strict=True):
            row[n] = plus(row[n], r)
        increments.append(increment)
        if reach is not None:
            place = [a + reach * h * r for a, r in zip(x, rates, strict=True)]
            motion = _plus(eye[:n], _scaled(increment, reach))
    return _plus(eye[:n], *(_scaled(k, w) for k, w in zip(increments, WEIGHTS, strict=True))), stages


def _backward(f: Differentiated, stages, u, h, multipliers, p) -> Matrix:
    n = f.n
    hessian: Matrix = []
    reached = [0.0] * n
    for (z, slopes, by_z), weight, reach in zip(stages[::-1], WEIGHTS[::-1], (0.0, *REACH[:0:-1]), strict=True):
        mu = tuple(plus(weight * lam, times(reach, r)) for lam, r in zip(multipliers, reached, strict=True))
        pull = [dot(mu, column) for column in zip(*slopes, strict=True)]
        inner = [[times(h, e) for e in row] for row in f.curvature(z, mu, p)]
        pull, inner = held((pull, inner), jnp.sign(h))
        reached = [times(h, e) for e in pull[:n]]
        columns = list(zip(*by_z, strict=True))
        half = [[dot(row, column) for column in columns] for row in inner]
        mixed = [dot(pull, column) for column in columns]
        outer = [
            [plus(dot(a, [row[j] for row in half]), *_step_terms(i, j, mixed, n)) for j in range(i + 1)]
            for i, a in enumerate(columns)
        ]
        hessian = _plus(hessian, outer) if hessian else outer
    return hessian


def _step_terms(i, j, mixed, n):
    """(g e_h' + e_h g')_ij."""
    return [mixed[j] if i == n else 0.0, mixed[i] if j == n else 0.0]


def _with_step(curvature: Matrix, slope: Row, n: int) -> Matrix:
    """The lower half of the Hessian of h c(x, u) in (x, h, u) from h c_zz and c_z."""
    rows = [[*row[:n], s, *row[n:]] for row, s in zip(curvature, slope, strict=True)]
    rows = [*rows[:n], [*slope[:n], 0.0, *slope[n:]], *rows[n:]]
    return [row[: i + 1] for i, row in enumerate(rows)]


def _scaled(matrix: Matrix, factor: float) -> Matrix:
    return [[times(factor, e) for e in row] for row in matrix]


def _plus(*matrices: Matrix) -> Matrix:
    return [[plus(*entries) for entries in zip(*rows, strict=True)] for rows in zip(*matrices, strict=True)]
