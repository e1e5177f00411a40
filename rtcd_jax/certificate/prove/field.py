"""A claimed robot's equations in float64."""

from collections.abc import Mapping
from functools import lru_cache
from math import comb
from typing import Any, NamedTuple

import numpy as np

from rtcd_jax.certificate import check


@lru_cache
def float_equations(robot: check.Robot) -> check.Equations:
    """A robot's equations with float coefficients."""

    def function(terms: Any) -> Any:
        return tuple(term._replace(cosine=float(term.cosine), sine=float(term.sine)) for term in terms)

    exact = check.derive(robot)
    return exact._replace(
        robot=robot._replace(
            mass=tuple(tuple(function(entry) for entry in row) for row in robot.mass),
            damping=tuple(map(function, robot.damping)),
            motor=tuple(map(function, robot.motor)),
        ),
        slopes=tuple(map(function, exact.slopes)),
        christoffel=tuple({pair: function(terms) for pair, terms in row.items()} for row in exact.christoffel),
    )


def field(robot: check.Robot, numbers: Mapping[str, Any], x: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """D [...], a [n ...] and b [n ...] at states x [n ...], real or complex; numbers may be arrays."""
    equations = float_equations(robot)
    angles = {k: sum(a * q for a, q in zip(k, x, strict=False) if a) for k in equations.waves}
    waves = {k: (np.sin(angle), np.cos(angle)) for k, angle in angles.items()}
    determinant, a, b = equations.field(numbers, x, waves)
    shape = np.broadcast_shapes(*map(np.shape, (determinant, *a, *b)))
    whole = [np.broadcast_to(each, shape) for each in (determinant, *a, *b)]
    return whole[0], np.stack(whole[1 : len(x) + 1]), np.stack(whole[len(x) + 1 :])


def rate(robot: check.Robot, numbers: Mapping[str, Any], x: np.ndarray, u: Any) -> np.ndarray:
    """x' [n ...] of states [n ...], real or complex."""
    determinant, drift, push = field(robot, numbers, x)
    return (drift + push * u) / determinant


def linear(robot: check.Robot, numbers: Mapping[str, Any], x: np.ndarray, u: float) -> tuple[np.ndarray, np.ndarray]:
    """A [n n] and B [n] at x [n], by complex steps."""
    step = 1e-30
    a = np.imag(rate(robot, numbers, x[:, None] + 1j * step * np.eye(len(x)), u)) / step
    return a, np.imag(rate(robot, numbers, x.astype(complex), u + 1j * step)) / step


class ControlPoints(NamedTuple):
    """The field's Bernstein control points over the robots: mixtures [J, nodes] of its values at robots of the box.

    `numbers` are these robots' [nodes 1].
    """

    numbers: dict[str, np.ndarray]
    mixtures: np.ndarray

    @classmethod
    def of(cls, claim: check.Claim) -> "ControlPoints":
        """With the degrees of the exact field at some state."""
        space, n = claim.space(0, 0), claim.n
        states = [check.Q(2 * i + 3, 7) for i in range(n)]
        waves = {k: (check.Q(3, 5 + i), check.Q(4, 7 + i)) for i, k in enumerate(claim.equations.waves)}
        determinant, a, b = claim.equations.field(claim.numbers(space), states, waves)
        exponents = [e for each in (determinant, *a, *b) for e, _ in check.terms_of(space.enclose(each).p)]
        degrees = [max(e[n + 1 + i] for e in exponents) for i in range(space.m)]
        axes = {name: np.array([float(low)]) for name, (low, _) in claim.parameters.items()}
        mixtures = np.eye(1)
        for name, degree in zip(claim.uncertain, degrees, strict=True):
            low, high = map(float, claim.parameters[name])
            at = np.linspace(0, 1, degree + 1)
            axes[name] = low + (high - low) * at
            values = np.array(
                [[comb(degree, j) * t**j * (1 - t) ** (degree - j) for j in range(degree + 1)] for t in at]
            )
            mixtures = np.kron(mixtures, np.linalg.inv(values))
        grid = np.meshgrid(*(axes[name] for name in claim.uncertain), indexing="ij")
        spread = {name: each.reshape(-1, 1) for name, each in zip(claim.uncertain, grid, strict=True)}
        return cls({name: spread.get(name, value[:, None]) for name, value in axes.items()}, mixtures)

    def field(self, robot: check.Robot, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """D [J D], a [n J D] and b [n J D] at states x [n D], or [n J D] with each robot's own."""
        return tuple(  # pyright: ignore[reportReturnType]
            np.einsum(
                "jk,...kd->...jd",
                self.mixtures,
                np.broadcast_to(each, (*each.shape[:-2], len(self.mixtures), x.shape[-1])),
            )
            for each in field(robot, self.numbers, x if x.ndim == 3 else x[:, None])
        )


def floats(values: Any) -> np.ndarray:
    """Nested lists of exact numbers as doubles."""
    return np.array(values, dtype=object).astype(float)
