"""Bodies of other functions than the default's in the hands of a robot.

Builds a body of local handles and one of Q-GMLS, which the default's replace elsewhere.
"""

from __future__ import annotations

from dataclasses import replace

import gymnasium as gym
import pytest

from softmode.deformables import BuildOptions
from softmode.envs import LiftSoftConfig
from softmode.testing import assert_no_flag, assert_success
from tests.envs.conftest import Episodes


@pytest.mark.rest
@pytest.mark.parametrize("handles", ["local", "qgmls"])
def test_a_robot_lifts_them(episode: Episodes, handles: str) -> None:
    """The scripted policy lifts a toy of the functions of eight handles."""
    scene = LiftSoftConfig().scene
    build = BuildOptions(handles=handles, local_count=8)  # type: ignore[arg-type]
    config = LiftSoftConfig(scene=replace(scene, object=replace(scene.object, build=build)))
    played = episode(gym.make("softmode/LiftSoft-v0", config=config, device="cpu"), "scripted", 2)
    assert_success(played)
    assert_no_flag(played, allow=["iteration_limit"])
