"""The checks of a task: what holds of softmode's own, and what is found in broken ones."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import warp as wp

from softmode.cli.main import main
from softmode.envs.tasks.press_soft.task import PressSoft, PressSoftEnv, PressSoftVectorEnv
from softmode.errors import ConfigError
from softmode.testing import check_task


@wp.kernel
def write_secret(secret: wp.array[float], column: int, observation: wp.array2d[float]):
    """Write a number of each world to a column."""
    w = wp.tid()
    observation[w, column] = secret[w]


class Secretive(PressSoft):
    """A task that observes something which it was told when it was built."""

    def build(self) -> None:
        """Draw it."""
        super().build()
        drawn = np.random.default_rng().uniform(0.1, 0.9, self.world_count).astype(np.float32)
        self.secret = wp.array(drawn, dtype=float, device=self.device)

    def observe(self) -> None:
        """Write it over the goal."""
        super().observe()
        self.launch(write_secret, [self.secret, self.layout.column("goal_force")], [self.observation])


class BrokenEnv(PressSoftEnv):
    """The single environment, whose actions tremble by chance that no seed rules."""

    task_class = Secretive

    def step(self, action: Any) -> Any:
        """Step with another action."""
        return super().step(np.clip(action + np.random.default_rng().normal(0.0, 0.3, 5), -1.0, 1.0))


@pytest.fixture
def broken() -> Any:
    """Register the broken environment for a test; its worlds are those of a sound one."""
    gym.register("BrokenEnv-v0", BrokenEnv, vector_entry_point=PressSoftVectorEnv, max_episode_steps=120)
    yield
    del gym.registry["BrokenEnv-v0"]


def test_a_task_of_softmode_passes(capsys: pytest.CaptureFixture[str]) -> None:
    """The command prints a line per check and returns 0."""
    assert main(["check", "softmode/PressSoft-v0", "--episodes", "2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[28:].split()[0] for line in lines] == ["ok"] * 6
    assert "2 of 2 episodes" in lines[-1] and "segments" in lines[-2]


@pytest.mark.usefixtures("broken")
def test_what_is_broken_is_found(capsys: pytest.CaptureFixture[str]) -> None:
    """Chance without a seed breaks Gymnasium's rules, worlds and replay; a secret, the observation; all in one."""
    assert main(["check", "BrokenEnv-v0", "--episodes", "1"]) == 1
    found = {line[:28].strip(): line[28:] for line in capsys.readouterr().out.splitlines()}
    for name in ("Gymnasium's checker", "world i of many", "replay", "observation from the state"):
        assert found[name].startswith("FAILED"), name
    assert found["vector checker"].startswith("ok")
    assert "step 0 of 20: played again, it is off by" in found["replay"]
    assert "goal_force depend" in found["observation from the state"]


def test_what_is_no_task_is_refused() -> None:
    """Another environment, one that is unknown, and no episodes."""
    for name, message in (("CartPole-v1", "not made of a softmode task"), ("Nothing-v0", "unknown environment")):
        with pytest.raises(ConfigError, match=message):
            check_task(name)
    with pytest.raises(ConfigError, match="episodes must"):
        check_task("softmode/PressSoft-v0", episodes=0)
