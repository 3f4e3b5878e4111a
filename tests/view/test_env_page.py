"""The page that shows an environment to people who look on: what is on it, and where there can be none."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any
from urllib.request import urlopen

import gymnasium as gym
import numpy as np
import pytest

from softmode.envs import LiftSoftEnv
from softmode.envs.soft_env import LOOK_ON
from softmode.errors import ConfigError, MissingExtraError
from tests.needs import needs


@needs("viser")
def test_a_page_shows_every_step(make_env: Callable[..., gym.Env], monkeypatch: pytest.MonkeyPatch) -> None:
    """Opened by the first reset, without a display; bodies and splats are where the simulation has them."""
    env: Any = make_env("LiftSoft", "pixels_agent_pos").unwrapped
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(env, "render_mode", LOOK_ON)
    try:
        env.reset(seed=0)
        assert urlopen(env.page_url, timeout=10.0).status == 200
        env.step(env.action_space.sample())
        assert env.render() is None
        stage = env._page._stage
        stage.update()
        poses = env.scene.state.body_q.numpy()
        for body, frame in stage._frames.items():
            np.testing.assert_allclose(frame.position, poses[body, :3], atol=1e-6)
        shown = stage._session.splats()
        goal = env.scene.marker_place.numpy()[0, :3]
        ring = np.linalg.norm(shown.means[-180:] - goal, axis=1)
        np.testing.assert_allclose(ring, 1.12 * env.scene.soft.radius, rtol=1e-4)
        assert np.abs(shown.means[:-180].mean(axis=0) - env.scene.object_position.numpy()[0, 0]).max() < 0.02
    finally:
        env.close()
    assert env.page_url is None


def test_where_there_can_be_no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without viser the extra is named before anything is built; many worlds have no page."""
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtraError, match="viz"):
        LiftSoftEnv(render_mode="human")
    with pytest.raises(ConfigError, match="human"):
        gym.make_vec("softmode/LiftSoft-v0", num_envs=2, render_mode="human")
