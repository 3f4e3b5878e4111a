"""Demonstrations: episodes recorded as LeRobot v3.0 datasets, and read back; needs the extra `[data]`.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.demonstrations.episode import Episode as Episode
    from softmode.demonstrations.reader import Dataset as Dataset
    from softmode.demonstrations.reader import read_dataset as read_dataset
    from softmode.demonstrations.recording import Recorded as Recorded
    from softmode.demonstrations.recording import environment_features as environment_features
    from softmode.demonstrations.recording import observation_columns as observation_columns
    from softmode.demonstrations.recording import record_episodes as record_episodes
    from softmode.demonstrations.schema import Feature as Feature
    from softmode.demonstrations.writer import DatasetWriter as DatasetWriter

__getattr__, __dir__ = lazy_names(__name__)
