"""Polynomials in s alone, as lists of coefficients, and matrices of them."""

from rtcd_jax.certificate.check.exact import Q


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


def constants(m: list[list]) -> list[list[list]]:
    """A matrix of numbers as one of polynomials."""
    return [[[c] for c in row] for row in m]


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


def norm_squared(polynomials: list[list]) -> list:
    """The sum of their squares."""
    total = [Q(0)]
    for p in polynomials:
        total = plus(total, times(p, p))
    return total


def product_entry(row: list, m: list, column: int) -> list:
    """Entry `column` of the row vector times the matrix."""
    total = [Q(0)]
    for a, entries in zip(row, m, strict=True):
        total = plus(total, times(a, entries[column]))
    return total
