"""How sure a success rate is."""

from __future__ import annotations

import math


def wilson_interval(successes: float, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a success rate (Wilson 1927, doi:10.1080/01621459.1927.10502953).

    Args:
        successes: How many of them succeeded.
        count: Number of episodes.
    """
    p, z = successes / count, 1.96
    center = (p + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(p * (1 - p) / count + z * z / (4 * count * count))
    return max(min(center - half, p), 0.0), min(max(center + half, p), 1.0)  # rounding must not put p outside
