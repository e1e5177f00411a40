"""Laurent polynomials: one ring for trigonometry, slides and symbols.

A real function of hinge angles q, slide positions s and symbols p is a sum of terms c e^(i k.q) s^e p^d, conjugate in
k. The exponents (k, e, d) are one tuple of integers. So a product is a convolution, sin^2 + cos^2 = 1 holds by itself,
a derivative is a factor, and two expressions of one function have the same terms.
"""

from collections.abc import Mapping
from typing import final

ROUNDING = 1e-15
"""Terms below this share of the largest one are what rounding leaves where terms cancel."""

Exponents = tuple[int, ...]
Coefficient = complex | float


@final
class Laurent:
    """A polynomial by its `terms`: exponents, all of one length, to coefficients other than zero."""

    __slots__ = ("terms",)

    def __init__(self, terms: Mapping[Exponents, Coefficient]):
        largest = max(map(abs, terms.values()), default=0.0)
        self.terms = {e: c for e, c in terms.items() if abs(c) > ROUNDING * largest}

    def __add__(self, other: "Laurent") -> "Laurent":
        terms = dict(self.terms)
        for e, c in other.terms.items():
            terms[e] = terms.get(e, 0.0) + c
        # Compared with the summands: what cancels leaves nothing, however small the sum is.
        largest = max(map(abs, (*self.terms.values(), *other.terms.values())), default=0.0)
        return Laurent({e: c for e, c in terms.items() if abs(c) > ROUNDING * largest})

    def __neg__(self) -> "Laurent":
        return -1.0 * self

    def __sub__(self, other: "Laurent") -> "Laurent":
        return self + -other

    def __mul__(self, other: "Laurent") -> "Laurent":
        terms: dict[Exponents, Coefficient] = {}
        for e, c in self.terms.items():
            for f, d in other.terms.items():
                g = tuple(map(int.__add__, e, f))
                terms[g] = terms.get(g, 0.0) + c * d
        return Laurent(terms)

    def __rmul__(self, factor: Coefficient) -> "Laurent":
        return Laurent({e: factor * c for e, c in self.terms.items()})

    def by_angle(self, i: int) -> "Laurent":
        """The derivative by the i-th generator's angle, where that generator is e^(iq)."""
        return Laurent({e: 1j * e[i] * c for e, c in self.terms.items() if e[i]})

    def by_position(self, i: int) -> "Laurent":
        """The derivative by the i-th generator."""
        return Laurent({(*e[:i], e[i] - 1, *e[i + 1 :]): e[i] * c for e, c in self.terms.items() if e[i]})
