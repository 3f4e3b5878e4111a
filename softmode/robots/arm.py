"""A seven-axis arm with a parallel gripper, made of primitive shapes: its description and its Newton builder."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import newton
import numpy as np
import warp as wp

from softmode.checks import require_choice, require_fields
from softmode.errors import ConfigError
from softmode.robots.arm_shapes import Part, add_part, arm_links, base_parts, finger_parts, hand_parts

ARM_JOINT_COUNT = 7
"""Revolute joints between base and hand."""

_FINGER_STOP_STIFFNESS = 1.0e5
"""Stiffness of a finger's end stops [N/m]: the full drive force presses a closed finger half a mm past zero."""
_FINGER_STOP_DAMPING = 1000.0
"""Damping of a finger's end stops [N s/m]: well above critical; weaker stops ring under an implicit drive."""
_JOINT_STOP_STIFFNESS = 1.0e4
"""Stiffness of the end stops of the arm's joints [N m/rad]."""


@dataclass(frozen=True, kw_only=True)
class GripperDescription:
    """Two prismatic fingers that move along the hand's y axis, each with its own drive."""

    stroke: float = 0.09
    """Distance between the pads when fully open [m]; each finger travels half of it."""
    pad_size: tuple[float, float, float] = (0.024, 0.006, 0.044)
    """Size of a pad [m]: across the finger, thickness along the closing axis, along the finger."""
    finger_length: float = 0.066
    """Distance from the face of the hand to the finger tip [m]."""
    finger_mass: float = 0.12
    """Mass of one finger with its carriage [kg]."""
    armature: float = 0.15
    """Inertia of a finger's motor reflected to its travel [kg]."""
    damping: float = 2.0
    """Viscous friction of a finger's guide [N s/m]."""
    drive_stiffness: float = 4000.0
    """Position gain of a finger drive [N/m]."""
    drive_damping: float = 80.0
    """Velocity gain of a finger drive [N s/m]."""
    force_limit: float = 30.0
    """Largest drive force of one finger, so also the largest squeeze [N]."""
    friction: float = 1.0
    """Coulomb coefficient of the pads."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_fields(self, ("stroke", "finger_length", "finger_mass", "force_limit", "drive_stiffness"), above=0.0)
        require_fields(self, ("armature", "damping", "drive_damping", "friction"), at_least=0.0)
        require_fields(self, ("pad_size",), count=3, above=0.0)
        if self.pad_size[2] > self.finger_length:
            raise ConfigError(
                f"pad_size[2] = {self.pad_size[2]} m is longer than finger_length = {self.finger_length} m",
                hint="shorten the pad or lengthen the finger",
            )


@dataclass(frozen=True, kw_only=True)
class ArmDescription:
    """A spherical-shoulder, spherical-wrist arm (axes z y z y z y z, straight up at zero) on a fixed base.

    The base frame stands on the mounting plane with z up. Tuples over joints run from base to hand.
    """

    shoulder_height: float = 0.333
    """Height of the second axis above the mounting plane [m]."""
    upper_arm_length: float = 0.36
    """Shoulder to elbow [m]."""
    forearm_length: float = 0.36
    """Elbow to wrist [m]."""
    flange_length: float = 0.088
    """Wrist to flange [m]."""
    hand_length: float = 0.070
    """Flange to the face from which the fingers stand out [m]."""
    link_masses: tuple[float, ...] = (3.2, 2.6, 2.4, 1.9, 1.7, 1.1, 0.9)
    """Masses of the moving links [kg]; the last one holds the hand without fingers. Inertia follows from the shapes."""
    joint_lower: tuple[float, ...] = (-2.9, -1.9, -2.9, -2.6, -2.9, -2.1, -2.9)
    """Lower joint limits [rad]."""
    joint_upper: tuple[float, ...] = (2.9, 1.9, 2.9, 2.6, 2.9, 2.1, 2.9)
    """Upper joint limits [rad]."""
    effort_limits: tuple[float, ...] = (87.0, 87.0, 87.0, 87.0, 25.0, 25.0, 20.0)
    """Largest drive torques [N m]."""
    armatures: tuple[float, ...] = (0.6, 0.6, 0.5, 0.4, 0.12, 0.12, 0.10)
    """Rotor inertia reflected through the gears [kg m^2]."""
    dampings: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0, 0.3, 0.3, 0.3)
    """Viscous friction of the joints [N m s/rad]."""
    drive_stiffnesses: tuple[float, ...] = (4500.0, 4500.0, 3500.0, 3500.0, 1200.0, 1200.0, 800.0)
    """Position gains of the drives [N m/rad]."""
    drive_dampings: tuple[float, ...] = (260.0, 260.0, 160.0, 160.0, 30.0, 30.0, 20.0)
    """Velocity gains of the drives [N m s/rad]; the defaults damp each joint near the critical value."""
    gravity_compensation: bool = True
    """Whether the robot carries its own weight apart from the drives, as the controllers of real arms do."""
    touch: Literal["gripper", "all"] = "gripper"
    """Which shapes soft bodies may touch: fingers and hand, or every shape. Each shape costs a test per sample."""
    home_position: tuple[float, float, float] = (0.45, 0.0, 0.25)
    """Tool position of the home pose in the base frame [m]; the tool points down."""
    home_opening: float = 0.08
    """Distance between the pads in the home pose [m]."""
    gripper: GripperDescription = field(default_factory=GripperDescription)
    """The gripper at the flange."""

    joint_count: ClassVar[int] = ARM_JOINT_COUNT
    """Joints between base and tool."""

    def __post_init__(self) -> None:
        """Check the ranges, and that the home pose can be reached."""
        lengths = ("shoulder_height", "upper_arm_length", "forearm_length", "flange_length", "hand_length")
        require_fields(self, lengths, above=0.0)
        joints = ARM_JOINT_COUNT
        require_fields(self, ("link_masses", "effort_limits", "drive_stiffnesses"), count=joints, above=0.0)
        require_fields(self, ("armatures", "dampings", "drive_dampings"), count=joints, at_least=0.0)
        require_fields(self, ("joint_lower", "joint_upper"), count=joints)
        require_fields(self, ("home_position",), count=3)
        if not all(low < high for low, high in zip(self.joint_lower, self.joint_upper, strict=True)):
            hint = "give each joint a range in rad, lower before upper"
            raise ConfigError(f"joint_lower {self.joint_lower} is not below joint_upper {self.joint_upper}", hint=hint)
        require_choice("touch", self.touch, ("gripper", "all"))
        require_fields(self, ("home_opening",), at_least=0.0, at_most=self.gripper.stroke, unit="m")
        self.joint_q_over(self.home_position)

    @property
    def tool_length(self) -> float:
        """Flange to tool point [m]: the tool point lies between the centres of the pads."""
        return self.hand_length + self.gripper.finger_length - 0.5 * self.gripper.pad_size[2]

    @property
    def reach(self) -> float:
        """Shoulder to flange of the straight arm [m]."""
        return self.upper_arm_length + self.forearm_length + self.flange_length

    @property
    def home_joint_q(self) -> np.ndarray:
        """Joint coordinates of the home pose, seven angles [rad] and two finger positions [m], shape (9,)."""
        finger = 0.5 * self.home_opening
        return np.append(self.joint_q_over(self.home_position), (finger, finger))

    def add_to(
        self, builder: newton.ModelBuilder, *, xform: Sequence[float] | None = None, label: str = "arm"
    ) -> ArmIndices:
        """Add the arm to a builder, see :func:`add_arm`; robots read from files have the same method."""
        return add_arm(builder, self, xform=xform, label=label)

    def joint_q_over(self, position: Sequence[float], yaw: float = 0.0) -> np.ndarray:
        """Return the arm's joint angles that hold the tool at a point, pointing down, in closed form.

        The elbow stays in the vertical plane through the base axis and the tool (third and fifth joint zero), above the
        line from shoulder to wrist.

        Args:
            position: Tool position in the base frame [m], shape (3,).
            yaw: Rotation of the tool about the vertical [rad]; at zero the fingers close along the base's y axis.

        Returns:
            Joint angles [rad], shape (7,).

        Raises:
            ConfigError: If the point is out of reach or a joint limit forbids the pose.
        """
        x, y, z = (float(value) for value in position)
        out = math.hypot(x, y)
        up = z + self.flange_length + self.tool_length - self.shoulder_height
        upper, fore = self.upper_arm_length, self.forearm_length
        distance = math.hypot(out, up)
        if not abs(upper - fore) < distance < upper + fore:
            raise ConfigError(
                f"the tool cannot point down at ({x:.3f}, {y:.3f}, {z:.3f}) m: the wrist would be {distance:.3f} m "
                f"from the shoulder, the arm allows {abs(upper - fore):.3f} to {upper + fore:.3f} m",
                hint="choose a point closer to the middle of the workspace",
            )
        at_shoulder = math.acos((upper**2 + distance**2 - fore**2) / (2.0 * upper * distance))
        shoulder = math.atan2(out, up) - at_shoulder
        elbow = math.pi - math.acos((upper**2 + fore**2 - distance**2) / (2.0 * upper * fore))
        base = math.atan2(y, x)
        # The angles are kept within half a turn, so that a yaw given past pi still finds its pose.
        spin = math.remainder(base - yaw, 2.0 * math.pi)
        joint_q = np.array([base, shoulder, 0.0, elbow, 0.0, math.pi - shoulder - elbow, spin])
        low, high = np.array(self.joint_lower), np.array(self.joint_upper)
        if np.any(joint_q < low) or np.any(joint_q > high):
            worst = int(np.argmax(np.maximum(low - joint_q, joint_q - high)))
            raise ConfigError(
                f"joint {worst + 1} would need {joint_q[worst]:.3f} rad at ({x:.3f}, {y:.3f}, {z:.3f}) m with yaw "
                f"{yaw:.3f} rad, its range is {low[worst]} to {high[worst]} rad",
                hint="turn the tool by pi, or move the point",
            )
        return joint_q


@dataclass(frozen=True, kw_only=True)
class ArmIndices:
    """Where an arm stands in the builder it was added to.

    The indices count from the start of that builder; in world w of a replicated model add the model's
    ``*_world_start[w]``.
    """

    description: ArmDescription
    """What was built."""
    articulation: int
    """Articulation index."""
    joint_start: int
    """Index of the first joint; nine in a row: seven arm joints, left finger (+y), right finger (-y)."""
    coord_start: int
    """Index of the first joint coordinate, in the same order."""
    dof_start: int
    """Index of the first joint degree of freedom, in the same order."""
    link_bodies: tuple[int, ...]
    """Bodies of the seven links; the last one is the hand."""
    finger_bodies: tuple[int, int]
    """Bodies of the left (+y) and the right (-y) finger."""
    pad_shapes: tuple[int, int]
    """Box shapes of the two pads."""
    shapes: tuple[int, ...]
    """All shapes of the robot, those of its base included."""

    @property
    def hand_body(self) -> int:
        """Body of the hand, on whose frame the tool point sits at (0, 0, tool_length)."""
        return self.link_bodies[-1]


def add_arm(
    builder: newton.ModelBuilder,
    description: ArmDescription | None = None,
    *,
    xform: Sequence[float] | None = None,
    label: str = "arm",
) -> ArmIndices:
    """Add the arm, standing in its home pose, to a Newton builder.

    The base is static, the chain is one articulation of nine joints with position drives. Densities are chosen so that
    each link has the mass of the description; centre of mass and inertia follow from its shapes. With
    ``gravity_compensation`` the bodies carry MuJoCo's ``gravcomp`` attribute, which only ``SolverMuJoCo`` reads.

    Args:
        builder: The builder of one world.
        description: What to build; the default arm if omitted.
        xform: Pose of the base, position [m] and quaternion (xyzw), seven numbers.
        label: Prefix of the labels.

    Returns:
        The indices of what was added.
    """
    arm = description if description is not None else ArmDescription()
    gripper = arm.gripper
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    base = wp.transform(*xform) if xform is not None else wp.transform()
    bodies, joints, shapes, added = ([] for _ in range(4))
    coord_start, dof_start = builder.joint_coord_count, builder.joint_dof_count
    weight = {"mujoco:gravcomp": 1.0} if arm.gravity_compensation else {}

    def add_parts(body: int, parts: Sequence[Part], mass: float, name: str, pose: wp.transform) -> list[int]:
        density, added = mass / sum(part.volume for part in parts), []
        for part in parts:
            config = newton.ModelBuilder.ShapeConfig(
                density=density,
                mu=gripper.friction,
                has_shape_collision=part.touch,
                has_particle_collision=part.touch or arm.touch == "all",
            )
            added.append(add_part(builder, body, part, config, pose, f"{label}/{name}/{part.name or part.kind}"))
        shapes.extend(added)
        return added

    def add_joint(add: Callable[..., int], body: int, name: str, **settings: Any) -> None:
        position = newton.JointTargetMode.POSITION
        joints.append(add(child=body, friction=0.0, actuator_mode=position, label=f"{label}/{name}", **settings))

    add_parts(-1, base_parts(), 1.0, "base", base)
    offsets, axes, links = arm_links(arm.shoulder_height, arm.upper_arm_length, arm.forearm_length, arm.flange_length)
    links.append(hand_parts(arm.hand_length, gripper.stroke))
    home = arm.home_joint_q
    for k in range(ARM_JOINT_COUNT):
        mount = wp.transform(wp.vec3(0.0, 0.0, offsets[k]), wp.quat_identity())
        body = builder.add_link(label=f"{label}/link{k + 1}", custom_attributes=weight)
        bodies.append(body)
        added = add_parts(body, links[k], arm.link_masses[k], f"link{k + 1}", wp.transform())
        add_joint(
            builder.add_joint_revolute,
            body,
            f"joint{k + 1}",
            parent=bodies[k - 1] if k else -1,
            parent_xform=mount if k else base * mount,
            axis=axes[k],
            limit_lower=arm.joint_lower[k],
            limit_upper=arm.joint_upper[k],
            limit_ke=_JOINT_STOP_STIFFNESS,
            limit_kd=12.0 * math.sqrt(_JOINT_STOP_STIFFNESS * max(arm.armatures[k], 0.05)),
            target_q=home[k],
            target_ke=arm.drive_stiffnesses[k],
            target_kd=arm.drive_dampings[k],
            effort_limit=arm.effort_limits[k],
            armature=arm.armatures[k],
            damping=arm.dampings[k],
        )
    palm, hand = added[-1], bodies[-1]
    fingers, pads = [], []
    for side, name in ((1.0, "left"), (-1.0, "right")):
        body = builder.add_link(label=f"{label}/finger_{name}", custom_attributes=weight)
        fingers.append(body)
        parts = finger_parts(gripper.pad_size, gripper.finger_length, side)
        added = add_parts(body, parts, gripper.finger_mass, f"finger_{name}", wp.transform())
        pads.append(added[0])
        for shape in added:
            builder.add_shape_collision_filter_pair(shape, palm)
        add_joint(
            builder.add_joint_prismatic,
            body,
            f"finger_joint_{name}",
            parent=hand,
            parent_xform=wp.transform(wp.vec3(0.0, 0.0, arm.hand_length), wp.quat_identity()),
            axis=wp.vec3(0.0, side, 0.0),
            limit_lower=0.0,
            limit_upper=0.5 * gripper.stroke,
            limit_ke=_FINGER_STOP_STIFFNESS,
            limit_kd=_FINGER_STOP_DAMPING,
            target_q=home[-1],
            target_ke=gripper.drive_stiffness,
            target_kd=gripper.drive_damping,
            effort_limit=gripper.force_limit,
            armature=gripper.armature,
            damping=gripper.damping,
        )
    for pair in itertools.product(*(builder.body_shapes[finger] for finger in fingers)):
        builder.add_shape_collision_filter_pair(*pair)
    builder.add_articulation(joints, label=label)
    builder.joint_q[coord_start : coord_start + len(home)] = home.tolist()
    return ArmIndices(
        description=arm,
        articulation=builder.articulation_count - 1,
        joint_start=joints[0],
        coord_start=coord_start,
        dof_start=dof_start,
        link_bodies=tuple(bodies),
        finger_bodies=(fingers[0], fingers[1]),
        pad_shapes=(pads[0], pads[1]),
        shapes=tuple(shapes),
    )
