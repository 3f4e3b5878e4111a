"""A robot read from a file: a frozen description, and the method that adds it to a Newton builder."""

from __future__ import annotations

import functools
import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from softmode.checks import require_choice, require_fields
from softmode.deformables.coupling.rigid_solver import mujoco_warnings
from softmode.errors import AssetError, ConfigError

ToolPose = tuple[float, float, float, float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class JointDrive:
    """A position drive: force = clamp(stiffness (target - q) - damping qd), in N or N m."""

    stiffness: float
    """Position gain [N/m or N m/rad]."""
    damping: float
    """Velocity gain [N s/m or N m s/rad]; the viscous friction of the joint comes on top."""
    effort_limit: float = math.inf
    """Largest force [N] or torque [N m]."""
    lower: float = -math.inf
    """Least target [m or rad]."""
    upper: float = math.inf
    """Greatest target [m or rad]."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        require_fields(self, ("stiffness", "damping"), at_least=0.0, at_most=1.0e9)
        if not self.effort_limit >= 0.0 or math.isnan(self.lower) or math.isnan(self.upper):
            raise ConfigError(
                f"{self} has a negative effort limit or NaN", hint="give numbers; inf stands for no limit"
            )


@dataclass(frozen=True, kw_only=True)
class JointTie:
    """A joint that follows another: q = offset + ratio q_leader."""

    joint: str
    """Name of the joint that follows."""
    leader: str
    """Name of the joint that leads, which follows none."""
    ratio: float
    """Travel for a unit of the leader's."""
    offset: float
    """Coordinate where the leader's is zero [m or rad]."""


def followed(joint_q: ArrayLike, leader: ArrayLike, ratio: ArrayLike, offset: ArrayLike) -> np.ndarray:
    """Return joint coordinates (..., n) with those of followers where their ties have them.

    Args:
        joint_q: Coordinates [m or rad], shape (..., n).
        leader: Which joint each one follows, itself for most, shape (n,).
        ratio: Travel of each for a unit of its leader's, shape (n,).
        offset: Coordinate of each where its leader's is zero, shape (n,).
    """
    values, owner = np.array(joint_q, float), np.asarray(leader)
    moved = np.asarray(offset) + np.asarray(ratio) * values[..., owner]
    return np.where(owner == np.arange(len(owner)), values, moved)


@dataclass(frozen=True, kw_only=True)
class RobotGripper:
    """The joints that open and close, with their coordinates at both ends."""

    joints: tuple[str, ...]
    """Names of the driven joints."""
    closed: tuple[float, ...]
    """Coordinates when closed [m or rad], in the order of ``joints``."""
    open: tuple[float, ...]
    """Coordinates when open [m or rad]."""


@dataclass(frozen=True, kw_only=True)
class RobotDescription:
    """A robot on a fixed base, with one hinge or slide per link; made by :func:`softmode.robots.load`.

    Tuples over joints run in the order of the joint coordinates. Variants are made with ``dataclasses.replace``.
    """

    name: str
    """Name of the robot."""
    path: Path = field(repr=False)
    """The file it was read from."""
    mjcf: str = field(repr=False)
    """The robot alone as canonical MJCF with absolute asset paths, without actuators."""
    link_names: tuple[str, ...]
    """Names of all links, parents before children."""
    joint_names: tuple[str, ...]
    """Names of the joints that move."""
    joint_links: tuple[str, ...]
    """Name of the link behind each joint."""
    joint_lower: tuple[float, ...]
    """Lower joint limits [m or rad]; -inf without limit."""
    joint_upper: tuple[float, ...]
    """Upper joint limits [m or rad]; inf without limit."""
    drives: tuple[JointDrive | None, ...]
    """Drive of each joint; None where the joint is passive."""
    home: tuple[float, ...]
    """Joint coordinates of the home pose [m or rad]."""
    end_effector: str
    """Name of the link that carries the tool."""
    tool: ToolPose
    """Pose of the tool point in the frame of that link: position [m], quaternion (xyzw)."""
    hand_links: tuple[str, ...]
    """Names of the end effector's link and of all links behind it."""
    gripper: RobotGripper | None = None
    """The gripper, or None."""
    ties: tuple[JointTie, ...] = ()
    """Joints that follow others. Limits are those that all joints of a group reach together."""
    notes: tuple[str, ...] = ()
    """What was chosen where the file does not say it, a line each."""
    gravity_compensation: bool = True
    """Whether the robot carries its own weight apart from the drives, as the controllers of real arms do."""
    collision: Literal["hull", "mesh"] = "hull"
    """Collision meshes as their convex hulls, or as they are; soft contact refuses meshes that are not closed."""
    touch: Literal["gripper", "all"] = "gripper"
    """Which links soft bodies may touch: those of the hand, or every one. Each shape costs a test per sample."""
    visuals: bool = True
    """Whether shapes that are only there to be seen are added."""

    def __post_init__(self) -> None:
        """Check what a caller may replace."""
        require_choice("collision", self.collision, ("hull", "mesh"))
        require_choice("touch", self.touch, ("gripper", "all"))
        for name in ("home", "joint_lower", "joint_upper", "drives"):
            if len(getattr(self, name)) != len(self.joint_names):
                raise ConfigError(
                    f"{name} has {len(getattr(self, name))} entries, expected {len(self.joint_names)}",
                    hint=f"give one value for each of {', '.join(self.joint_names)}",
                )
        for name, q, low, high in zip(self.joint_names, self.home, self.joint_lower, self.joint_upper, strict=True):
            if not low - 1e-6 <= q <= high + 1e-6:
                raise ConfigError(
                    f"home of joint {name!r} is {q}, outside its range {low} to {high}", hint="choose a value inside"
                )

    @property
    def model(self) -> Any:
        """The robot as MuJoCo compiles it, one for all that ask: not to be changed."""
        return compiled(self.mjcf)

    @property
    def home_joint_q(self) -> np.ndarray:
        """Joint coordinates of the home pose [m or rad], shape (joint_count,)."""
        return np.array(self.home)

    @property
    def bound(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Per joint its leader, itself for most, and ratio and offset of q = offset + ratio q_leader."""
        leader, ratio, offset = np.arange(len(self.home)), np.ones(len(self.home)), np.zeros(len(self.home))
        for tie in self.ties:
            j = self.joint_names.index(tie.joint)
            leader[j], ratio[j], offset[j] = self.joint_names.index(tie.leader), tie.ratio, tie.offset
        return leader, ratio, offset

    def followed(self, joint_q: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return joint coordinates [m or rad] with those of followers where their ties have them."""
        return followed(joint_q, *self.bound)

    @property
    def passive_joints(self) -> tuple[str, ...]:
        """Names of the joints without a drive."""
        return tuple(name for name, drive in zip(self.joint_names, self.drives, strict=True) if drive is None)

    @mujoco_warnings()
    def joint_inertias(self) -> np.ndarray:
        """Return what each joint accelerates in the home pose, the others held [kg or kg m^2], shape (joint_count,)."""
        mujoco, model = importlib.import_module("mujoco"), self.model
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0 + self.home_joint_q
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        return np.diag(mass).copy()

    def drive_frequencies(self) -> np.ndarray:
        """Return sqrt(stiffness / inertia) / (2 pi) of every drive in the home pose [Hz], NaN where there is none."""
        stiffness = np.array([math.nan if drive is None else drive.stiffness for drive in self.drives])
        return np.sqrt(stiffness / self.joint_inertias()) / (2.0 * math.pi)

    def with_opening(self, opening: float, joint_q: Sequence[float] | None = None) -> np.ndarray:
        """Return joint coordinates with the gripper at an opening; they may serve as drive targets.

        Args:
            opening: 0 is closed, 1 is open. Values below 0 squeeze: the drives aim past the closed pose.
            joint_q: Coordinates of the other joints, shape (joint_count,); the home pose if omitted.

        Returns:
            Joint coordinates [m or rad], shape (joint_count,).

        Raises:
            ConfigError: If the robot has no gripper.
        """
        if self.gripper is None:
            hint = "name its joints: load(..., gripper={'joint': (closed, open)})"
            raise ConfigError(f"robot {self.name!r} has no gripper", hint=hint)
        values = self.home_joint_q if joint_q is None else np.array(joint_q, float)
        for name, closed, wide in zip(self.gripper.joints, self.gripper.closed, self.gripper.open, strict=True):
            values[self.joint_names.index(name)] = closed + opening * (wide - closed)
        return self.followed(values)

    def tool_pose(self, joint_q: Sequence[float] | None = None) -> tuple[float, ...]:
        """Return the pose of the tool in the base frame.

        Args:
            joint_q: Joint coordinates [m or rad], shape (joint_count,); the home pose if omitted.

        Returns:
            Position [m] and quaternion (xyzw), seven numbers.
        """
        mount: Any = self._link_poses(joint_q)[self.end_effector]
        pose: Any = mount * wp.transformd(*self.tool)
        return tuple(float(value) for value in pose)

    def _link_poses(self, joint_q: Sequence[float] | None = None) -> dict[str, wp.transformd]:
        """Return the pose of every link in the base frame; the home pose's if no coordinates are given."""
        mujoco, model = importlib.import_module("mujoco"), self.model
        data = mujoco.MjData(model)
        data.qpos[:] = model.qpos0 + np.asarray(self.home if joint_q is None else joint_q, float)
        mujoco.mj_kinematics(model, data)
        ids = {name: model.body(name).id for name in self.link_names}
        return {name: wp.transformd(data.xpos[k], np.roll(data.xquat[k], -1)) for name, k in ids.items()}

    def add_to(
        self, builder: newton.ModelBuilder, *, xform: Sequence[float] | None = None, label: str | None = None
    ) -> RobotIndices:
        """Add the robot, standing in its home pose, to a Newton builder: ``joint_q`` and ``body_q`` say so.

        The base is static and the robot one articulation. Inertia, limits, armature, damping and dry friction of the
        joints are those of the file; its position servos become joint drives, to be commanded through
        ``control.joint_target_q``. Links of one robot do not collide with each other. With ``gravity_compensation``
        the bodies carry MuJoCo's ``gravcomp`` attribute, which only ``SolverMuJoCo`` reads.

        Args:
            builder: The builder of one world.
            xform: Pose of the base, position [m] and quaternion (xyzw), seven numbers.
            label: Prefix of the labels; the robot's name if omitted.

        Returns:
            The indices of what was added.

        Raises:
            AssetError: If Newton cannot import the robot.
        """
        first_body, first_joint, first_shape = builder.body_count, builder.joint_count, builder.shape_count
        coord_start, dof_start = builder.joint_coord_count, builder.joint_dof_count
        try:
            builder.add_mjcf(
                self.mjcf,
                xform=wp.transform(*xform) if xform is not None else wp.transform(),
                floating=False,
                parse_sites=False,
                parse_visuals=self.visuals,
                parse_mujoco_options=False,
                enable_self_collisions=False,
                # As loop joints they would stand among the joints of the tree; SolverMuJoCo enforces them either way.
                convert_mjc_equality_constraints=False,
            )
        except (ValueError, OSError, RuntimeError, KeyError) as error:
            raise AssetError(f"robot {self.name!r} ({self.path}): {error}", hint="mend the file") from error
        bodies = self._take_over(builder, first_body, first_joint, dof_start, label or self.name)
        shapes = tuple(range(first_shape, builder.shape_count))
        self._set_drives(builder, coord_start, dof_start)
        base: Any = wp.transformd(*(xform if xform is not None else (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
        for name, pose in self._link_poses().items():
            builder.body_q[bodies[name]] = wp.transform(*(base * pose))
        if self.gravity_compensation:
            weightless: Any = builder.custom_attributes["mujoco:gravcomp"].values
            weightless.update({body: 1.0 for body in bodies.values()})
        self._set_shapes(builder, shapes, {bodies[name] for name in self.hand_links})
        fingers = self.gripper.joints if self.gripper else ()
        return RobotIndices(
            description=self,
            articulation=builder.articulation_count - 1,
            joint_start=first_joint,
            coord_start=coord_start,
            dof_start=dof_start,
            link_bodies=tuple(bodies[name] for name in self.link_names),
            finger_bodies=tuple(bodies[self.joint_links[self.joint_names.index(name)]] for name in fingers),
            hand_body=bodies[self.end_effector],
            shapes=shapes,
        )

    def _take_over(
        self, builder: newton.ModelBuilder, first_body: int, first_joint: int, first_dof: int, label: str
    ) -> dict[str, int]:
        """Give what was imported its names; return the body of every link."""
        links, moving = len(self.link_names), len(self.joint_names)
        found = (builder.body_count - first_body, builder.joint_count - first_joint)
        dofs = builder.joint_dof_count - first_dof
        # Newton imports bodies depth first, as MuJoCo numbers them, each with one joint to its parent.
        if (*found, dofs) != (links, links, moving):
            raise AssetError(
                f"robot {self.name!r}: Newton imported {found[0]} bodies, {found[1]} joints and {dofs} dofs, "
                f"expected {links}, {links} and {moving}",
                hint="the file holds something that Newton reads differently from MuJoCo; simplify it",
            )
        owner = dict(zip(self.joint_links, self.joint_names, strict=True))
        for k, link in enumerate(self.link_names):
            builder.body_label[first_body + k] = f"{label}/{link}"
            builder.joint_label[first_joint + k] = f"{label}/{owner.get(link, link + '_mount')}"
        builder.articulation_label[-1] = label
        return {link: first_body + k for k, link in enumerate(self.link_names)}

    def _set_drives(self, builder: newton.ModelBuilder, coord_start: int, dof_start: int) -> None:
        """Set drives and home pose."""
        for k, (drive, home) in enumerate(zip(self.drives, self.home, strict=True)):
            dof, coord = dof_start + k, coord_start + k
            builder.joint_q[coord] = builder.joint_target_q[coord] = float(home)
            mode = newton.JointTargetMode.NONE if drive is None else newton.JointTargetMode.POSITION
            builder.joint_target_mode[dof] = int(mode)
            if drive is not None:
                builder.joint_target_ke[dof] = drive.stiffness
                builder.joint_target_kd[dof] = drive.damping
                builder.joint_effort_limit[dof] = min(drive.effort_limit, 1.0e6)
        for name in {name for tie in self.ties for name in (tie.joint, tie.leader)}:
            k = self.joint_names.index(name)
            if math.isfinite(self.joint_lower[k]):
                builder.joint_limit_lower[dof_start + k] = self.joint_lower[k]
                builder.joint_limit_upper[dof_start + k] = self.joint_upper[k]

    def _set_shapes(self, builder: newton.ModelBuilder, shapes: Sequence[int], hand: set[int]) -> None:
        """Replace collision meshes by hulls, and decide what soft bodies touch."""
        solid, soft = int(newton.ShapeFlags.COLLIDE_SHAPES), int(newton.ShapeFlags.COLLIDE_PARTICLES)
        colliding = [shape for shape in shapes if builder.shape_flags[shape] & solid]
        if self.collision == "hull":
            builder.approximate_meshes("convex_hull", colliding, raise_on_failure=True)
        for shape in shapes:
            touched = shape in colliding and (self.touch == "all" or builder.shape_body[shape] in hand)
            flags = builder.shape_flags[shape]
            builder.shape_flags[shape] = flags | soft if touched else flags & ~soft


@dataclass(frozen=True, kw_only=True)
class RobotIndices:
    """Where a robot stands in the builder it was added to.

    The indices count from the start of that builder; in world w of a replicated model add the model's
    ``*_world_start[w]``.
    """

    description: RobotDescription
    """What was added."""
    articulation: int
    """Articulation index."""
    joint_start: int
    """Index of the first joint; one per link, fixed ones included."""
    coord_start: int
    """Index of the first joint coordinate; one per name in ``description.joint_names``."""
    dof_start: int
    """Index of the first joint degree of freedom, in the same order."""
    link_bodies: tuple[int, ...]
    """Bodies of the links, in the order of ``description.link_names``."""
    finger_bodies: tuple[int, ...]
    """Bodies behind the gripper's joints."""
    hand_body: int
    """Body that carries the tool, whose pose in its frame is ``description.tool``."""
    shapes: tuple[int, ...]
    """All shapes of the robot."""


@functools.lru_cache(8)
def compiled(mjcf: str) -> Any:
    """Return the compiled model of a robot."""
    with mujoco_warnings():
        return importlib.import_module("mujoco").MjModel.from_xml_string(mjcf)
