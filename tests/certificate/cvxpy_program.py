"""The semidefinite program of `prove/sdp.py` as cvxpy states it: an outside oracle of what Clarabel is given."""

import math

import cvxpy as cp
import numpy as np
import scipy.sparse as sp

from rtcd_jax.certificate import check
from rtcd_jax.certificate.prove.sdp import data_of


class CvxpyProgram:
    """The program of a shape, built once; `margin` solves it for an obligation's data."""

    def __init__(self, shape):
        self.shape = shape
        grams, sides = products(shape.n, shape.degree, 0), products(shape.n, shape.degree - 1, 1)
        high, rest = shape.multiplier, shape.bernstein - shape.multiplier
        self.p = cp.Parameter((shape.bernstein + 1, grams[0].shape[0]))
        self.g = [cp.Parameter((rest + 1, len(sides))) for _ in range(shape.constraints)]
        t = cp.Variable()
        first = np.eye(grams[0].shape[0])[0]
        sums = [grams[0] @ positive(shape.n, shape.degree) + t * first for _ in range(shape.bernstein + 1)]
        for parameter in self.g:
            for a in range(high + 1):
                sigma = positive(shape.n, shape.degree - 1)
                for b in range(rest + 1):
                    weight = math.comb(high, a) * math.comb(rest, b) / math.comb(high + rest, a + b)
                    for m, product in enumerate(sides):
                        sums[a + b] += weight * parameter[b, m] * (product @ sigma)
        self.problem = cp.Problem(cp.Maximize(t), [s == self.p[j] for j, s in enumerate(sums)])

    def margin(self, obligation):
        """The largest t; -inf if the program is infeasible."""
        data = data_of(obligation, self.shape)
        self.p.value = data.p
        for parameter, value in zip(self.g, data.g, strict=True):
            parameter.value = value
        return float(self.problem.solve(solver="CLARABEL", ignore_dpp=False))


def positive(n, degree):
    """A positive semidefinite matrix of unknowns over the monomials up to `degree`, row by row."""
    rows = len(check.monomials(n, degree))
    return cp.vec(cp.Variable((rows, rows), PSD=True), order="C")


def products(n, degree, side):
    """For every monomial m up to `side`: the coefficients of (z'G z) m on the sphere, from G's entries row by row."""
    basis, target = check.monomials(n, degree), check.monomials(n, 2 * degree + 2 * side)
    maps = []
    for m in check.monomials(n, side):
        table = np.zeros((len(target), len(basis) ** 2))
        for i, first in enumerate(basis):
            for j, second in enumerate(basis):
                for exponents, coefficient in check.reduced(tuple(map(sum, zip(first, second, m, strict=True)))):
                    table[target.index(exponents), i * len(basis) + j] += coefficient
        maps.append(sp.csc_matrix(table))
    return maps
