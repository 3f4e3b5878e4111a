"""Vector environments as tensors: any `gymnasium.vector.VectorEnv`, its arrays on one device."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from softmode.errors import ConfigError
from softmode.learning.networks import Observation
from softmode.learning.spaces import Interface


class Step(NamedTuple):
    """What one control step gives, worlds first."""

    observation: Observation
    reward: torch.Tensor  # (n,) float32
    terminated: torch.Tensor  # (n,) bool
    truncated: torch.Tensor  # (n,) bool
    final: Observation | None  # last observations of worlds that were reset in this step; SAME_STEP only
    success: torch.Tensor | None  # (n,) float32, of the state before a reset
    terms: dict[str, torch.Tensor]  # terms of the reward, (n,) float32 each
    raw: Any  # the observation as the environment gave it
    safe: torch.Tensor | None = None  # (n,) float32, likewise: success within the limits of force and strain


def tensors_of(observation: Any, interface: Interface, device: torch.device) -> Observation:
    """Return the parts of an observation, of one world or many, as tensors: pictures of bytes, vectors of floats.

    Raises:
        KeyError: If one is missing.
    """
    kinds = {**dict.fromkeys(interface.vectors, torch.float32), **dict.fromkeys(interface.pictures, torch.uint8)}
    parts = observation if isinstance(observation, dict) else {next(iter(kinds)): observation}
    return {key: torch.as_tensor(parts[key], device=device).to(kind) for key, kind in kinds.items()}


def action_range(interface: Interface, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the middle of the range of the action and half its width."""
    low, high = (torch.tensor(bound, device=device) for bound in (interface.action_low, interface.action_high))
    return (high + low) / 2.0, (high - low) / 2.0


class TensorVectorEnv:
    """A vector environment that takes and gives tensors.

    Nothing is read back from the device where the environment itself works with tensors on it.

    Args:
        env: The environment.
        device: Where the tensors are.

    Raises:
        ConfigError: If its worlds do not reset themselves, or policies cannot act in its spaces.
    """

    def __init__(self, env: gym.vector.VectorEnv, device: torch.device) -> None:
        """Read the spaces."""
        mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        if mode not in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
            raise ConfigError(f"autoreset mode {mode} cannot be trained on", hint="use AutoresetMode.NEXT_STEP")
        self.env, self.device = env, device
        self.same_step = mode == AutoresetMode.SAME_STEP
        self.interface = Interface.of(env)
        self.count = env.num_envs
        self._center, self._half = action_range(self.interface, device)
        self._tensors: bool | None = None
        self._single = not isinstance(env.single_observation_space, gym.spaces.Dict)

    def privileged(self) -> torch.Tensor | None:
        """Return the full state (n, size) where the environment has one as a tensor or array, else None."""
        state = getattr(self.env.unwrapped, "state_observation", None)
        return None if state is None else self._tensor(state, torch.float32)

    def reset(self, seed: int) -> Observation:
        """Reset all worlds, world i with seed ``seed + i``."""
        observation, _ = self.env.reset(seed=seed)
        return self._observation(observation)

    def reset_some(self, mask: np.ndarray) -> Observation:
        """Reset the worlds of a mask (n,); the others go on. Return what all see."""
        observation, _ = self.env.reset(options={"reset_mask": mask})
        return self._observation(observation)

    @property
    def episode_steps(self) -> int | None:
        """Control steps after which an episode is truncated; None if unknown."""
        own = getattr(self.env.unwrapped, "max_episode_steps", None)
        spec = self.env.spec
        return own if own is not None or spec is None else spec.max_episode_steps

    def step(self, action: torch.Tensor) -> Step:
        """Step all worlds.

        Args:
            action: In [-1, 1], shape (n, action).
        """
        scaled = self._center + self._half * action
        return self.step_raw(scaled if self._tensors else scaled.cpu().numpy())

    def step_raw(self, action: Any) -> Step:
        """Step all worlds with actions as the environment takes them."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        final = last = None
        if self.same_step and "final_obs" in info:
            final = self._final(info["final_obs"], observation)
            last = info.get("final_info", {})
        source = last if self.same_step and last is not None else info
        success, safe = source.get("is_success"), source.get("is_safe_success")
        terms = info.get("reward_terms", {})
        return Step(
            self._observation(observation),
            self._tensor(reward, torch.float32),
            self._tensor(terminated, torch.bool),
            self._tensor(truncated, torch.bool),
            final,
            None if success is None else self._tensor(success, torch.float32),
            {key: self._tensor(value, torch.float32) for key, value in terms.items() if not key.startswith("_")},
            observation,
            None if safe is None else self._tensor(safe, torch.float32),
        )

    def _tensor(self, value: Any, dtype: torch.dtype) -> torch.Tensor:
        return torch.as_tensor(value, device=self.device).to(dtype)

    def _observation(self, observation: Any) -> Observation:
        if self._tensors is None:
            parts = observation.values() if isinstance(observation, dict) else [observation]
            self._tensors = all(isinstance(value, torch.Tensor) for value in parts)
        return tensors_of(observation, self.interface, self.device)

    def _final(self, final: Any, observation: Any) -> Observation:
        """Return last observations of all worlds; those of worlds that go on mean nothing."""
        if isinstance(final, np.ndarray) and final.dtype == object:
            # gymnasium's own vector environments give None where a world goes on.
            if self._single:
                rows = [observation[i] if row is None else row for i, row in enumerate(final)]
                final = np.stack(rows)
            else:
                final = {
                    key: np.stack([value[i] if row is None else row[key] for i, row in enumerate(final)])
                    for key, value in observation.items()
                }
        return self._observation(final)
