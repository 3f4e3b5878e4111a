"""softmode's vector environments as a `Wrapper` of skrl (skrl 2, torch)."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.vector import VectorEnv

from softmode.envs.adapters.common import checked_env, missing
from softmode.vector_check.tensors import map_tree

try:
    import torch
    from skrl import config
    from skrl.envs.wrappers.torch import Wrapper
    from skrl.utils.spaces.torch import flatten_tensorized_space, unflatten_tensorized_space
except ImportError as error:
    raise missing("skrl and torch", "skrl") from error


class SkrlWrapper(Wrapper):
    """All worlds of a softmode environment as skrl's `Wrapper`; tensors stay on the device.

    Use it in place of ``skrl.envs.wrappers.torch.wrap_env``, whose wrapper for Gymnasium copies every step to the host
    and back. Observations are flattened as skrl's models expect; ``unflatten_tensorized_space`` restores a Dict. Worlds
    restart by themselves, so ``reset`` starts episodes once and then returns the present observations. With pixels,
    ``state`` is the full state, for a critic.

    Args:
        env: A softmode vector environment with SAME_STEP autoreset and ``output="torch"``.

    Raises:
        ConfigError: If it is another kind of environment.
    """

    def __init__(self, env: VectorEnv) -> None:
        """Take over the device; skrl's global seed is that of the first reset."""
        super().__init__(checked_env(env, "SkrlWrapper", output="torch"))
        self._seed: int | None = config.torch.key
        self._observations: Any = None
        self._infos: dict[str, Any] = {}
        self._has_state = getattr(self._unwrapped, "obs_type", "state") != "state"

    @property
    def device(self) -> torch.device:
        """Where the tensors lie."""
        return self.reset()[0].device

    @property
    def observation_space(self) -> gym.Space:
        """Observations of one world."""
        return self._env.single_observation_space

    @property
    def action_space(self) -> gym.Space:
        """Actions of one world."""
        return self._env.single_action_space

    @property
    def state_space(self) -> gym.Space | None:
        """The full state of one world where the observation is pixels, else None."""
        if not self._has_state:
            return None
        size = self._unwrapped.state_observation.shape[1]
        return gym.spaces.Box(-float("inf"), float("inf"), (size,))

    def reset(self) -> tuple[torch.Tensor, dict[str, Any]]:
        """Start episodes the first time; later return what is there."""
        if self._observations is None:
            observation, self._infos = self._env.reset(seed=self._seed)
            self._observations = flatten_tensorized_space(_floats(observation))
        return self._observations, self._infos

    def step(self, actions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, Any]:
        """Make one control step.

        Args:
            actions: Shape (num_envs, action_size), clipped to -1..1.

        Returns:
            Observations (num_envs, D), rewards, terminated and truncated (num_envs, 1), infos. Numbers that skrl
            writes to its log are in ``infos["episode"]``.
        """
        actions = unflatten_tensorized_space(self.action_space, actions)
        observation, reward, terminated, truncated, self._infos = self._env.step(actions)
        self._observations = flatten_tensorized_space(_floats(observation))
        now, ended = self._infos["reward_terms"], self._infos["final_info"]["reward_terms"]
        self._infos["episode"] = {
            f"Reward / {name}": torch.where(terminated | truncated, ended[name], value).mean()
            for name, value in now.items()
            if not name.startswith("_")
        }
        reward, terminated, truncated = (value.view(-1, 1) for value in (reward, terminated, truncated))
        return self._observations, reward, terminated, truncated, self._infos

    def state(self) -> torch.Tensor | None:
        """Return the full state (num_envs, D) where the observation is pixels, else None."""
        return self._unwrapped.state_observation if self._has_state else None

    def render(self, *args: Any, **kwargs: Any) -> Any:
        """Return a picture of each world."""
        return self._env.render()

    def close(self) -> None:
        """Close the environment."""
        self._env.close()


def _floats(observation: Any) -> Any:
    """Return an observation with its bytes and whole numbers as float32, which models take; floats stay themselves."""
    return map_tree(lambda leaf: leaf if leaf.is_floating_point() else leaf.float(), observation)
