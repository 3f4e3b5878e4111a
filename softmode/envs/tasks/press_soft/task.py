"""PressSoft: press on a soft pad of unknown stiffness and hold a contact force."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from softmode.checks import require_fields, require_range
from softmode.deformables.materials.material import Material
from softmode.deformables.reduction.options import BuildOptions
from softmode.envs.cameras import square_camera
from softmode.envs.markers import sphere_marker
from softmode.envs.observation import Segment
from softmode.envs.parameters import Parameter
from softmode.envs.presets import RL_SOLVER
from softmode.envs.soft_env import SoftEnv
from softmode.envs.soft_vector_env import SoftVectorEnv
from softmode.envs.task import Task
from softmode.envs.task_config import TaskConfig
from softmode.envs.tasks.press_soft import kernels
from softmode.errors import ConfigError
from softmode.objects.config import ObjectConfig
from softmode.robots.arm import ArmDescription
from softmode.robots.control import ArmControlOptions
from softmode.robots.table_robot import TableRobot, tip_length
from softmode.scenes.table_scene import TableSceneConfig
from softmode.splats.raster.pinhole import PinholeCamera
from softmode.splats.splats import Splats

THICKNESS = 0.04
"""Thickness of the default pad [m]."""
START_HEIGHT = 0.02
"""Height of the finger tips over the pad at the start of an episode [m]."""
COMPLIANCE = 6.0
"""Factor by which the arm's drives are more compliant than usual; their damping ratio stays."""
TOOL_STIFFNESS = 3.0e3
"""What its vertical stiffness at the tool then is [N/m]."""
CLEARANCE = 0.005
"""What has to remain of it over a pad that is scaled up [m]."""
MOST_FORCE = 100.0
"""Greatest goal force that may be asked for [N]."""


def press_scene() -> TableSceneConfig:
    """Return a disc under the closed fingers of a compliant arm, which start over it and move by small steps.

    The drives have a sixth of their usual stiffness, 3 kN/m at the tool, as impedance control gives an arm that is to
    touch things: the command's lead of at most 1 cm presses with 30 N, and a full step on the stiffest pad with 4 N.
    The fingers stay closed: the gripper's share of an action is a hundredth of a millimetre. The command does not take
    them below half of the pad's thickness.
    """
    arm = ArmDescription()
    arm = replace(
        arm,
        drive_stiffnesses=tuple(COMPLIANCE**-1 * k for k in arm.drive_stiffnesses),
        drive_dampings=tuple(COMPLIANCE**-0.5 * k for k in arm.drive_dampings),
    )
    tip = arm.tool_length - arm.hand_length - arm.gripper.finger_length  # of the finger tips over the tool point
    return TableSceneConfig(
        object=ObjectConfig(
            shape="cylinder",
            extents=(0.06, 0.06, THICKNESS),
            surface_count=200,
            build=BuildOptions(mode_count=3, handles="quadratic", cubature_count=192),
        ),
        material=Material(youngs_modulus=2.0e5, poissons_ratio=0.4, density=1000.0),
        arm=replace(arm, home_position=(0.45, 0.0, THICKNESS + START_HEIGHT - tip), home_opening=0.0),
        control=ArmControlOptions(
            translation_scale=0.0015,
            opening_rate=1.0e-5,
            max_lead=0.01,
            workspace_lower=(0.35, -0.10, 0.5 * THICKNESS - tip),
            workspace_upper=(0.55, 0.10, 0.20),
        ),
        solver=RL_SOLVER,
        substeps=4,
    )


@dataclass(frozen=True, kw_only=True)
class PressSoftConfig(TaskConfig):
    """Goal and success of PressSoft."""

    heights_of_tips = True
    samples_for_tips = True
    tool_stiffness = TOOL_STIFFNESS
    scene: TableSceneConfig = field(default_factory=press_scene)
    """Objects, robot and physics."""
    position_range: tuple[float, float] = (0.02, 0.02)
    """Half-width of the pad's random position in x and y [m]."""
    force_range: tuple[float, float] = (2.0, 10.0)
    """Range of the goal force [N]."""
    force_tolerance: float = 0.1
    """Error of the force that counts as none, as a share of the goal."""
    least_tolerance: float = 0.3
    """The same in newtons, where that is more [N]."""
    centre_tolerance: float = 0.012
    """Horizontal distance of the tool from the pad's axis within which the force counts [m]."""
    hold_steps: int = 15
    """Control steps in a row with the right force that make a success."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        super().__post_init__()
        require_range("force_range", self.force_range, above=0.0, at_most=MOST_FORCE, unit="N")
        require_fields(self, ("force_tolerance",), above=0.0, below=1.0)
        require_fields(self, ("least_tolerance",), at_least=0.0, below=self.force_range[0], unit="N")
        require_fields(self, ("centre_tolerance",), above=0.0, unit="m")
        require_fields(self, ("hold_steps",), at_least=1)


class PressSoft(Task):
    """Press the closed fingers on the middle of a pad until it pushes back with the goal force, and hold that.

    The contact force is the vertical component of what the pad exerts on both fingers, of the contact solve itself.
    Young's modulus is random over two decades and not observed: the same step means another force on every pad.

    Reward terms: ``reach`` (0..1, finger tips to the middle of the pad's top), ``force`` (0..1.5, nearness to the goal
    force while there), ``hold`` (0 or 2, within the tolerance), ``overshoot`` (-1..0, beyond 1.3 times the goal).
    Success: within the tolerance, over the middle of the pad, for ``hold_steps`` steps in a row.
    """

    config: PressSoftConfig
    config_class = PressSoftConfig
    step_kernels = (kernels.observe, kernels.evaluate)
    takes_sets = True
    any_robot = True
    term_names = tuple(kernels.Term.__members__)
    metric_names = tuple(kernels.Metric.__members__)

    def build(self) -> None:
        """Upload how high the pads are."""
        self.top = self.scene.occupancy.follow(self._tops)
        """Height of every unscaled pad [m], shape (world_count,), on the device."""

    @property
    def _tops(self) -> NDArray[np.float64]:
        """Height of every unscaled pad that a world may have [m], shape (choices,)."""
        return np.array([float(np.ptp(thing.body.surface.points[:, 2])) for thing in self.scene.occupancy.choices])

    @property
    def tops(self) -> NDArray[np.float64]:
        """Height of every unscaled pad [m], shape (world_count,)."""
        return self._tops[self.scene.occupancy.rows]

    @property
    def tip_length(self) -> float:
        """Distance from the tool point down to the finger tips [m]."""
        return tip_length(self.config.scene.arm)

    @property
    def arm_stiffness(self) -> float:
        """Vertical stiffness of arm and drives at the tool [N/m]."""
        arm = self.config.scene.arm
        return arm.tool_stiffness if isinstance(arm, TableRobot) else TOOL_STIFFNESS

    def parameters(self) -> tuple[Parameter, ...]:
        """Add the goal force [N]; a pad must not reach up to the fingers.

        Raises:
            ConfigError: If a pad of the greatest scale does.
        """
        config = self.config
        room = config.scene.arm.home_position[2] - self.tip_length - CLEARANCE
        top = float(self._tops.max())
        most = min(2.0, room / top)
        largest = 1.0 if config.scale_range is None else config.scale_range[1]
        if largest > most:
            raise ConfigError(
                f"a pad of height {top:.3f} m, scaled by up to {largest}, reaches the finger tips at the start",
                hint=f"keep the scale below {most:.2f}, or raise scene.arm.home_position",
            )
        (low, high), least = config.force_range, config.least_tolerance
        drawn = [replace(p, most=(most,)) if p.name == "scale" else p for p in super().parameters()]
        return (
            *drawn,
            Parameter(name="goal_force", low=(low,), high=(high,), least=(max(least, 0.01),), most=(MOST_FORCE,)),
        )

    def goal_segments(self) -> tuple[Segment, ...]:
        """Goal force, contact force and what is missing [N]."""
        return (
            Segment("goal_force", 1, 0.0, MOST_FORCE),
            Segment("contact_force", 1, -200.0, 200.0),
            Segment("missing_force", 1, -200.0, 200.0),
        )

    def marker(self) -> Splats:
        """Return a small ball; it hangs beside the pad, over its top by `kernels.GAUGE` per newton that is missing."""
        return sphere_marker(0.006)

    def front_camera(self, name: str, edge: int) -> PinholeCamera:
        """Return a camera close to pad, finger tips and marker, with pictures of `edge` x `edge` pixels."""
        return square_camera(name, edge, (0.80, -0.24, 0.21), (0.465, 0.015, 0.065), 0.42)


class PressSoftEnv(SoftEnv[PressSoft]):
    """One arm, one pad, one force; see :class:`PressSoft` and :class:`SoftEnv`."""


class PressSoftVectorEnv(SoftVectorEnv[PressSoft]):
    """Many worlds of it; see :class:`PressSoft` and :class:`SoftVectorEnv`."""
