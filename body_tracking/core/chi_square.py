"""Gates: quantiles of the chi-square distribution. ``scipy.special`` has them, and takes a node 0.3 s to import."""

from __future__ import annotations

import math
from functools import lru_cache


def tail(dimension: int, value: float) -> float:
    """Probability of a larger value (Abramowitz and Stegun 1964, 26.4.4 and 26.4.5).

    Args:
        dimension: degrees of freedom, at least 1.
        value: not negative.
    """
    half = 0.5 * value
    first = 2 - dimension % 2
    probability = math.exp(-half) if first == 2 else math.erfc(math.sqrt(half))
    for k in range(first, dimension, 2):
        probability += math.exp(0.5 * k * math.log(half) - half - math.lgamma(0.5 * k + 1.0)) if half else 0.0
    return probability


@lru_cache(maxsize=256)
def gate(dimension: int, probability: float) -> float:
    """The value that a chi-square number exceeds with the given probability; infinity for 0.

    Args:
        dimension: degrees of freedom, at least 1.
        probability: 0 to 1.
    """
    if probability <= 0.0:
        return math.inf
    low, high = 0.0, 1.0
    while tail(dimension, high) > probability:
        high *= 2.0
    while (middle := 0.5 * (low + high)) not in (low, high):
        low, high = (middle, high) if tail(dimension, middle) > probability else (low, middle)
    return high
