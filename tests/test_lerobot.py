"""The package for LeRobot: what its loops are given, and the name by which it finds the package."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import numpy as np
import pytest

from softmode.envs import env_spec
from softmode.errors import MissingExtraError
from tests.modules import load

PACKAGE = Path(__file__).resolve().parents[1] / "packages" / "lerobot_env_softmode"


@pytest.mark.parametrize("obs_type", ["state", "pixels_agent_pos"])
def test_worlds_are_as_the_loops_of_lerobot_expect(obs_type: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Names, batches, pictures of every world, the reset's mark; success by both rules is counted and said."""
    module = load(PACKAGE / "lerobot_env_softmode" / "worlds.py")  # it needs no LeRobot, which is not installed here
    module.check_version("0.6.1")
    with pytest.raises(MissingExtraError, match=r"0\.7\.0 is installed"):
        module.check_version("0.7.0")
    options = {} if obs_type == "state" else {"image_size": 36}
    env = module.make_worlds(
        "softmode/LiftSoft-v0", 2, camera="front", obs_type=obs_type, max_episode_steps=2, **options
    )
    found = env_spec("softmode/LiftSoft-v0", obs_type=obs_type, **options)  # what the plug-in is told without an env
    vector = found.vector_space if obs_type == "state" else None
    space = module.named_space(found.observation_space, vector, found.agent_size, "front")
    assert space == env.single_observation_space and found.action_space == env.single_action_space
    assert env.call("_max_episode_steps") == (2, 2) and env.get_attr("task")[0] == "softmode/LiftSoft-v0"
    assert "hold it at a goal" in env.call("task_description")[0]
    observation, _ = env.reset(seed=[3, 4], options={module.NEW_ROLLOUT: True})
    assert env.observation_space.contains(observation)
    for _ in range(3):  # the third step is of the next episodes, which do not count
        observation, _, terminated, truncated, infos = env.step(np.zeros(env.action_space.shape, np.float32))
        assert env.observation_space.contains(observation)
        if (terminated | truncated).any():
            assert infos["final_info"]["is_success"].shape == (2,)
    assert [frame.ndim for frame in env.call("render")] == [3, 3]
    assert (env.episodes, env.any_successes) == (2, 0)
    env.reset(seed=[0, 1], options={module.NEW_ROLLOUT: True})  # world 0 loses its success again, world 1 ends in one
    for now, ending in (([1, 0], [0, 0]), ([0, 0], [1, 0]), ([1, 1], [0, 1]), ([1, 1], [1, 1])):
        env.count(np.array(ending, bool), np.array(now, bool))
    env.close()
    told = "4 episodes of softmode/LiftSoft-v0: success at the last step 25.0 %, at any step 50.0 %"
    assert told in capsys.readouterr().out


def test_the_wheel_has_the_name_that_lerobot_looks_for(tmp_path: Path) -> None:
    """LeRobot imports distributions whose name in METADATA begins with "lerobot_env_", underscores and all."""
    pytest.importorskip("setuptools", minversion="77")
    source = shutil.copytree(PACKAGE, tmp_path / "source", ignore=shutil.ignore_patterns("*.egg-info", "build"))
    build = "from setuptools import build_meta; build_meta.build_wheel('..')"
    subprocess.run([sys.executable, "-c", build], cwd=source, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("METADATA"))
        told = Parser().parsestr(archive.read(name).decode())
    assert told["Name"] == "lerobot_env_softmode"
