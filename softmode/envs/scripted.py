"""From an environment to its task's scripted policy: what the task's demonstrations look like."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import gymnasium as gym

from softmode.errors import ConfigError

_POLICIES = {
    "LiftSoft": "lift_soft.scripted:ScriptedLift",
    "PushSoft": "push_soft.scripted:ScriptedPush",
    "PressSoft": "press_soft.scripted:ScriptedPress",
    "PlaceInBin": "place_in_bin.scripted:ScriptedPlace",
    "RopeRoute": "rope_route.scripted:ScriptedRope",
    "ShapeSoft": "shape_soft.scripted:ScriptedShape",
}


def scripted_policy(env: gym.Env) -> Callable[[Any], Any]:
    """Return the scripted policy of an environment: called with an observation it returns an action.

    Args:
        env: An environment of one world, wrapped or not.

    Raises:
        ConfigError: If its task has none, or it takes other actions than tool steps.
    """
    kind = type(getattr(env.unwrapped, "task", None))
    own = getattr(kind, "scripted_policy", None)
    if own is not None:
        return own(env)
    for base in kind.__mro__:
        if base.__name__ in _POLICIES:
            module, _, name = _POLICIES[base.__name__].partition(":")
            return getattr(importlib.import_module(f"softmode.envs.tasks.{module}"), name)(env)
    hint = f"there is one for {', '.join(_POLICIES)}; a task of yours may set scripted_policy"
    raise ConfigError(f"there is no scripted policy for {env}", hint=hint)
