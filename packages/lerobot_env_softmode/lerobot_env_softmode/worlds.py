"""A vector environment of softmode as LeRobot's loops expect one; needs no LeRobot."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

NEW_ROLLOUT = "lerobot_new_rollout"
"""Reset option by which LeRobot marks the first episodes of a rollout."""


def check_version(found: str) -> None:
    """Raise MissingExtraError for a version of LeRobot that this package was not made for."""
    from softmode.errors import MissingExtraError

    if found.split(".")[:2] != ["0", "6"] or found == "0.6.0":
        hint = "install it with: pip install 'lerobot>=0.6.1,<0.7'"
        raise MissingExtraError(f"LeRobot {found} is installed, and this package is for 0.6.1 up to 0.7", hint=hint)


def make_worlds(env_id: str, count: int, *, camera: str, **options: Any) -> SoftmodeWorlds:
    """Make a task's vector environment for LeRobot.

    Args:
        env_id: Id of the environment, such as "softmode/LiftSoft-v0".
        count: Number of worlds.
        camera: Name of the camera of pictures, and of its observations.
        options: Arguments of the environment.

    Raises:
        ConfigError: If an option is unknown or out of range.
    """
    import softmode  # noqa: F401  (registers the ids)

    if options.get("obs_type") != "state":
        options["camera"] = camera
    mode = AutoresetMode.SAME_STEP
    return SoftmodeWorlds(gym.make_vec(env_id, count, render_mode="rgb_array", autoreset_mode=mode, **options), camera)


def named_space(space: gym.Space, vector: gym.spaces.Box | None, agent_size: int, camera: str) -> gym.spaces.Dict:
    """Return the space of one world's observation by LeRobot's names.

    Args:
        space: Space of the environment's own observation.
        vector: Space of the state, where that is observed; None for pictures.
        agent_size: How many of its leading numbers are the robot's.
        camera: Name of the camera.
    """
    if vector is not None:
        low, high, size = vector.low, vector.high, agent_size
        return gym.spaces.Dict(
            agent_pos=gym.spaces.Box(low[:size], high[:size]),
            environment_state=gym.spaces.Box(low[size:], high[size:]),
        )
    pictures = space["pixels"] if isinstance(space, gym.spaces.Dict) else space
    parts: dict[str, gym.Space] = {"pixels": gym.spaces.Dict({camera: pictures})}
    return gym.spaces.Dict(parts | ({"agent_pos": space["agent_pos"]} if isinstance(space, gym.spaces.Dict) else {}))


class SoftmodeWorlds(gym.vector.VectorWrapper):
    """Worlds of a softmode task with observations by LeRobot's names, and successes counted by both rules.

    Observations are a dict: ``pixels`` (a dict by camera of uint8 pictures, shape (N, H, W, 3)), ``agent_pos``, shape
    (N, A), and for "state" ``environment_state``, shape (N, S), which is the rest of the state.

    Args:
        env: The vector environment, with SAME_STEP autoreset.
        camera: Name of the camera.
    """

    def __init__(self, env: gym.vector.VectorEnv, camera: str) -> None:
        """Read what is observed."""
        super().__init__(env)
        from softmode.envs.catalogue import purpose

        self._base: Any = env.unwrapped
        assert env.spec is not None
        self.camera, self.task, self.task_description = camera, env.spec.id, purpose(env.spec.id)
        self._max_episode_steps = self._base.max_episode_steps
        self._state, self._agent_size = self._base.obs_type == "state", self._base.task.layout.agent_size
        layout, space = self._base.task.layout, self._base.single_observation_space
        vector = layout.space(slice(None)) if self._state else None
        self.single_observation_space = named_space(space, vector, self._agent_size, camera)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self._ended = np.ones(self.num_envs, bool)
        self._ever = np.zeros(self.num_envs, bool)
        self.episodes, self.last_successes, self.any_successes = 0, 0, 0

    def _view(self, observation: Any) -> dict[str, Any]:
        if self._state:
            vector = self._base.state_observation  # also where the observation is a dict of goals
            return {
                "agent_pos": vector[:, : self._agent_size].copy(),
                "environment_state": vector[:, self._agent_size :].copy(),
            }
        if not isinstance(observation, dict):
            return {"pixels": {self.camera: observation}}
        return {"pixels": {self.camera: observation["pixels"]}, "agent_pos": observation["agent_pos"]}

    def reset(self, *, seed: Any = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin new episodes; the mark of a new rollout is LeRobot's own and is not passed on."""
        given = {key: value for key, value in (options or {}).items() if key != NEW_ROLLOUT}
        observation, infos = self.env.reset(seed=seed, options=given or None)
        self._ended[:], self._ever[:] = False, False
        return self._view(observation), infos

    def step(self, actions: Any) -> tuple[dict[str, Any], Any, Any, Any, dict[str, Any]]:
        """Step all worlds; count the first episode of each since the reset."""
        observation, reward, terminated, truncated, infos = self.env.step(actions)
        ending = terminated | truncated
        now = np.array(infos["is_success"], bool)
        if ending.any():
            now[ending] = infos["final_info"]["is_success"][ending]
        self.count(ending, now)
        return self._view(observation), reward, terminated, truncated, infos

    def count(self, ending: NDArray[np.bool_], success: NDArray[np.bool_]) -> None:
        """Count a step: which worlds ended their episode in it, and where it was a success, each shape (N,)."""
        self._ever |= success & ~self._ended
        first = ending & ~self._ended
        self._ended |= first
        self.episodes += int(first.sum())
        self.last_successes += int(success[first].sum())
        self.any_successes += int(self._ever[first].sum())

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return what every world answers: pictures for "render", an attribute otherwise."""
        if name == "render":
            return tuple(self.env.render() or ())
        return self.get_attr(name)

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return an attribute, which is the same in all worlds."""
        return (getattr(self, name),) * self.num_envs

    def close(self, **kwargs: Any) -> None:
        """Close the environment, and say how many of the episodes succeeded."""
        if self.episodes:
            last, ever = (100.0 * count / self.episodes for count in (self.last_successes, self.any_successes))
            print(
                f"softmode: {self.episodes} episodes of {self.task}: success at the last step {last:.1f} %, "
                f"at any step {ever:.1f} %"
            )
            self.episodes = 0
        super().close(**kwargs)
