"""Tasks with a robot from a file: where it stands, and the ranges of what is random within its reach."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from softmode.envs.task_config import TaskConfig
from softmode.errors import ConfigError
from softmode.objects.config import ObjectConfig
from softmode.robots.arm import ArmDescription
from softmode.robots.description import RobotDescription
from softmode.robots.jaws import ParallelJaw
from softmode.robots.loading import load
from softmode.robots.table_robot import TableRobot, place_robot, tip_length

Config = TypeVar("Config", bound=TaskConfig)
Robot = str | Path | Mapping[str, Any] | RobotDescription | TableRobot
"""How a robot is given: a name, a file, arguments of `softmode.robots.load` by name, loaded, or at the table."""

_TOP = 0.17
"""Height that every tool is to reach where the workspace allows it: over what stands on the table [m]."""
_MOST_SAMPLES = 2000
"""Most surface samples that an object gets for the sake of narrow finger tips."""
_RANGES = ("position_range", "goal_range", "goal_height")
"""Fields of configurations that shrink with the share of the places that a robot reaches."""


def _sampled_for(thing: ObjectConfig, jaw: ParallelJaw) -> ObjectConfig:
    """Return an object whose surface samples are no farther apart than a finger tip is wide.

    Contact is that of samples: a narrower tip sinks in between them. Objects without extents stay as they are.
    """
    if thing.extents is None:
        return thing
    a, b, c = thing.extents
    wanted = math.ceil(2.0 * (a * b + b * c + c * a) / min(jaw.pad_width, jaw.thickness) ** 2)
    return replace(thing, surface_count=max(thing.surface_count, min(wanted, _MOST_SAMPLES)))


def loaded(robot: Robot) -> RobotDescription | TableRobot:
    """Return a robot that is named, or given by a file or the arguments of `softmode.robots.load`.

    Raises:
        ConfigError: If it is none of that, or an argument is unknown.
        AssetError: If it cannot be loaded.
    """
    if isinstance(robot, Mapping):
        unknown = set(robot) - set(inspect.signature(load).parameters)
        if unknown or "source" not in robot:
            hint = "give source, and further arguments of softmode.robots.load"
            raise ConfigError(f"robot has {sorted(unknown) or 'no source'}", hint=hint)
        return load(**robot)
    return load(robot) if isinstance(robot, (str, Path)) else robot


def with_robot(config: Config, robot: Robot) -> Config:
    """Return a task's configuration with another robot.

    A robot that is not at the table yet is placed so that its tool reaches, pointing down, the home position of the
    configured arm and the random places and goals of the task. Where that cannot be, the ranges shrink about their
    middle, and so does the height of goals.

    Args:
        config: The configuration.
        robot: A name, a file, the arguments of `softmode.robots.load` by name, a loaded robot, or one at the table.

    Raises:
        ConfigError: If the robot has no gripper of two fingers, or cannot reach the table.
        AssetError: If it cannot be loaded.
    """
    scene = config.scene
    arm = scene.arm if isinstance(scene.arm, ArmDescription) else ArmDescription()
    robot = loaded(robot)
    if isinstance(robot, RobotDescription):
        (dx, dy), goal = config.position_range, getattr(config, "goal_range", (0.0, 0.0, 0.0))
        goal = (*(max(side, getattr(config, "goal_distance", (0.0, 0.0))[1]) for side in goal[:2]), *goal[2:])
        rise = getattr(config, "goal_height", arm.home_position[2] - 0.08) + goal[-1]
        x, y, z = arm.home_position
        if config.heights_of_tips and robot.gripper is not None:
            z += ParallelJaw.of(robot).tip - tip_length(arm)
        robot = place_robot(
            robot,
            home_position=(x, y, z),
            home_opening=arm.home_opening,
            over=scene.object_position,
            ranges=(max(dx, goal[0]) + 0.03, max(dy, goal[1]) + 0.03),
            height=max(rise + 0.06, z, min(scene.control.workspace_upper[2], _TOP)),
            also=config.spots(),
        )
        if config.tool_stiffness is not None:
            robot = robot.with_tool_stiffness(config.tool_stiffness)
    if not isinstance(robot, TableRobot):
        hint = "give a name of softmode.robots.available(), a file, a RobotDescription, or a TableRobot"
        raise ConfigError(f"robot is a {type(robot).__name__}", hint=hint)
    control = scene.control
    if config.heights_of_tips:
        up = np.array([0.0, 0.0, tip_length(robot) - tip_length(arm)])
        lower, upper = (tuple((corner + up).tolist()) for corner in (control.workspace_lower, control.workspace_upper))
        control = replace(control, workspace_lower=lower, workspace_upper=upper)
    if robot.share < 1.0:  # the box shrinks about the middle of the places, and still holds what does not move
        ends = [np.array(control.workspace_lower), np.array(control.workspace_upper)]
        middle = np.array([*scene.object_position, ends[0][2]])
        corners = [middle + robot.share * (end - middle) for end in ends]
        corners = np.array([*corners, robot.home_position, *config.spots()])
        lower, upper = (tuple(corner.tolist()) for corner in (corners.min(axis=0), corners.max(axis=0)))
        control = replace(control, workspace_lower=lower, workspace_upper=upper)
    # Loops and joint limits of a gripper take rows of their own.
    more = len(robot.robot.joint_names) + 6 * robot.robot.mjcf.count("<connect")
    shapes = int(np.count_nonzero(robot.robot.model.geom_contype))
    scene = replace(
        scene,
        arm=robot,
        control=control,
        constraint_max=scene.constraint_max + 2 * more,
        rigid_contact_max=max(scene.rigid_contact_max, 64) + 3 * shapes,  # pairs that come near count as well
    )
    if config.samples_for_tips:
        scene = replace(scene, object=_sampled_for(scene.object, robot.jaw))
    changes: dict[str, Any] = {"scene": scene}
    if robot.share < 1.0:
        names = {field.name for field in fields(config)}
        for name in _RANGES:
            if name in names:
                value = getattr(config, name)
                shrunk = tuple(robot.share * v for v in value) if isinstance(value, tuple) else robot.share * value
                changes[name] = shrunk
    return replace(config, **changes)
