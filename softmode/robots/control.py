"""Delta-pose and delta-joint actions turned into joint position targets, for all worlds in one kernel.

The controller keeps the *commanded* configuration: an action moves the command, never the measured pose, so the arm
does not creep under a load. The command may lead the measured pose only by a bounded distance (anti-windup), so an arm
that is held back does not lunge when it is let go.

Newton's own differential inverse kinematics maps a desired tool pose to joint velocities. It is not used here because
the command itself must be iterated to convergence, clamped to limits and workspace, and held between actions; for a
serial chain that is one small kernel.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import newton
import numpy as np
import warp as wp

from softmode.checks import require_choice, require_fields, require_number
from softmode.deformables.model.declare import launch
from softmode.deformables.model.structs import filled
from softmode.errors import ConfigError
from softmode.robots import control_kernels as kernels
from softmode.robots.arm import ARM_JOINT_COUNT, ArmIndices, GripperDescription
from softmode.robots.control_kernels import Command, Settings
from softmode.robots.description import RobotIndices


@dataclass(frozen=True, kw_only=True)
class ArmControlOptions:
    """How actions in [-1, 1] move the command; "per action" is the change of one control step at full deflection."""

    mode: Literal["pose_delta", "joint_delta"] = "pose_delta"
    """Tool steps (x, y, z, yaw, gripper) with the tool held vertical, or steps of the seven joints and the gripper."""
    translation_scale: float = 0.015
    """Tool travel per action and axis [m]."""
    rotation_scale: float = 0.08
    """Tool yaw per action [rad]."""
    joint_scale: float = 0.04
    """Joint travel per action [rad]."""
    opening_rate: float = 0.006
    """Largest change of the commanded opening per action [m]."""
    workspace_lower: tuple[float, float, float] = (0.25, -0.35, 0.012)
    """Least commanded tool position, world frame [m]."""
    workspace_upper: tuple[float, float, float] = (0.65, 0.35, 0.55)
    """Greatest commanded tool position, world frame [m]."""
    max_lead: float = 0.06
    """Largest distance of the commanded tool position from the measured one [m]."""
    max_lead_angle: float = 0.30
    """Largest lead of a commanded joint (joint_delta) or of the commanded yaw (pose_delta) [rad]."""
    squeeze_lead: float = 1.05
    """Largest lead of the commanded opening while it closes, as a multiple of the one at which the drives saturate."""
    damping: float = 0.03
    """Damping lambda of the least squares; metres for positions, with rotations weighted by rotation_weight."""
    rotation_weight: float = 0.3
    """Length by which a rotation error counts [m/rad]."""
    posture_gain: float = 0.05
    """Share of the distance to the home posture that each iteration removes in the null space."""
    iterations: int = 6
    """Damped least-squares iterations per action."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_choice("mode", self.mode, ("pose_delta", "joint_delta"))
        scales = ("translation_scale", "rotation_scale", "joint_scale", "opening_rate", "max_lead")
        require_fields(self, (*scales, "max_lead_angle", "squeeze_lead", "damping", "rotation_weight"), above=0.0)
        require_fields(self, ("workspace_lower", "workspace_upper"), count=3)
        require_fields(self, ("posture_gain",), at_least=0.0, at_most=1.0)
        require_number("iterations", self.iterations, at_least=1, hint="six are enough for any action")
        lower, upper = self.workspace_lower, self.workspace_upper
        if not all(a < b for a, b in zip(lower, upper, strict=True)):
            hint = "give two corners (x, y, z) in metres, lower before upper"
            raise ConfigError(f"workspace_lower {lower} is not below workspace_upper {upper}", hint=hint)


def action_names(mode: str, joints: Iterable[int]) -> tuple[str, ...]:
    """Return the names of an action's entries; the last one is the gripper.

    Args:
        mode: What actions mean, see `ArmControlOptions`.
        joints: Coordinates of the joints between base and tool.
    """
    steps = ("x", "y", "z", "yaw") if mode == "pose_delta" else map("joint.{}".format, joints)
    return (*steps, "gripper")


class Controller:
    """Holds the commanded configuration of one robot in every world and writes the joint targets.

    All methods but the constructor only launch kernels on preallocated arrays, so they can be captured in a graph. A
    control step reads::

        controller.command(action, state)               # moves the command
        for i in range(substeps):
            controller.write_targets(control, (i + 1) / substeps)
            ...                                         # step the solvers
        controller.measure(state)                       # tool_pose, opening for the observation

    Args:
        model: The finalised model; its worlds are copies of the builder that the robot was added to.
        arm: Where it stands there.
        gripper: Its gripper.
        joints: Coordinates of the joints between base and tool in the robot.
        options: The action's meaning.

    Attributes:
        commanded_q: Commanded coordinates: joints between base and tool, then twice half the distance between the
            fingers, (world_count, joint_count + 2) [rad, m].
        tool_pose: Measured pose of the tool frame, (world_count,) transforms, of the last `measure` or `command`.
        coord_start: First joint coordinate of the robot in each world, (world_count,) int32.
        opening: Measured distance between the pads [m], (world_count,).
        target_position: Commanded tool position [m], (world_count,) vec3.
        target_yaw: Commanded tool yaw [rad], (world_count,); zero in the home pose.
    """

    kernels: ClassVar[Any]
    """The kernels of its chain."""

    def __init__(
        self,
        model: newton.Model,
        arm: ArmIndices | RobotIndices,
        gripper: GripperDescription,
        joints: Sequence[int],
        options: ArmControlOptions | None,
    ) -> None:
        """Allocate the command of every world and set it to the model's initial coordinates."""
        self.options = options if options is not None else ArmControlOptions()
        self.arm, self.joint_count = arm, len(joints)
        self.action_names = action_names(self.options.mode, joints)
        """Names of an action's entries; the last one is the gripper, -1 squeezes and +1 opens."""
        self.action_size = len(self.action_names)
        self.world_count = w = max(model.world_count, 1)
        self._device = device = model.device
        self.coord_start = self._starts(model.joint_coord_world_start, arm.coord_start)
        self.joint_columns = wp.array(np.asarray(joints), dtype=wp.int32, device=device)
        """Coordinates of the joints between base and tool in the robot, (joint_count,)."""
        # Both drives saturate at an opening error of twice force_limit / stiffness.
        lead = self.options.squeeze_lead * 2.0 * gripper.force_limit / gripper.drive_stiffness
        joint_mode = int(self.options.mode == "joint_delta")
        self._settings = filled(Settings, self.options, gripper, joint_mode=joint_mode, opening_lead=lead)
        self.commanded_q = wp.zeros((w, self.joint_count + 2), dtype=wp.float32, device=device)
        self.tool_pose = wp.zeros(w, dtype=wp.transform, device=device)
        self.opening = wp.zeros(w, dtype=wp.float32, device=device)
        self.target_position = wp.zeros(w, dtype=wp.vec3, device=device)
        self.target_yaw = wp.zeros(w, dtype=wp.float32, device=device)
        self.previous_q = wp.zeros_like(self.commanded_q)
        """The command before the last one, from which targets move on."""
        self._command = filled(Command, self)
        """What moves when the command does."""
        self._everywhere = wp.ones(w, dtype=wp.bool, device=device)
        self._chain = self._chain_of(model)
        self._targets: int | tuple[int, int] = w
        """How many threads write targets."""
        self._reset(model.joint_q, self._everywhere)

    def _chain_of(self, model: newton.Model) -> Any:
        """Return the robot's chain on the device."""
        raise NotImplementedError

    def _starts(self, world_start: wp.array | None, first: int) -> wp.array:
        """Return where something begins in every world, (world_count,) int32."""
        assert world_start is not None
        start, w = world_start.numpy(), self.world_count
        # A builder that is finalised without replication keeps everything outside any world.
        offset = start[:w] if start[w] > start[0] else np.zeros(w, dtype=np.int32)
        return wp.array(offset + first, dtype=wp.int32, device=self._device)

    def reset(self, state: newton.State, world_mask: wp.array | None = None) -> None:
        """Set the command to the measured configuration.

        Args:
            state: Where joint_q is read.
            world_mask: Which worlds, (world_count,) bool; all if omitted.
        """
        self._reset(state.joint_q, world_mask if world_mask is not None else self._everywhere)

    def _reset(self, joint_q: wp.array | None, world_mask: wp.array) -> None:
        launch(
            self._device, self.kernels.reset_command, self.world_count, self._chain, joint_q, world_mask, self._command
        )

    def command(self, action: wp.array, state: newton.State) -> None:
        """Move the commanded configuration by one action per world.

        Args:
            action: Actions in [-1, 1], (world_count, action_size) float32; larger values are clamped and values
                that are not finite count as zero. The gripper entry names an opening which the command approaches at
                opening_rate: +1 is fully open, -1 squeezes whatever is between the pads with the full drive force.
            state: The measured state, for the anti-windup.
        """
        if action.shape != (self.world_count, self.action_size):
            hint = f"expected ({self.world_count}, {self.action_size}) in mode {self.options.mode!r}"
            raise ConfigError(f"action has shape {tuple(action.shape)}", hint=hint)
        arguments = (self._chain, self._settings, action, state.joint_q, self._command)
        launch(self._device, self.kernels.move_command, self.world_count, *arguments)

    def write_targets(self, control: newton.Control, fraction: float = 1.0) -> None:
        """Write the drives' position targets, on the line from the previous command to the present one.

        Args:
            control: Where joint_target_q is written.
            fraction: Share of the control step that the targets should have covered, 0 to 1.
        """
        arguments = (self._chain, self._command, fraction, control.joint_target_q)
        launch(self._device, self.kernels.write_targets, self._targets, *arguments)

    def measure(self, state: newton.State) -> None:
        """Update `tool_pose` and `opening` from the measured joint coordinates."""
        launch(self._device, self.kernels.measure, self.world_count, self._chain, state.joint_q, self._command)


class ArmController(Controller):
    """The controller of the built-in arm.

    Args:
        model: The finalised model; its worlds are copies of the builder that the arm was added to.
        arm: What `add_arm` returned.
        options: The action's meaning.
    """

    kernels = kernels

    def __init__(self, model: newton.Model, arm: ArmIndices, options: ArmControlOptions | None = None) -> None:
        """Allocate the command of every world and set it to the model's initial coordinates."""
        if not isinstance(arm, ArmIndices):
            raise ConfigError(
                f"arm is a {type(arm).__name__}; the controller knows the kinematics of the built-in arm only",
                hint="a loaded robot has RobotController, or write control.joint_target_q yourself",
            )
        self.arm: ArmIndices
        super().__init__(model, arm, arm.description.gripper, range(ARM_JOINT_COUNT), options)
        self._targets = (self.world_count, ARM_JOINT_COUNT + 2)

    def _chain_of(self, model: newton.Model) -> Any:
        """Return the arm in the model's arrays."""
        description = self.arm.description
        return filled(
            kernels.Chain,
            model,
            description,
            joint_start=self._starts(model.joint_world_start, self.arm.joint_start),
            coord_start=self.coord_start,
            dof_start=self._starts(model.joint_dof_world_start, self.arm.dof_start),
            home=kernels.vec7(*description.home_joint_q[:ARM_JOINT_COUNT].tolist()),
        )
