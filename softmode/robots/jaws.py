"""The two fingers of a parallel gripper as a planner of grasps sees them: how far they open, pads, fingers, palm."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from softmode.checks import require_fields
from softmode.errors import ConfigError
from softmode.robots.arm import ArmDescription
from softmode.robots.arm_shapes import finger_parts, hand_parts
from softmode.robots.convex_parts import edge_ends, slab_corners
from softmode.robots.description import RobotDescription, RobotGripper, ToolPose, compiled
from softmode.robots.hand import above, colliding, geom_corners, in_world, opposed, settled, side_of, surface_corners

Array = NDArray[np.float64]

_FACE = 0.002
"""How far behind the foremost point of a finger its face reaches [m]: pads are rounded, and some are tilted."""

_USUAL = 0.06
"""Width of what is usually grasped [m]."""
_TIP = 0.01
"""How far behind the tip of a finger a link may end that counts as its pad [m]."""
_JAW = 0.02
"""How much of the tip of a jaw that turns counts as its pad [m]; it is open where its tip has come up by as much."""
_DEEP = 0.75
"""Share of the gap at its tips to which a jaw that turns may narrow where an object reaches into it."""
_LEAST_OPENING = 0.03
"""Least opening of a hand with one moving jaw that tasks can use [m]."""
_SLIDE = 2
"""MuJoCo's number of a joint that slides."""


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
    follow: float = 0.0
    """By what share of the gap the middle moves along y as they open: 0.5, or -0.5, where one of them moves alone; its
    `frame` is on the face of the other one."""

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
            ConfigError: If the robot has no two fingers that close on each other, nor one that closes on a fixed one.
        """
        if isinstance(robot, RobotDescription):
            return measured(robot)[1]
        if not isinstance(robot, ArmDescription):
            return replace(robot.jaw, frame=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), follow=0.0)
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

    def frame_at(self, gap: float) -> ToolPose:
        """Return the frame's pose in that of the tool where the pads are so far apart [m]."""
        if not self.follow:
            return self.frame
        x, y, z = Rotation.from_quat(self.frame[3:]).apply([0.0, self.follow * gap, 0.0]) + self.frame[:3]
        return (float(x), float(y), float(z), *self.frame[3:])


def gap_of(robot: RobotDescription, jaw: ParallelJaw, opening: float) -> float:
    """Return the distance between the faces of the fingers along the closing axis at an opening of the gripper [m].

    Args:
        robot: The robot that the jaw was measured on.
        jaw: Its fingers.
        opening: 0 is closed, 1 is open.
    """
    data = _kinematics(robot, opening)
    tool, origin = _tool(robot, data)
    turn = (tool * Rotation.from_quat(jaw.frame[3:])).as_matrix()
    if jaw.follow:
        place = (origin + tool.apply(jaw.frame[:3])) @ turn
        return _one_gap(robot, data, turn, float(place[2]) - 0.5 * jaw.pad_length)
    return _apart(*(_pad_corners(robot.model, data, side, turn[:, 2]) @ turn[:, 1] for side in _fingers(robot)))


def dry_friction_of(robot: RobotDescription) -> float:
    """Return the work against dry friction of all joints of the hand from closed to open, to be shared by travel [J].

    Args:
        robot: A robot with a gripper.
    """
    closed, wide = (_kinematics(robot, opening).qpos for opening in (0.0, 1.0))
    return float(np.abs(wide - closed) @ robot.model.dof_frictionloss)


def measured(robot: RobotDescription) -> tuple[RobotDescription, ParallelJaw]:
    """Measure the jaw of a robot from a file; a gripper of one that turns alone gets the ends between which it grasps.

    Raises:
        ConfigError: If the robot has no two fingers that close on each other, nor one that closes on a fixed one.
    """
    sides = _fingers(robot)
    if int(robot.model.body_parentid[sides[0][0]]) in sides[1]:
        return _one_jaw(robot, sides)
    return robot, _two_fingers(robot, sides)


@functools.lru_cache(8)
def _edges(mjcf: str, links: tuple[int, ...]) -> dict[int, Array]:
    """Return both ends of the edges of the hulls of shapes of links, in their frames, (2 E, 3) [m]."""
    model = compiled(mjcf)
    hulls = {geom: ConvexHull(geom_corners(model, geom)) for geom in colliding(model, links)}
    return {geom: edge_ends(hull.points[hull.simplices]) for geom, hull in hulls.items()}


def _apart(one: Array, other: Array) -> float:
    """Return the gap between two sets of coordinates along an axis that may point from either to the other."""
    return float(max(one.min() - other.max(), other.min() - one.max()))


def _one_gap(robot: RobotDescription, data: Any, turn: Array, low: float, high: float = np.inf) -> float:
    """Return the gap between a jaw and the fixed one, moving less fixed along y of a frame, in a slab of z [m]."""
    sides = _fingers(robot)
    ends = [in_world(data, _edges(robot.mjcf, tuple(side))) @ turn for side in sides]
    jaw, fixed = (slab_corners(side, 2, low, high)[:, 1] for side in ends)
    return _apart(jaw, fixed) if len(jaw) and len(fixed) else -np.inf


def _one_jaw(robot: RobotDescription, sides: tuple[list[int], list[int]]) -> tuple[RobotDescription, ParallelJaw]:
    """Measure a jaw that closes on a fixed one: its gap is that at the tips, half of it from the fixed face."""
    model, gripper = robot.model, robot.gripper
    assert gripper is not None
    j = int(model.body_jntadr[sides[0][0]])
    openings = np.linspace(0.0, 1.0, 41)
    poses = [_kinematics(robot, s) for s in openings]
    closed, axis = poses[0], poses[0].xaxis[j]

    def points(data: Any, k: int) -> Array:
        return in_world(data, _edges(robot.mjcf, tuple(sides[k])))

    z = _out(robot, closed, points(closed, 0).mean(0) - closed.xanchor[j], axis)
    y = axis if model.jnt_type[j] == _SLIDE else np.cross(axis, z)
    y = y * np.sign((points(poses[5], 0).mean(0) - points(closed, 0).mean(0)) @ y)
    turn = np.column_stack([np.cross(y, z), y, z])
    fixed = points(closed, 1) @ turn
    tip = min(fixed[:, 2].max(), (points(closed, 0) @ turn)[:, 2].max())
    gaps = np.array([_one_gap(robot, data, turn, tip - _JAW) for data in poses])
    last = int(np.argmax(gaps))
    if gaps[last] < _LEAST_OPENING:
        raise ConfigError(
            f"the jaw of {robot.name!r} opens {1e3 * max(gaps[last], 0.0):.0f} mm at its tip, between the hulls of "
            f"what collides; tasks need {1e3 * _LEAST_OPENING:.0f} mm",
            hint="give its links collision shapes that leave the space between the jaws free, such as boxes",
        )
    first = int(np.flatnonzero(gaps[: last + 1] <= 0.0)[-1]) if gaps[0] < 0.0 else 0
    zero = np.interp(0.0, gaps[first : first + 2], openings[first : first + 2])
    ends = np.array([gripper.closed, gripper.open])
    ends = ends[0] + np.outer([zero, openings[last]], ends[1] - ends[0])
    jaws = RobotGripper(joints=gripper.joints, closed=tuple(ends[0].tolist()), open=tuple(ends[1].tolist()))
    at_usual = min(_USUAL, float(gaps[last]))
    usual = poses[int(np.searchsorted(gaps[: last + 1], at_usual))]
    moving = points(usual, 0) @ turn
    tips = [slab_corners(side, 2, tip - _JAW, np.inf) for side in (moving, fixed)]
    low, high = np.max([pad.min(0) for pad in tips], axis=0), np.min([pad.max(0) for pad in tips], axis=0)
    depth = np.arange(_JAW, tip - float(closed.xanchor[j] @ z), 0.005)
    free = [_one_gap(robot, usual, turn, tip - h - 0.0025, tip - h + 0.0025) > _DEEP * at_usual for h in depth]
    middle = np.array([0.5 * (low[0] + high[0]), tips[1][:, 1].max(), tip - 0.5 * _JAW])
    width = max(float(np.ptp(pad[:, 0])) for pad in tips)
    beyond = max(moving[:, 2].max(), (points(closed, 0) @ turn)[:, 2].max(), fixed[:, 2].max()) - middle[2]
    jaw = ParallelJaw(
        opening=float(gaps[last]),
        pad_width=max(float(high[0] - low[0]), _FACE),
        pad_length=_JAW,
        finger_width=width,
        thickness=max(float(np.ptp(pad[:, 1])) for pad in tips),
        tip=float(beyond),
        reach=float(beyond - 0.5 * _JAW + (depth[free.index(False)] if False in free else depth[-1])),
        palm=(0.5 * width, 0.5 * float(gaps[last])),
        friction=_friction(model, sides),
        frame=_in_tool(robot, closed, turn, middle),
        follow=0.5,
    )
    return replace(robot, gripper=jaws), jaw


def _two_fingers(robot: RobotDescription, sides: tuple[list[int], list[int]]) -> ParallelJaw:
    """Measure two fingers that move."""
    model = robot.model
    hand = [link for name in robot.hand_links if (link := model.body(name).id) not in sides[0] + sides[1]]
    closed, wide = (_kinematics(robot, opening) for opening in (0.0, 1.0))
    fingers, shut = ([surface_corners(model, data, side) for side in sides] for data in (wide, closed))
    moved = [ahead.mean(0) - behind.mean(0) for ahead, behind in zip(fingers, shut, strict=True)]
    axis = moved[0] - moved[1]
    y = axis / max(float(np.linalg.norm(axis)), 1e-12)
    base = surface_corners(model, wide, hand)
    if not len(base):
        base = wide.xpos[[model.body_parentid[sides[0][0]]]]
    z = _out(robot, wide, np.concatenate(fingers).mean(0) - base.mean(0), y)
    turn = np.column_stack([np.cross(y, z), y, z])
    left, right = (_pad_corners(model, wide, side, turn[:, 2]) @ turn for side in sides)
    face = np.array([left[:, 1].min(), right[:, 1].max()])
    opening = float(face[0] - face[1])
    if moved[0] @ y <= 0.0 or moved[1] @ y >= 0.0 or opening <= 0.0:
        gap = f"open, the hulls of what collides are {1e3 * opening:.0f} mm apart"
        raise ConfigError(f"the fingers of {robot.name!r} do not close on each other: {gap}", hint=_HINT)
    pads = [left[left[:, 1] < face[0] + _FACE], right[right[:, 1] > face[1] - _FACE]]
    low = np.max([pad.min(0) for pad in pads], axis=0)
    high = np.min([pad.max(0) for pad in pads], axis=0)
    # The fingers of linkages come out as they close: the table is what they must not reach then.
    poses = (wide, _kinematics(robot, min(_USUAL / opening, 1.0)))
    tips = max(min(float((surface_corners(model, pose, side) @ turn[:, 2]).max()) for side in sides) for pose in poses)
    whole = fingers[0] @ turn
    beside = whole[whole[:, 2] >= min(low[2], high[2]) - 1e-9]
    base = base @ turn
    middle = np.array([0.5 * (low[0] + high[0]), 0.5 * (face[0] + face[1]), 0.5 * (low[2] + high[2])])
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
        friction=_friction(model, sides),
        frame=_in_tool(robot, wide, turn, middle),
    )


def _friction(model: Any, sides: tuple[list[int], list[int]]) -> float:
    """Return the mean coefficient of what touches of both fingers."""
    return float(model.geom_friction[colliding(model, sides[0] + sides[1]), 0].mean())


def _out(robot: RobotDescription, data: Any, towards: Array, axis: Array) -> Array:
    """Return the unit vector across an axis along which fingers stand out: an axis of the link that carries them."""
    mount = data.xmat[robot.model.body(robot.end_effector).id].reshape(3, 3)
    along = mount.T @ (towards - axis * (towards @ axis))
    k = int(np.abs(along).argmax())
    z = mount[:, k] * np.sign(along[k])
    z = z - axis * (z @ axis)
    return z / np.linalg.norm(z)


def _tool(robot: RobotDescription, data: Any) -> tuple[Rotation, Array]:
    """Return how the tool is turned in the world, and its origin there [m]."""
    link = robot.model.body(robot.end_effector).id
    mount = Rotation.from_matrix(data.xmat[link].reshape(3, 3))
    return mount * Rotation.from_quat(robot.tool[3:]), data.xpos[link] + mount.apply(robot.tool[:3])


def _in_tool(robot: RobotDescription, data: Any, turn: Array, middle: Array) -> ToolPose:
    """Return the pose of a frame in that of the tool, by its axes in the world and its origin along them [m]."""
    tool, origin = _tool(robot, data)
    x, y, z = tool.inv().apply(turn @ middle - origin).tolist()
    a, b, c, d = (tool.inv() * Rotation.from_matrix(turn)).as_quat().tolist()
    return x, y, z, a, b, c, d


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


_HINT = "give ParallelJaw(opening=..., ...) yourself; tasks need two fingers, or one that closes on a fixed one"


def _fingers(robot: RobotDescription) -> tuple[list[int], list[int]]:
    """Return the links of both fingers: the driven ones and all behind them."""
    model, joints = robot.model, robot.gripper.joints if robot.gripper else ()
    driven = {model.body(robot.joint_links[robot.joint_names.index(name)]).id for name in joints}
    roots = [link for link in sorted(driven) if driven.isdisjoint(above(model, link))]
    # A link that a loop ties to the driven one belongs to the finger: the pads of linkages hang there.
    sides = [set(side_of(model, int(model.body_parentid[root]), root)) for root in roots]
    leaders = {tie.joint: tie.leader for tie in robot.ties}
    if len(sides) > 2 and len({leaders.get(name, name) for name in joints}) == 1:
        sides = opposed(_kinematics(robot, 0.0), _kinematics(robot, 1.0), sides)
    if len(sides) == 1:  # what is fixed to the palm is the other finger
        rigid = model.body_weldid == model.body_weldid[model.body_parentid[roots[0]]]
        sides.append({b for b in range(1, model.nbody) if rigid[b]})
    if len(sides) != 2:
        raise ConfigError(f"robot {robot.name!r} has {len(roots)} driven fingers, not two", hint=_HINT)
    first, second = (sorted(side) for side in sides)
    return first, second


def finger_names(robot: RobotDescription) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the links of both fingers.

    Raises:
        ConfigError: If the robot has no two driven fingers.
    """
    first, second = (tuple(robot.model.body(b).name for b in side) for side in _fingers(robot))
    return first, second


def _kinematics(robot: RobotDescription, opening: float) -> Any:
    """Return where everything is with the gripper at an opening."""
    passive = [robot.joint_names.index(name) for name in robot.passive_joints]
    return settled(robot.model, robot.model.qpos0 + robot.with_opening(opening), passive)
