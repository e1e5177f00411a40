"""Exact numbers, and how they are rounded; python-flint's where it is installed, else the standard library's."""

import math
from fractions import Fraction
from typing import Any

try:
    import flint
except ImportError:  # the standard library's fractions do the same
    flint = None

Q: Any = flint.fmpq if flint else Fraction
BITS = 80
"""Coefficients are rounded to multiples of 2^-80; every rounding is added to a remainder."""
MAX_ORDER = 16
"""Of polynomials: no file may ask for more."""
MAX_TERMS = 10000
"""Of a Taylor model: a product of two takes some seconds then. The cart-pole's intervals have up to 3960, about own
motions 9520, most of which are zero."""
MAX_FURTHER = 32
"""Of the monomials of a sum of squares, beside those up to its degree."""
MOST_HALVINGS = 4
"""Of an interval in the proof of one of its cases."""
MAX_BYTES = 1 << 28
"""Of a file; that of the refined cart-pole has 1.7e8."""
PI = Q(314159265358979323846264338327950288419716939937510, 10**50)
PI_ERROR = Q(1, 10**49)


class Refused(Exception):
    """What is wrong with a certificate, and where."""

    def __init__(self, place: str, reason: str):
        super().__init__(place, reason)  # both, so that it can be sent between processes

    def __str__(self) -> str:
        place, reason = self.args
        return printable(f"{place}: {reason}")


class Damaged(Refused):
    """The file is not what was written: it is no JSON, or a digest is another."""


class Undecided(Exception):
    """Neither accepted nor refused: the file asks for more time or memory than the limits allow."""


def printable(text: object, longest: int = 400) -> str:
    """A file's text on one line of ASCII, without control sequences."""
    shown = str(text)[:longest].encode("unicode_escape").decode("ascii")
    return shown if len(shown) <= longest and len(str(text)) <= longest else f"{shown[: longest - 3]}..."


def rational(double: float):
    """The number that a double is; OverflowError where it is none."""
    return Q(*double.as_integer_ratio())


def rounded(q) -> float:
    """The double of a number, infinite where it is larger than all doubles."""
    try:
        return float(q)
    except OverflowError:
        return math.inf if q > 0 else -math.inf


def require(holds: bool, place: str, reason: str) -> None:
    """Refuses the certificate, at the place and for the reason, unless it holds."""
    if not holds:
        raise Refused(place, reason)


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
