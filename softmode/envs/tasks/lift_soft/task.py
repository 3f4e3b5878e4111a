"""LiftSoft: pick a soft object from a table and hold it at a goal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from softmode.checks import require_fields, require_numbers
from softmode.envs.markers import sphere_marker
from softmode.envs.observation import Segment
from softmode.envs.parameters import Parameter
from softmode.envs.presets import gentle, rl_scene
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.task import Task
from softmode.envs.task_config import TaskConfig
from softmode.envs.tasks.lift_soft import kernels
from softmode.errors import ConfigError
from softmode.objects.config import ObjectConfig
from softmode.objects.task_objects import BEAM, BEAM_MATERIAL
from softmode.robots.arm import ArmDescription
from softmode.scenes.table_scene import TableSceneConfig
from softmode.splats.splats import Splats


def lift_scene() -> TableSceneConfig:
    """Return the scene: a plush under the open gripper, coarse enough for training (`rl_scene`)."""
    return rl_scene(
        TableSceneConfig(
            object=ObjectConfig(surface_count=200),
            arm=ArmDescription(home_position=(0.45, 0.0, 0.17)),
        )
    )


@dataclass(frozen=True, kw_only=True)
class LiftSoftConfig(TaskConfig):
    """Goal and success of LiftSoft."""

    scene: TableSceneConfig = field(default_factory=lift_scene)
    """Objects, robot and physics."""
    goal_height: float = 0.15
    """Middle of the goal's range of heights: how far the object's centre of mass is to rise [m]."""
    goal_range: tuple[float, float, float] = (0.04, 0.08, 0.05)
    """Half-width of the goal's random position in x and y, around the object's default place, and in height [m]."""
    goal_tolerance: float = 0.03
    """Distance from the goal that counts as there [m]."""
    hold_steps: int = 15
    """Control steps in a row at the goal, held by both fingers, that make a success."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        if not 0.0 < self.goal_height - self.goal_range[2] <= self.goal_height + self.goal_range[2] <= 0.4:
            raise ConfigError(
                f"goal_height {self.goal_height} and goal_range {self.goal_range} must keep the goal in 0..0.4 m"
            )
        require_numbers("goal_range", self.goal_range, 3, at_least=0.0, unit="m")
        require_fields(self, ("goal_tolerance",), above=0.0, below=self.goal_height, unit="m")
        require_fields(self, ("hold_steps",), at_least=1)

    @classmethod
    def presets(cls) -> Mapping[str, Self]:
        """Return "beam" and "gentle".

        The first has object and goals of Isaac Lab's `Isaac-Lift-Soft-Franka`, as high as this arm reaches.
        """
        scene = replace(lift_scene(), object=BEAM, material=BEAM_MATERIAL)
        beam = cls(scene=scene, yaw_range=0.5, goal_height=0.2, goal_range=(0.08, 0.15, 0.08))
        return {"beam": beam, "gentle": gentle(cls())}


class LiftSoft(Task):
    """Lift the object to a goal in the air and hold it there.

    Reward terms: ``reach`` (0..1, tool to object), ``grasp`` (0 or 0.5, both fingers touch), ``lift`` (0..1, share of
    the goal's height while grasped), ``goal`` (0..2, nearness to the goal while lifted), ``hold`` (0 or 2, at the
    goal), ``gentle`` (at most 0, see `TaskConfig.care`). Success: at the goal, held by both fingers, for
    ``hold_steps`` steps in a row.
    """

    config: LiftSoftConfig
    config_class = LiftSoftConfig
    step_kernels = (kernels.observe, kernels.evaluate)
    grasps = True
    filmed_across = goal_ring = True
    takes_sets = True
    takes_several = True
    any_robot = True
    term_names = tuple(kernels.Term.__members__)
    metric_names = tuple(kernels.Metric.__members__)

    def build(self) -> None:
        """Measure the objects."""
        self.radius = self.scene.occupancy.follow([thing.radius for thing in self.scene.occupancy.choices])
        """From the centre of each unscaled object to its farthest point [m], shape (world_count,)."""

    def parameters(self) -> tuple[Parameter, ...]:
        """Add the goal: x, y [m] and how far to rise [m]."""
        config = self.config
        middle, half = np.array([*config.scene.object_position, config.goal_height]), np.array(config.goal_range)
        low, high = tuple((middle - half).tolist()), tuple((middle + half).tolist())
        control = config.scene.control
        least, most = (*control.workspace_lower[:2], 0.01), (*control.workspace_upper[:2], 0.4)
        return (*super().parameters(), Parameter(name="goal", low=low, high=high, least=least, most=most))

    def goal_segments(self) -> tuple[Segment, ...]:
        """The goal's position [m]."""
        return (Segment("goal", 3, -2.0, 2.0),)

    def marker(self) -> Splats:
        """Return a small ball."""
        return sphere_marker(0.4 * self.config.goal_tolerance)


class LiftSoftEnv(SoftEnv[LiftSoft]):
    """One arm, one soft object, one goal; see :class:`LiftSoft` and :class:`SoftEnv`."""


class LiftSoftVectorEnv(SoftVectorEnv[LiftSoft]):
    """Many worlds of it; see :class:`LiftSoft` and :class:`SoftVectorEnv`."""
