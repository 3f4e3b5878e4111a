"""The two fingers of a parallel gripper as a planner of grasps sees them: how far they open, pads, fingers, palm."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.checks import require_fields
from softmode.errors import ConfigError
from softmode.robots.arm import ArmDescription
from softmode.robots.arm_shapes import finger_parts, hand_parts
from softmode.robots.description import RobotDescription, ToolPose
from softmode.robots.hand import colliding, opposed, settled, side_of, surface_corners

Array = NDArray[np.float64]

_FACE = 0.002
"""How far behind the foremost point of a finger its face reaches [m]: pads are rounded, and some are tilted."""

_USUAL = 0.06
"""Width of what is usually grasped [m]."""
_TIP = 0.01
"""How far behind the tip of a finger a link may end that counts as its pad [m]."""


@dataclass(frozen=True, kw_only=True)
class ParallelJaw:
    """Two fingers that move towards each other: x across the fingers, y along the closing axis, z towards the tips."""

    opening: float
    """Widest gap between the pads [m]."""
    pad_width: float
    """Size of a pad across the finger [m]."""
    pad_length: float
    """Size of a pad along the finger [m]."""
    finger_width: float
    """Size of a finger across, along its pad [m]."""
    thickness: float
    """From the face of a finger to its back [m]."""
    tip: float
    """How far the finger tips stand beyond the middle of the pads [m]."""
    reach: float
    """From the palm to the finger tips [m]."""
    palm: tuple[float, float]
    """Half sizes of the palm along x and y [m]."""
    friction: float
    """Coulomb coefficient of the pads."""
    frame: ToolPose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    """Pose of the middle between the pads in the tool's frame: position [m], quaternion (xyzw)."""

    def __post_init__(self) -> None:
        """Check the sizes."""
        sizes = ("opening", "pad_width", "pad_length", "finger_width", "thickness", "tip", "reach")
        require_fields(self, sizes, above=0.0, unit="m")
        require_fields(self, ("palm",), count=2, above=0.0, unit="m")
        require_fields(self, ("friction",), above=0.0)

    @classmethod
    def of(cls, robot: Any) -> ParallelJaw:
        """Return the jaw of a robot; that of a robot from a file is measured from its collision shapes.

        Args:
            robot: An `ArmDescription`, a `RobotDescription`, or a `TableRobot`, whose jaw has the frame of its tool.

        Raises:
            ConfigError: If the robot has no two fingers, each with joints of its own, that close on each other.
        """
        if isinstance(robot, RobotDescription):
            return _measured(robot)
        if not isinstance(robot, ArmDescription):
            return replace(robot.jaw, frame=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
        gripper = robot.gripper
        parts = [part for part in finger_parts(gripper.pad_size, gripper.finger_length, 1.0) if part.touch]
        palm = hand_parts(robot.hand_length, gripper.stroke)[-1].size
        return cls(
            opening=gripper.stroke,
            pad_width=gripper.pad_size[0],
            pad_length=gripper.pad_size[2],
            finger_width=max(2.0 * part.size[0] for part in parts),
            thickness=max(part.center[1] + part.size[1] for part in parts),
            tip=0.5 * gripper.pad_size[2],
            reach=gripper.finger_length,
            palm=(palm[0], palm[1]),
            friction=gripper.friction,
        )


def gap_of(robot: RobotDescription, jaw: ParallelJaw, opening: float) -> float:
    """Return the distance between the faces of the fingers along the closing axis at an opening of the gripper [m].

    Args:
        robot: The robot that the jaw was measured on.
        jaw: Its fingers.
        opening: 0 is closed, 1 is open.
    """
    model = robot.model
    data = _kinematics(robot, model, opening)
    mount = data.xmat[model.body(robot.end_effector).id].reshape(3, 3)
    turn = mount @ (Rotation.from_quat(robot.tool[3:]) * Rotation.from_quat(jaw.frame[3:])).as_matrix()
    y, z = turn[:, 1], turn[:, 2]
    left, right = (_pad_corners(model, data, side, z) @ y for side in _fingers(robot, model))
    # The closing axis may point from either finger to the other.
    return float(max(left.min() - right.max(), right.min() - left.max()))


def dry_friction_of(robot: RobotDescription) -> float:
    """Return the work against dry friction of all joints of the hand from closed to open, to be shared by travel [J].

    Args:
        robot: A robot with a gripper.
    """
    model = robot.model
    closed, wide = (_kinematics(robot, model, opening).qpos for opening in (0.0, 1.0))
    return float(np.abs(wide - closed) @ model.dof_frictionloss)


def _measured(robot: RobotDescription) -> ParallelJaw:
    """Measure the jaw of a robot from a file."""
    model = robot.model
    sides = _fingers(robot, model)
    hand = [model.body(name).id for name in robot.hand_links]
    hand = [link for link in hand if link not in sides[0] + sides[1]]
    closed, wide = (_kinematics(robot, model, opening) for opening in (0.0, 1.0))
    moved = [
        surface_corners(model, wide, side).mean(0) - surface_corners(model, closed, side).mean(0) for side in sides
    ]
    axis = moved[0] - moved[1]
    y = axis / max(float(np.linalg.norm(axis)), 1e-12)
    mount = wide.xmat[model.body(robot.end_effector).id].reshape(3, 3)
    fingers = [surface_corners(model, wide, side) for side in sides]
    base = surface_corners(model, wide, hand) if hand else np.empty((0, 3))
    if not len(base):
        base = wide.xpos[[model.body_parentid[sides[0][0]]]]
    out = np.concatenate(fingers).mean(0) - base.mean(0)
    # The fingers stand out along an axis of the link that carries them.
    along = mount.T @ (out - y * (out @ y))
    k = int(np.abs(along).argmax())
    z = mount[:, k] * np.sign(along[k])
    z = z - y * (z @ y)
    turn = np.column_stack([np.cross(y, z / np.linalg.norm(z)), y, z / np.linalg.norm(z)])
    left, right = (_pad_corners(model, wide, side, turn[:, 2]) @ turn for side in sides)
    face = np.array([left[:, 1].min(), right[:, 1].max()])
    opening = float(face[0] - face[1])
    if moved[0] @ y <= 0.0 or moved[1] @ y >= 0.0 or opening <= 0.0:
        raise ConfigError(f"the fingers of {robot.name!r} do not close on each other", hint=_HINT)
    pads = [left[left[:, 1] < face[0] + _FACE], right[right[:, 1] > face[1] - _FACE]]
    low = np.max([pad.min(0) for pad in pads], axis=0)
    high = np.min([pad.max(0) for pad in pads], axis=0)
    # The fingers of linkages come out as they close: the table is what they must not reach then.
    poses = (wide, _kinematics(robot, model, min(_USUAL / opening, 1.0)))
    tips = max(min(float((surface_corners(model, pose, side) @ turn[:, 2]).max()) for side in sides) for pose in poses)
    whole = fingers[0] @ turn
    beside = whole[whole[:, 2] >= min(low[2], high[2]) - 1e-9]
    base = base @ turn
    middle = np.array([0.5 * (low[0] + high[0]), 0.5 * (face[0] + face[1]), 0.5 * (low[2] + high[2])])
    tool = Rotation.from_matrix(mount) * Rotation.from_quat(robot.tool[3:])
    origin = wide.xpos[model.body(robot.end_effector).id] + mount @ np.array(robot.tool[:3])
    place = tool.inv().apply(turn @ middle - origin)
    faces = [geom for side in sides for geom in colliding(model, side)]
    pad_width, pad_length = (max(float(high[j] - low[j]), _FACE) for j in (0, 2))
    return ParallelJaw(
        opening=opening,
        pad_width=pad_width,
        pad_length=pad_length,
        finger_width=float(np.ptp(beside[:, 0])),
        thickness=max(float(beside[:, 1].max() - face[0]), _FACE),
        tip=float(tips - middle[2]),
        reach=float(tips - base[:, 2].max()),
        palm=(max(0.5 * float(np.ptp(base[:, 0])), 0.01), max(0.5 * float(np.ptp(base[:, 1])), 0.01)),
        friction=float(model.geom_friction[faces, 0].mean()),
        frame=(*place.tolist(), *(tool.inv() * Rotation.from_matrix(turn)).as_quat().tolist()),
    )


def _pad_corners(model: Any, data: Any, side: list[int], out: Array) -> Array:
    """Return the corners of those links of a finger that reach its tip, (N, 3) [m]: pads, not the links of a linkage.

    Args:
        model: The compiled robot.
        data: Where everything is.
        side: The links of the finger.
        out: The direction in which the fingers stand out.
    """
    solid = {int(model.geom_bodyid[geom]) for geom in colliding(model, side)}
    links = {link: surface_corners(model, data, [link]) for link in side if link in solid}
    tip = max((float((points @ out).max()) for points in links.values()), default=0.0)
    near = [points for points in links.values() if float((points @ out).max()) >= tip - _TIP]
    return np.concatenate(near) if near else np.empty((0, 3))


_HINT = "give ParallelJaw(opening=..., ...) yourself; tasks need two fingers that both move"


def _fingers(robot: RobotDescription, model: Any) -> tuple[list[int], list[int]]:
    """Return the links of both fingers: the driven ones and all behind them."""
    joints = robot.gripper.joints if robot.gripper else ()
    driven = {model.body(robot.joint_links[robot.joint_names.index(name)]).id for name in joints}
    roots = [link for link in sorted(driven) if not _above(model, link) & driven]
    sides: list[set[int]] = []
    for root in roots:
        palm = int(model.body_parentid[root])
        own = {b for b in range(1, model.nbody) if root in {b, *_above(model, b)}}
        # A link that a loop ties to the driven one belongs to the finger: the pads of linkages hang there.
        sides.append(own | set(side_of(model, palm, root)))
    leaders = {tie.joint: tie.leader for tie in robot.ties}
    if len(sides) > 2 and len({leaders.get(name, name) for name in joints}) == 1:
        sides = opposed(_kinematics(robot, model, 0.0), _kinematics(robot, model, 1.0), sides)
    if len(sides) != 2:
        fixed = " (one that moves against a jaw that does not)" if len(roots) == 1 else ""
        raise ConfigError(f"robot {robot.name!r} has {len(roots)} driven fingers{fixed}, not two", hint=_HINT)
    first, second = (sorted(side) for side in sides)
    return first, second


def finger_names(robot: RobotDescription) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the links of both fingers.

    Raises:
        ConfigError: If the robot has no two driven fingers.
    """
    model = robot.model
    first, second = _fingers(robot, model)
    return tuple(model.body(b).name for b in first), tuple(model.body(b).name for b in second)


def _above(model: Any, link: int) -> set[int]:
    """Return all links between a link and the world."""
    found = set()
    while (link := int(model.body_parentid[link])) > 0:
        found.add(link)
    return found


def _kinematics(robot: RobotDescription, model: Any, opening: float) -> Any:
    """Return where everything is with the gripper at an opening."""
    passive = [robot.joint_names.index(name) for name in robot.passive_joints]
    return settled(model, model.qpos0 + robot.with_opening(opening), passive)
