"""Environments as animations: `UsdAnimation.of_env` and `softmode play --usd`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from softmode.cli.main import main
from softmode.errors import ConfigError
from softmode.splats.formats import read_usd
from softmode.usd import UsdAnimation, read_animation
from softmode.usd.openusd import openusd

pytest.importorskip("pxr", reason="needs the extra [usd]")
PLAY = ["play", "softmode/LiftSoft-v0", "--policy", "random"]


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Return a function that shortens the episodes of the environment."""

    def limit(steps: int) -> None:
        monkeypatch.setattr(gym.spec("softmode/LiftSoft-v0"), "max_episode_steps", steps)

    return limit


@pytest.mark.rest
def test_play_writes_a_stage(tmp_path: Path, capsys: pytest.CaptureFixture[str], short: Callable[[int], None]) -> None:
    """Every reset and step of all episodes is a frame at the control rate; the file is the only one."""
    short(3)
    path = tmp_path / "new" / "lift.usdc"
    assert main([*PLAY, "--episodes", "2", "--usd", str(path), "--usd-mode", "baked"]) == 0
    assert "wrote" in capsys.readouterr().out
    assert [found.name for found in path.parent.iterdir()] == ["lift.usdc"]
    found = read_animation(path)
    (toy,) = found.bodies
    assert found.fps == 30.0
    np.testing.assert_allclose(toy.times, np.arange(8) / 30.0, atol=1e-12)
    lowest = [toy.points_at(frame)[:, 2].min() for frame in range(8)]
    assert -1e-3 < min(lowest) <= max(lowest) < 2e-2  # it stands on the table, z = 0
    assert np.linalg.norm(toy.splats_at(0).means - toy.splats_at(4).means, axis=1).min() > 1e-3  # another place
    np.testing.assert_allclose(read_usd(path, time_code=5).means, toy.splats_at(5).means, atol=1e-6)


def test_worlds_of_a_vector_environment(tmp_path: Path) -> None:
    """World 1 of 2: its own states, not those of world 0; robot and table are there."""
    env: Any = gym.make_vec("softmode/LiftSoft-v0", num_envs=2)
    try:
        env.reset(seed=3)
        with UsdAnimation.of_env(tmp_path / "a.usdc", env, world=1) as animation:
            animation.record()
            env.step(env.action_space.sample())
            animation.record()
            scene = env.unwrapped.task.scene
            q = scene.state.softmode.q.numpy().astype(float)
            place = scene.state.body_q.numpy()
            bodies = scene.model.body_world.numpy()
    finally:
        env.close()
    (toy,) = read_animation(tmp_path / "a.usdc").bodies
    count = toy.object.body.function_count
    np.testing.assert_allclose(toy.coordinates[-1], q[count:], atol=1e-12)
    assert np.abs(toy.coordinates[-1] - q[:count]).max() > 1e-3
    Usd, UsdGeom = openusd("Usd", "UsdGeom")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    links = stage.GetPrimAtPath("/World/Rigid").GetChildren()
    assert stage.GetPrimAtPath("/World/Rigid/world/table") and len(links) > 5
    names = [str(label).rpartition("/")[2] for label in scene.model.body_label]
    last = UsdGeom.XformCache(stage.GetEndTimeCode())
    checked = 0
    for i in np.flatnonzero(bodies == 1).tolist():
        prim = stage.GetPrimAtPath(f"/World/Rigid/{names[i]}")
        if prim:  # links without a visible shape have none
            matrix = np.array(last.GetLocalToWorldTransform(prim))
            np.testing.assert_allclose(matrix[3, :3], place[i, :3], atol=1e-6)
            checked += 1
    assert checked > 5


def test_bad_targets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """They are told in one line before anything is built; what is no environment is refused."""
    (tmp_path / "file").touch()
    for bad in (tmp_path / "a.mp4", tmp_path / "file" / "a.usdc"):
        assert main([*PLAY, "--usd", str(bad)]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    assert main([*PLAY, "--usd", str(tmp_path / "a.usdc")]) == 2
    assert "pip install 'softmode[usd]'" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    monkeypatch.undo()
    with pytest.raises(ConfigError, match="CartPole"):
        UsdAnimation.of_env(tmp_path / "a.usdc", gym.make("CartPole-v1"))
    with pytest.raises(ConfigError, match="state is None"):
        from tests.usd.test_export_animation import Scene

        scene = Scene("affine")
        UsdAnimation(tmp_path / "a.usdc", scene.model, scene.bodies).record()
