"""Confidence in a proportion of independent trials (Clopper and Pearson, Biometrika 26, 1934)."""

import math

from scipy.special import betaincinv


def clopper_pearson(failures: int, trials: int, confidence: float) -> tuple[float, float]:
    """Exact lower and upper bounds of a probability, each of which holds with `confidence` (one-sided)."""
    lower = betaincinv(failures, trials - failures + 1, 1 - confidence) if failures else 0.0
    upper = betaincinv(failures + 1, trials - failures, confidence) if failures < trials else 1.0
    return float(lower), float(upper)


def failure_bound(trials: int, doubt: float) -> float:
    """The upper bound for `trials` trials without a failure, at confidence 1 - doubt: 1 - doubt^(1/trials).

    1 for no trials. Unlike the general bound it keeps its digits for a small `doubt`.
    """
    return -math.expm1(math.log(doubt) / trials) if trials else 1.0
