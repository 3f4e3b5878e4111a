"""PushSoft: push a soft object over the table to a goal pose."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from softmode.checks import require_fields, require_number, require_range
from softmode.deformables.materials.material import Material
from softmode.deformables.reduction.options import BuildOptions
from softmode.envs.markers import dots
from softmode.envs.observation import Segment
from softmode.envs.parameters import Parameter
from softmode.envs.placement import Arcs
from softmode.envs.presets import RL_SOLVER
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.task import Task
from softmode.envs.task_config import TaskConfig
from softmode.envs.task_kernels import forget
from softmode.envs.tasks.push_soft import kernels
from softmode.objects.config import ObjectConfig
from softmode.objects.soft_object import SoftObject
from softmode.robots.arm import ArmDescription
from softmode.robots.control import ArmControlOptions
from softmode.robots.table_robot import TableRobot
from softmode.scenes.table_scene import Marker, TableSceneConfig
from softmode.splats.splats import Splats

PUCK = ObjectConfig(
    shape="cylinder",
    extents=(0.07, 0.07, 0.04),
    surface_count=120,
    build=BuildOptions(mode_count=4, cubature_count=64),
)
"""A soft disc."""
ASIDE = 0.7
"""Angle about the object between the ways of object and tool and what lies beside it [rad]."""
PUCK_MATERIAL = Material(youngs_modulus=1.0e5, density=300.0, friction=0.4)
"""Soft foam that slides: nothing lower than its width over twice its friction topples when it is pushed."""


def push_scene() -> TableSceneConfig:
    """Return the scene: a puck, and a fork of two fingers that starts low over the table between robot and puck."""
    return TableSceneConfig(
        object=PUCK,
        material=PUCK_MATERIAL,
        table_friction=0.4,
        solver=RL_SOLVER,
        substeps=4,
        object_position=(0.42, 0.0),
        arm=ArmDescription(home_position=(0.31, 0.0, 0.03), home_opening=0.045),
        control=ArmControlOptions(workspace_lower=(0.25, -0.35, 0.024), workspace_upper=(0.66, 0.35, 0.16)),
    )


@dataclass(frozen=True, kw_only=True)
class PushSoftConfig(TaskConfig):
    """Goal and success of PushSoft."""

    heights_of_tips = True
    scene: TableSceneConfig = field(default_factory=push_scene)
    """Objects, robot and physics."""
    position_range: tuple[float, float] = (0.03, 0.06)
    """Half-width of the object's random position in x and y [m]."""
    goal_distance: tuple[float, float] = (0.08, 0.20)
    """Range of the distance from the object to its goal [m]."""
    goal_direction: tuple[float, float] = (-1.0, 1.0)
    """Range of the direction to the goal, from the x axis, which points away from the robot, about z [rad]."""
    goal_yaw: tuple[float, float] = (0.0, 0.0)
    """Range of the angle by which to turn the object about z [rad]; counts with `yaw_tolerance` only."""
    goal_tolerance: float = 0.02
    """Distance from the goal that counts as there [m]."""
    yaw_tolerance: float | None = None
    """Error of the object's yaw that counts as there [rad]; None ignores yaw, as for round objects."""
    rest_speed: float = 0.02
    """Speed of the object under which it counts as at rest [m/s]."""
    hold_steps: int = 10
    """Control steps in a row at rest at the goal that make a success."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        require_range("goal_distance", self.goal_distance, at_least=0.0, at_most=0.5, unit="m")
        for name in ("goal_direction", "goal_yaw"):
            require_range(name, getattr(self, name), at_least=-np.pi, at_most=np.pi, unit="rad")
        require_fields(self, ("goal_tolerance",), above=0.0, at_most=0.1, unit="m")
        if self.yaw_tolerance is not None:
            require_number("yaw_tolerance", self.yaw_tolerance, above=0.0, at_most=np.pi, unit="rad")
        require_fields(self, ("rest_speed",), above=0.0, unit="m/s")
        require_fields(self, ("hold_steps",), at_least=1)


class PushSoft(Task):
    """Push the object to a goal on the table and leave it there at rest.

    Reward terms: ``reach`` (0..0.5, tool to the side of the object that faces away from the goal), ``progress``
    (-1..1, object towards the goal in this step, over the longest tool step), ``goal`` (0..1, nearness to the goal),
    ``rest`` (0 or 2, at rest at the goal). Success: at rest at the goal for ``hold_steps`` steps in a row.

    Yaw is the rotation about the vertical that best maps the observed surface points from rest to where they are, so
    that it is defined for a deformed object.
    """

    config: PushSoftConfig
    config_class = PushSoftConfig
    step_kernels = (kernels.observe, kernels.evaluate)
    takes_sets = True
    takes_several = True
    any_robot = True
    term_names = tuple(kernels.Term.__members__)
    metric_names = tuple(kernels.Metric.__members__)

    def build(self) -> None:
        """Allocate what the reward remembers."""
        self.before = wp.zeros(self.world_count, dtype=float, device=self.device)
        surfaces = [thing.body.surface.points for thing in self.scene.occupancy.choices]
        rest = [surface[points] for surface, points in zip(surfaces, self.points_of_choices, strict=True)]
        self.rest = self.scene.occupancy.follow(np.stack(rest), wp.vec3)
        self.yaw_tolerance = -1.0 if self.config.yaw_tolerance is None else self.config.yaw_tolerance
        arm = self.config.scene.arm
        width = arm.jaw.finger_width if isinstance(arm, TableRobot) else arm.gripper.pad_size[0]
        radii = [float(np.linalg.norm(points[:, :2], axis=1).max() + 0.5 * width) for points in surfaces]
        self._push_distances = np.array(radii)
        self.push_distances = self.scene.occupancy.follow(self._push_distances)
        """From the centre of each unscaled object to the tool that pushes it [m], shape (world_count,)."""
        self.push_height = self.config.scene.control.workspace_lower[2] + 0.006
        """Height of the tool that pushes [m]."""

    @property
    def push_distance(self) -> NDArray[np.float64]:
        """The same on the host."""
        return self._push_distances[self.scene.occupancy.rows]

    def other_arcs(self) -> Arcs:
        """Return the directions beside the ways to the goal and beside the tool, which comes from the robot."""
        low, high = self.config.goal_direction
        return Arcs(ranges=((high + ASIDE, np.pi - ASIDE), (ASIDE - np.pi, low - ASIDE)), aside=ASIDE)

    def parameters(self) -> tuple[Parameter, ...]:
        """Add the goal: distance [m] and direction [rad] from the object, and the angle to turn [rad]."""
        config = self.config
        low, high = zip(config.goal_distance, config.goal_direction, strict=True)
        low_yaw, high_yaw = config.goal_yaw
        return (
            *super().parameters(),
            Parameter(name="goal", low=low, high=high, least=(0.0, -2.0 * np.pi), most=(0.5, 2.0 * np.pi)),
            Parameter(name="goal_yaw", low=(low_yaw,), high=(high_yaw,), least=(-2.0 * np.pi,), most=(2.0 * np.pi,)),
        )

    def goal_segments(self) -> tuple[Segment, ...]:
        """The goal's position [m] and heading, and its position relative to the tool [m]."""
        return (
            Segment("goal", 2, -2.0, 2.0),
            Segment("goal_heading", 2, -1.0, 1.0),
            Segment("goal_offset", 2, -4.0, 4.0),
        )

    def object_segments(self) -> tuple[Segment, ...]:
        """The way of the object to the goal [m], its heading seen from the goal, the way of the tool behind it [m]."""
        return (
            Segment("object_goal", 2, -4.0, 4.0),
            Segment("object_heading", 2, -1.0, 1.0),
            Segment("push_offset", 3, -4.0, 4.0),
        )

    def clear(self) -> None:
        """Forget how long the object rested and where it was."""
        super().clear()
        self.launch(forget, [self.scene.world_mask, -1.0], [self.before])

    def state_arrays(self) -> dict[str, wp.array]:
        """Add how far the object was from its goal a step ago."""
        return {**super().state_arrays(), "before": self.before}

    def marker(self) -> Marker:
        """Return what draws the outline of an object, to lie on the table."""
        return _outline


def _outline(thing: SoftObject) -> Splats:
    """Return dots along the outline of an object, seen from above."""
    points = thing.body.surface.points[:, :2]
    corners = points[ConvexHull(points).vertices]
    edges = np.roll(corners, -1, axis=0) - corners
    length = np.linalg.norm(edges, axis=1)
    along = np.arange(0.0, length.sum(), 0.003)
    start = np.concatenate([[0.0], np.cumsum(length)])
    k = np.searchsorted(start, along, side="right") - 1
    outline = corners[k] + edges[k] * ((along - start[k]) / length[k])[:, None]
    return dots(np.column_stack([outline, np.full(len(outline), 0.001)]), 0.0018, opacity=0.8)


class PushSoftEnv(SoftEnv[PushSoft]):
    """One arm, one soft object, one goal on the table; see :class:`PushSoft` and :class:`SoftEnv`."""


class PushSoftVectorEnv(SoftVectorEnv[PushSoft]):
    """Many worlds of it; see :class:`PushSoft` and :class:`SoftVectorEnv`."""
