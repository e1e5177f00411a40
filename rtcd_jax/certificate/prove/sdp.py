"""The semidefinite program behind one obligation: the Gram certificate with the largest margin, in float64.

maximize t  such that, for every Bernstein index j and modulo |y|^2 = 1,

    p_j(y) - error - t = z'G_j z + sum_i (sigma_i g_i)_j(y),    G_j >= 0,
    sigma_i = sum_a B_a(s) z'S_ia z,    S_ia >= 0

(check has the theorem). The time s stays outside the Gram matrices, and the sphere makes them small: with monomials
up to degree 3, 7 rows for two states and 30 for four. `solve` hands the program to Clarabel.
"""

# pyright: reportAttributeAccessIssue=false, reportOptionalSubscript=false
# (clarabel ships no types for its native module, scipy says that shapes may be None.)

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple, final

import numpy as np
import scipy.sparse as sp

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import GramCertificate, Obligation, Q

GRID = 44
"""Gram certificates are rounded to multiples of 2^-44, so that the checker's integers stay short."""
LIFT = 2.0**-36
"""Added to every diagonal: the solver's matrices are positive definite up to its tolerance only."""
SAMPLED_TIMES = 7
SQRT2 = math.sqrt(2)


class Shape(NamedTuple):
    """Sizes of a program: states, degree of z, Bernstein degrees of the whole and of the multipliers, constraints."""

    n: int
    degree: int
    bernstein: int
    multiplier: int
    constraints: int


class Data(NamedTuple):
    """Coefficients of p - error [j, monomial] and of every g_i [i, b, monomial of degree 1]."""

    p: np.ndarray
    g: np.ndarray


@final
@dataclass(frozen=True)
class Solution:
    """Margin t and the matrices G_j, S_ia behind it; not proved before the checker accepts them."""

    margin: float
    certificate: GramCertificate


@lru_cache(None)
def _index(n: int, degree: int) -> dict[tuple[int, ...], int]:
    return {e: i for i, e in enumerate(check.monomials(n, degree))}


@lru_cache(None)
def _product_map(n: int, degree: int, side: int, up_to: int) -> list[sp.csc_matrix]:
    """For every monomial m up to `side`: coefficients of (z'G z) m by monomials up to `up_to`.

    They multiply G as a scaled upper triangle by columns.
    """
    basis, index, maps = check.monomials(n, degree), _index(n, up_to), []
    for m in check.monomials(n, side):
        rows, columns, values = [], [], []
        for column, (i, j) in enumerate(_triangle(len(basis))):
            exponents = tuple(map(sum, zip(basis[i], basis[j], m, strict=True)))
            for e, k in check.reduced(exponents):
                rows.append(index[e])
                columns.append(column)
                values.append(k * (1.0 if i == j else SQRT2))
        size = len(basis) * (len(basis) + 1) // 2
        maps.append(sp.csc_matrix((values, (rows, columns)), shape=(len(index), size)))
    return maps


@lru_cache(None)
def _triangle(rows: int) -> tuple[tuple[int, int], ...]:
    """The upper triangle by columns, as Clarabel orders it."""
    return tuple((i, j) for j in range(rows) for i in range(j + 1))


def shape_of(todo: Obligation, degree: int, bernstein: int, multiplier: int) -> Shape:
    n = len(next(iter(check.terms_of(todo.p)))[0]) - 1
    return Shape(n, degree, bernstein, multiplier, len(todo.where))


def data_of(todo: Obligation, shape: Shape) -> Data:
    """The obligation in floats.

    Raises:
        Refused: its orders in s exceed the Bernstein degrees.
        KeyError: its degree in y exceeds 2 `degree`.
    """
    p = _floats(todo.p, todo, shape.bernstein, _index(shape.n, 2 * shape.degree))
    p[:, 0] -= float(todo.error)
    width, side = shape.bernstein - shape.multiplier + 1, _index(shape.n, 1)
    g = [_floats(each, todo, shape.bernstein - shape.multiplier, side) for each in todo.where]
    return Data(p, np.array(g).reshape(len(g), width, len(side)))


def _floats(p, todo: Obligation, degree: int, index: dict) -> np.ndarray:
    parts = check.bernstein(p, degree, todo.low, todo.high, "program")
    table = np.zeros((degree + 1, len(index)))
    for row, part in zip(table, parts, strict=True):
        for e, c in part.items():
            row[index[e]] = float(c)
    return table


def _multiplier_blocks(shape: Shape, g: np.ndarray) -> list[list[sp.csc_matrix]]:
    """[constraint][a]: the coefficients of B_a z'S z g_i in all Bernstein parts, stacked, by the triangle of S."""
    maps = _product_map(shape.n, shape.degree - 1, 1, 2 * shape.degree)
    high, rest = shape.multiplier, shape.bernstein - shape.multiplier
    blocks = []
    for each in g:
        parts = [sum((m * c for m, c in zip(maps, row, strict=True)), 0 * maps[0]) for row in each]
        column = []
        for a in range(high + 1):
            stack: list[Any] = [0 * maps[0]] * (shape.bernstein + 1)
            for b, part in enumerate(parts):
                stack[a + b] = part * (math.comb(high, a) * math.comb(rest, b) / math.comb(high + rest, a + b))
            column.append(sp.vstack(stack, format="csc"))
        blocks.append(column)
    return blocks


def lowest(data: Data, shape: Shape, y: np.ndarray) -> float:
    """The least p - error over sampled times and those directions y [n D] where all g >= 0: no margin is larger."""
    powers = _powers(shape.n, 2 * shape.degree, y)
    p, conditions = data.p @ powers, [g @ powers[: g.shape[1]] for g in data.g]
    least = np.inf
    for t in np.linspace(0, 1, SAMPLED_TIMES):
        holds = np.ones(y.shape[1], bool)
        for g in conditions:
            holds &= _weights(len(g) - 1, t) @ g >= 0
        least = min(least, float(np.min((_weights(len(p) - 1, t) @ p)[holds], initial=np.inf)))
    return least


def _powers(n: int, degree: int, y: np.ndarray) -> np.ndarray:
    """Monomials [M D] at the directions y [n D]."""
    table = np.cumprod(np.concatenate([np.ones((1, *y.shape)), np.repeat(y[None], degree, axis=0)]), axis=0)
    return np.array([np.prod([table[e, i] for i, e in enumerate(m)], axis=0) for m in check.monomials(n, degree)])


def _weights(degree: int, t: float) -> np.ndarray:
    """The Bernstein polynomials at t in [0, 1]."""
    return np.array([math.comb(degree, j) * t**j * (1 - t) ** (degree - j) for j in range(degree + 1)])


def solve(data: Data, shape: Shape) -> Solution | None:
    """The best Gram certificate by Clarabel; None where the solver has none, or no positive margin."""
    import clarabel

    gram, parts = _product_map(shape.n, shape.degree, 0, 2 * shape.degree)[0], shape.bernstein + 1
    rows, multipliers = gram.shape[0], _multiplier_blocks(shape, data.g)
    constant = np.zeros((rows, 1))
    constant[0] = 1
    blocks = [sp.csc_matrix(np.tile(constant, (parts, 1))), sp.block_diag([gram] * parts)]
    blocks += [block for column in multipliers for block in column]
    equalities = sp.hstack(blocks, format="csc")
    sizes = [len(check.monomials(shape.n, shape.degree))] * parts
    sizes += [len(check.monomials(shape.n, shape.degree - 1))] * (shape.constraints * (shape.multiplier + 1))
    unknowns = equalities.shape[1]
    cone = sp.hstack([sp.csc_matrix((unknowns - 1, 1)), -sp.identity(unknowns - 1)], format="csc")
    cost = np.zeros(unknowns)
    cost[0] = -1
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads, settings.presolve_enable = False, 1, False
    settings.tol_gap_abs = settings.tol_gap_rel = 1e-7
    settings.tol_feas = 1e-9
    cones = [clarabel.ZeroConeT(equalities.shape[0]), *map(clarabel.PSDTriangleConeT, sizes)]
    solution = clarabel.DefaultSolver(
        sp.csc_matrix((unknowns, unknowns)),
        cost,
        sp.vstack([equalities, cone], format="csc"),
        np.concatenate([data.p.ravel(), np.zeros(unknowns - 1)]),
        cones,
        settings,
    ).solve()
    x = np.asarray(solution.x)
    if str(solution.status) not in ("Solved", "AlmostSolved") or not np.all(np.isfinite(x)) or x[0] <= 0:
        return None
    return Solution(float(x[0]), _gram_certificate(shape, x[1:], sizes))


def _gram_certificate(shape: Shape, x: np.ndarray, sizes: list[int]) -> GramCertificate:
    """The solver's triangles as exact matrices on the grid, lifted to be positive definite."""
    ends = np.cumsum([rows * (rows + 1) // 2 for rows in sizes])
    matrices = [_exact(rows, part) for rows, part in zip(sizes, np.split(x, ends[:-1]), strict=True)]
    parts, each = shape.bernstein + 1, shape.multiplier + 1
    rest = matrices[parts:]
    return GramCertificate(shape.degree, matrices[:parts], [rest[i : i + each] for i in range(0, len(rest), each)])


def _exact(rows: int, triangle: np.ndarray) -> list[list]:
    matrix = np.zeros((rows, rows))
    for value, (i, j) in zip(triangle, _triangle(rows), strict=True):
        matrix[i, j] = matrix[j, i] = value if i == j else value / SQRT2
    lift = max(LIFT, LIFT - float(np.linalg.eigvalsh(matrix)[0]))
    grid = np.rint((matrix + lift * np.eye(rows)) * 2.0**GRID)
    return [[Q(int(c), 1 << GRID) for c in row] for row in grid]
