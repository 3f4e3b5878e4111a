"""A scripted episode of every task: it succeeds within forces and depths that a robot would survive, and replays."""

from __future__ import annotations

import pytest

from softmode.testing import (
    assert_max_force,
    assert_max_penetration,
    assert_no_flag,
    assert_replays,
    assert_success,
)
from tests.envs.conftest import Episodes, MakeEnv

LIMITS = {
    "LiftSoft": (9.0, 0.52),
    "PushSoft": (0.7, 0.41),
    "PressSoft": (6.6, 0.5),
    "RopeRoute": (19.7, 1.4),
    "ShapeSoft": (0.92, 2.0),
    "PlaceInBin": (2.4, 0.62),
}
"""Largest force on a rigid body [N] and depth in it besides the dent [mm]: 1.5 times those of the episode."""


@pytest.mark.parametrize("task", LIMITS)
def test_a_scripted_episode(make_env: MakeEnv, episode: Episodes, task: str) -> None:
    """With seed 2, whatever the material that it draws."""
    played = episode(make_env(task), "scripted", 2)
    assert_success(played)
    assert_no_flag(played, allow=["iteration_limit"])
    force, depth = LIMITS[task]
    assert_max_force(played, force)
    assert_max_penetration(played, depth)
    assert_replays(played)
