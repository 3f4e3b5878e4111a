"""An episode that was played: its start, its actions, and what tests ask of every step."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from softmode.deformables.tools.gaps import rigid_gaps
from softmode.envs.env_state import EnvState
from softmode.envs.soft_env import SoftEnv
from softmode.errors import ConfigError
from softmode.learning.players import policy_factory

Player = Callable[[Any], Any]
"""Turns an observation into an action."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Step:
    """A control step, and how it ended."""

    action: NDArray[np.float32]
    """What the task was given, behind any wrapper, shape (A,)."""
    observation: NDArray[np.float32]
    """The full observation vector, whatever `obs_type`, shape (D,)."""
    reward: float
    """Reward of the task."""
    info: dict[str, Any]
    """Info of the environment."""
    force: float
    """Largest contact force of the soft objects on a rigid body [N], a mean over the last substep; what is fixed to the
    world is none."""
    depth: float
    """Depth of the deepest surface sample in a rigid shape [m], at the start of the last substep, less its dent."""


@dataclass(kw_only=True, eq=False)
class Episode:
    """An episode, which can be played again from its start."""

    env: gym.Env
    """The environment that played it."""
    seed: int
    """Seed of its reset."""
    start: EnvState
    """State after the reset."""
    steps: list[Step] = field(default_factory=list)
    """Its steps."""
    failed_at: int | None = None
    """Step at which an assertion on it failed, counted from 0."""

    @property
    def base(self) -> SoftEnv:
        """The bare environment."""
        return soft_base(self.env)

    @property
    def success(self) -> bool:
        """Whether the last step counts as success."""
        return bool(self.steps) and bool(self.steps[-1].info["is_success"])

    @property
    def actions(self) -> NDArray[np.float32]:
        """What the task was given, shape (T, A)."""
        return np.array([step.action for step in self.steps], np.float32)

    @property
    def observations(self) -> NDArray[np.float32]:
        """The full observation vectors after each step, shape (T, D)."""
        return np.array([step.observation for step in self.steps], np.float32)

    @property
    def rewards(self) -> NDArray[np.float64]:
        """The rewards, shape (T,)."""
        return np.array([step.reward for step in self.steps])

    def replayed(self, env: SoftEnv) -> Iterator[Step]:
        """Play the actions again from the start, step by step.

        Args:
            env: A bare environment of the same task, robot and objects.
        """
        env.set_state(self.start)
        for step in self.steps:
            yield played(env, env, step.action)

    def failed(self, step: int, message: str) -> AssertionError:
        """Note the step and return what to raise."""
        self.failed_at = step
        return AssertionError(f"seed {self.seed}, step {step} of {len(self.steps)}: {message}")


def soft_base(env: gym.Env) -> SoftEnv:
    """Return the environment inside its wrappers.

    Raises:
        ConfigError: If it is not softmode's.
    """
    base = env.unwrapped
    if not isinstance(base, SoftEnv):
        raise ConfigError(f"{env} is not made of a softmode task", hint="give a single environment of softmode's")
    return base


def play_episode(
    env: gym.Env,
    policy: str | Player = "scripted",
    seed: int = 0,
    *,
    options: Mapping[str, Any] | None = None,
    max_steps: int | None = None,
    begun: Callable[[Episode], None] | None = None,
) -> Episode:
    """Play an episode to its end.

    Args:
        env: A single environment of softmode's, wrapped or not.
        policy: "scripted", "random", "zero", the file of a trained policy, or a callable from observation to action;
            one with a method `reset` is reset first.
        seed: Seed of the reset.
        options: Options of the reset.
        max_steps: Steps after which it ends; needed where nothing else ends it.
        begun: Called with the episode before its first step, so that it is known even if the policy raises.

    Raises:
        ConfigError: If the environment is not softmode's, or nothing would end the episode.
        SoftmodeError: As for :func:`softmode.learning.policy_factory`.
    """
    base = soft_base(env)
    if max_steps is None and (env.spec is None or env.spec.max_episode_steps is None):
        raise ConfigError("nothing ends the episode", hint="make the environment by gymnasium.make, or give max_steps")
    observation, _ = env.reset(seed=seed, options=None if options is None else dict(options))
    act = policy_factory(policy, env)(seed) if isinstance(policy, str) else policy
    if not isinstance(policy, str) and callable(reset := getattr(policy, "reset", None)):
        reset()
    episode, over = Episode(env=env, seed=seed, start=base.get_state()), False
    if begun is not None:
        begun(episode)
    while not over and len(episode.steps) != max_steps:
        result: list[Any] = []
        episode.steps.append(played(env, base, act(observation), result))
        observation, _, terminated, truncated, _ = result
        over = terminated or truncated
    return episode


def played(env: gym.Env, base: SoftEnv, action: Any, result: list[Any] | None = None) -> Step:
    """Step an environment and return the step; what it returned goes to `result`."""
    returned = env.step(action)
    if result is not None:
        result.extend(returned)
    task, scene = base.task, base.scene
    wrench = scene.solver.body_wrench.numpy().reshape(-1, 6)
    return Step(
        action=scene.actions.numpy()[0].copy(),
        observation=task.observation.numpy()[0].copy(),
        reward=float(task.episodes.reward.numpy()[0]),
        info=returned[-1],
        force=float(np.linalg.norm(wrench[:, :3], axis=1).max(initial=0.0)),
        depth=_depth(base),
    )


def _depth(base: SoftEnv) -> float:
    """Return how deep the deepest surface sample is in a rigid shape besides its dent [m], zero where none is."""
    return max(0.0, -float(rigid_gaps(base.scene.solver).min(initial=0.0)))
