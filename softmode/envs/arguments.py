"""Checks of what the environments are called with: options, devices, actions."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, get_args

import gymnasium as gym
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.checks import require_choice
from softmode.envs.robots import Robot, with_robot
from softmode.envs.task import Task
from softmode.envs.task_config import ObservationType, TaskConfig
from softmode.errors import ConfigError, UnknownArgumentError
from softmode.objects.config import ObjectConfig

CONTROL_MODES = ("pose_delta", "joint_delta")
RENDER_MODES = ("rgb_array",)
LOOK_ON = "human"
"""Render mode of a single environment that opens a page in the browser."""

TaskT = TypeVar("TaskT", bound=Task)


class TaskEnv(Generic[TaskT]):
    """What environments of one world and of many are both: those of the task in brackets, ``SoftEnv[LiftSoft]``."""

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 30}  # noqa: RUF012  (gymnasium's convention)
    task_class: ClassVar[type[Task]] = Task
    """The task."""
    config: Any
    """Configuration of the task."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Take the task from the brackets."""
        super().__init_subclass__(**options)
        arguments = (kind for base in cls.__dict__.get("__orig_bases__", ()) for kind in get_args(base))
        cls.task_class = next((kind for kind in arguments if isinstance(kind, type)), cls.task_class)


@dataclass(frozen=True, kw_only=True)
class Shortcuts:
    """What the constructors of environments take beside or instead of a configuration."""

    obs_type: ObservationType = "state"
    """Kind of observation."""
    render_mode: str | None = None
    """"rgb_array", "human" or None."""
    control_mode: str | None = None
    """What actions mean; None keeps the configuration's."""
    splat: str | Path | None = None
    """Splat file of the object; None for the configured one."""
    size: float | None = None
    """Longest edge of the object [m]."""
    preset: str | None = None
    """Named variant of the task, instead of a configuration."""
    robot: Robot | None = None
    """Robot instead of the built-in arm: a name, a file, arguments of `softmode.robots.load`, or a loaded one."""


def checked_config(
    wanted: type[TaskConfig],
    config: TaskConfig | None,
    given: Shortcuts,
    any_robot: bool = True,
    values: Mapping[str, Any] | None = None,
    *,
    single: bool = False,
) -> TaskConfig:
    """Return the configuration with the constructor's fields and shortcuts applied.

    Args:
        wanted: Class of the configuration.
        config: The configuration, or None for the preset or the default.
        given: The shortcuts.
        any_robot: Whether the task plays with robots from files.
        values: Fields of the configuration, which replace those that it has.
        single: Whether it is for an environment of one world, which people may look on.

    Raises:
        ConfigError: If an option or a field is unknown, or the configuration of another task.
    """
    require_choice("obs_type", given.obs_type, get_args(ObservationType))
    require_choice("render_mode", given.render_mode, (*RENDER_MODES, *([LOOK_ON] if single else []), None))
    require_choice("control_mode", given.control_mode, (*CONTROL_MODES, None))
    if config is not None and not isinstance(config, wanted):
        hint = f"pass {wanted.__name__}(image_size=128), of {wanted.__module__}"
        raise ConfigError(f"config is a {type(config).__name__}", hint=hint)
    if config is not None and given.preset is not None:
        raise ConfigError(f"preset {given.preset!r} and config exclude each other", hint="give one of them")
    if config is None:
        config = wanted() if given.preset is None else wanted.preset(given.preset)
    config = _with_fields(config, values or {})
    scene = config.scene
    if given.control_mode is not None:
        scene = replace(scene, control=replace(scene.control, mode=given.control_mode))  # type: ignore[arg-type]
    if config.object_set is not None and (given.splat is not None or given.size is not None):
        what = "splat" if given.splat is not None else "size"
        hint = "leave it out, or give the set a size: ObjectSet([...], size=0.07)"
        raise ConfigError(f"{what} is given beside a set of objects", hint=hint)
    if given.splat is not None or given.size is not None:
        scene = replace(scene, object=_with_splat(scene.object, given))
    config = replace(config, scene=scene)
    if given.robot is None:
        return config
    if not any_robot:
        low, high = config.scene.control.workspace_lower, config.scene.control.workspace_upper
        far = math.hypot(max(abs(low[0]), abs(high[0])), max(abs(low[1]), abs(high[1])))
        raise ConfigError(
            f"robot given for a task of {wanted.__name__}, which plays with the built-in arm only: it needs a reach "
            f"of {far:.2f} m along the table with the tool {low[2]:.2f} to {high[2]:.2f} m above it",
            hint="LiftSoft, PushSoft, PressSoft and PlaceInBin take any robot; docs/howto/own_robot.md has a scene of "
            "your own",
        )
    return with_robot(config, given.robot)


def _with_fields(config: TaskConfig, values: Mapping[str, Any]) -> TaskConfig:
    """Return a configuration with other values of fields."""
    known = {field.name for field in fields(config)}
    for name in sorted(set(values) - known):
        like = difflib.get_close_matches(name, sorted(known | {field.name for field in fields(Shortcuts)}), cutoff=0.4)
        near = f"Nearest: {', '.join(like)}. " if like else ""
        raise UnknownArgumentError(
            f"unexpected keyword argument {name!r}: no option of the environment, no field of {type(config).__name__}",
            hint=f"{near}Fields: {', '.join(sorted(known))}",
        )
    return replace(config, **values) if values else config


def _with_splat(thing: ObjectConfig, given: Shortcuts) -> ObjectConfig:
    """Return an object of another splat file or size."""
    if given.splat is not None and any(other is not None for other in (thing.extents, thing.preset, thing.file)):
        thing = ObjectConfig(surface_count=thing.surface_count, build=thing.build)
    if thing.extents is not None or thing.body is not None:
        what = f"a {thing.shape} of {thing.extents} m" if thing.body is None else f"the body {thing.body}"
        raise ConfigError(
            f"size given for {what}", hint="set the extents of config.scene.object, or give a splat file too"
        )
    changes = {"splat": given.splat, "size": given.size}
    return thing.changed(**{name: value for name, value in changes.items() if value is not None})


def checked_device(device: wp.DeviceLike) -> wp.Device:
    """Return a Warp device.

    Raises:
        ConfigError: If there is no such device.
    """
    if isinstance(device, str) and device == "cuda":
        device = "cuda:0"
    try:
        return wp.get_device(device)
    except (ValueError, RuntimeError) as error:
        known = ", ".join(str(found) for found in wp.get_devices())
        raise ConfigError(f"there is no device {device!r}", hint=f"use one of {known}") from error


def checked_options(options: Mapping[str, object] | None) -> dict[str, object]:
    """Return reset options as a dict of its own.

    Raises:
        ConfigError: If they are no mapping.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ConfigError(f"options is a {type(options).__name__}", hint="give a dict")
    return dict(options or {})


def checked_actions(actions: object, space: gym.Space) -> NDArray[np.float32]:
    """Return actions as an array.

    Raises:
        ConfigError: If they have another shape than those of the space, or a number is not finite.
    """
    try:
        numbers = np.asarray(actions, np.float32)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"action is no array of numbers: {error}", hint="give one number per entry") from error
    if numbers.shape != space.shape:
        hint = "give one number in [-1, 1] per entry of env.action_space"
        raise ConfigError(f"action has shape {numbers.shape}, expected {space.shape}", hint=hint)
    if not np.isfinite(numbers).all():
        where = f" of worlds {np.flatnonzero(~np.isfinite(numbers).all(axis=1)).tolist()}" if numbers.ndim > 1 else ""
        raise ConfigError(f"action{where} holds NaN or infinity", hint="check the policy that produced it")
    return numbers


def checked_count(name: str, value: object) -> int:
    """Return a whole number of at least 1.

    Raises:
        ConfigError: If it is none.
    """
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ConfigError(f"{name} is {value!r}", hint="give a whole number of at least 1")
    return int(value)


def checked_processes(processes: object, num_envs: int, device: wp.Device, output: str) -> int:
    """Return how many processes share the worlds.

    Args:
        processes: How many were asked for.
        num_envs: Number of worlds.
        device: Where the worlds live.
        output: "numpy" or "torch".

    Raises:
        ConfigError: If they cannot share them.
    """
    count = checked_count("processes", processes)
    if count > 1 and (not device.is_cpu or output != "numpy"):
        hint = "several processes serve CPU and numpy only; leave processes at 1"
        raise ConfigError(f"processes is {count} on {device} with output {output!r}", hint=hint)
    return min(count, num_envs)


def world_seed(random: np.random.Generator) -> int:
    """Return the seed of a world's draws from the generator that `reset(seed=...)` made."""
    return int(random.integers(2**31))
