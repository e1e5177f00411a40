"""Positive on the sphere: a sum of squares in exact numbers, by Bernstein polynomials in the time."""

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.exact import Q, require, rounded, up
from rtcd_jax.certificate.check.matrix import dot
from rtcd_jax.certificate.check.taylor import chebyshev, economize, peak, polynomial, terms_of


class Obligation(NamedTuple):
    """To show: q > 0 wherever |y| = 1, s in [low, high] and all of `where` >= 0; q is `p` up to `error`.

    `drift` bounds what does not vanish with l, at the goal: its error is error + drift / l there.
    """

    p: Any
    error: Any
    drift: Any
    where: list
    low: Any
    high: Any


class GramCertificate(NamedTuple):
    """`gram` [j] and `multipliers` [i][a], symmetric matrices: the G_j and S_ia of the theorem's proof.

    Their monomials of y go up to `degree` and `degree` - 1; those of G_j are followed by the `further` ones.
    """

    degree: int
    gram: list
    multipliers: list
    further: tuple[tuple[int, ...], ...] = ()


class Halves(NamedTuple):
    """Of an obligation's two halves in s, the first in time first."""

    first: "Squares"
    second: "Squares"


Squares = GramCertificate | Halves


def halves_of(todo: Obligation) -> tuple[Obligation, Obligation]:
    middle = (todo.low + todo.high) / 2
    return todo._replace(high=middle), todo._replace(low=middle)


@lru_cache(None)
def monomials(n: int, degree: int) -> tuple[tuple[int, ...], ...]:
    """Exponents of y up to `degree`, by degree; on the sphere the last component needs no square."""
    basis = []
    for order in range(degree + 1):
        for chosen in combinations_with_replacement(range(n), order):
            exponents = tuple(chosen.count(i) for i in range(n))
            if exponents[-1] < 2:
                basis.append(exponents)
    return tuple(basis)


@lru_cache(None)
def reduced(exponents: tuple[int, ...]) -> tuple[tuple[tuple[int, ...], int], ...]:
    """y^exponents on the sphere: y_n^2 = 1 - y_1^2 - ... - y_{n-1}^2."""
    if exponents[-1] < 2:
        return ((exponents, 1),)
    rest = (*exponents[:-1], exponents[-1] - 2)
    total = dict(reduced(rest))
    for i in range(len(exponents) - 1):
        for e, c in reduced(tuple(a + 2 * (i == j) for j, a in enumerate(rest))):
            total[e] = total.get(e, 0) - c
    return tuple(total.items())


def expanded(k: int, a, b) -> list:
    """Coefficients of (a + b t)^k."""
    return [math.comb(k, i) * a ** (k - i) * b**i for i in range(k + 1)]


@lru_cache(1000)
def basis_change(order: int, degree: int, low, high) -> tuple:
    """Row k: s^k in the Bernstein polynomials of `degree` on [low, high]."""
    rows = []
    for k in range(order + 1):
        powers = expanded(k, low, high - low)
        rows.append([sum((p * Q(math.comb(j, i), math.comb(degree, i)) for i, p in enumerate(powers[: j + 1])), Q(0))
                     for j in range(degree + 1)])  # fmt: skip
    return tuple(rows)


def bernstein(p, degree: int, low, high) -> tuple[list[dict], Any]:
    """Bernstein coefficients in s, each a polynomial in y on the sphere by exponents, and by how much they may differ
    from p, which they do where its order in s is above their degree.
    """
    terms = terms_of(p)
    order = max((e[0] for e, _ in terms), default=0)
    by_y: dict[tuple[int, ...], list] = {}
    for e, c in terms:
        for f, k in reduced(e[1:]):
            by_y.setdefault(f, [Q(0)] * (order + 1))[e[0]] += c * k
    error = Q(0)
    if order > degree:
        rows = [expanded(k, (low + high) / 2, (high - low) / 2) for k in range(order + 1)]
        low, high = Q(-1), Q(1)
        for f, powers in by_y.items():
            scaled = [sum((powers[k] * rows[k][i] for k in range(i, order + 1)), Q(0)) for i in range(order + 1)]
            by_y[f], cut = economize(scaled, 1, degree)
            error += cut * peak(f)
    columns = list(zip(*basis_change(min(order, degree), degree, low, high), strict=True))
    parts = [{f: dot(powers, column) for f, powers in by_y.items()} for column in columns]
    return parts, error


def condition(g, n: int, degree: int, low, high) -> list[dict]:
    """As `bernstein`, of a polynomial in (s, y [n]) that is not below g: it is >= 0 wherever g is."""
    parts, error = bernstein(g, degree, low, high)
    for part in parts:
        part[(0,) * n] = part.get((0,) * n, 0) + error
    return parts


def is_positive_definite(matrix: Sequence[Sequence]) -> bool:
    """By Sylvester's criterion: all leading minors, from Bareiss' elimination in integers."""
    entries = [c for row in matrix for c in row]
    common = math.lcm(*(int(c.denominator) for c in entries))
    a = [[int(c.numerator) * (common // int(c.denominator)) for c in row] for row in matrix]
    before = 1
    for k in range(len(a)):
        pivot = a[k][k]
        if pivot <= 0:
            return False
        for i in range(k + 1, len(a)):
            left = a[i][k]
            for j in range(i, len(a)):
                a[i][j] = a[j][i] = (pivot * a[i][j] - left * a[k][j]) // before
        before = pivot
    return True


def quadratic(matrix: Sequence[Sequence], basis: Sequence[tuple[int, ...]]) -> dict:
    """z'M z on the sphere, z the monomials of the basis."""
    total: dict = {}
    for i, e in enumerate(basis):
        for j in range(i, len(basis)):
            c = matrix[i][j] * (1 + (i != j))
            for f, k in reduced(tuple(map(sum, zip(e, basis[j], strict=True)))):
                total[f] = total.get(f, 0) + c * k
    return total


def margin(todo: Obligation, squares: Squares, place: str):
    """A lower bound > 0 of q where the obligation asks for it.

    Raises:
        Refused: the squares do not show that.
    """
    if isinstance(squares, Halves):
        halves = zip(halves_of(todo), squares, strict=True)
        return min(margin(half, each, f"{place}[{i}]") for i, (half, each) in enumerate(halves))
    n = len(next(iter(todo.p.to_dict()), (0, 0))) - 1
    basis, sides = (*monomials(n, squares.degree), *squares.further), monomials(n, squares.degree - 1)
    parts, error = bernstein(todo.p, len(squares.gram) - 1, todo.low, todo.high)
    require(len(squares.multipliers) == len(todo.where), place, f"needs {len(todo.where)} multipliers")
    for i, (g, multiplier) in enumerate(zip(todo.where, squares.multipliers, strict=True)):
        _subtract_product(parts, g, multiplier, sides, todo, f"{place}.multipliers[{i}]")
    bound = None
    for j, (part, gram) in enumerate(zip(parts, squares.gram, strict=True)):
        _require_definite(gram, len(basis), f"{place}.gram[{j}]")
        for e, c in quadratic(gram, basis).items():
            part[e] = part.get(e, 0) - c
        lost = sum((abs(c) * peak(e) for e, c in part.items() if any(e)), todo.error + error)
        rest = part.get((0,) * n, Q(0)) - lost
        require(rest > 0, f"{place}.gram[{j}]", f"proves no decrease: at best {rounded(rest):.3g}, must be > 0")
        bound = rest if bound is None else min(bound, rest)
    return bound


def _require_definite(matrix, rows: int, place: str) -> None:
    require(len(matrix) == rows, place, f"has {len(matrix)} rows, must have {rows}")
    require(is_positive_definite(matrix), place, "is not positive definite")


def _subtract_product(parts, g, multiplier, basis, todo: Obligation, place: str) -> None:
    """Takes sigma (g + its error) from the Bernstein coefficients, sigma = sum_a B_a z'S_a z."""
    degree, high = len(parts) - 1, len(multiplier) - 1
    require(0 <= high <= degree, place, f"has {high + 1} matrices, must have 1 to {degree + 1}")
    factors = condition(g, len(basis[0]), degree - high, todo.low, todo.high)
    for a, matrix in enumerate(multiplier):
        _require_definite(matrix, len(basis), f"{place}[{a}]")
        square = quadratic(matrix, basis)
        for b, factor in enumerate(factors):
            weight = Q(math.comb(high, a) * math.comb(degree - high, b), math.comb(degree, a + b))
            part = parts[a + b]
            for e, c in square.items():
                for f, d in factor.items():
                    for h, k in reduced(tuple(map(sum, zip(e, f, strict=True)))):
                        part[h] = part.get(h, 0) - weight * c * d * k


def is_positive(p, box: Mapping[int, tuple[Any, Any]], depth: int = 10) -> bool:
    """Whether a polynomial is shown to be positive on a box, by Bernstein coefficients and bisection.

    `box` has the ends of its variables by their place among the exponents; p has no others.
    """
    terms, degrees, widest = dict(terms_of(p)), [], None
    for i, (low, high) in box.items():
        degrees.append(max((e[i] for e in terms), default=0))
        terms = _in_bernstein(terms, i, degrees[-1], low, high)
        if degrees[-1] and (widest is None or high - low > box[widest][1] - box[widest][0]):
            widest = i
    values = {tuple(e[i] for i in box): c for e, c in terms.items()}
    if len(values) == math.prod(degree + 1 for degree in degrees) and min(values.values()) > 0:
        return True
    corners = itertools.product(*({0, degree} for degree in degrees))
    if widest is None or depth == 0 or any(values.get(corner, 0) <= 0 for corner in corners):
        return False
    low, high = box[widest]
    middle = (low + high) / 2
    return all(is_positive(p, {**box, widest: half}, depth - 1) for half in ((low, middle), (middle, high)))


def _in_bernstein(terms: Mapping[tuple[int, ...], Any], i: int, degree: int, low, high) -> dict:
    """The coefficients with the powers of the variable i replaced by Bernstein polynomials of a degree."""
    rows, total = basis_change(degree, degree, low, high), {}
    for e, c in terms.items():
        for j, weight in enumerate(rows[e[i]]):
            if weight != 0:
                place = (*e[:i], j, *e[i + 1 :])
                total[place] = total.get(place, 0) + c * weight
    return total


def economized(p, n: int, degrees: Sequence[int]) -> tuple[Any, Any]:
    """A polynomial of at most these degrees in the robot's numbers, and a bound of what that changes."""
    terms, error = dict(terms_of(p)), Q(0)
    others = len(next(iter(terms), (0,) * (n + 1))) - 1
    for i, degree in zip(range(n + 1, others + 1), degrees, strict=False):
        for k in range(max(e[i] for e in terms), degree, -1):
            for e in [e for e in terms if e[i] == k]:
                c = terms.pop(e) / 2 ** (k - 1)
                error += abs(c) * peak(e[1 : n + 1])
                for j, t in enumerate(chebyshev(k)[:k]):
                    if t:
                        lower = (*e[:i], j, *e[i + 1 :])
                        terms[lower] = terms.get(lower, Q(0)) - c * t
    return polynomial(others, terms), up(error)


def control_points(p, n: int) -> dict[str, Any]:
    """Polynomials in (s, y [n]) whose mean, by the Bernstein weights of the robot, is p; each by its place, "" where
    there is one robot.
    """
    terms, degrees = dict(terms_of(p)), []
    for i in range(n + 1, len(next(iter(terms), (0,) * (n + 1)))):
        degrees.append(max(e[i] for e in terms))
        terms = _in_bernstein(terms, i, degrees[-1], Q(-1), Q(1))
    points = {place: {} for place in itertools.product(*(range(degree + 1) for degree in degrees))}
    for e, c in terms.items():
        points[e[n + 1 :]][e[: n + 1]] = c
    return {",".join(map(str, place)): polynomial(n, point) for place, point in points.items()}
