"""Ellipsoids {x : (x - x_k)' S_k (x - x_k) <= rho_k} as they are drawn: their shadows on planes of the state."""

import itertools

import numpy as np
from jaxtyping import Float


def planes(n: int) -> list[tuple[int, int]]:
    """Indices of the coordinate and of its velocity, for x = (q_1 .. q_{n/2}, their rates). ValueError for odd n."""
    if n % 2:
        raise ValueError(f"states must be coordinates and their velocities, got an odd number of them: {n}")
    return [(i, i + n // 2) for i in range(n // 2)]


def other_planes(n: int) -> list[tuple[int, int]]:
    """All further pairs of states."""
    usual = planes(n)
    return [pair for pair in itertools.combinations(range(n), 2) if pair not in usual]


def projections(
    S: Float[np.ndarray, "knots n n"], rho: Float[np.ndarray, " knots"], plane: tuple[int, int]
) -> Float[np.ndarray, "knots 2 2"]:
    """M such that {d' M^-1 d <= 1} is the shadow of {x' S x <= rho} on a plane: that block of rho S^-1."""
    i = np.asarray(plane)
    return rho[:, None, None] * np.linalg.inv(S)[:, i[:, None], i]


def outlines(
    centers: Float[np.ndarray, "knots 2"], M: Float[np.ndarray, "knots 2 2"], points: int = 181
) -> Float[np.ndarray, "knots points 2"]:
    """Closed curves of `points` points on the boundaries of {x : (x - c)' M^-1 (x - c) <= 1}."""
    angle = np.linspace(0, 2 * np.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    # M = L L' makes the ellipse the image of the unit disk under L.
    return centers[:, None] + np.swapaxes(np.linalg.cholesky(M) @ circle, 1, 2)
