"""Cubic Hermite interpolation of arrays, JAX's or numpy's."""

from typing import Any


def cubic_hermite(s: Any, duration: Any, start: Any, start_rate: Any, end: Any, end_rate: Any) -> Any:
    """The cubic through both ends' values and rates at the fraction s of the interval, elementwise."""
    s2, s3 = s * s, s * s * s
    return (
        (2 * s3 - 3 * s2 + 1) * start
        + (s3 - 2 * s2 + s) * duration * start_rate
        + (3 * s2 - 2 * s3) * end
        + (s3 - s2) * duration * end_rate
    )


def cubic_hermite_rate(s: Any, duration: Any, start: Any, start_rate: Any, end: Any, end_rate: Any) -> Any:
    """The time derivative of that cubic."""
    rest = 1 - s
    return 6 * s * rest * (end - start) / duration + rest * (1 - 3 * s) * start_rate + s * (3 * s - 2) * end_rate
