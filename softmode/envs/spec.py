"""What an environment observes and takes as actions, from its configuration, without building it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any

import gymnasium as gym

from softmode.envs.arguments import Shortcuts, checked_config
from softmode.envs.catalogue import env_class, registered_id
from softmode.envs.pictures import picture_space
from softmode.envs.task import layout_of
from softmode.envs.worlds import spaces_of
from softmode.robots.control import action_names

_OF_WORLDS = ("num_envs", "max_episode_steps", "autoreset_mode", "output", "processes", "device", "progress")


@dataclass(frozen=True, kw_only=True)
class EnvSpec:
    """What one world of an environment observes, and takes."""

    action_space: gym.spaces.Box
    """Space of actions."""
    observation_space: gym.Space
    """Space of observations."""
    vector_space: gym.spaces.Box
    """Space of the whole state, whatever is observed."""
    agent_size: int
    """How many of its leading numbers are the robot's own."""
    fps: int
    """Control steps per second."""


def env_spec(name: str, **options: Any) -> EnvSpec:
    """Return what an environment of these options would observe.

    A task's `goal_segments` and `object_segments` are asked with what its configuration says; they may read of the
    scene the controller's `joint_count` and `action_size` alone.

    Args:
        name: Id of the environment.
        options: Arguments of the environment; those of worlds and devices are not looked at.

    Raises:
        ConfigError: If an option is unknown or out of range, the environment is not softmode's, or it observes a
            segmentation, whose labels a scene alone knows.
    """
    kind = env_class(name).task_class
    options = {**gym.spec(registered_id(name)).kwargs, **options}
    given = {key: value for key, value in options.items() if key not in _OF_WORLDS}
    short = Shortcuts(**{field.name: given.pop(field.name) for field in fields(Shortcuts) if field.name in given})
    config = checked_config(kind.config_class, given.pop("config", None), short, kind.any_robot, given)
    joints, objects = config.scene.arm.joint_count, config.object_set
    actions = action_names(config.scene.control.mode, range(joints))
    task = kind.__new__(kind)  # of a task its class and configuration alone; nothing is built
    task.config, task.obs_type, task.world_count, task.device = config, short.obs_type, 1, "cpu"
    held = SimpleNamespace(slots=1 if objects is None else objects.number_range[1])
    controller = SimpleNamespace(joint_count=joints, action_size=len(actions))
    task.scene = SimpleNamespace(controller=controller, occupancy=held)
    task.layout = layout_of(task)
    names = ("pixels", *config.image_outputs) if short.obs_type != "state" else ()
    spaces = {name: picture_space(name, config.image_size) for name in names}
    task.pictures = SimpleNamespace(spaces=lambda: spaces)
    action_space, observation_space = spaces_of(task)
    return EnvSpec(
        action_space=action_space,
        observation_space=observation_space,
        vector_space=task.layout.space(slice(None)),
        agent_size=task.layout.agent_size,
        fps=round(config.scene.control_hz),
    )
