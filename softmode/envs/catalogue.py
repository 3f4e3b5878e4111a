"""From the name of an environment to its id and its classes."""

from __future__ import annotations

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

import gymnasium as gym
from gymnasium.envs.registration import load_env_creator, registry

from softmode import ENVIRONMENTS
from softmode.errors import ConfigError

if TYPE_CHECKING:
    from softmode.envs.task import TaskConfig

_HINT = f"use one of {', '.join(ENVIRONMENTS)}, or module:id for one that a module of yours registers"


def registered_id(name: str) -> str:
    """Return the id that a name stands for; imports the module in front of a colon, as `gymnasium.make` does.

    Modules in the working folder are found as well, last.

    Raises:
        ConfigError: If the module cannot be imported, or nothing is registered under the id.
    """
    module, _, env = name.rpartition(":")
    if module:
        if not {"", os.getcwd()} & set(sys.path):
            sys.path.append(os.getcwd())
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise ConfigError(
                f"{name!r}: module {module!r} cannot be imported ({error})", hint="install it, or run in its folder"
            ) from error
    if env not in registry:
        raise ConfigError(f"unknown environment {name!r}", hint=_HINT)
    return env


def is_soft(name: str) -> bool:
    """Return whether an environment is one of softmode's or derives from them; errors as for `registered_id`."""
    return hasattr(_creator(name), "task_class")


def env_class(name: str, *, vector: bool = False) -> Any:
    """Return the environment class of a name, or its vector class.

    Raises:
        ConfigError: If there is no such environment, or it is not made of a softmode task.
    """
    if not is_soft(name):
        raise ConfigError(f"environment {name!r} is not made of a softmode task", hint=_HINT)
    creator = _creator(name, vector=vector)
    if creator is None:
        raise ConfigError(
            f"environment {name!r} has no vector form", hint="give gymnasium.register a vector_entry_point"
        )
    return creator


def config_class(name: str) -> type[TaskConfig]:
    """Return the configuration class of an environment; errors as for `env_class`."""
    return env_class(name).task_class.config_class


def purpose(name: str) -> str:
    """Return in a sentence what an environment is about; errors as for `env_class`."""
    text = ENVIRONMENTS.get(name) or (env_class(name).task_class.__doc__ or "").strip().partition("\n")[0]
    return text or registered_id(name)


def _creator(name: str, *, vector: bool = False) -> Any:
    """Return what makes the environment, a class as a rule."""
    spec = gym.spec(registered_id(name))
    entry = spec.vector_entry_point if vector else spec.entry_point
    return load_env_creator(entry) if isinstance(entry, str) else entry
