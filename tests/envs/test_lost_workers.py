"""What a vector environment does when its processes fail or die, and what it says of arguments it cannot use."""

from __future__ import annotations

from collections.abc import Iterator
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


@pytest.fixture
def shared() -> Iterator[Any]:
    """Return two worlds in two processes."""
    env = gym.make_vec(TASK, num_envs=2, processes=2)
    yield env
    env.close()


def test_a_process_that_died_is_reported_and_close_stops_the_others(shared: Any) -> None:
    """Every call raises WorkerError, `close` does not, and no process is left."""
    shared.reset(seed=0)
    processes = [worlds._process for worlds in shared._worlds]
    processes[0].kill()
    processes[0].join()
    for _ in range(2):
        with pytest.raises(WorkerError, match="has died"):
            shared.step(REST)
    shared.close()
    assert not any(process.is_alive() for process in processes)
    with pytest.raises(WorkerError, match="closed"):
        shared.step(REST)


def test_an_answer_that_nobody_took_is_not_that_of_the_next_call(shared: Any) -> None:
    """After an error in one process the next reset returns its own observations, in both."""
    expected = shared.reset(seed=0)[0]
    shared.step(REST + 1.0)
    first, second = shared._worlds
    first._send("no such call")
    second._send("step", REST[1:])
    with pytest.raises(WorkerError, match="AttributeError"):
        first.result()
    np.testing.assert_array_equal(shared.reset(seed=0)[0], expected)


def test_final_info_tells_the_solver_status_of_the_episode_that_ended() -> None:
    """The reset of SAME_STEP clears the status of the new episode only."""
    env: Any = gym.make_vec(TASK, num_envs=2, autoreset_mode=AutoresetMode.SAME_STEP)
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


def test_a_limit_is_whole_and_there_is_no_state_before_a_reset() -> None:
    """Both are said, not left to a kernel launch or an index."""
    with pytest.raises(ConfigError, match="max_episode_steps"):
        gym.make_vec(TASK, num_envs=1, max_episode_steps=2.5)
    env: Any = gym.make_vec(TASK, num_envs=1)
    with pytest.raises(ConfigError, match="before the first reset"):
        _ = env.state_observation
