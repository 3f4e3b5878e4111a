"""The observation vector: its named segments, from which its columns, bounds and spaces follow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp

from softmode.deformables.model.declare import launch
from softmode.deformables.model.structs import filled
from softmode.envs import task_kernels as kernels
from softmode.robots.arm import ARM_JOINT_COUNT


@dataclass(frozen=True)
class Segment:
    """A named part of the observation vector."""

    name: str
    """Name of the quantity."""
    size: int
    """How many numbers."""
    low: float | tuple[float, ...]
    """Bound below, in the unit of the quantity."""
    high: float | tuple[float, ...]
    """Bound above."""

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of every number, two float32 arrays of shape (size,)."""
        low, high = (np.broadcast_to(np.array(bound, np.float32), self.size) for bound in (self.low, self.high))
        return low, high


PROPRIOCEPTION = (
    Segment("tool_position", 3, -2.0, 2.0),
    Segment("tool_heading", 2, -1.0, 1.0),
    Segment("opening", 1, -0.1, 0.5),
    Segment("finger_force", 2, 0.0, 200.0),
    Segment("joint_angles", ARM_JOINT_COUNT, -3.5, 3.5),
    Segment("command_lead", 3, -1.0, 1.0),
    Segment("command_turn", 1, -1.0, 1.0),
    Segment("command_opening", 1, -0.5, 0.5),
)
"""What every observation begins with; robots from files have `joint_angles` of their own number."""


def proprioception(joint_count: int) -> tuple[Segment, ...]:
    """Return the segments of the robot.

    Args:
        joint_count: Joints between base and tool.
    """
    return tuple(replace(s, size=joint_count) if s.name == "joint_angles" else s for s in PROPRIOCEPTION)


def goal_part(joint_count: int, size: int) -> tuple[Segment, ...]:
    """Return the segments of a task with goals: proprioception again, and what was reached, ``achieved_goal``.

    With a ``desired_goal`` beside it a state observation is a dict, see `ObservationTable.keys`. The task writes both.

    Args:
        joint_count: Joints between base and tool.
        size: Numbers of a goal.
    """
    bounds = [segment.bounds() for segment in proprioception(joint_count)]
    low, high = (np.concatenate(part) for part in zip(*bounds, strict=True))
    arm = Segment("arm", len(low), tuple(low.tolist()), tuple(high.tolist()))
    return (arm, Segment("achieved_goal", size, -2.0, 2.0))


def object_part(point_count: int) -> tuple[Segment, ...]:
    """Return the segments of object 0 that every state observation has.

    Args:
        point_count: How many of its surface points are observed.
    """
    return (
        Segment("object_position", 3, -2.0, 2.0),
        Segment("object_velocity", 3, -20.0, 20.0),
        Segment("object_offset", 3, -4.0, 4.0),
        Segment("object_points", 3 * point_count, -2.0, 2.0),
    )


def others_part(count: int) -> tuple[Segment, ...]:
    """Return the segments of objects of a set beside object 0, zero where one is not there; none for none.

    Args:
        count: How many there may be.
    """
    if not count:
        return ()
    return (Segment("other_offsets", 3 * count, -4.0, 4.0), Segment("other_present", count, 0.0, 1.0))


def one_hot_part(object_count: int, slots: int = 1) -> tuple[Segment, ...]:
    """Return the segment that says which objects of a set are there.

    Args:
        object_count: Number of objects of the set.
        slots: How many of them a world has room for.
    """
    return (Segment("object_one_hot", slots * object_count, 0.0, 1.0),)


class ObservationTable:
    """The observation vectors of all worlds: where every segment stands, its bounds, and the numbers on the device.

    Args:
        agent: The leading segments, which do not see the object: proprioception and goal.
        rest: The others.
        world_count: Number of worlds.
        device: Warp device.

    Attributes:
        segments: Columns and segment by name.
        low: Bounds below, float32, shape (D,).
        high: Bounds above, float32, shape (D,).
        agent_size: Columns of the leading segments.
        values: The vectors, float32, shape (world_count, D).
        finite: Whether all numbers of a world were finite, shape (world_count,).
    """

    def __init__(
        self, agent: Iterable[Segment], rest: Iterable[Segment], world_count: int, device: wp.DeviceLike = None
    ) -> None:
        """Give every segment its columns."""
        agent, self._device = tuple(agent), wp.get_device(device)
        self.segments: dict[str, tuple[slice, Segment]] = {}
        column = 0
        for segment in (*agent, *rest):
            self.segments[segment.name] = (slice(column, column + segment.size), segment)
            column += segment.size
        bounds = [segment.bounds() for _, segment in self.segments.values()]
        self.low, self.high = (np.concatenate(part) for part in zip(*bounds, strict=True))
        self.agent_size = sum(segment.size for segment in agent)
        self._low, self._high = (wp.array(bound, dtype=float, device=device) for bound in (self.low, self.high))
        self.values = wp.zeros((world_count, column), dtype=float, device=device)
        self.finite = wp.zeros(world_count, dtype=wp.bool, device=device)
        size = self.segments["arm"][1].size if "arm" in self.segments else 0
        columns = {"arm": -1, "arm_size": size, **{name: self.column(name) for name in self.segments}}
        self._columns = filled(kernels.Columns, **columns)

    def column(self, segment: str) -> int:
        """Return the first column of a segment."""
        return self.segments[segment][0].start

    def columns_in(self, struct: Any) -> Any:
        """Return a struct of a kernel whose fields are the first columns of the segments of their names."""
        return filled(struct, **{name: self.column(name) for name in self.segments})

    @property
    def keys(self) -> dict[str, slice]:
        """Columns of each key of a state observation that is a dict, of tasks with goals; empty for a vector."""
        if "achieved_goal" not in self.segments:
            return {}
        goals = {name: self.segments[name][0] for name in ("achieved_goal", "desired_goal")}
        return {"observation": slice(self.column("object_position"), self.column("achieved_goal")), **goals}

    def space(self, columns: slice) -> gym.spaces.Box:
        """Return the space of some columns."""
        return gym.spaces.Box(self.low[columns], self.high[columns], dtype=np.float32)

    def write(self, state: Any, arm: Any) -> None:
        """Write what every observation has: the robot, object 0, objects beside it, and which they are; capturable.

        Args:
            state: A `WorldState`.
            arm: An `ArmState`.
        """
        device, worlds = self._device, self.values.shape[0]
        launch(device, kernels.observe, worlds, state, arm, self._columns, self.values)
        if "object_one_hot" in self.segments:
            columns, segment = self.segments["object_one_hot"]
            given = (state.choice, state.slots, segment.size // state.slots, columns.start)
            launch(device, kernels.observe_choice, (worlds, segment.size), *given, self.values)
        if "other_present" in self.segments:
            offsets, (present, segment) = self.column("other_offsets"), self.segments["other_present"]
            dim = (worlds, segment.size)
            launch(device, kernels.observe_others, dim, state, offsets, present.start, self.values)

    def bound(self) -> None:
        """Clip the vectors to their bounds, and flag what is not finite; capturable."""
        bounds = (self._low, self._high)
        launch(self._device, kernels.bound_observation, self.values.shape[0], *bounds, self.values, self.finite)
