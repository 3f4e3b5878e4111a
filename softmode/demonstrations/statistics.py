"""Statistics of features: per episode exactly, over a dataset by combining its episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Statistics = dict[str, NDArray[Any]]
"""min, max, mean, std, count and the quantiles of one feature, each of the feature's shape, count of shape (1,)."""


def number_statistics(values: NDArray[Any]) -> Statistics:
    """Return the statistics of a column of numbers.

    Args:
        values: Shape (N, D), N >= 1.
    """
    exact = values.astype(np.float64)
    quantiles = np.quantile(exact, list(QUANTILES.values()), axis=0)
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": exact.mean(axis=0),
        "std": exact.std(axis=0),
        "count": np.array([len(values)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


class PictureStatistics:
    """Statistics of the pictures of an episode per colour channel, scaled to 0..1, from a histogram of the bytes."""

    def __init__(self) -> None:
        """Start without a picture."""
        self._counts = np.zeros((3, 256), np.int64)
        self._pictures = 0

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Count a picture of shape (height, width, 3)."""
        for channel in range(3):
            self._counts[channel] += np.bincount(picture[..., channel].ravel(), minlength=256)
        self._pictures += 1

    def result(self) -> Statistics:
        """Return the statistics, each of shape (3, 1, 1); count is the number of pictures.

        A quantile is the smallest byte that at least that share of the bytes does not exceed.
        """
        level = np.arange(256) / 255.0
        total = self._counts.sum(axis=1)
        below = self._counts.cumsum(axis=1)
        mean = self._counts @ level / total
        variance = (self._counts * (level - mean[:, None]) ** 2).sum(axis=1) / total
        found = {
            "min": level[(self._counts > 0).argmax(axis=1)],
            "max": level[255 - (self._counts[:, ::-1] > 0).argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(variance),
            "count": np.array([self._pictures]),
            **{name: level[(below >= q * total[:, None]).argmax(axis=1)] for name, q in QUANTILES.items()},
        }
        return {name: value if name == "count" else value.reshape(3, 1, 1) for name, value in found.items()}


def combine(parts: Sequence[Statistics]) -> Statistics:
    """Return the statistics of the union of disjoint parts.

    All are exact but the quantiles: those are the parts' quantiles averaged with the parts' counts as weights, which is
    the format's own rule.
    """
    count = np.array([part["count"][0] for part in parts], np.float64)
    share = count / count.sum()

    def average(values: list[NDArray[Any]]) -> NDArray[Any]:
        return np.tensordot(share, np.stack(values), axes=1)

    mean = average([part["mean"] for part in parts])
    variance = average([part["std"] ** 2 + (part["mean"] - mean) ** 2 for part in parts])
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": np.array([int(count.sum())]),
        **{name: average([part[name] for part in parts]) for name in QUANTILES},
    }
