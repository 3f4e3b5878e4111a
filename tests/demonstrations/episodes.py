"""Made-up episodes for the tests of datasets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from softmode.demonstrations import DatasetWriter, Feature

FPS = 30
CAMERA = "observation.images.front"


def features(pictures: str | None = None) -> dict[str, Feature]:
    """Return features of every kind, with pictures of 32 x 48 if a way to store them is given."""
    found = {
        "observation.state": Feature(dtype="float32", shape=(3,), names=("x", "y", "z")),
        "observation.environment_state": Feature(dtype="float64", shape=(2,)),
        "action": Feature(dtype="float32", shape=(2,)),
        "next.reward": Feature(dtype="float32", shape=(1,)),
        "next.done": Feature(dtype="bool", shape=(1,)),
        "next.success": Feature(dtype="bool", shape=(1,)),
    }
    if pictures:
        found[CAMERA] = Feature(dtype=pictures, shape=(32, 48, 3))  # type: ignore[arg-type]
    return found


def episode(number: int, length: int, pictures: bool = False) -> list[dict[str, Any]]:
    """Return the frames of an episode, a function of its number."""
    random = np.random.default_rng(number)
    frames = []
    for k in range(length):
        frame: dict[str, Any] = {
            "observation.state": random.normal(size=3).astype(np.float32),
            "observation.environment_state": random.normal(size=2),
            "action": random.uniform(-1.0, 1.0, 2).astype(np.float32),
            "next.reward": np.float32(random.normal()),
            "next.done": k == length - 1,
            "next.success": k >= length - 2,
        }
        if pictures:
            frame[CAMERA] = np.full((32, 48, 3), (40 * number, 200, 90), np.uint8)
            frame[CAMERA][:, : 2 * k] = (250, 10, 5 * k)
        frames.append(frame)
    return frames


def write(
    folder: Path, lengths: tuple[int, ...], pictures: str | None = None, *, first: int = 0, **options: Any
) -> list[list[dict[str, Any]]]:
    """Write episodes of the given lengths; return their frames."""
    episodes = [episode(first + k, length, pictures is not None) for k, length in enumerate(lengths)]
    with DatasetWriter(folder, features(pictures), fps=FPS, robot_type="arm", **options) as writer:
        for k, frames in enumerate(episodes):
            for frame in frames:
                writer.add_frame(frame)
            writer.save_episode("push" if (first + k) % 3 == 2 else "lift the toy")
    return episodes
