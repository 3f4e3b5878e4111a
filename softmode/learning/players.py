"""Who plays an environment: a script, chance, nobody, or a trained policy from a file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softmode.errors import ConfigError, needs_extra
from softmode.learning.run_folder import checkpoint_in

if TYPE_CHECKING:
    import gymnasium as gym

    from softmode.learning.policy import Policy

Player = Callable[[Any], Any]
"""Turns an observation into an action."""

POLICIES = ("scripted", "random", "zero")
"""Policies that need no file."""


def check_policy(name: str) -> None:
    """Raise ConfigError if a policy is neither a name of :data:`POLICIES` nor a file, nor the folder of a run."""
    if name not in POLICIES and not checkpoint_in(Path(name)).is_file():
        raise ConfigError(
            f"unknown policy {name!r}", hint=f"use one of {', '.join(POLICIES)}, or the file of a trained policy"
        )


def trained_policy(name: str, env: str) -> Policy | None:
    """Return the policy in a checkpoint, or None for a policy that needs no file.

    Args:
        name: What :func:`check_policy` let pass.
        env: Id of the environment that it is to play.

    Raises:
        CheckpointError: If the file is missing, damaged, foreign, or of another environment.
        MissingExtraError: If torch is not installed.
    """
    if name in POLICIES:
        return None
    require_torch()
    from softmode.learning.checkpoints import check_id
    from softmode.learning.policy import load_policy

    policy = load_policy(name)
    check_id(policy.env, name, env)
    return policy


def policy_factory(name: str, env: gym.Env, trained: Policy | None = None) -> Callable[[int], Player]:
    """Return what makes a policy for each episode.

    Args:
        name: scripted, random, zero, or the file of a trained policy.
        env: The environment it will play.
        trained: The policy in that file, if it has been loaded already.

    Returns:
        A callable that takes the seed of an episode whose reset just happened and returns a callable from observation
        to action.

    Raises:
        ConfigError: If there is no such policy, or the environment has no scripted one.
    """
    check_policy(name)
    if name == "scripted":
        from softmode.envs.scripted import scripted_policy

        scripted_policy(env)  # refuses environments without one
        return lambda seed: scripted_policy(env)
    if name == "random":

        def random(seed: int) -> Player:
            env.action_space.seed(seed)
            return lambda observation: env.action_space.sample()

        return random
    if name == "zero":
        zero = env.action_space.low * 0  # type: ignore[attr-defined]
        return lambda seed: lambda observation: zero.copy()
    from softmode.learning.policy import load_policy

    player = load_policy(name) if trained is None else trained
    player.check(env)
    return lambda seed: player


def require_torch() -> None:
    """Raise MissingExtraError where torch is not installed."""
    with needs_extra("rl", "training needs torch"):
        import torch  # noqa: F401
