"""Splitting a capture into its objects."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from softmode.errors import ConfigError
from softmode.splats import Splats, make_plush, read_splats, split_components


def merged(*parts: Splats) -> Splats:
    """Return all splats in one capture."""
    fields = ("means", "quats", "scales", "opacities", "sh")
    return Splats(**{field: np.concatenate([getattr(part, field) for part in parts]) for field in fields})


def test_two_toys_and_a_floater() -> None:
    """Two toys a centimetre apart come back as they were, the larger first; a lone splat is dropped."""
    large, small = make_plush(1500), make_plush(500, height=0.04).transformed(translation=(0.0, 0.07, 0.0))
    floater = small.subset([0]).transformed(translation=(0.0, 0.0, 0.2))
    capture = merged(small, floater, large)
    parts = split_components(capture, gap=0.006)
    assert [part.count for part in parts] == [1500, 500]
    np.testing.assert_array_equal(parts[0].means, large.means)
    np.testing.assert_array_equal(parts[1].means, small.means)


def test_haze_joins_nothing_and_goes_with_the_nearest() -> None:
    """Faint splats between two toys do not join them; each goes with the toy within reach."""
    toy = make_plush(800)
    other = toy.transformed(translation=(0.0, 0.1, 0.0))
    bridge = toy.subset(np.zeros(40, dtype=int))
    line = np.linspace([0.0, 0.0, 0.03], [0.0, 0.1, 0.03], 40)
    bridge = replace(bridge, means=line, opacities=np.full(40, 0.05))
    parts = split_components(merged(toy, bridge, other), gap=0.008)
    assert len(parts) == 2 and all(800 < part.count < 840 for part in parts)
    assert len(split_components(merged(toy, bridge, other), gap=0.008, min_opacity=0.01)) == 1


def test_playbot_is_ground_robot_and_two_hands(playbot: Path) -> None:
    """The trained asset holds a patch of ground, the robot above it and its two floating hands."""
    parts = split_components(read_splats(playbot).oriented("-y"))
    robot = max(parts, key=lambda part: np.ptp(part.means[:, 2]))
    low, high = robot.bounds(quantile=0.01)
    assert robot.count > 1500 and low[2] > 0.1 and high[2] - low[2] > 0.7
    assert (np.abs(robot.bounds()[:, :2]) < 0.6).all()


def test_refuses_a_bad_gap() -> None:
    """A gap of zero joins nothing and is refused."""
    with pytest.raises(ConfigError, match="gap"):
        split_components(make_plush(300), gap=0.0)
