"""From the id of an environment to its classes."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator

from softmode import ENVIRONMENTS
from softmode.envs.task import TaskConfig
from softmode.errors import ConfigError


def env_class(name: str, *, vector: bool = False) -> Any:
    """Return the environment class of an id, or its vector class.

    Raises:
        ConfigError: If softmode has no environment of that id.
    """
    if name not in ENVIRONMENTS:
        raise ConfigError(f"unknown environment {name!r}", hint=f"use one of {', '.join(ENVIRONMENTS)}")
    spec = gym.spec(name)
    return load_env_creator(str(spec.vector_entry_point if vector else spec.entry_point))


def config_class(name: str) -> type[TaskConfig]:
    """Return the configuration class of an id; errors as for `env_class`."""
    return env_class(name).task_class.config_class
