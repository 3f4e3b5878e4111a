"""RopeRoute: lead a soft rope around pegs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
import warp as wp

from softmode.checks import require_fields, require_range
from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.model.structs import filled
from softmode.envs.cameras import square_camera
from softmode.envs.markers import sphere_marker
from softmode.envs.observation import Segment
from softmode.envs.parameters import Parameter
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.task import Task
from softmode.envs.task_config import TaskConfig
from softmode.envs.tasks.rope_route import kernels
from softmode.errors import ConfigError
from softmode.objects.task_objects import ROPE, ROPE_MATERIAL
from softmode.robots.arm import ArmDescription
from softmode.robots.control import ArmControlOptions
from softmode.scenes.table_scene import Fixture, TableSceneConfig
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.splats import Splats

LENGTH = 0.36
"""Length of the default rope [m]."""
AXIS_POINTS = 25
"""Points on the rope's axis that its winding is measured with."""
GRASP = 0.03
"""Distance of the point to grasp from the rope's end [m]."""
SLENDER = 8
"""Least ratio of a rope's length to its width."""
PEGS = ((0.45, -0.03), (0.45, 0.11))
"""Where the default pegs stand [m]; the rope is to pass them in this order, towards y."""
PEG_SIZE = (0.015, 0.04)
"""Radius and height of a peg [m]."""


def pegs_at(positions: tuple[tuple[float, float], ...]) -> tuple[Fixture, ...]:
    """Return pegs, the cylinders that the rope is led around in their order."""
    radius, height = PEG_SIZE
    return tuple(
        Fixture(
            label=f"peg_{k}",
            shape="cylinder",
            size=(radius, 0.5 * height),
            position=(x, y, 0.5 * height),
            color=(0.85, 0.62, 0.35),
            friction=0.3,
        )
        for k, (x, y) in enumerate(positions)
    )


def rope_scene() -> TableSceneConfig:
    """Return a rope that lies along y before a row of smooth pegs, on a smooth table, the open gripper over its end."""
    return TableSceneConfig(
        object=replace(
            ROPE,
            extents=(LENGTH, 0.016, 0.016),
            surface_count=160,
            build=replace(ROPE.build, cubature_count=128),
        ),
        material=ROPE_MATERIAL,
        fixtures=pegs_at(PEGS),
        arm=ArmDescription(home_position=(0.45, -0.14, 0.09), home_opening=0.05),
        control=ArmControlOptions(workspace_lower=(0.30, -0.35, 0.024), workspace_upper=(0.62, 0.30, 0.25)),
        object_position=(0.45, -0.12),
        table_friction=0.4,
        substeps=4,
    )


@dataclass(frozen=True, kw_only=True)
class RopeRouteConfig(TaskConfig):
    """Goal and success of RopeRoute; the pegs are the cylinders among ``scene.fixtures``.

    `position` is that of the rope's end, `yaw` its angle from the y axis.
    """

    scene: TableSceneConfig = field(default_factory=rope_scene)
    """Objects, robot and physics."""
    position_range: tuple[float, float] = (0.02, 0.015)
    """Half-width of the random position of the rope's end in x and y [m]."""
    yaw_range: float = 0.2
    """Half-width of its random angle from the y axis [rad]."""
    youngs_modulus_range: tuple[float, float] | None = (1.5e5, 6.0e5)
    """Range of the random Young's modulus [Pa], log-uniform."""
    goal_aside: tuple[float, float] = (0.0, 0.04)
    """Range of the goal's distance from the last peg along x, on the side where the rope passes it [m]."""
    goal_beyond: tuple[float, float] = (0.06, 0.10)
    """Range of its distance from the last peg along y [m]."""
    goal_tolerance: float = 0.025
    """Horizontal distance of the rope's end from the goal that counts as there [m]."""
    winding: float = 2.0
    """Angle by which the rope, seen from a peg, has to sweep past it on the right side [rad]; pi if it were long."""
    hold_steps: int = 10
    """Control steps in a row with the rope as wanted that make a success."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        for name in ("goal_aside", "goal_beyond"):
            require_range(name, getattr(self, name), at_least=-0.2, at_most=0.2, unit="m")
        require_fields(self, ("goal_tolerance",), above=0.0, unit="m")
        require_fields(self, ("winding",), above=0.0, below=np.pi, unit="rad")
        require_fields(self, ("hold_steps",), at_least=1)
        if not self.pegs:
            raise ConfigError("scene.fixtures holds no cylinder", hint="add pegs: pegs_at(((0.45, 0.0),))")

    @property
    def pegs(self) -> tuple[Fixture, ...]:
        """The pegs, in the order in which the rope passes them."""
        return tuple(fixture for fixture in self.scene.fixtures if fixture.shape == "cylinder")

    @classmethod
    def presets(cls) -> Mapping[str, Self]:
        """Return "one_peg", with a single peg, for a start."""
        return {"one_peg": cls(scene=replace(rope_scene(), fixtures=pegs_at(PEGS[:1])))}


class RopeRoute(Task):
    """Grasp the rope's end and lead it past the pegs, each on its side, to a goal.

    The side of the first peg is drawn (``route``: negative towards the robot, positive away from it), the next ones
    alternate. The winding of the rope about a peg is the angle by which the axis sweeps past it, seen from above, from
    tail to end; its sign is the side.

    Reward terms: ``reach`` (0..1, tool to the point to grasp), ``grasp`` (0 or 0.5, both fingers touch the rope there),
    ``route`` (-2..2, winding on the right side, mean over the pegs), ``goal`` (0..2, end to the goal, the more the
    better routed), ``hold`` (0 or 2, routed and at the goal). Success: all pegs passed on their side by ``winding`` at
    least, the whole rope below the pegs' top, and its end at the goal, for ``hold_steps`` steps in a row.
    """

    config: RopeRouteConfig
    config_class = RopeRouteConfig
    step_kernels = (kernels.observe, kernels.evaluate)
    takes_sets = True
    grasps = True
    term_names = tuple(kernels.Term.__members__)
    metric_names = tuple(kernels.Metric.__members__)

    def build(self) -> None:
        """Sample the axes."""
        device, bodies = self.device, [thing.body for thing in self.scene.occupancy.choices]
        self._check_ropes(bodies)
        halves = np.array([0.5 * (body.bounds[1][0] - body.bounds[0][0]) for body in bodies])
        self.half_length = self.scene.occupancy.follow(halves)
        """Half of the length of every unscaled rope [m], shape (world_count,)."""
        rest = np.zeros((len(bodies), AXIS_POINTS, 3))
        rest[:, :, 0] = [np.linspace(-half, half, AXIS_POINTS) for half in halves]
        self.grasp_points = np.argmin(np.abs(rest[:, :, 0] - (halves - GRASP)[:, None]), axis=1)
        """Index of the axis point to grasp, of every choice of the scene."""
        self.grasp_point = self.scene.occupancy.follow(self.grasp_points, int)
        counts = [body.function_count for body in bodies]
        basis = np.zeros((len(bodies), AXIS_POINTS, max(counts)))
        for b, body in enumerate(bodies):
            basis[b, :, : counts[b]] = body.evaluate(rest[b])[0]
        self._ropes = filled(
            kernels.Ropes,
            choice=self.scene.occupancy.follow(np.arange(len(bodies)), int),
            rest=wp.array(rest, dtype=wp.vec3d, device=device),
            basis=wp.array(basis, dtype=wp.float64, device=device),
            function_count=wp.array(counts, dtype=int, device=device),
        )
        self.axis = wp.zeros((self.world_count, AXIS_POINTS), dtype=wp.vec3, device=device)
        """Points on the axis, from tail to end [m], shape (world_count, AXIS_POINTS)."""
        self.peg_height = min(peg.position[2] + peg.size[1] for peg in self.config.pegs)
        """Height of the lowest peg's top [m]."""
        self.peg_position = wp.array([peg.position[:2] for peg in self.config.pegs], dtype=wp.vec2, device=device)

    def _check_ropes(self, bodies: list[ReducedBody]) -> None:
        """Refuse what does not lie straight along x, or is not slender.

        Raises:
            ConfigError: If a body is no rope; it names the object.
        """
        for name, body in zip(self.scene.occupancy.names, bodies, strict=True):
            length = float(np.ptp(body.surface.points[:, 0]))
            width = 2.0 * float(np.linalg.norm(body.surface.points[:, 1:], axis=1).max())
            if length < SLENDER * width:
                raise ConfigError(
                    f"{name} is no rope: {length:.3f} m along x, and {width:.3f} m across",
                    hint=f"give straight ropes along x, at least {SLENDER} times as long as wide, such as"
                    " ObjectConfig(shape='capsule', extents=(0.36, 0.016, 0.016)); leave others out of the set",
                )

    def parameters(self) -> tuple[Parameter, ...]:
        """Add the side of the first peg, and the goal: aside of the last peg, and beyond it [m]."""
        config = self.config
        low, high = zip(config.goal_aside, config.goal_beyond, strict=True)
        return (
            *super().parameters(),
            Parameter(name="route", low=(-1.0,), high=(1.0,)),
            Parameter(name="goal", low=low, high=high, least=(-0.2, -0.2), most=(0.2, 0.2)),
        )

    def goal_segments(self) -> tuple[Segment, ...]:
        """The goal's position, that from the tool [m], and the side of every peg."""
        return (
            Segment("goal", 2, -2.0, 2.0),
            Segment("goal_offset", 2, -4.0, 4.0),
            Segment("side", len(self.config.pegs), -1.0, 1.0),
        )

    def object_segments(self) -> tuple[Segment, ...]:
        """The point to grasp from the tool, the end from there, the goal from the end [m], the winding [rad]."""
        return (
            Segment("grasp_offset", 3, -4.0, 4.0),
            Segment("end_offset", 3, -1.0, 1.0),
            Segment("end_goal", 2, -4.0, 4.0),
            Segment("winding", len(self.config.pegs), -10.0, 10.0),
        )

    def place(self) -> None:
        """Put the rope down along y, its end where the position says."""
        self.placement.put(0, turn=0.5 * np.pi, shift=self.half_length)

    def observe(self) -> None:
        """Trace the axis and write goal, end and winding."""
        self.launch(kernels.trace_axis, [self.state, self._ropes], [self.axis], self.axis.shape)
        super().observe()

    def marker(self) -> Splats:
        """Return a ball."""
        return sphere_marker(0.5 * self.config.goal_tolerance)

    def front_camera(self, name: str, edge: int) -> PinholeCamera:
        """Return a camera that looks down on rope and pegs, past the hand, with pictures of `edge` x `edge` pixels."""
        return square_camera(name, edge, (0.95, -0.50, 0.62), (0.44, -0.10, 0.02), 0.68)


class RopeRouteEnv(SoftEnv[RopeRoute]):
    """One arm, one rope, some pegs; see :class:`RopeRoute` and :class:`SoftEnv`."""


class RopeRouteVectorEnv(SoftVectorEnv[RopeRoute]):
    """Many worlds of it; see :class:`RopeRoute` and :class:`SoftVectorEnv`."""
