"""A point that is pushed to a goal: the smallest vector environment with softmode's conventions, on torch tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

if TYPE_CHECKING:
    import torch


class PointVectorEnv(gym.vector.VectorEnv):
    """Points in the plane move by 0.2 times the action; reward is minus the distance to the goal.

    Episodes end after ``limit`` steps (truncated) or when a point leaves the square of half-width 2 (terminated). Draws
    are a function of (seed, episode), so worlds play the same episodes in both autoreset modes.

    Args:
        num_envs: Number of worlds.
        obs_type: state (position and goal) or pixels_agent_pos (a picture of both, and the position).
        mode: NEXT_STEP or SAME_STEP.
        limit: Steps of an episode.
        nan_at: Step and world at which the state is spoilt.
        reward_nan: Spoil the reward in place of the state.
    """

    SIZE = 36

    def __init__(
        self,
        num_envs: int,
        *,
        obs_type: str = "state",
        mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        limit: int = 12,
        nan_at: tuple[int, int] | None = None,
        reward_nan: bool = False,
        device: str = "cpu",
    ) -> None:
        """Allocate the worlds."""
        import torch

        self.num_envs, self.obs_type, self.mode, self.max_episode_steps = num_envs, obs_type, mode, limit
        self.metadata = {"autoreset_mode": mode}
        self.nan_at, self.reward_nan, self.device = nan_at, reward_nan, torch.device(device)
        box = gym.spaces.Box
        if obs_type == "state":
            self.single_observation_space = box(-4.0, 4.0, (4,), np.float32)
        else:
            picture = box(0, 255, (self.SIZE, self.SIZE, 3), np.uint8)
            self.single_observation_space = gym.spaces.Dict(pixels=picture, agent_pos=box(-4.0, 4.0, (2,), np.float32))
        self.single_action_space = box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.place = torch.zeros(num_envs, 2, device=self.device)
        self.goal = torch.zeros(num_envs, 2, device=self.device)
        self.age = torch.zeros(num_envs, device=self.device)
        self.episode = torch.zeros(num_envs, device=self.device)
        self.seeds = torch.arange(num_envs, device=self.device)
        self.done = torch.zeros(num_envs, dtype=torch.bool, device=self.device)
        self.frequencies = torch.tensor([1.0, 1.7, 2.3, 3.1], dtype=torch.float64, device=self.device)
        self.clock = 0

    @property
    def state_observation(self) -> torch.Tensor:
        """Position and goal, (n, 4)."""
        import torch

        return torch.cat([self.place, self.goal], dim=1)

    def _start(self, mask: torch.Tensor) -> None:
        """Begin the next episode of the worlds of a mask."""
        import torch

        phase = ((self.seeds % 10007).double() * 12.9898 + self.episode.double() * 78.233)[:, None]
        phase = phase * self.frequencies
        draw = (2.0 * torch.remainder(torch.sin(phase) * 43758.5, 1.0) - 1.0).float()
        self.place = torch.where(mask[:, None], draw[:, :2], self.place)
        self.goal = torch.where(mask[:, None], draw[:, 2:], self.goal)
        self.age = torch.where(mask, 0.0, self.age)
        self.episode = self.episode + mask.float()
        self.done = self.done & ~mask

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start episodes."""
        import torch

        mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        if options and "reset_mask" in options:
            mask = torch.as_tensor(options["reset_mask"], device=self.device)
        if seed is not None:
            self.seeds = seed + torch.arange(self.num_envs, device=self.device)
            self.episode = torch.zeros_like(self.episode)
        self._start(mask)
        return self._observe(), {}

    def _observe(self) -> Any:
        import torch

        if self.obs_type == "state":
            return self.state_observation.clone()
        grid = torch.linspace(-2.0, 2.0, self.SIZE, device=self.device)
        picture = torch.zeros(self.num_envs, self.SIZE, self.SIZE, 3, dtype=torch.uint8, device=self.device)
        for channel, point in enumerate((self.place, self.goal)):
            near = ((grid[None] - point[:, :1]).abs()[:, None, :] < 0.2) & (
                (grid[None] - point[:, 1:]).abs()[:, :, None] < 0.2
            )
            picture[..., channel] = 255 * near.to(torch.uint8)
        return {"pixels": picture, "agent_pos": self.place.clone()}

    def step(self, actions: torch.Tensor) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Move the points."""
        import torch

        assert isinstance(actions, torch.Tensor) and actions.shape == (self.num_envs, 2)
        waiting = self.done.clone() if self.mode == AutoresetMode.NEXT_STEP else torch.zeros_like(self.done)
        self.place = self.place + torch.where(waiting[:, None], 0.0, 0.2 * actions.clamp(-1.0, 1.0))
        self.age = self.age + (~waiting).float()
        distance = (self.place - self.goal).norm(dim=1)
        terminated = (self.place.abs() > 2.0).any(1) & ~waiting
        truncated = (self.age >= self.max_episode_steps) & ~waiting & ~terminated
        reward = torch.where(waiting, 0.0, -distance)
        self.clock += 1
        if self.nan_at is not None and self.clock == self.nan_at[0]:
            if self.reward_nan:
                reward[self.nan_at[1]] = float("nan")
            else:
                self.place[self.nan_at[1]] = float("nan")
        info: dict[str, Any] = {
            "is_success": (distance < 0.25) & ~waiting,
            "reward_terms": {"distance": reward.clone(), "_distance": ~waiting},
        }
        self.done = terminated | truncated
        if self.mode == AutoresetMode.SAME_STEP:
            last = {"final_obs": self._observe(), "_final_obs": self.done.clone(), "final_info": dict(info)}
            info = {**info, **last, "is_success": info["is_success"] & ~self.done}  # what has just begun is no success
            self._start(self.done.clone())
        else:
            self._start(waiting)
            self.done = terminated | truncated
        return self._observe(), reward, terminated, truncated, info
