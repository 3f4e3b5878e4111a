"""ShapeSoft: bend a soft post into a given shape and hold it there; goal-conditioned."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import warp as wp

from softmode.deformables.build.options import BuildOptions
from softmode.deformables.materials.material import Material
from softmode.envs.markers import dots
from softmode.envs.parameters import Parameter
from softmode.envs.rl_scene import RL_SOLVER
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.task import PROPRIOCEPTION, Segment, Task, TaskConfig
from softmode.envs.tasks.shape_soft import kernels
from softmode.envs.tasks.shape_soft.goals import POINTS, GoalMethods, reward_arguments
from softmode.envs.tasks.shape_soft.targets import ShapeTargets, record_press
from softmode.errors import ConfigError
from softmode.objects.config import ObjectConfig
from softmode.objects.loader import load
from softmode.robots.arm import ArmDescription
from softmode.robots.control import ArmControlOptions
from softmode.scenes.table_scene import TableSceneConfig
from softmode.splats.splats import Splats

RewardType = Literal["dense", "sparse"]

POST = ObjectConfig(
    shape="cylinder",
    extents=(0.03, 0.03, 0.12),
    surface_count=240,
    contact_radius=0.0015,
    clamped_height=0.012,
    build=BuildOptions(mode_count=2, response_derivatives=0, cubature_count=96),
)
"""A soft post whose foot is fixed to the table; 0.7 mm (rms) from one of 49 functions when its end is bent by 84 mm."""
POST_MATERIAL = Material(youngs_modulus=2.0e5, density=300.0, friction=0.4)
"""Soft rubber foam."""


def shape_scene() -> TableSceneConfig:
    """Return the scene: the post between the open fingers."""
    return TableSceneConfig(
        object=POST,
        material=POST_MATERIAL,
        solver=RL_SOLVER,
        substeps=4,
        arm=ArmDescription(home_position=(0.45, 0.0, 0.09), home_opening=0.08),
        control=ArmControlOptions(workspace_lower=(0.33, -0.12, 0.08), workspace_upper=(0.57, 0.12, 0.20)),
    )


@dataclass(frozen=True, kw_only=True)
class ShapeSoftConfig(TaskConfig):
    """Goal and success of ShapeSoft."""

    scene: TableSceneConfig = field(default_factory=shape_scene)
    """Objects, robot and physics; the object is a cylinder that stands upright on a clamped foot."""
    position_range: tuple[float, float] = (0.01, 0.01)
    """Half-width of the post's random position in x and y [m]."""
    youngs_modulus_range: tuple[float, float] | None = (5.0e4, 1.0e6)
    """Range of the random Young's modulus [Pa], log-uniform; None keeps the scene's material."""
    goal_displacement: tuple[float, float] = (0.025, 0.06)
    """Range of the displacement of the free end in the target shape [m]."""
    goal_direction: tuple[float, float] = (-np.pi, np.pi)
    """Range of the direction in which it is bent, about z from the x axis [rad]."""
    reward: RewardType = "dense"
    """"dense": 1 - tanh(error / `reward_length`), and 1 more at the target; "sparse": 0 there and -1 elsewhere."""
    reward_length: float = 0.02
    """Error of the shape that matters to the dense reward [m]."""
    goal_tolerance: float = 0.005
    """Error of the shape, root mean square over the points, that counts as at the target [m]."""
    hold_steps: int = 10
    """Control steps in a row at the target that make a success."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        thing = self.scene.object
        upright = thing.shape == "cylinder" and thing.extents is not None and thing.extents[0] == thing.extents[1]
        if not upright or not thing.clamped_height > 0.0:
            raise ConfigError(
                f"the object of ShapeSoft is a {thing.shape} {thing.extents}, clamped {thing.clamped_height} m high",
                hint="give a cylinder with two equal horizontal extents and clamped_height > 0",
            )
        if self.scale_range is not None:
            raise ConfigError(
                f"scale_range is {self.scale_range}", hint="a clamped object keeps its scale; leave it out"
            )
        near, far = self.goal_displacement
        if not (0.0 <= near <= far <= 0.6 * thing.extents[2] and far > 0.0):  # type: ignore[index]
            raise ConfigError(
                f"goal_displacement must satisfy 0 <= low <= high, 0 < high <= 0.6 height: {self.goal_displacement}"
            )
        least, most = self.goal_direction
        if not -np.pi <= least <= most <= np.pi:
            raise ConfigError(f"goal_direction must satisfy -pi <= low <= high <= pi, got {self.goal_direction}")
        if self.reward not in get_args(RewardType):
            raise ConfigError(f"reward is {self.reward!r}", hint="use 'dense' or 'sparse'")
        for name in ("reward_length", "goal_tolerance"):
            if not 0.0 < getattr(self, name) <= 0.1:
                raise ConfigError(f"{name} must lie in 0..0.1 m, got {getattr(self, name)}")
        if self.hold_steps < 1:
            raise ConfigError(f"hold_steps must be at least 1, got {self.hold_steps}")


class ShapeSoft(Task):
    """Bend the post so that its surface points lie where those of the target shape do, and hold it there.

    The targets are shapes that the arm has made: at construction it presses the post aside once, its surface is
    recorded over the displacement of the free end, and a target is that press turned about the vertical. Static shapes
    under a given displacement depend on stiffness only as far as weight matters, so that one press serves all.

    A state observation is a dict of ``observation``, ``achieved_goal`` and ``desired_goal``, the latter two the points
    [m] relative to the middle of the foot, on the table. The reward is a function of both goals, see
    `GoalMethods.compute_reward`. Terms: ``shape`` (0..1) and ``there`` (0 or 1), or ``there`` (-1 or 0) alone where it
    is sparse. Success: within the tolerance for ``hold_steps`` steps in a row.
    """

    config: ShapeSoftConfig
    config_class = ShapeSoftConfig
    term_names = ("shape", "there")
    metric_names = ("shape_error",)
    point_count = POINTS

    def build(self) -> None:
        """Record the targets."""
        scene, body = self.scene, self.scene.soft.body
        press = record_press(scene, self.config.goal_displacement[1])
        rest = body.surface_points[self.points]
        if scene.cameras:  # the marker shows the whole surface
            rest = np.concatenate([rest, body.surface_points])
            scene.marker_points = wp.zeros((self.world_count, body.surface_count), dtype=wp.vec3, device=self.device)
        self.targets = ShapeTargets.from_press(body, press, rest, self.device)

    def parameters(self) -> tuple[Parameter, ...]:
        """Add the goal: displacement of the free end [m] and direction [rad]."""
        config = self.config
        low, high = np.transpose((config.goal_displacement, config.goal_direction)).tolist()
        goal = Parameter(
            name="goal",
            low=tuple(low),
            high=tuple(high),
            least=(0.0, -2.0 * np.pi),
            most=(config.goal_displacement[1], 2.0 * np.pi),
        )
        return (*super().parameters(), goal)

    def goal_segments(self) -> tuple[Segment, ...]:
        """The points of the target shape [m]."""
        return (Segment("desired_goal", 3 * self.point_count, -2.0, 2.0),)

    def object_segments(self) -> tuple[Segment, ...]:
        """Proprioception again, so that what does not depend on the goal is one range, and the points now [m]."""
        low = np.concatenate([np.broadcast_to(part.low, part.size) for part in PROPRIOCEPTION])
        high = np.concatenate([np.broadcast_to(part.high, part.size) for part in PROPRIOCEPTION])
        return (
            Segment("arm", len(low), tuple(low.tolist()), tuple(high.tolist())),
            Segment("achieved_goal", 3 * self.point_count, -2.0, 2.0),
        )

    def state_keys(self) -> dict[str, slice]:
        """Return the columns of observation and goals."""
        goals = {name: self.segments[name][0] for name in ("achieved_goal", "desired_goal")}
        return {"observation": slice(self.column("object_position"), self.column("achieved_goal")), **goals}

    def observe(self) -> None:
        """Write both goals and the error."""
        scene, table, data = self.scene, self.table, self.scene.model.softmode
        columns = [table.values, table.column("position"), table.column("yaw"), table.column("goal")]
        target = [self.targets.points, self.targets.displacement_max]
        self.launch(
            kernels.observe_points,
            [
                *columns,
                *target,
                data.particle_start,
                scene.state.particle_q,
                self._points,
                len(scene.objects),
                self.column("desired_goal"),
                self.column("achieved_goal"),
            ],
            [self.observation],
            (self.world_count, self.point_count),
        )
        self.launch(
            kernels.observe,
            [
                self.column("desired_goal"),
                self.column("achieved_goal"),
                self.point_count,
                self.column("arm"),
                self.segments["arm"][1].size,
            ],
            [self.observation, self.metrics],
        )
        if scene.cameras:
            shown = scene.marker_points.shape[1]
            self.launch(
                kernels.shape_marker,
                [*columns, *target, self.point_count],
                [scene.marker_points, scene.marker_place],
                (self.world_count, shown),
            )

    def evaluate(self) -> None:
        """Judge the shape."""
        config = self.config
        self.launch(
            kernels.evaluate,
            [
                self.observation,
                self.column("achieved_goal"),
                self.column("desired_goal"),
                self.point_count,
                *reward_arguments(config),
                config.hold_steps,
            ],
            [self.held, self.terms, self.success],
        )

    def marker(self) -> Splats:
        """Return the surface of the post; `observe` bends it."""
        return dots(load(self.config.scene.object).body.surface_points, 0.004, opacity=0.35)


class ShapeSoftEnv(GoalMethods, SoftEnv):
    """One arm, one soft post, one target shape; see :class:`ShapeSoft` and :class:`SoftEnv`."""

    config: ShapeSoftConfig
    task: ShapeSoft
    task_class = ShapeSoft

    @property
    def task_device(self) -> Any:
        """Device of the task."""
        return self.task.device


class ShapeSoftVectorEnv(GoalMethods, SoftVectorEnv):
    """Many worlds of it; see :class:`ShapeSoft` and :class:`SoftVectorEnv`."""

    config: ShapeSoftConfig
    task_class = ShapeSoft

    @property
    def task_device(self) -> Any:
        """Device of the worlds."""
        return self.device
