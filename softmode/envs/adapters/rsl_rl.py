"""softmode's vector environments as a `VecEnv` of rsl_rl (rsl-rl-lib 5)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import warp as wp
from gymnasium.vector import VectorEnv

from softmode.envs.adapters.common import checked_env, missing
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.errors import ConfigError

try:
    import torch
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError as error:
    raise missing("rsl-rl-lib", "rsl-rl") from error


class RslRlVecEnv(VecEnv):
    """All worlds of a softmode environment as rsl_rl's `VecEnv`; tensors stay on the device.

    Observation groups: ``policy``, the state (the parts of a Dict in the order of its keys), or with pixels the
    proprioception; ``critic``, the full state, whatever the policy sees; and one group per image, float32 in 0..1 of
    shape (num_envs, channels, height, width). Choose among them by ``obs_groups`` of the runner's configuration::

        {"actor": ["policy"], "critic": ["critic"]}             # obs_type="state"
        {"actor": ["policy", "pixels"], "critic": ["critic"]}   # obs_type="pixels_agent_pos"

    ``extras["time_outs"]`` marks episodes cut short by the time limit. ``extras["log"]`` holds the mean of each reward
    term in this step, and what the last episode of each world came to, averaged over the worlds that ended one.

    Args:
        env: A softmode vector environment with SAME_STEP autoreset, ``output="torch"`` and a time limit. It is reset.
        seed: Seed of that reset.

    Raises:
        ConfigError: If it is another kind of environment.
    """

    def __init__(self, env: VectorEnv, *, seed: int | None = None) -> None:
        """Reset the environment; rsl_rl never does."""
        self.env = checked_env(env, "RslRlVecEnv", output="torch")
        inner = cast(SoftVectorEnv, env.unwrapped)
        limit = getattr(inner, "max_episode_steps", None)
        if not limit:
            raise ConfigError("RslRlVecEnv needs a time limit", hint="give gymnasium.make_vec max_episode_steps=150")
        self._inner = inner
        self.num_envs = env.num_envs
        self.num_actions = int(env.single_action_space.shape[0])  # type: ignore[index]
        self.max_episode_length = int(limit)
        self.cfg = inner.config
        observation, _ = env.reset(seed=seed)
        self._observations = self._groups(observation)
        self._elapsed = wp.to_torch(inner.task.episodes.elapsed)
        self.device = self._elapsed.device
        self._ended = torch.zeros(self.num_envs, dtype=torch.float32, device=self.device)
        self._last: dict[str, torch.Tensor] = {}

    @property
    def unwrapped(self) -> Any:
        """The softmode environment."""
        return self._inner

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps that each world's episode has taken, shape (num_envs,); settable, to spread the ends of episodes."""
        return self._elapsed

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:  # type: ignore[override]
        """Count on from these steps."""
        self._elapsed.copy_(steps)

    def get_observations(self) -> TensorDict:
        """Return the present observations."""
        return self._observations

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Make one control step.

        Args:
            actions: Shape (num_envs, num_actions), clipped to -1..1.

        Returns:
            Observations, rewards, dones and extras.
        """
        observation, reward, terminated, truncated, infos = self.env.step(actions)
        self._observations = self._groups(observation)
        done = terminated | truncated
        extras = {"time_outs": truncated & ~terminated, "log": self._log(infos, done)}
        return self._observations, reward, done, extras

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Start new episodes in all worlds."""
        observation, infos = self.env.reset()
        self._observations = self._groups(observation)
        return self._observations, infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def _groups(self, observation: Any) -> TensorDict:
        """Return the observation groups."""
        parts = observation if isinstance(observation, Mapping) else {"pixels": observation}
        groups = {name: _image(value) for name, value in parts.items() if value.dim() > 2}
        vectors = [value for value in parts.values() if value.dim() == 2]
        state = self._inner.state_observation if groups else torch.cat(vectors, dim=1)
        groups |= {"critic": state} | ({"policy": torch.cat(vectors, dim=1)} if vectors else {})
        return TensorDict(groups, batch_size=[self.num_envs], device=state.device)  # type: ignore[arg-type]

    def _log(self, infos: dict[str, Any], done: torch.Tensor) -> dict[str, torch.Tensor]:
        """Average reward terms and the ends of episodes; nothing is read back to the host."""
        ended = infos["final_info"]["reward_terms"]
        log = {
            f"/reward/{name}": torch.where(done, ended[name], value).mean()
            for name, value in infos["reward_terms"].items()
            if not name.startswith("_")
        }
        self._ended = torch.maximum(self._ended, done.float())
        for name, value in infos["final_info"].items():
            if isinstance(value, torch.Tensor) and value.dim() == 1 and not name.startswith("_"):
                kept = self._last.get(name, torch.zeros_like(self._ended))
                self._last[name] = torch.where(done, value.float(), kept)
                log[f"/episode/{name}"] = self._last[name].sum() / self._ended.sum().clamp(min=1.0)
        return log


def _image(values: torch.Tensor) -> torch.Tensor:
    """Return pictures as float32, channels first; (N, H, W, C) or (N, H, W) -> (N, C, H, W), bytes to 0..1."""
    values = values.permute(0, 3, 1, 2) if values.dim() == 4 else values.unsqueeze(1)
    return values.float() / 255.0 if values.dtype == torch.uint8 else values.float()
