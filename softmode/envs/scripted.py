"""From an environment to its task's scripted policy: what the task's demonstrations look like."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softmode.envs.scripted_base import Environment, ScriptedPolicy
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.errors import ConfigError

_POLICIES = {
    "LiftSoft": "lift_soft.scripted:ScriptedLift",
    "PushSoft": "push_soft.scripted:ScriptedPush",
    "PressSoft": "press_soft.scripted:ScriptedPress",
    "PlaceInBin": "place_in_bin.scripted:ScriptedPlace",
    "RopeRoute": "rope_route.scripted:ScriptedRope",
    "ShapeSoft": "shape_soft.scripted:ScriptedShape",
}


def scripted_policy(env: Environment) -> Callable[[Any], Any]:
    """Return the scripted policy of an environment: called with an observation it returns an action.

    That of a vector environment returns one action per world, each what it would be in an environment of its own.

    Args:
        env: An environment, wrapped or not; all worlds of a vector environment live in this process.

    Raises:
        ConfigError: If its task has none, or it takes other actions than tool steps.
    """
    base = env.unwrapped
    kind = type(getattr(base, "task", None))
    own = getattr(kind, "scripted_policy", None)
    if own is not None:
        return own(env)
    for parent in kind.__mro__:
        if parent.__name__ in _POLICIES:
            module, _, name = _POLICIES[parent.__name__].partition(":")
            policy = getattr(importlib.import_module(f"softmode.envs.tasks.{module}"), name)
            return scripted_worlds(policy)(env)
    hint = f"there is one for {', '.join(_POLICIES)}; a task of yours may set scripted_policy"
    raise ConfigError(f"there is no scripted policy for {kind.__name__}", hint=hint)


def scripted_worlds(policy: type[ScriptedPolicy]) -> Callable[[Any], Callable[[Any], Any]]:
    """Return what `Task.scripted_policy` of a task of your own is: the policy of an environment, single or vector.

    Args:
        policy: Class of the policy of one world.
    """

    def make(env: Environment) -> Callable[[Any], Any]:
        """Return the policy of an environment."""
        base = env.unwrapped
        return ScriptedWorlds(base, policy) if isinstance(base, SoftVectorEnv) else policy(env)

    return make


class ScriptedWorlds:
    """A scripted policy in every world of a vector environment; it notices by itself when an episode begins.

    Args:
        env: The environment.
        policy: Class of the policy.
    """

    def __init__(self, env: SoftVectorEnv, policy: type[ScriptedPolicy]) -> None:
        """Make a policy per world."""
        self._task = env.task
        self._policies = [policy(env, world=world) for world in range(env.num_envs)]

    def __call__(self, observation: object = None) -> NDArray[np.float32]:
        """Return the actions for the present state, shape (num_envs, action_size)."""
        for policy, elapsed in zip(self._policies, self._task.episodes.elapsed.numpy(), strict=True):
            if elapsed == 0:
                policy.reset()
        return np.stack([policy() for policy in self._policies])
