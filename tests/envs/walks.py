"""A small vector environment that keeps every rule, with the options of softmode's own: noisy points on a plane."""

# ruff: noqa: D102
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space


class WalkVectorEnv(gym.vector.VectorEnv):
    """Points that are pushed about; an episode ends at x > 1 (terminated) or after ``max_episode_steps``.

    Its methods are the places where the tests break it.
    """

    def __init__(
        self,
        num_envs: int,
        *,
        autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP,
        max_episode_steps: int = 6,
        output: str = "numpy",
    ) -> None:
        self.num_envs, self.mode, self.output = num_envs, autoreset_mode, output
        self.metadata = {"autoreset_mode": autoreset_mode}
        self.max_episode_steps = max_episode_steps
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.single_observation_space = gym.spaces.Box(-9.0, 9.0, (3,), np.float32)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.random = [np.random.default_rng() for _ in range(num_envs)]
        self.place = np.zeros((num_envs, 2), np.float32)
        self.count = np.zeros(num_envs, np.int64)
        self.finished = np.zeros(num_envs, bool)

    # -- the API ------------------------------------------------------------------------------------------------------

    def reset(self, *, seed: Any = None, options: Mapping[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        self.seed_worlds(seed, mask)
        self.begin(mask)
        return self.give(self.observe()), self.give(self.reset_infos(mask))

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        actions = self.checked(actions)
        fresh = self.finished.copy() if self.mode is AutoresetMode.NEXT_STEP else np.zeros(self.num_envs, bool)
        self.move(actions, fresh)
        self.count[~fresh] += 1
        if fresh.any():
            self.begin(fresh)
        reward = np.where(fresh, 0.0, self.reward())
        terminated = ~fresh & (self.place[:, 0] > 1.0)
        truncated = ~fresh & self.late()
        self.finished = terminated | truncated
        infos = self.infos(~fresh)
        if self.mode is AutoresetMode.SAME_STEP and self.finished.any():
            final, done = self.observe(), self.finished.copy()
            self.begin(done)
            infos = self.with_final(infos, final, done)
        return tuple(self.give(part) for part in (self.observe(), reward, terminated, truncated, infos))  # type: ignore

    # -- its parts ----------------------------------------------------------------------------------------------------

    def seed_worlds(self, seed: Any, mask: np.ndarray) -> None:
        seeds = (
            [None if seed is None else seed + i for i in range(self.num_envs)] if not isinstance(seed, list) else seed
        )
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self.random[i] = np.random.default_rng(seeds[i])

    def begin(self, mask: np.ndarray) -> None:
        for i in np.flatnonzero(mask):
            self.place[i] = self.random[i].uniform(-0.5, 0.5, 2)
        self.count[mask] = 0
        self.finished[mask] = False

    def checked(self, actions: Any) -> np.ndarray:
        actions = np.array(actions.numpy() if hasattr(actions, "numpy") else actions, np.float32)
        if actions.shape != self.action_space.shape or not np.isfinite(actions).all():
            raise ValueError(f"actions must be finite and of shape {self.action_space.shape}, got {actions.shape}")
        return np.clip(actions, -1.0, 1.0)

    def move(self, actions: np.ndarray, fresh: np.ndarray) -> None:
        self.place[~fresh] += 0.3 * actions[~fresh]

    def observe(self) -> np.ndarray:
        return np.concatenate([self.place, self.count[:, None]], axis=1, dtype=np.float32)

    def reward(self) -> np.ndarray:
        return 1.0 - np.abs(self.place).sum(axis=1)

    def late(self) -> np.ndarray:
        return self.count >= self.max_episode_steps

    def infos(self, mask: np.ndarray) -> dict[str, Any]:
        distance = np.linalg.norm(self.place, axis=1)
        terms = {"x": self.place[:, 0].copy(), "_x": mask.copy()}
        return {
            "distance": distance, "_distance": mask.copy(), "is_success": distance < 0.1, "_is_success": mask.copy(),
            "reward_terms": terms, "_reward_terms": mask.copy(),
        }  # fmt: skip

    def reset_infos(self, mask: np.ndarray) -> dict[str, Any]:
        return self.infos(mask)

    def with_final(self, infos: dict[str, Any], final: np.ndarray, done: np.ndarray) -> dict[str, Any]:
        last = {key: value & done if key.startswith("_") else value for key, value in infos.items()}
        now = self.infos(np.ones(self.num_envs, bool))
        return {
            **now, "final_obs": final, "_final_obs": done.copy(), "final_info": last, "_final_info": done.copy()
        }  # fmt: skip

    def give(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {key: self.give(item) for key, item in value.items()}
        if self.output == "torch":
            import torch

            tensor = torch.from_numpy(value)
            return tensor.float() if tensor.dtype == torch.float64 else tensor
        return value


class GoalWalkVectorEnv(WalkVectorEnv):
    """The same with a goal: Dict observations, and a reward that can be computed for other goals."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs, autoreset_mode=AutoresetMode.SAME_STEP)
        place = gym.spaces.Box(-9.0, 9.0, (2,), np.float32)
        self.single_observation_space = gym.spaces.Dict(
            {"observation": place, "achieved_goal": place, "desired_goal": place}
        )
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.goal = np.full((num_envs, 2), 0.5, np.float32)
        self.calls = 0

    def observe(self) -> Any:
        return {
            "observation": self.place.copy(),
            "achieved_goal": self.place.copy(),
            "desired_goal": self.goal.copy(),
        }

    def reward(self) -> np.ndarray:
        return self.compute_reward(self.place, self.goal, None)

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        """Return the distance to a goal, negative."""
        self.calls += info is not None
        return -np.linalg.norm(achieved - desired, axis=-1)
