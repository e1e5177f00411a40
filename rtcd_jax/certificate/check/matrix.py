"""Products and determinants of numbers and of polynomials alike."""

from collections.abc import Iterable
from functools import reduce
from operator import add
from typing import Any


def dot(a: Iterable, b: Iterable) -> Any:
    """The sum of products."""
    return reduce(add, (c * d for c, d in zip(a, b, strict=True)))


def cofactors(m: list[list]) -> tuple[list[list], Any]:
    """The adjugate and the determinant of a matrix."""
    if len(m) == 1:
        return [[1]], m[0][0]

    def determinant(rows: tuple[int, ...], columns: tuple[int, ...]) -> Any:
        first = m[rows[0]]
        if len(rows) == 1:
            return first[columns[0]]
        minors = [determinant(rows[1:], columns[:k] + columns[k + 1 :]) for k in range(len(columns))]
        return dot([first[column] * (-1) ** k for k, column in enumerate(columns)], minors)

    every = tuple(range(len(m)))
    without = [tuple(j for j in every if j != i) for i in every]
    adjugate = [[determinant(without[j], without[i]) * (-1) ** (i + j) for j in every] for i in every]
    return adjugate, determinant(every, every)
