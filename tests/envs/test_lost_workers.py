"""What a vector environment does when its processes fail or die, and what it says of arguments it cannot use."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

import softmode  # noqa: F401
from softmode.deformables.model import status as bits
from softmode.errors import AssetError, ConfigError, WorkerError

TASK = "softmode/PushSoft-v0"
REST = np.zeros((2, 5), np.float32)


def test_processes_that_fail_and_die() -> None:
    """After an error in one process the next reset returns its own observations, in both: an answer that nobody took is
    not that of the next call. With a process that died every call raises WorkerError, `close` does not, and no process
    is left.
    """  # noqa: D205
    env: Any = gym.make_vec(TASK, num_envs=2, processes=2)
    expected = env.reset(seed=0)[0]
    env.step(REST + 1.0)
    first, second = env._worlds
    first._send("no such call")
    second._send("step", REST[1:])
    with pytest.raises(WorkerError, match="AttributeError"):
        first.result()
    np.testing.assert_array_equal(env.reset(seed=0)[0], expected)
    processes = [worlds._process for worlds in env._worlds]
    processes[0].kill()
    processes[0].join()
    for _ in range(2):
        with pytest.raises(WorkerError, match="has died"):
            env.step(REST)
    env.close()
    assert not any(process.is_alive() for process in processes)
    with pytest.raises(WorkerError, match="closed"):
        env.step(REST)


def test_final_info_tells_the_solver_status_of_the_episode_that_ended() -> None:
    """The reset of SAME_STEP clears the status of the new episode only; before the first reset there is no state."""
    env: Any = gym.make_vec(TASK, num_envs=2, autoreset_mode=AutoresetMode.SAME_STEP)
    with pytest.raises(ConfigError, match="before the first reset"):
        _ = env.state_observation
    env.reset(seed=0)
    memory, data = env.task.scene.state.softmode, env.task.scene.model.softmode
    q = memory.q.numpy().copy()
    q[: data.function_start.numpy()[1]] = np.nan
    memory.q.assign(q)
    _, _, terminated, _, info = env.step(REST)
    assert terminated.tolist() == [True, False]
    assert info["final_info"]["solver_status"][0] & bits.WORLD_NOT_FINITE
    assert info["solver_status"][0] == 0


@pytest.mark.parametrize(
    ("given", "error"),
    [
        ({"device": "cuda:99"}, ConfigError),
        ({"size": 0.05}, ConfigError),
        ({"splat": "missing.ply"}, AssetError),
    ],
)
def test_bad_arguments_are_refused_with_typed_errors(given: dict[str, Any], error: type[Exception]) -> None:
    """So by the single environment as by the vector; a splat file stands in for a shape."""
    with pytest.raises(error):
        gym.make(TASK, **given)
    with pytest.raises(error):
        gym.make_vec(TASK, num_envs=1, **given)


def test_a_limit_is_whole() -> None:
    """It is said, not left to a kernel launch."""
    with pytest.raises(ConfigError, match="max_episode_steps"):
        gym.make_vec(TASK, num_envs=1, max_episode_steps=2.5)
