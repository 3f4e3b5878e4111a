"""Demonstrations: episodes recorded as LeRobot v3.0 datasets, and read back."""

from softmode.demonstrations.reader import Dataset, read_dataset
from softmode.demonstrations.schema import Feature
from softmode.demonstrations.writer import DatasetWriter

__all__ = ["Dataset", "DatasetWriter", "Feature", "read_dataset"]
