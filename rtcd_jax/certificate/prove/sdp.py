"""The semidefinite program behind one obligation: the Gram certificate with the largest margin, in float64.

maximize t  such that, for every Bernstein index j and modulo |y|^2 = 1,

    p_j(y) - error - t = z'G_j z + sum_i (sigma_i g_i)_j(y),    G_j >= 0,
    sigma_i = sum_a B_a(s) z'S_ia z,    S_ia >= 0

(check has the theorem). The time s stays outside the Gram matrices, and the sphere makes them small: with monomials
up to degree 3, 7 rows for two states and 30 for four. What is of higher degree is mostly one in the angles, for
which a few `further` monomials of z are enough; what no product of theirs has counts as error. cvxpy states the program
once a shape, with p and g as its parameters, and hands it to any solver that is installed: the exact checker decides
what a solution is worth.
"""

import contextlib
import itertools
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple, cast, final

import numpy as np
import scipy.sparse as sp

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import GramCertificate, Obligation, Q, Squares
from rtcd_jax.system.errors import UserError

if TYPE_CHECKING:
    import cvxpy as cp

SOLVER = "CLARABEL"
"""By cvxpy's name."""
OPTIONS: dict[str, dict[str, Any]] = {
    "CLARABEL": {
        "tol_gap_abs": 1e-7, "tol_gap_rel": 1e-7, "tol_feas": 1e-9, "max_threads": 1, "presolve_enable": False,
    },
    "SCS": {"eps_abs": 1e-7, "eps_rel": 1e-7, "max_iters": 20_000},
}  # fmt: skip
"""Of solvers whose own tolerances leave margins of thousandths no room."""
GRID = 30
"""Gram certificates are rounded to multiples of 2^-30, so that files and the checker's integers stay short."""
LIFT = 2.0**-24
"""Added to every diagonal: the solver's matrices are positive definite up to its tolerance only."""
SAMPLED_TIMES = 7


Monomials = tuple[tuple[int, ...], ...]
"""Exponents of y."""


class Shape(NamedTuple):
    """Sizes of a program: states, degree of z, Bernstein degrees of the whole and of the multipliers, constraints; and
    the monomials of z beyond its degree.
    """

    n: int
    degree: int
    bernstein: int
    multiplier: int
    constraints: int
    further: Monomials = ()

    @property
    def basis(self) -> Monomials:
        """z."""
        return (*check.monomials(self.n, self.degree), *self.further)


class Data(NamedTuple):
    """Coefficients of p - error [j, monomial] and of every g_i [i, b, monomial of degree 1]."""

    p: np.ndarray
    g: np.ndarray


@final
@dataclass(frozen=True)
class Solution:
    """Margin t and, if it is positive, the squares behind it; not proved before the checker accepts them."""

    margin: float
    squares: Squares | None = None


@lru_cache(None)
def _products(basis: Monomials, degree: int) -> Monomials:
    """All monomials up to the degree, then those beyond that products of the basis have on the sphere."""
    n = len(basis[0])
    pairs = itertools.combinations_with_replacement(basis, 2)
    found = {e for pair in pairs for e, _ in check.reduced(tuple(map(sum, zip(*pair, strict=True))))}
    usual = check.monomials(n, degree)
    return (*usual, *sorted(found - set(usual)))


@lru_cache(None)
def _index(monomials: Monomials) -> dict[tuple[int, ...], int]:
    return {e: i for i, e in enumerate(monomials)}


@lru_cache(None)
def _product_map(basis: Monomials, products: Monomials, side: int) -> sp.csc_matrix:
    """Coefficients, by `products`, of (z'G z) m on the sphere, from the entries of G, row by row: those of the first
    monomial m up to the degree `side`, then those of the next one.
    """
    index = _index(products)
    rows, columns, values = [], [], []
    for block, m in enumerate(check.monomials(len(basis[0]), side)):
        for column, (first, second) in enumerate(itertools.product(basis, basis)):
            for e, k in check.reduced(tuple(map(sum, zip(first, second, m, strict=True)))):
                rows.append(block * len(index) + index[e])
                columns.append(column)
                values.append(k)
    shape = len(check.monomials(len(basis[0]), side)) * len(index), len(basis) ** 2
    return sp.csc_matrix((np.array(values, float), (rows, columns)), shape=shape)


def of_the_angles(n: int, angles: int, degree: int) -> Monomials:
    """The monomials of the next degree that have at most one power of others than the first y, by which the angles
    are.
    """
    return tuple(e for e in check.monomials(n, degree + 1) if sum(e) > degree and sum(e[:angles]) >= degree)


def shape_of(todo: Obligation, degree: int, bernstein: int, multiplier: int, further: Monomials = ()) -> Shape:
    n = len(next(iter(check.terms_of(todo.p)))[0]) - 1
    return Shape(n, degree, bernstein, multiplier, len(todo.where), further)


def data_of(todo: Obligation, shape: Shape) -> Data:
    """The obligation in floats."""
    span = todo.low, todo.high
    parts, cut = check.bernstein(todo.p, shape.bernstein, *span)
    p, lost = _floats(parts, _products(shape.basis, 2 * shape.degree))
    p[:, 0] -= float(todo.error + cut) + lost
    side, rest = check.monomials(shape.n, 1), shape.bernstein - shape.multiplier
    g = [_floats(check.condition(each, shape.n, rest, *span), side)[0] for each in todo.where]
    return Data(p, np.array(g).reshape(len(g), rest + 1, len(side)))


def _floats(parts: list[dict], monomials: Monomials) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients [j, monomial] of polynomials, and bounds [j] of what other monomials have."""
    index = _index(monomials)
    table, others = np.zeros((len(parts), len(index))), np.zeros(len(parts))
    for j, part in enumerate(parts):
        for e, c in part.items():
            if e in index:
                table[j, index[e]] = float(c)
            else:
                others[j] += abs(float(c)) * float(check.peak(e))
    return table, others


def lowest(data: Data, shape: Shape, y: np.ndarray) -> float:
    """The least p - error over sampled times and those directions y [n D] where all g >= 0: no margin is larger."""
    powers = _powers(_products(shape.basis, 2 * shape.degree), y)
    p, conditions = data.p @ powers, [g @ powers[: g.shape[1]] for g in data.g]
    least = np.inf
    for t in np.linspace(0, 1, SAMPLED_TIMES):
        holds = np.ones(y.shape[1], bool)
        for g in conditions:
            holds &= _weights(len(g) - 1, t) @ g >= 0
        least = min(least, float(np.min((_weights(len(p) - 1, t) @ p)[holds], initial=np.inf)))
    return least


def _powers(monomials: Monomials, y: np.ndarray) -> np.ndarray:
    """Monomials [M D] at the directions y [n D]."""
    highest = max(map(max, monomials))
    table = np.cumprod(np.concatenate([np.ones((1, *y.shape)), np.repeat(y[None], highest, axis=0)]), axis=0)
    return np.array([np.prod([table[e, i] for i, e in enumerate(m)], axis=0) for m in monomials])


def _weights(degree: int, t: float) -> np.ndarray:
    """The Bernstein polynomials at t in [0, 1]."""
    return np.array([math.comb(degree, j) * t**j * (1 - t) ** (degree - j) for j in range(degree + 1)])


@final
class Program:
    """The program of a shape, a `problem` of cvxpy's, with the solution for the data that were given last."""

    def __init__(self, shape: Shape):
        import cvxpy as cp

        def positive(basis: Monomials) -> "cp.Variable":
            return cp.Variable((len(basis), len(basis)), PSD=True)

        parts, high, rest = shape.bernstein + 1, shape.multiplier, shape.bernstein - shape.multiplier
        products, lower = _products(shape.basis, 2 * shape.degree), check.monomials(shape.n, shape.degree - 1)
        gram, sides = _product_map(shape.basis, products, 0), _product_map(lower, products, 1)
        size, side = len(products), len(check.monomials(shape.n, 1))
        self._p = cp.Parameter((parts, size))
        self._g = [cp.Parameter((rest + 1, side)) for _ in range(shape.constraints)]
        self._gram = [positive(shape.basis) for _ in range(parts)]
        self._multipliers = [[positive(lower) for _ in range(high + 1)] for _ in self._g]
        t = cp.Variable()
        sums: list[Any] = [gram @ cp.vec(each, order="C") + t * np.eye(size)[0] for each in self._gram]
        for g, multipliers in zip(self._g, self._multipliers, strict=True):
            for a, sigma in enumerate(multipliers):
                weighted = cp.reshape(sides @ cp.vec(sigma, order="C"), (size, side), order="F") @ g.T
                for b in range(rest + 1):
                    weight = math.comb(high, a) * math.comb(rest, b) / math.comb(high + rest, a + b)
                    sums[a + b] += weight * weighted[:, b]
        self._shape = shape
        self.problem = cp.Problem(cp.Maximize(t), [each == self._p[j] for j, each in enumerate(sums)])

    def margin(self, data: Data, solver: str = SOLVER) -> float:
        """The largest margin; -inf where the solver finds none."""
        import cvxpy as cp

        self._p.value = data.p
        for parameter, value in zip(self._g, data.g, strict=True):
            parameter.value = value
        # The checker decides. For all threads: a filter of one thread's own is not known before Python 3.14.
        warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)
        try:
            self.problem.solve(solver=solver, warm_start=False, **OPTIONS.get(solver, {}))
        except cp.SolverError:
            return -math.inf
        solved = self.problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
        return float(cast(float, self.problem.value)) if solved else -math.inf

    def certificate(self) -> GramCertificate:
        """The solution as exact matrices on the grid, lifted to be positive definite."""
        multipliers = [[_exact(each.value) for each in of_one] for of_one in self._multipliers]
        gram = [_exact(each.value) for each in self._gram]
        return GramCertificate(self._shape.degree, gram, multipliers, self._shape.further)


_FREE: dict[Shape, list[Program]] = {}


@contextlib.contextmanager
def program_of(shape: Shape) -> Iterator[Program]:
    """The program of a shape for one thread, stated anew only where all that there are of it are in use: the large
    ones have 0.4 GB.
    """
    free = _FREE.setdefault(shape, [])
    try:
        program = free.pop()
    except IndexError:
        program = Program(shape)
    try:
        yield program
    finally:
        free.append(program)


def solve(data: Data, shape: Shape, solver: str = SOLVER) -> Solution:
    """The best Gram certificate by a solver of cvxpy's."""
    with program_of(shape) as program:
        margin = program.margin(data, solver)
        return Solution(margin, program.certificate() if margin > 0 else None)


def require_solver(name: str) -> str:
    """The name as cvxpy has it. Raises UserError unless it is installed and solves semidefinite programs."""
    import cvxpy as cp

    smallest = cp.Problem(cp.Minimize(cp.trace(cp.Variable((2, 2), PSD=True))))
    able = []
    for each in cp.installed_solvers():
        with contextlib.suppress(cp.SolverError):
            smallest.get_problem_data(each)
            able.append(each)
    if name.upper() not in able:
        raise UserError(
            f"--solver = {name}: must be one of {', '.join(able)}, which are installed and solve semidefinite programs"
        )
    return name.upper()


def _exact(matrix: Any) -> list[list]:
    lift = max(LIFT, LIFT - float(np.linalg.eigvalsh(matrix)[0]))
    grid = np.rint((matrix + lift * np.eye(len(matrix))) * 2.0**GRID)
    return [[Q(int(c), 1 << GRID) for c in row] for row in grid]
