"""Vector environments to train on, by id and options that JSON can hold."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import torch

from softmode.envs.catalogue import is_soft
from softmode.errors import ConfigError
from softmode.learning.config_values import with_config


def make_vector_env(env: str, num_envs: int, device: torch.device, options: dict[str, Any]) -> gym.vector.VectorEnv:
    """Return the vector environment of an id: softmode's own with tensors on the device, others as gymnasium has them.

    Args:
        env: Id of the environment, or module:id.
        num_envs: Number of worlds.
        device: Where a softmode environment computes.
        options: Keyword arguments of the environment; ``config`` may be a dict of the fields that differ.

    Raises:
        ConfigError: If the id is not registered or an option is unknown.
    """
    given = dict(options)
    if not is_soft(env):
        return gym.make_vec(env, num_envs=num_envs, vectorization_mode="sync", **given)
    given = with_config(env, given)
    try:
        return gym.make_vec(env, num_envs=num_envs, **{"device": str(device), "output": "torch", **given})
    except TypeError as error:
        if "unexpected keyword" not in str(error):
            raise
        raise ConfigError(
            f"unknown option of {env}: {error}", hint="see the documentation of the environment"
        ) from error
