"""Taylor models: functions of time, of a point in the unit ball and of a robot as polynomials with remainders' bounds.

The robot is a point p of the cube |p_i| <= 1: its uncertain numbers, each between its bounds.
"""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.exact import BITS, Q, flint, near, require, root_up, up

# Polynomials in (s, y_1 .. y_n, p_1 .. p_m) ---------------------------------------------------------------------------


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
def _ring(others: int) -> Any:
    names = ["s", *(f"y{i}" for i in range(others))]
    return flint.fmpq_mpoly_ctx.get(names, flint.Ordering.degrevlex)  # pyright: ignore[reportOptionalMemberAccess]


def polynomial(others: int, terms: Mapping[tuple[int, ...], Any]) -> Any:
    """The polynomial with these coefficients by exponents, of s and so many other variables."""
    return _ring(others).from_dict(dict(terms)) if flint else Sparse(terms)


def terms_of(p) -> list[tuple[tuple[int, ...], Any]]:
    return [(tuple(map(int, e)), c) for e, c in p.to_dict().items()]


@lru_cache(None)
def peak(exponents: tuple[int, ...]):
    """An upper bound of |y^exponents| on the unit ball: prod (e_i / e)^(e_i / 2)."""
    total = sum(exponents)
    square = math.prod((Q(e, total) ** e for e in exponents if e), start=Q(1))
    return root_up(square) if total and max(exponents) < total else Q(1)


# Taylor models --------------------------------------------------------------------------------------------------------


class Taylor:
    """A function of (s, y, robot) within d + r s of the polynomial p, for |y| <= 1 and all robots; s = l at the goal,
    1 along a funnel.
    """

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
            a, b = self.space.size(self.p), self.space.size(other.p)
            r = a * other.r + b * self.r + self.r * (other.r + other.d) + self.d * other.r
            d = a * other.d + b * self.d + self.d * other.d
        return Taylor(self.space, self.p * other.p, r, d).tidy()

    __rmul__ = __mul__

    def tidy(self) -> "Taylor":
        """The same function without terms of high order in s and y, its coefficients rounded."""
        terms, r, d, n, stride = {}, self.r, self.d, self.space.n, self.space.stride
        for e, c in terms_of(self.p):
            order = sum(e[1 : n + 1]) + (stride * sum(e[n + 1 :]) if stride else 0)
            if e[0] > self.space.s_order or order > self.space.y_order:
                coefficient, error = Q(0), abs(c)
            else:
                coefficient, error = near(c)
            if error != 0 and e[0]:
                r += error * peak(e[1 : n + 1])
            elif error != 0:
                d += error * peak(e[1 : n + 1])
            if coefficient != 0:
                terms[e] = coefficient
        return Taylor(self.space, self.space.polynomial(terms), up(r), up(d))

    @property
    def constant(self):
        return self.p.to_dict().get(self.space.exponents(), Q(0))

    @property
    def least(self):
        """A lower bound."""
        return 2 * self.constant - self.space.size(self.p) - self.r - self.d

    @property
    def largest(self):
        """An upper bound of its absolute value."""
        return self.space.size(self.p) + self.r + self.d


class Space(NamedTuple):
    """Where Taylor models live: n components of y, the orders in s and y above which terms go to the remainder, and m
    uncertain numbers p of the robot. Each power of p counts as `stride` powers of y; with 0 all powers of p stay.
    """

    n: int
    s_order: int
    y_order: int
    m: int = 0
    stride: int = 0

    def exponents(self, s: int = 0, y: int | None = None, p: int | None = None) -> tuple[int, ...]:
        """Of s^s, times the component y, times the component p."""
        return (s, *(int(y == i) for i in range(self.n)), *(int(p == i) for i in range(self.m)))

    def polynomial(self, terms: Mapping[tuple[int, ...], Any]) -> Any:
        return polynomial(self.n + self.m, terms)

    def derivative(self, p) -> Any:
        """In s."""
        return self.polynomial({(e[0] - 1, *e[1:]): c * e[0] for e, c in terms_of(p) if e[0]})

    def size(self, p):
        """An upper bound of |p| for |s| <= 1, |y| <= 1 and all robots."""
        return up(sum((abs(c) * peak(e[1 : self.n + 1]) for e, c in terms_of(p)), Q(0)))

    def enclose(self, a: Any) -> Taylor:
        """A Taylor model of itself, of a polynomial or of a scalar."""
        if isinstance(a, Taylor):
            return a
        return Taylor(self, self.poly(a) if isinstance(a, int | Q) else a)

    def poly(self, a: Any):
        """The polynomial of a scalar."""
        return self.polynomial({self.exponents(): Q(a)} if a != 0 else {})

    def compose(self, coefficients: Sequence, inner):
        """The polynomial with these coefficients of the powers of another one."""
        total = self.poly(0)
        for c in reversed(coefficients):
            total = total * inner + self.poly(c)
        return total

    def of_the_robot(self, powers: Sequence[int]):
        """The product of these powers of p."""
        return self.polynomial({(0,) * (self.n + 1) + tuple(powers): Q(1)})

    @property
    def s(self):
        return self.polynomial({self.exponents(1): Q(1)})

    def y(self, i: int):
        return self.polynomial({self.exponents(y=i): Q(1)})

    def between(self, low, high, i: int) -> Taylor:
        """The number that goes from `low` to `high` with p_i."""
        return Taylor(
            self, self.polynomial({self.exponents(): (low + high) / 2, self.exponents(p=i): (high - low) / 2})
        )


def economize(series: Sequence, radius, degree: int):
    """Coefficients of a polynomial of lower degree, and a bound of what that changes for |x| <= radius (Lanczos)."""
    c, error = list(series), Q(0)
    for k in range(len(c) - 1, degree, -1):
        if c[k] != 0:
            scale = c[k] * radius**k / Q(2 ** (k - 1))
            c = [a - scale * t / radius**j for j, (a, t) in enumerate(zip(c[: k + 1], chebyshev(k), strict=True))]
            error += abs(scale)
    return c[: degree + 1], error


@lru_cache(None)
def chebyshev(k: int) -> tuple[int, ...]:
    """Coefficients of T_k."""
    if k < 2:
        return (1,) if k == 0 else (0, 1)
    twice, before = (0, *chebyshev(k - 1)), (*chebyshev(k - 2), 0, 0)
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
    radius = max(up(space.size(x.p), 20), Q(1, 1 << 20))
    require(radius <= 8, place, "the funnel is wider than 8 rad")
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
