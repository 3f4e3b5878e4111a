"""The two fingers of a parallel gripper as a planner of grasps sees them: how far they open, pads, fingers, palm."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.checks import require_fields
from softmode.errors import ConfigError
from softmode.robots.arm import ArmDescription
from softmode.robots.arm_shapes import finger_parts, hand_parts
from softmode.robots.description import RobotDescription, ToolPose

Array = NDArray[np.float64]

_FACE = 0.002
"""How far behind the foremost point of a finger its face reaches [m]: pads are rounded, and some are tilted."""


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
    def of(cls, robot: ArmDescription | RobotDescription) -> ParallelJaw:
        """Return the jaw of a robot; that of a robot from a file is measured from its collision shapes.

        Raises:
            ConfigError: If the robot has no two fingers, each with joints of its own, that close on each other.
        """
        if isinstance(robot, RobotDescription):
            return _measured(robot)
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


def _measured(robot: RobotDescription) -> ParallelJaw:
    """Measure the jaw of a robot from a file."""
    model: Any = importlib.import_module("mujoco").MjModel.from_xml_string(robot.mjcf)
    sides = _fingers(robot, model)
    hand = [model.body(name).id for name in robot.hand_links]
    hand = [link for link in hand if link not in sides[0] + sides[1]]
    closed, wide = (_kinematics(robot, model, opening) for opening in (0.0, 1.0))
    moved = [_points(model, wide, side).mean(0) - _points(model, closed, side).mean(0) for side in sides]
    axis = moved[0] - moved[1]
    y = axis / max(float(np.linalg.norm(axis)), 1e-12)
    mount = wide.xmat[model.body(robot.end_effector).id].reshape(3, 3)
    fingers = [_points(model, wide, side) for side in sides]
    base = _points(model, wide, hand) if hand else np.empty((0, 3))
    if not len(base):
        base = wide.xpos[[model.body_parentid[sides[0][0]]]]
    out = np.concatenate(fingers).mean(0) - base.mean(0)
    # The fingers stand out along an axis of the link that carries them.
    along = mount.T @ (out - y * (out @ y))
    k = int(np.abs(along).argmax())
    z = mount[:, k] * np.sign(along[k])
    z = z - y * (z @ y)
    turn = np.column_stack([np.cross(y, z / np.linalg.norm(z)), y, z / np.linalg.norm(z)])
    left, right = (points @ turn for points in fingers)
    face = np.array([left[:, 1].min(), right[:, 1].max()])
    opening = float(face[0] - face[1])
    if moved[0] @ y <= 0.0 or moved[1] @ y >= 0.0 or opening <= 0.0:
        raise ConfigError(f"the fingers of {robot.name!r} do not close on each other", hint=_HINT)
    pads = [left[left[:, 1] < face[0] + _FACE], right[right[:, 1] > face[1] - _FACE]]
    low = np.max([pad.min(0) for pad in pads], axis=0)
    high = np.min([pad.max(0) for pad in pads], axis=0)
    tips = min(left[:, 2].max(), right[:, 2].max())
    beside = left[left[:, 2] >= min(low[2], high[2]) - 1e-9]
    base = base @ turn
    middle = np.array([0.5 * (low[0] + high[0]), 0.5 * (face[0] + face[1]), 0.5 * (low[2] + high[2])])
    tool = Rotation.from_matrix(mount) * Rotation.from_quat(robot.tool[3:])
    origin = wide.xpos[model.body(robot.end_effector).id] + mount @ np.array(robot.tool[:3])
    place = tool.inv().apply(turn @ middle - origin)
    faces = [geom for side in sides for geom in _geoms(model, side)]
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


_HINT = "give ParallelJaw(opening=..., ...) yourself"


def _fingers(robot: RobotDescription, model: Any) -> tuple[list[int], list[int]]:
    """Return the links of both fingers: the driven ones and all behind them."""
    joints = robot.gripper.joints if robot.gripper else ()
    driven = {model.body(robot.joint_links[robot.joint_names.index(name)]).id for name in joints}
    roots = [link for link in sorted(driven) if not _above(model, link) & driven]
    if len(roots) != 2:
        raise ConfigError(f"robot {robot.name!r} has {len(roots)} driven fingers, not two", hint=_HINT)
    first, second = ([b for b in range(1, model.nbody) if root in {b, *_above(model, b)}] for root in roots)
    return first, second


def _above(model: Any, link: int) -> set[int]:
    """Return all links between a link and the world."""
    found = set()
    while (link := int(model.body_parentid[link])) > 0:
        found.add(link)
    return found


def _kinematics(robot: RobotDescription, model: Any, opening: float) -> Any:
    """Return where everything is with the gripper at an opening."""
    mujoco = importlib.import_module("mujoco")
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0 + robot.with_opening(opening)
    mujoco.mj_kinematics(model, data)
    return data


def _geoms(model: Any, links: list[int]) -> list[int]:
    """Return the shapes of links that collide; all of them if none does."""
    own = [geom for geom in range(model.ngeom) if int(model.geom_bodyid[geom]) in links]
    return [geom for geom in own if model.geom_contype[geom] | model.geom_conaffinity[geom]] or own


def _points(model: Any, data: Any, links: list[int]) -> Array:
    """Return corners of the shapes of links in the world, (N, 3) [m]: a mesh's vertices, else of the bounding box."""
    found = []
    for geom in _geoms(model, links):
        mesh = int(model.geom_dataid[geom])
        if mesh >= 0:
            start = model.mesh_vertadr[mesh]
            local = np.asarray(model.mesh_vert[start : start + model.mesh_vertnum[mesh]], float)
        else:
            signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
            local = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
        found.append(data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T)
    return np.concatenate(found) if found else np.empty((0, 3))
