"""Demonstrations: episodes recorded as LeRobot v3.0 datasets, and read back; needs the extra `[data]`.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.demonstrations.episode import Episode
    from softmode.demonstrations.reader import Dataset, read_dataset
    from softmode.demonstrations.recording import Recorded, environment_features, observation_columns, record_episodes
    from softmode.demonstrations.schema import Feature
    from softmode.demonstrations.writer import DatasetWriter

__all__ = [
    "Dataset",
    "DatasetWriter",
    "Episode",
    "Feature",
    "Recorded",
    "environment_features",
    "observation_columns",
    "read_dataset",
    "record_episodes",
]

__getattr__, __dir__ = lazy_names(__name__)
