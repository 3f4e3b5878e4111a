"""softmode's vector environments as a `VecEnv` of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import VectorEnv

from softmode.envs.adapters.common import checked_env, infos_of_worlds, missing, to_numpy
from softmode.errors import ConfigError
from softmode.vector_check.tensors import world_of

try:
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices
except ImportError as error:
    raise missing("stable-baselines3", "rl") from error


class StableBaselinesVecEnv(VecEnv):
    """All worlds of a softmode environment as Stable-Baselines3's `VecEnv`.

    A finished world starts its next episode in the same step: ``infos[i]`` describes the step that ended the episode
    and holds its last observation as ``terminal_observation``; ``infos[i]["TimeLimit.truncated"]`` says whether it was
    cut short. ``reset_infos[i]`` describes the new episode.

    The worlds share one object: ``get_attr``, ``set_attr`` and ``env_method`` act on it once and answer for every
    index asked for. A goal environment's ``compute_reward`` is reached that way, as `HerReplayBuffer` does.

    Args:
        env: A softmode vector environment with SAME_STEP autoreset; with ``output="numpy"`` nothing is converted.

    Raises:
        ConfigError: If it is another kind of environment.
    """

    def __init__(self, env: VectorEnv) -> None:
        """Take over spaces and render mode."""
        self.env = checked_env(env, "StableBaselinesVecEnv")
        self.spec = env.spec
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._actions = np.empty(0, np.float32)

    def reset(self) -> Any:
        """Start new episodes in all worlds, with the seeds and options set before."""
        options = self._options[0]
        if any(other != options for other in self._options):
            hint = "give set_options one dict; an array in it holds a value per world"
            raise ConfigError("the options of the worlds differ", hint=hint)
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observation, infos = self.env.reset(seed=seeds, options=dict(options) or None)  # type: ignore[arg-type]
        self.reset_infos = infos_of_worlds(to_numpy(infos), self.num_envs)
        self._reset_seeds()
        self._reset_options()
        return to_numpy(observation)

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions, shape (num_envs, action_size)."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Make the step and return observations, rewards, dones and one info per world."""
        observation, reward, terminated, truncated, infos = self.env.step(self._actions)
        terminated, truncated, infos = map(to_numpy, (terminated, truncated, infos))
        last, ended, _, _ = (infos.pop(key, {}) for key in ("final_obs", "final_info", "_final_obs", "_final_info"))
        worlds = infos_of_worlds(infos, self.num_envs)
        done = terminated | truncated
        if done.any():
            ends = infos_of_worlds(ended, self.num_envs)
            for i in np.flatnonzero(done):
                self.reset_infos[i] = worlds[i]
                worlds[i] = {**ends[i], "terminal_observation": world_of(last, int(i))}
        for info, late in zip(worlds, (truncated & ~terminated).tolist(), strict=True):
            info["TimeLimit.truncated"] = late
        return to_numpy(observation), to_numpy(reward).astype(np.float32), done, worlds

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return a picture of each world."""
        frames: Any = self.env.render()
        return [None] * self.num_envs if frames is None else list(frames)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the environment, once for each index."""
        return [getattr(self._owner(attr_name), attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the environment.

        Raises:
            ConfigError: If it is asked for some worlds alone.
        """
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ConfigError(
                f"{attr_name} cannot be set for {indices} alone: the worlds share one object", hint="leave indices out"
            )
        setattr(self._owner(attr_name) if self.has_attr(attr_name) else self.env.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the environment once and return its result for each index."""
        result = getattr(self._owner(method_name), method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return False: no world has a wrapper of its own. `VecMonitor` records the episodes."""
        return [False for _ in self._get_indices(indices)]

    def _owner(self, name: str) -> Any:
        """Return the wrapper that has an attribute, or the environment inside all of them."""
        return self.env if hasattr(self.env, name) else self.env.unwrapped
