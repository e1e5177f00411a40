"""The independent checker: it accepts a certificate only if the theorem below follows from it, by exact arithmetic.

`rtcd check FILE`, `python -m rtcd_jax.certificate.check FILE` or `python check.py FILE`. It knows no solver and nothing
of the rest of the package: the standard library is enough, and python-flint makes it faster. Who wants to believe a
certificate needs to believe this file alone.

THEOREM. Let the claim hold a robot x' = f(x, u) with D(x) f(x, u) = a(x) + b(x) u, where a, b, D are polynomials in x
and in the sine and cosine of one angle (`PLANTS`), and its controller

    u = clip(u_k - K(t) (x - x*(t)), -F, F)  on [t_k, t_{k+1}],      u = clip(-K_g (x - x_g), -F, F)  after t_N,

with x* the cubic Hermite interpolant of the claimed states and rates, K linear between K_k and K_{k+1}. If this file
accepts, then with E(t) = {x*(t) + L(t) y : |y| <= 1} and G = {x_g + L_g y : |y| <= 1} of the certificate, every motion
that is in E(t) at some t of [start, t_N] stays in E until t_N, is then in G, never leaves G, and comes and stays as
close to x_g as reported; and in E and G no state exceeds its limit.

PROOF. *Funnel.* In y, d/dt |y|^2 = 2 y'L^-1 (f - x*' - L'y). Let L = L(s), s in [-1, 1] the time of one interval,
det L > 0 and D > 0. Then q = -2 c y' adj(L) (a + b u - D (x*' + L'y)), with a constant c > 0, is -d/dt |y|^2 times a
positive function. On the sphere |y| = 1 one of three cases holds: |u_lin| <= F and u = u_lin, or u_lin >= F and u = F,
or u_lin <= -F and u = -F. For each, q is a polynomial p(s, y) up to a remainder r (sine, cosine and every rounding
enclosed), and the certificate gives p = sum_j B_j(s) p_j(y) in Bernstein polynomials with, modulo |y|^2 = 1,

    p_j = z'G_j z + sum_i (sigma_i g_i)_j + rest_j,    G_j > 0,    sigma_i = sum_a B_a(s) z'S_ia z,    S_ia > 0,

g_i >= 0 the inequalities of the case. B_j >= 0 and sum_j B_j = 1, so that q >= min_j inf rest_j - r = margin > 0 on the
case. So |y| decreases wherever |y| = 1: no motion leaves E (its right side is Lipschitz in x, its intervals join
without a gap).
*Goal.* The same with y = l z, |z| = 1, l in [0, 1] in the place of s, and q divided by l^2: the remainder of q is
r l^2 + d l, where d bounds what does not vanish with l (x_g is a rounded multiple of pi). |y| decreases wherever
l > d / margin. QED

Every number of a file is an exact double in hexadecimal notation. Digests show where a file was changed; the theorem
does not rest on them.
"""

import hashlib
import json
import math
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import lru_cache
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any, NamedTuple

try:
    import flint
except ImportError:  # the standard library's fractions do the same
    flint = None

Q: Any = flint.fmpq if flint else Fraction
FORMAT, VERSION = "rtcd certificate", 1
BITS = 80
"""Coefficients are rounded to multiples of 2^-80; every rounding is added to a remainder."""
MAX_ORDER = 16
PI = Q(314159265358979323846264338327950288419716939937510, 10**50)
PI_ERROR = Q(1, 10**49)


class Refused(Exception):
    """What is wrong with a certificate, and where."""

    def __init__(self, place: str, reason: str):
        super().__init__(f"{place}: {reason}")


def insist(holds: bool, place: str, reason: str) -> None:
    if not holds:
        raise Refused(place, reason)


# Numbers --------------------------------------------------------------------------------------------------------------


def up(q, bits: int = BITS):
    """The least multiple of 2^-bits that is not below q."""
    return Q(-((-int(q.numerator) << bits) // int(q.denominator)), 1 << bits)


def near(q, bits: int = BITS):
    """The nearest multiple of 2^-bits, and an upper bound of the error."""
    n, d = int(q.numerator), int(q.denominator)
    if d <= 1 << bits and not d & (d - 1):
        return q, Q(0)
    return Q(((n << (bits + 1)) + d) // (2 * d), 1 << bits), Q(1, 1 << (bits + 1))


def root_up(q):
    """A rational not below the square root of q >= 0."""
    scaled = up(q, 2 * BITS) * (1 << 2 * BITS)
    return Q(math.isqrt(int(scaled.numerator)) + 1, 1 << BITS)


def alternating(x, k: int):
    """sum_i (-1)^i x^(k+2i) / (k+2i)!, the sine (k = 1) or cosine (k = 0), and a bound of the error; |x| <= 64."""
    term = x**k
    total = term
    while abs(term) > Q(1, 1 << (BITS + 8)) or k < abs(x):
        k += 2
        term, _ = near(-term * x * x / Q(k * (k - 1)), 2 * BITS)
        total += term
    return near(total)[0], Q(1, 1 << (BITS - 2))


# Polynomials in (s, y_1 .. y_n) ---------------------------------------------------------------------------------------


class Sparse:
    """What flint's fmpq_mpoly does, by the standard library."""

    def __init__(self, terms: Mapping):
        self.terms = {e: c for e, c in terms.items() if c != 0}

    def to_dict(self) -> dict:
        return self.terms

    def __add__(self, other: "Sparse") -> "Sparse":
        terms = dict(self.terms)
        for e, c in other.terms.items():
            terms[e] = terms.get(e, 0) + c
        return Sparse(terms)

    def __sub__(self, other: "Sparse") -> "Sparse":
        return self + other * -1

    def __mul__(self, other) -> "Sparse":
        if not isinstance(other, Sparse):
            return Sparse({e: c * other for e, c in self.terms.items()})
        terms: dict = {}
        for e, c in self.terms.items():
            for f, d in other.terms.items():
                g = tuple(map(sum, zip(e, f, strict=True)))
                terms[g] = terms.get(g, 0) + c * d
        return Sparse(terms)


@lru_cache
def _ring(n: int) -> Any:
    names = ["s", *(f"y{i}" for i in range(n))]
    return flint.fmpq_mpoly_ctx.get(names, flint.Ordering.degrevlex)  # pyright: ignore[reportOptionalMemberAccess]


def polynomial(n: int, terms: Mapping[tuple[int, ...], Any]) -> Any:
    """The polynomial with these coefficients by exponents (of s, y_1 .. y_n)."""
    return _ring(n).from_dict(dict(terms)) if flint else Sparse(terms)


def terms_of(p) -> list[tuple[tuple[int, ...], Any]]:
    return [(tuple(map(int, e)), c) for e, c in p.to_dict().items()]


@lru_cache(None)
def peak(exponents: tuple[int, ...]):
    """An upper bound of |y^exponents| on the unit ball: prod (e_i / e)^(e_i / 2)."""
    total = sum(exponents)
    square = math.prod((Q(e, total) ** e for e in exponents if e), start=Q(1))
    return root_up(square) if total and max(exponents) < total else Q(1)


def size(p):
    """An upper bound of |p| for |s| <= 1, |y| <= 1."""
    return up(sum((abs(c) * peak(e[1:]) for e, c in terms_of(p)), Q(0)))


class Taylor:
    """A function of (s, y) within d + r s of the polynomial p, for |y| <= 1; s = l at the goal, 1 along a funnel."""

    __slots__ = ("d", "p", "r", "space")

    def __init__(self, space: "Space", p, r=None, d=None):
        self.space, self.p = space, p
        self.r, self.d = (Q(0) if r is None else r), (Q(0) if d is None else d)

    def __add__(self, other: Any) -> "Taylor":
        other = self.space.enclose(other)
        return Taylor(self.space, self.p + other.p, self.r + other.r, self.d + other.d)

    __radd__ = __add__

    def __sub__(self, other: Any) -> "Taylor":
        return self + other * Q(-1)

    def __mul__(self, other: Any) -> "Taylor":
        if not isinstance(other, Taylor):
            return Taylor(self.space, self.p * other, self.r * abs(other), self.d * abs(other))
        r = d = Q(0)
        if self.r != 0 or self.d != 0 or other.r != 0 or other.d != 0:
            a, b = size(self.p), size(other.p)
            r = a * other.r + b * self.r + self.r * (other.r + other.d) + self.d * other.r
            d = a * other.d + b * self.d + self.d * other.d
        return Taylor(self.space, self.p * other.p, r, d).tidy()

    def tidy(self) -> "Taylor":
        """The same function without terms of high order, its coefficients rounded."""
        kept, r, d = {}, self.r, self.d
        for e, c in terms_of(self.p):
            order = sum(e[1:])
            if e[0] > self.space.s_order or order > self.space.y_order:
                coefficient, error = Q(0), abs(c)
            else:
                coefficient, error = near(c)
            if error != 0 and order:
                r += error * peak(e[1:])
            elif error != 0:
                d += error
            if coefficient != 0:
                kept[e] = coefficient
        return Taylor(self.space, polynomial(self.space.n, kept), up(r), up(d))

    @property
    def constant(self):
        return self.p.to_dict().get((0,) * (self.space.n + 1), Q(0))


class Space(NamedTuple):
    """Where Taylor models live: n components of y, and the orders in s and y above which terms go to the remainder."""

    n: int
    s_order: int
    y_order: int

    def enclose(self, a: Any) -> Taylor:
        """A Taylor model of itself, of a polynomial, of a scalar, or of the coefficients of a polynomial in s."""
        if isinstance(a, Taylor):
            return a
        return Taylor(self, self.poly(a) if isinstance(a, list | int | Q) else a)

    def poly(self, a: Any):
        """The polynomial of a scalar, or of a list of coefficients of powers of s."""
        powers = a if isinstance(a, list) else [Q(a) if isinstance(a, int) else a]
        return polynomial(self.n, {(k, *(0,) * self.n): c for k, c in enumerate(powers) if c != 0})

    def y(self, i: int):
        return polynomial(self.n, {(0, *(int(i == j) for j in range(self.n))): Q(1)})


def economize(series: Sequence, radius, degree: int):
    """Coefficients of a polynomial of lower degree, and a bound of what that changes for |x| <= radius (Lanczos)."""
    c, error = list(series), Q(0)
    for k in range(len(c) - 1, degree, -1):
        if c[k] != 0:
            scale = c[k] * radius**k / Q(2 ** (k - 1))
            c = [a - scale * t / radius**j for j, (a, t) in enumerate(zip(c[: k + 1], _chebyshev(k), strict=True))]
            error += abs(scale)
    return c[: degree + 1], error


@lru_cache(None)
def _chebyshev(k: int) -> tuple[int, ...]:
    """Coefficients of T_k."""
    if k < 2:
        return (1,) if k == 0 else (0, 1)
    twice, before = (0, *_chebyshev(k - 1)), (*_chebyshev(k - 2), 0, 0)
    return tuple(2 * a - b for a, b in zip(twice, before, strict=True))


_LONG = 31
_SINE = [Q(0) if k % 2 else Q((-1) ** (k // 2), math.factorial(k + 1)) for k in range(_LONG)]
"""Of sin(x) / x."""
_COSINE = [Q((-1) ** ((k + 1) // 2), math.factorial(k + 1)) if k % 2 else Q(0) for k in range(_LONG)]
"""Of (cos(x) - 1) / x."""


def sine_and_cosine(angle: Taylor, center, values: tuple, place: str) -> tuple[Taylor, Taylor]:
    """Of an angle near `center`, whose sine and cosine are `values` up to the third of them."""
    space = angle.space
    x = Taylor(space, angle.p - space.poly(center))
    radius = up(size(x.p), 20)
    insist(0 < radius <= 8, place, "the funnel is wider than 8 rad")
    squared, tail = x * x, radius**_LONG / Q(math.factorial(_LONG + 1))
    parts = []
    for series, first in ((_SINE, 0), (_COSINE, 1)):
        coefficients, error = economize(series, radius, space.y_order - 1)
        total = Taylor(space, space.poly(0))
        for c in coefficients[first::2][::-1]:
            total = total * squared + near(c)[0]
        error = radius * (error + tail + Q(space.y_order, 1 << BITS) * max(radius, Q(1)) ** space.y_order)
        total = total * x * x if first else total * x
        parts.append(Taylor(space, total.p, up(total.r + error), total.d))
    sine, cosine = parts[0], parts[1] + Q(1)
    lipschitz = (angle.r, angle.d + 3 * values[2])  # |sin' | <= 1; the values' errors times |sine| + |cosine| <= 3
    both = sine * values[1] + cosine * values[0], cosine * values[1] - sine * values[0]
    return tuple(Taylor(space, f.p, f.r + lipschitz[0], f.d + lipschitz[1]).tidy() for f in both)  # pyright: ignore


# Robots ---------------------------------------------------------------------------------------------------------------


class Plant(NamedTuple):
    """D f = a + b u. `field(parameters, x, sine, cosine)` gives D, a [n] and b [n], for any kind of number."""

    states: tuple[str, ...]
    units: tuple[str, ...]
    input_unit: str
    angle: int
    limit: str
    parameters: tuple[str, ...]
    field: Callable


def _pendulum(p, x, sine, cosine):
    inertia = p["m"] * p["l"] * p["l"]
    drift = x[1] * (-p["b"] / inertia) + sine * (-p["g"] / p["l"])
    return x[0] * 0 + 1, [x[1], drift], [x[0] * 0, x[0] * 0 + 1 / inertia]


def _cartpole(p, x, sine, cosine):
    """M (cart'', theta'') = (tau_1, tau_2) by Cramer's rule, D = det M; M_12 = -Mp lp cos(theta)."""
    moment = p["Mp"] * p["lp"]
    pivot, total = p["inertia_about_com"] + moment * p["lp"], p["Mc"] + p["Mp"]
    tau_1 = x[2] * -p["Beq"] + sine * x[3] * x[3] * -moment
    tau_2 = sine * (moment * p["g"]) + x[3] * -p["Bp"]
    coupling = cosine * moment
    determinant = coupling * coupling * -1 + pivot * total
    drift = [determinant * x[2], determinant * x[3], tau_1 * pivot + coupling * tau_2, coupling * tau_1 + tau_2 * total]
    return determinant, drift, [x[0] * 0, x[0] * 0, x[0] * 0 + pivot, coupling]


PLANTS = {
    "pendulum": Plant(
        ("theta", "theta_dot"),
        ("rad", "rad/s"),
        "N m",
        0,
        "torque_limit",
        ("m", "l", "b", "g", "torque_limit"),
        _pendulum,
    ),
    "cartpole": Plant(
        ("cart", "theta", "cart_dot", "theta_dot"),
        ("m", "rad", "m/s", "rad/s"),
        "N",
        1,
        "force_limit",
        ("Mc", "Mp", "lp", "inertia_about_com", "Beq", "Bp", "g", "force_limit"),
        _cartpole,
    ),
}


SINGULAR = "the mass matrix' determinant is not shown to be positive"


class Claim(NamedTuple):
    """The closed loop that the proof is about, in exact numbers."""

    plant: Plant
    parameters: dict[str, Any]
    limit: Any
    bounds: list
    dt: Any
    x: list
    rates: list
    u: list
    K: list
    x_goal: list
    K_goal: list
    start: tuple[int, Any]

    @property
    def n(self) -> int:
        return len(self.x_goal)


# Sums of squares ------------------------------------------------------------------------------------------------------


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


class Witness(NamedTuple):
    """`gram` [j] and `multipliers` [i][a], symmetric matrices, with monomials of y up to `degree` and `degree` - 1."""

    degree: int
    gram: list
    multipliers: list


@lru_cache(None)
def monomials(n: int, degree: int) -> tuple[tuple[int, ...], ...]:
    """Exponents of y up to `degree`, by degree; on the sphere the last component needs no square."""
    found = []
    for order in range(degree + 1):
        for chosen in combinations_with_replacement(range(n), order):
            exponents = tuple(chosen.count(i) for i in range(n))
            if exponents[-1] < 2:
                found.append(exponents)
    return tuple(found)


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


@lru_cache(1000)
def _basis_change(order: int, degree: int, low, high) -> tuple:
    """Row k: s^k in the Bernstein polynomials of `degree` on [low, high]."""
    rows, width = [], high - low
    for k in range(order + 1):
        powers = [math.comb(k, i) * low ** (k - i) * width**i for i in range(k + 1)]
        rows.append([sum((p * Q(math.comb(j, i), math.comb(degree, i)) for i, p in enumerate(powers[: j + 1])), Q(0))
                     for j in range(degree + 1)])  # fmt: skip
    return tuple(rows)


def bernstein(p, degree: int, low, high, place: str) -> list[dict]:
    """Bernstein coefficients in s, each a polynomial in y on the sphere by exponents."""
    terms = terms_of(p)
    order = max((e[0] for e, _ in terms), default=0)
    insist(order <= degree, place, f"order {order} in time needs more than {degree + 1} Bernstein polynomials")
    rows, parts = _basis_change(order, degree, low, high), [{} for _ in range(degree + 1)]
    for e, c in terms:
        for f, k in reduced(e[1:]):
            for part, weight in zip(parts, rows[e[0]], strict=True):
                part[f] = part.get(f, 0) + c * k * weight
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


def margin(todo: Obligation, witness: Witness, place: str):
    """A lower bound > 0 of q where the obligation asks for it.

    Raises:
        Refused: the witness does not show that.
    """
    n = len(next(iter(peakless(todo.p)))) - 1
    basis, sides = monomials(n, witness.degree), monomials(n, witness.degree - 1)
    degree = len(witness.gram) - 1
    parts = bernstein(todo.p, degree, todo.low, todo.high, place)
    insist(len(witness.multipliers) == len(todo.where), place, f"needs {len(todo.where)} multipliers")
    for i, (g, multiplier) in enumerate(zip(todo.where, witness.multipliers, strict=True)):
        _subtract_product(parts, g, multiplier, sides, todo, f"{place}.multipliers[{i}]")
    bound = None
    for j, (part, gram) in enumerate(zip(parts, witness.gram, strict=True)):
        _insist_definite(gram, len(basis), f"{place}.gram[{j}]")
        for e, c in quadratic(gram, basis).items():
            part[e] = part.get(e, 0) - c
        rest = part.pop((0,) * n, Q(0)) - sum((abs(c) * peak(e) for e, c in part.items()), Q(0)) - todo.error
        insist(rest > 0, f"{place}.gram[{j}]", f"proves no decrease: at best {float(rest):.3g}, must be > 0")
        bound = rest if bound is None else min(bound, rest)
    return bound


def peakless(p):
    """Exponents of a polynomial that is not zero."""
    return p.to_dict() or {(0, 0): 0}


def _insist_definite(matrix, rows: int, place: str) -> None:
    insist(len(matrix) == rows, place, f"has {len(matrix)} rows, must have {rows}")
    insist(is_positive_definite(matrix), place, "is not positive definite")


def _subtract_product(parts, g, multiplier, basis, todo: Obligation, place: str) -> None:
    """Takes sigma g from the Bernstein coefficients, sigma = sum_a B_a z'S_a z."""
    degree, high = len(parts) - 1, len(multiplier) - 1
    insist(0 <= high <= degree, place, f"has {high + 1} matrices, must have 1 to {degree + 1}")
    factors = bernstein(g, degree - high, todo.low, todo.high, place)
    for a, matrix in enumerate(multiplier):
        _insist_definite(matrix, len(basis), f"{place}[{a}]")
        square = quadratic(matrix, basis)
        for b, factor in enumerate(factors):
            weight = Q(math.comb(high, a) * math.comb(degree - high, b), math.comb(degree, a + b))
            part = parts[a + b]
            for e, c in square.items():
                for f, d in factor.items():
                    for h, k in reduced(tuple(map(sum, zip(e, f, strict=True)))):
                        part[h] = part.get(h, 0) - weight * c * d * k


def is_positive(coefficients: list, low, high, depth: int = 10) -> bool:
    """Whether a polynomial in s is shown to be positive on [low, high], by Bernstein coefficients and bisection."""
    degree = len(coefficients) - 1
    rows = _basis_change(degree, degree, low, high)
    values = [sum((c * row[j] for c, row in zip(coefficients, rows, strict=True)), Q(0)) for j in range(degree + 1)]
    if min(values) > 0:
        return True
    if depth == 0 or values[0] <= 0 or values[-1] <= 0:
        return False
    middle = (low + high) / 2
    return is_positive(coefficients, low, middle, depth - 1) and is_positive(coefficients, middle, high, depth - 1)


# Polynomials in s alone: lists of coefficients ------------------------------------------------------------------------


def plus(a: list, b: list) -> list:
    short, long = sorted((a, b), key=len)
    return [c + (short[k] if k < len(short) else 0) for k, c in enumerate(long)]


def times(a: list, b: list) -> list:
    total = [Q(0)] * (len(a) + len(b) - 1)
    for i, c in enumerate(a):
        for j, d in enumerate(b):
            total[i + j] += c * d
    return total


def derivative(a: list) -> list:
    return [c * k for k, c in enumerate(a)][1:] or [Q(0)]


def substitute(a: list, inner: list) -> list:
    total = [Q(0)]
    for c in reversed(a):
        total = plus(times(total, inner), [c])
    return total


def cofactors(m: list[list[list]]) -> tuple[list[list[list]], list]:
    """The adjugate and the determinant of a matrix of polynomials."""

    def determinant(rows: tuple[int, ...], columns: tuple[int, ...]) -> list:
        if not rows:
            return [Q(1)]
        total = [Q(0)]
        for k, column in enumerate(columns):
            entry = m[rows[0]][column]
            if any(c != 0 for c in entry):
                minor = determinant(rows[1:], columns[:k] + columns[k + 1 :])
                total = plus(total, times([c * (-1) ** k for c in entry], minor))
        return total

    every = tuple(range(len(m)))
    without = [tuple(j for j in every if j != i) for i in every]
    adjugate = [[[c * (-1) ** (i + j) for c in determinant(without[j], without[i])] for j in every] for i in every]
    return adjugate, determinant(every, every)


# The funnel -----------------------------------------------------------------------------------------------------------


class Motion(NamedTuple):
    """One interval's data as polynomials in s: x*, x*' [1/s], K, u, L and L' [1/s]."""

    state: list
    rate: list
    gain: list
    input: Any
    axes: list
    axes_rate: list
    duration: Any


class Stretch(NamedTuple):
    """One interval of the funnel: L(s) between its ends is linear plus (1 - s^2) (bend_0 + bend_1 s)."""

    knot: int
    start: Any
    end: Any
    first: list
    last: list
    bend: list
    orders: tuple[int, int]
    cases: dict[str, Witness]


def motion(claim: Claim, piece: Stretch) -> Motion:
    """The closed loop's and the funnel's data on one interval."""
    k, dt = piece.knot, claim.dt
    share = [(piece.start + piece.end) / 2, (piece.end - piece.start) / 2]  # of the knots' interval, at s
    speed = 1 / (dt * share[1])  # ds/dt
    state = []
    for a, va, b, vb in zip(claim.x[k], claim.rates[k][0], claim.x[k + 1], claim.rates[k][1], strict=True):
        hermite = [a, dt * va, 3 * (b - a) - dt * (2 * va + vb), 2 * (a - b) + dt * (va + vb)]
        state.append(substitute(hermite, share))
    gain = [substitute([a, b - a], share) for a, b in zip(claim.K[k], claim.K[k + 1], strict=True)]
    axes = []
    for first, last, bend0, bend1 in zip(piece.first, piece.last, *piece.bend, strict=True):
        row = []
        for a, b, c, d in zip(first, last, bend0, bend1, strict=True):
            row.append([(a + b) / 2 + c, (b - a) / 2 + d, -c, -d])
        axes.append(row)
    rate = [[c * speed for c in derivative(a)] for a in state]
    axes_rate = [[[c * speed for c in derivative(a)] for a in row] for row in axes]
    return Motion(state, rate, gain, claim.u[k], axes, axes_rate, 2 / speed)


def funnel_obligations(claim: Claim, piece: Stretch, place: str) -> dict[str, Obligation]:
    """By case of the saturation: "free", "high" (u = F), "low" (u = -F); those that cannot occur are left out."""
    data, space, every = motion(claim, piece), Space(claim.n, *piece.orders), range(claim.n)
    adjugate, determinant = cofactors(data.axes)
    insist(is_positive(determinant, Q(-1), Q(1)), place, "an ellipsoid is degenerate: det L must be > 0")
    y = [space.y(i) for i in every]
    error = [_sum(space, (space.poly(data.axes[i][j]) * y[j] for j in every)) for i in every]
    drag = [_sum(space, (space.poly(data.axes_rate[i][j]) * y[j] for j in every)) for i in every]
    x = [Taylor(space, space.poly(data.state[i]) + error[i]).tidy() for i in every]
    angle = x[claim.plant.angle]
    center, _ = near(angle.constant, 20)
    insist(abs(center) <= 64, place, "the nominal angle is beyond 64 rad")
    values = alternating(center, 1), alternating(center, 0)
    sine, cosine = sine_and_cosine(angle, center, (values[0][0], values[1][0], values[0][1]), place)
    d, a, b = claim.plant.field(claim.parameters, x, sine, cosine)
    d0 = d.constant
    insist(2 * d0 - size(d.p) - d.r - d.d > 0, place, SINGULAR)
    wide = space._replace(y_order=space.y_order + 1)
    scale, _ = near(2 / (d0 * determinant[0]), 30)
    push = [Taylor(wide, _sum(space, (space.poly(adjugate[i][j]) * y[i] for i in every))) * scale for j in every]
    free, forced = wide.enclose(0), wide.enclose(0)
    for j in every:
        fall = a[j] - d * Taylor(space, space.poly(data.rate[j]) + drag[j]).tidy()
        free += push[j] * Taylor(wide, fall.p, fall.r, fall.d)
        forced += push[j] * Taylor(wide, b[j].p, b[j].r, b[j].d)
    linear = _sum(space, (space.poly(data.gain[i]) * error[i] * Q(-1) for i in every))
    reach = _square([_combine(data.gain, data.axes, j) for j in every])
    where = _cases(space, claim.limit, data.input, linear, reach, Q(-1), Q(1))
    inputs = {"free": space.poly(data.input) + linear, "high": claim.limit, "low": -claim.limit}
    found = {}
    for case, conditions in where.items():
        u = inputs[case]
        total = (free + forced * (Taylor(wide, u) if case == "free" else u)) * Q(-1)
        found[case] = Obligation(total.p, total.r + total.d, Q(0), conditions, Q(-1), Q(1))
    return found


def _combine(gain, axes, column: int) -> list:
    """(K L)_column."""
    total = [Q(0)]
    for k, row in zip(gain, axes, strict=True):
        total = plus(total, times(k, row[column]))
    return total


def _sum(space: Space, polynomials):
    total = space.poly(0)
    for p in polynomials:
        total = total + p
    return total


def _square(polynomials: list[list]) -> list:
    total = [Q(0)]
    for p in polynomials:
        total = plus(total, times(p, p))
    return total


def _cases(space: Space, limit, feedforward, linear, reach, low, high) -> dict[str, list]:
    """What is >= 0 where u = feedforward + linear is free, too high, too low; |linear|^2 <= reach(s) on the sphere."""
    room = {"high": space.poly(limit - feedforward) - linear, "low": space.poly(limit + feedforward) + linear}
    occurs = []
    for case, left in (("high", limit - feedforward), ("low", limit + feedforward)):
        square = plus([left * left], [-c for c in reach])
        if not (left > 0 and is_positive(square, low, high, depth=4)):
            occurs.append(case)
    return {"free": [room[case] for case in occurs], **{case: [room[case] * Q(-1)] for case in occurs}}


def insist_bounds(claim: Claim, data: Motion, place: str) -> None:
    """|x_i| <= bound: (bound -+ x*_i)^2 > |row i of L|^2 and bound -+ x*_i > 0."""
    for i, bound in enumerate(claim.bounds):
        if bound is None:
            continue
        row = _square(data.axes[i])
        for sign in (1, -1):
            left = plus([bound], [c * sign for c in data.state[i]])
            inside = is_positive(left, Q(-1), Q(1)) and is_positive(
                plus(times(left, left), [-c for c in row]), Q(-1), Q(1)
            )
            name = claim.plant.states[i]
            insist(inside, place, f"the limit |{name}| <= {float(bound):.6g} {claim.plant.units[i]} is not kept")


# The goal -------------------------------------------------------------------------------------------------------------


class Shell(NamedTuple):
    """The part of the goal region with |y| between two levels."""

    start: Any
    end: Any
    cases: dict[str, Witness]


def goal_field(claim: Claim, axes: list, y_order: int, place: str) -> tuple[Taylor, Taylor, list]:
    """2 y' adj(L) a / l and 2 y' adj(L) b / l as Taylor models in (l, z) after y = l z, and K L."""
    space, every = Space(claim.n, MAX_ORDER, y_order), range(claim.n)
    adjugate, determinant = cofactors([[[c] for c in row] for row in axes])
    insist(determinant[0] > 0, place, "the ellipsoid is degenerate: det L must be > 0")
    level = polynomial(claim.n, {(1, *(0,) * claim.n): Q(1)})
    z = [space.y(i) for i in every]
    error = [_sum(space, (z[j] * axes[i][j] for j in every)) * level for i in every]
    center = claim.x_goal[claim.plant.angle]
    turns = round(float(center) / math.pi)
    off = abs(center - PI * turns) + PI_ERROR * abs(turns)
    insist(off < Q(1, 10**9), place, "the goal's angle is no multiple of pi")
    x = [Taylor(space, space.poly(c) + e) for c, e in zip(claim.x_goal, error, strict=True)]
    values = (Q(0), Q(-1 if turns % 2 else 1), off / 3)
    sine, cosine = sine_and_cosine(x[claim.plant.angle], center, values, place)
    d, a, b = claim.plant.field(claim.parameters, x, sine, cosine)
    insist(2 * d.constant - size(d.p) - d.r - d.d > 0, place, SINGULAR)
    scale, _ = near(2 / (d.constant * determinant[0]), 30)
    wide = space._replace(y_order=y_order + 1)
    push = [Taylor(wide, _sum(space, (z[i] * adjugate[i][j][0] for i in every)) * scale) for j in every]
    insist(all(f.constant == 0 for f in a), place, "the goal is no equilibrium")
    fields = []
    for f in (a, b):
        total = wide.enclose(0)
        for j in every:
            total += push[j] * Taylor(wide, f[j].p, f[j].r, f[j].d)
        fields.append(total)
    return fields[0], fields[1], [_combine([[k] for k in claim.K_goal], [[[c] for c in row] for row in axes], j)[0]
                                  for j in every]  # fmt: skip


def goal_obligations(claim: Claim, field: tuple[Taylor, Taylor, list], low, high) -> dict[str, Obligation]:
    """As `funnel_obligations`, in l on [low, high]: q / l^2 where u is free, q / l where it is saturated."""
    free, forced, gain = field
    space, zero = free.space, (0,) * (claim.n + 1)
    linear = _sum(space, (space.y(j) * -k for j, k in enumerate(gain)))
    level = polynomial(claim.n, {(1, *zero[1:]): Q(1)})
    reach = [Q(0), Q(0), _square([[k] for k in gain])[0]]
    where = _cases(space, claim.limit, Q(0), linear * level, reach, low, high)
    found = {}
    for case, conditions in where.items():
        if case == "free":
            lowered = polynomial(claim.n, {(e[0] - 1, *e[1:]): c for e, c in terms_of(free.p)})
            held = forced * Taylor(space, linear)
            p, error, drift = (lowered + held.p) * Q(-1), free.r + held.r + held.d, free.d
        else:
            held = free + forced * (claim.limit if case == "high" else -claim.limit)
            p, error, drift = held.p * Q(-1), held.r + held.d, Q(0)
        found[case] = Obligation(p, error, drift, conditions, low, high)
    return found


def insist_arrival(claim: Claim, outlet: list, axes: list, weight, place: str) -> None:
    """E(t_N) in G: |adj(L_g) (x_N - x_g + L_N y)| < det L_g for |y| <= 1, by the S-lemma with the given weight."""
    every = range(claim.n)
    adjugate, determinant = cofactors([[[c] for c in row] for row in axes])
    offset = [a - b for a, b in zip(claim.x[-1], claim.x_goal, strict=True)]
    b = [[sum((adjugate[i][k][0] * outlet[k][j] for k in every), Q(0)) for j in every] for i in every]
    w = [sum((adjugate[i][k][0] * offset[k] for k in every), Q(0)) for i in every]
    columns = [[b[i][j] for i in every] for j in every] + [w]
    form = [[-sum((c * d for c, d in zip(p, q, strict=True)), Q(0)) for q in columns] for p in columns]
    for i in every:
        form[i][i] += weight
    form[-1][-1] += determinant[0] * determinant[0] - weight
    insist(is_positive_definite(form), place, "the funnel's outlet is not shown to lie in the goal region")


# The file -------------------------------------------------------------------------------------------------------------

_DOUBLE = re.compile(r"-?0x[01](\.[0-9a-f]{1,13})?p[+-]\d{1,4}")


class Node(NamedTuple):
    """A value of the file and where it stands."""

    place: str
    value: Any

    def keys(self, *names: str) -> "list[Node]":
        """The entries of an object that must have these keys and the digests of their values."""
        self.insist(isinstance(self.value, dict), "must be an object")
        wrong = sorted({*names, "sha256"} ^ self.value.keys())
        self.insist(not wrong, f"has unknown keys or lacks some: {', '.join(wrong)[:80]}")
        digests = self.value["sha256"]
        Node(f"{self.place}.sha256", digests).insist(
            isinstance(digests, dict) and digests.keys() == set(names), f"must be digests of {', '.join(names)}"
        )
        return [Node(f"{self.place}.{name}", self.value[name]) for name in names]

    def sealed(self) -> None:
        """Refuses values that are not those of the digests."""
        for name, digest in self.value["sha256"].items():
            insist(digest == seal(self.value[name]), f"{self.place}.{name}", "was changed: its digest is another")

    def insist(self, holds: bool, reason: str) -> None:
        insist(holds, self.place, reason)

    def items(self, count: int | None = None, at_least: int = 0) -> "list[Node]":
        self.insist(isinstance(self.value, list), "must be a list")
        entries = len(self.value)
        self.insist(count is None or entries == count, f"has {entries} entries, must have {count}")
        self.insist(entries >= at_least, f"has {entries} entries, must have at least {at_least}")
        return [Node(f"{self.place}[{i}]", v) for i, v in enumerate(self.value)]

    def number(self):
        self.insist(isinstance(self.value, str) and _DOUBLE.fullmatch(self.value), "must be a double in hexadecimal")
        try:
            return Q(*float.fromhex(self.value).as_integer_ratio())
        except OverflowError:
            raise Refused(self.place, "is too large for a double") from None

    def integer(self, low: int, high: int) -> int:
        holds = type(self.value) is int and low <= self.value <= high
        self.insist(holds, f"must be an integer from {low} to {high}")
        return self.value

    def array(self, *shape: int) -> Any:
        """Nested lists of numbers."""
        return [node.array(*shape[1:]) for node in self.items(shape[0])] if shape else self.number()

    def symmetric(self, rows: int) -> list[list]:
        """A symmetric matrix, of which the file has the upper triangle row by row."""
        c = iter(node.number() for node in self.items(rows * (rows + 1) // 2))
        full = [[Q(0)] * rows for _ in range(rows)]
        for i in range(rows):
            for j in range(i, rows):
                full[i][j] = full[j][i] = next(c)
        return full


def seal(value: Any) -> str:
    """The digest of a value of a file."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def read_claim(node: Node) -> Claim:
    names = ("plant", "parameters", "state_limits", "dt", "x", "rates", "u", "K", "x_goal", "K_goal", "start")
    entries = dict(zip(names, node.keys(*names), strict=True))
    node.sealed()
    entries["plant"].insist(entries["plant"].value in tuple(PLANTS), f"must be one of {', '.join(PLANTS)}")
    plant = PLANTS[entries["plant"].value]
    n = len(plant.states)
    given = entries["parameters"]
    given.insist(isinstance(given.value, dict) and given.value.keys() == set(plant.parameters), "must be the plant's")
    parameters = {name: Node(f"{given.place}.{name}", given.value[name]).number() for name in plant.parameters}
    for name, value in parameters.items():
        must = ">= 0" if name in ("b", "Beq", "Bp") else "> 0"
        holds = value >= 0 if must == ">= 0" else value > 0
        insist(holds, f"{given.place}.{name}", f"= {float(value):g}: must be {must}")
    limits = entries["state_limits"].items(n)
    bounds = [None if limit.value is None else limit.number() for limit in limits]
    dt = entries["dt"].number()
    entries["dt"].insist(dt > 0, "must be > 0")
    knots = len(entries["x"].items(at_least=2))
    start = entries["start"].items(2)
    return Claim(
        plant, parameters, parameters[plant.limit], bounds, dt,
        entries["x"].array(knots, n), entries["rates"].array(knots - 1, 2, n), entries["u"].array(knots - 1),
        entries["K"].array(knots, n), entries["x_goal"].array(n), entries["K_goal"].array(n),
        (start[0].integer(0, knots - 1), start[1].number()),
    )  # fmt: skip


def read_cases(node: Node, n: int) -> dict[str, Witness]:
    node.insist(isinstance(node.value, dict) and node.value.keys() <= {"free", "high", "low"}, "must be cases")
    found = {}
    for case, value in node.value.items():
        here = Node(f"{node.place}.{case}", value)
        here.insist(isinstance(value, dict) and value.keys() == {"degree", "gram", "multipliers"}, "must be a witness")
        degree = Node(f"{here.place}.degree", value["degree"]).integer(1, MAX_ORDER // 2)
        rows, sides = len(monomials(n, degree)), len(monomials(n, degree - 1))
        grams = Node(f"{here.place}.gram", value["gram"]).items(at_least=1)
        grams[0].insist(len(grams) <= 2 * MAX_ORDER, f"must have at most {2 * MAX_ORDER} matrices")
        multipliers = Node(f"{here.place}.multipliers", value["multipliers"]).items()
        found[case] = Witness(
            degree,
            [gram.symmetric(rows) for gram in grams],
            [[matrix.symmetric(sides) for matrix in each.items(at_least=1)] for each in multipliers],
        )
    return found


def read_stretch(node: Node, claim: Claim) -> Stretch:
    knot, start, end, first, last, bend, orders, cases = node.keys(
        "knot", "start", "end", "first", "last", "bend", "orders", "cases"
    )
    node.sealed()
    n = claim.n
    pair = [order.integer(1, MAX_ORDER - 1) for order in orders.items(2)]
    piece = Stretch(
        knot.integer(0, len(claim.u) - 1), start.number(), end.number(), first.array(n, n), last.array(n, n),
        bend.array(2, n, n), (pair[0], pair[1]), read_cases(cases, n),
    )  # fmt: skip
    node.insist(0 <= piece.start < piece.end <= 1, "must start before it ends, at shares of its interval in [0, 1]")
    return piece


def read_shell(node: Node, n: int) -> Shell:
    start, end, cases = node.keys("start", "end", "cases")
    node.sealed()
    shell = Shell(start.number(), end.number(), read_cases(cases, n))
    node.insist(0 <= shell.start < shell.end <= 1, "must have levels that rise within [0, 1]")
    return shell


def margins(todo: Mapping[str, Obligation], cases: Mapping[str, Witness], place: str) -> dict[str, Any]:
    """Margin by case; refused unless there is a witness for exactly the cases that can occur."""
    insist(todo.keys() == cases.keys(), place, f"must have the cases {', '.join(todo)}, has {', '.join(cases)}")
    return {case: margin(todo[case], cases[case], f"{place}.{case}") for case in todo}


# The whole ------------------------------------------------------------------------------------------------------------


class Report(NamedTuple):
    """What an accepted certificate proves, rounded: volumes in the product of the states' units, times in s."""

    claim: Claim
    stretches: int
    shells: int
    start: float
    end: float
    volumes: dict[str, float]
    axes: dict[str, list[float]]
    rest: list[float]
    margin: float
    notes: dict[str, str]


def check_stretch(claim: Claim, piece: Stretch, place: str):
    """The margin of one interval's proof."""
    insist_bounds(claim, motion(claim, piece), place)
    return min(margins(funnel_obligations(claim, piece, place), piece.cases, f"{place}.cases").values())


def check_chain(claim: Claim, pieces: Sequence[Stretch], place: str) -> None:
    """The intervals cover [start, t_N] without gap or overlap, and their ellipsoids join."""
    reached, axes = claim.start, None
    for i, piece in enumerate(pieces):
        here, at, begins = f"{place}[{i}]", reached[0] + reached[1], piece.knot + piece.start
        where = f"starts at {float(begins):.17g} knots, must start at {float(at):.17g}"
        insist(begins <= at, here, f"leaves a gap: {where}")
        insist(begins == at, here, f"overlaps: {where}")
        insist(axes is None or axes == piece.first, f"{here}.first", "is not where the interval before it ends")
        reached, axes = (piece.knot, piece.end), piece.last
    insist(reached[0] + reached[1] == len(claim.u), place, "does not reach the last knot")


def read_goal(node: Node, claim: Claim) -> tuple[list, int, Any, list[Shell]]:
    """Axes, order of the Taylor models, weight of the S-lemma, and the shells, which cover the levels [0, 1]."""
    axes, order, weight, items = node.keys("axes", "order", "weight", "shells")
    shells, reached = [read_shell(item, claim.n) for item in items.items(at_least=1)], Q(0)
    node.sealed()
    for i, shell in enumerate(shells):
        place = f"{items.place}[{i}]"
        insist(shell.start == reached, place, f"starts at {float(shell.start):g}, must start at {float(reached):g}")
        reached = shell.end
    items.insist(reached == 1, f"ends at {float(reached):g}, must end at 1")
    return axes.array(claim.n, claim.n), order.integer(2, MAX_ORDER - 2), weight.number(), shells


def check_goal(claim: Claim, node: Node, outlet: list) -> tuple[list, list, int, Any]:
    """Axes of the goal region, how close motions come [n], the number of shells and the least margin."""
    axes, order, weight, shells = read_goal(node, claim)
    for i, bound in enumerate(claim.bounds):
        left = None if bound is None else bound - abs(claim.x_goal[i])
        kept = left is None or (left > 0 and left * left > _square([[c] for c in axes[i]])[0])
        insist(kept, f"{node.place}.axes", f"the limit on |{claim.plant.states[i]}| is not kept")
    field = goal_field(claim, axes, order, node.place)
    insist_arrival(claim, outlet, axes, weight, f"{node.place}.axes")
    least, drift = None, Q(0)
    for i, shell in enumerate(shells):
        todo = goal_obligations(claim, field, shell.start, shell.end)
        found = min(margins(todo, shell.cases, f"{node.place}.shells[{i}].cases").values())
        least = found if least is None else min(least, found)
        drift = max(drift, *(each.drift for each in todo.values()))
    rest = drift / least
    insist(rest < 1, node.place, "the rounding of the goal is too large for a proof")
    return axes, [rest * root_up(_square([[c] for c in row])[0]) for row in axes], len(shells), least


def check(content: Any, progress: Callable[[int, int], None] = lambda done, of: None) -> Report:
    """What the parsed certificate proves.

    Raises:
        Refused: it proves nothing, with the place and the reason.
    """
    top = Node("certificate", content)
    top.insist(isinstance(content, dict), "must be an object")
    top.insist(content.get("format") == FORMAT, f"is no {FORMAT!r}")
    top.insist(type(content.get("version")) is int and content["version"] == VERSION, f"must be of version {VERSION}")
    _, _, about, funnel, goal, notes = top.keys("format", "version", "claim", "funnel", "goal", "notes")
    claim = read_claim(about)
    pieces = [read_stretch(item, claim) for item in funnel.items(at_least=1)]
    check_chain(claim, pieces, funnel.place)
    l_goal, rest, shells, least = check_goal(claim, goal, pieces[-1].last)
    for i, piece in enumerate(pieces):
        least = min(least, check_stretch(claim, piece, f"{funnel.place}[{i}]"))
        progress(i + 1, len(pieces))
    notes.insist(isinstance(notes.value, dict), "must be an object")
    top.sealed()
    volumes, axes = volumes_of(claim, pieces, l_goal)
    begin = float((claim.start[0] + claim.start[1]) * claim.dt)
    return Report(
        claim, len(pieces), shells, begin, float(len(claim.u) * claim.dt), volumes, axes,
        [float(r) for r in rest], float(least), {str(k): str(v) for k, v in notes.value.items()},
    )  # fmt: skip


def volumes_of(
    claim: Claim, pieces: Sequence[Stretch], l_goal: list
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Volumes |unit ball| det L, and half widths of the ellipsoids along each state."""
    ball = math.pi ** (claim.n / 2) / math.gamma(claim.n / 2 + 1)

    def volume(axes) -> float:
        return ball * float(cofactors([[[c] for c in row] for row in axes])[1][0])

    def widths(axes) -> list[float]:
        return [float(root_up(_square([[c] for c in row])[0])) for row in axes]

    knots = [volume(piece.first) for piece in pieces if piece.start == 0] + [volume(pieces[-1].last)]
    integral = Q(0)
    for piece in pieces:
        data = motion(claim, piece)
        determinant = cofactors(data.axes)[1]
        integral += sum((c / (k + 1) for k, c in enumerate(determinant) if k % 2 == 0), Q(0)) * data.duration
    volumes = {
        "sum": math.fsum(knots), "integral": ball * float(integral), "inlet": volume(pieces[0].first),
        "outlet": knots[-1], "goal": volume(l_goal),
    }  # fmt: skip
    return volumes, {"inlet": widths(pieces[0].first), "outlet": widths(pieces[-1].last), "goal": widths(l_goal)}


def sentence(name: str, report: Report) -> str:
    """What is proved, in plain words."""
    claim, plant, v = report.claim, report.claim.plant, report.volumes
    numbers = ", ".join(f"{key} = {float(value):.6g}" for key, value in claim.parameters.items())
    unit = " ".join(plant.units)

    def extent(place: str) -> str:
        triples = zip(plant.states, report.axes[place], plant.units, strict=True)
        return f"{place} " + ", ".join(f"{state} +-{value:.3g} {unit}" for state, value, unit in triples)

    limits = [(s, b, u) for s, b, u in zip(plant.states, claim.bounds, plant.units, strict=True) if b is not None]
    kept = " and ".join(f"|{state}| <= {float(bound):.6g} {unit}" for state, bound, unit in limits)
    return (
        f"PROVED in continuous time, by exact arithmetic, for the model {name!r} ({numbers}; SI units) under the "
        f"claimed controller, whose input never exceeds {float(claim.limit):.6g} {plant.input_unit}: every motion that "
        f"is in the funnel at some time of [{report.start:.6g} s, {report.end:.6g} s] stays in it, is in the goal "
        f"region at {report.end:.6g} s, never leaves that region, and comes and stays within "
        f"{max(report.rest):.1g} of the goal in every state; {kept or 'there is no limit on a state'} all the while. "
        f"Half widths: {extent('inlet')}; {extent('outlet')}; {extent('goal')}. Volumes (proved) [{unit}]: inlet "
        f"{v['inlet']:.6g}, sum over the knots {v['sum']:.6g}, integral over time {v['integral']:.6g} s, goal region "
        f"{v['goal']:.6g}. {report.stretches} intervals of time and {report.shells} of level, smallest margin "
        f"{report.margin:.2g}. It is a statement about this model, its state known and its input continuous, not about "
        "hardware."
    )


def _unique(pairs: list[tuple[str, Any]]) -> dict:
    found = dict(pairs)
    insist(len(found) == len(pairs), "certificate", "has the same key twice")
    return found


def _no_constant(name: str) -> Any:
    raise Refused("certificate", f"holds {name}")


def parse(text: str) -> Any:
    """The JSON of a file; refused if it is none."""
    try:
        return json.loads(text, object_pairs_hook=_unique, parse_constant=_no_constant)
    except Refused:
        raise
    except RecursionError:
        raise Refused("certificate", "is nested too deeply") from None
    except ValueError as error:
        raise Refused("certificate", f"is no JSON: {error}") from None


def check_file(path: Path, progress: Callable[[int, int], None] = lambda done, of: None) -> Report:
    """`check` of a file.

    Raises:
        Refused: as `check`.
        OSError: the file cannot be read.
    """
    try:
        text = path.read_bytes().decode("ascii")
    except UnicodeDecodeError:
        raise Refused("certificate", "is no ASCII text") from None
    return check(parse(text), progress)


def main(arguments: Sequence[str]) -> int:
    """0 and what is proved; 1 and why nothing is; 2 where there is nothing to read."""
    if len(arguments) != 1 or arguments[0] in ("-h", "--help"):
        print("usage: check FILE    (a certificate, certificates/NNN.json of a run folder)")
        return 0 if arguments[:1] in (["-h"], ["--help"]) else 2
    try:
        report = check_file(Path(arguments[0]))
    except OSError as error:
        print(f"{arguments[0]}: {error.strerror}", file=sys.stderr)
        return 2
    except Refused as refused:
        print(f"REFUSED {arguments[0]}\n{refused}", file=sys.stderr)
        return 1
    name = next(key for key, plant in PLANTS.items() if plant is report.claim.plant)
    print(sentence(name, report))
    for key, value in report.notes.items():
        print(f"note, not proved: {key}: {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
