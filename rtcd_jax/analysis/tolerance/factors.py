"""The largest factors at which something holds, by bisection."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

PRECISE = 1.01
"""Ratio of the smallest factor that is not borne to the largest one that is."""
LEAST, MOST = 1e-3, 1e4
"""Factors that are tried."""

Bears = Callable[[Float[np.ndarray, " B"]], Bool[np.ndarray, " B"]]


def largest_factors(
    bears: Bears,
    most: Float[np.ndarray, " B"],
    tell: Callable[[np.ndarray, np.ndarray], None] = lambda low, high: None,
    precise: float = PRECISE,
) -> Float[np.ndarray, " B"]:
    """For each box the largest factor at which `bears` holds; 0 where it does not even at LEAST.

    Factors double until one is not borne, or `most` is, or halve until one is; then the bracket is halved on a log
    scale, all boxes at once. What a smaller box has lost a larger one does not regain. `tell(low, high)` hears of the
    brackets, whose ends are within `precise` of each other at the end.
    """
    most = np.minimum(most, MOST)
    low, high = np.zeros_like(most), np.where(bears(np.zeros_like(most)), np.inf, 0.0)
    while np.any(open_ := is_open(low, high, most, precise)):
        finite = np.where(np.isinf(high), 1.0, high)
        between = np.where(low > 0, np.sqrt(low * finite), finite / 2)
        tried = np.minimum(np.where(np.isinf(high), np.maximum(1.0, 2 * low), between), most)
        tried = np.where(open_, tried, low)
        borne = bears(tried)
        low, high = np.where(open_ & borne, tried, low), np.where(open_ & ~borne, tried, high)
        tell(low, high)
    return low


def is_open(low: np.ndarray, high: np.ndarray, most: np.ndarray, precise: float = PRECISE) -> np.ndarray:
    """Whose bracket is too wide: neither narrow, nor all that is tried borne, nor the least of it lost."""
    return (high > precise * low) & (low < most) & (high > LEAST)
