"""How figures grow with the number of robots, and their extrapolation to more robots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

LEAST = 1e-9
"""The value that counts as 0, which has no logarithm."""


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float | None:
    """Return the power of the size with which the values grow, by least squares of their logarithms; None if one of
    them is 0.

    0: they do not depend on the size, 1: they grow in proportion, 2: with its square.
    """
    if len(sizes) < 2 or any(value <= LEAST for value in values):
        return None
    x, y = [math.log(size) for size in sizes], [math.log(value) for value in values]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    spread = sum((a - mean_x) ** 2 for a in x)
    return sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True)) / spread


def extrapolated(sizes: Sequence[float], values: Sequence[float], to: float) -> tuple[float, float]:
    """Return the least and the greatest expected value at a larger size.

    One is a straight line through the two largest sizes. The other uses the steepest power between two successive
    sizes. Neither is less than the value at the largest size.
    """
    (before, b), (last, a) = sorted(zip(sizes, values, strict=True))[-2:]
    line = max(a, a + (a - b) / (last - before) * (to - last))
    ordered = sorted(zip(sizes, values, strict=True))
    steps = [exponent([m, n], [v, w]) for (m, v), (n, w) in pairwise(ordered)]
    power = max((step for step in steps if step is not None), default=0.0)
    curve = max(a, a * (to / last) ** power)
    return min(line, curve), max(line, curve)
