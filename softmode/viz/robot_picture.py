"""A picture of a robot from a file: in its home pose, and its hand open and closed, with the tool's axes."""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from softmode.robots.description import RobotDescription
from softmode.robots.hand import colliding, settled
from softmode.viz.figure_file import figure_file

Array = NDArray[np.float64]

_TOWARDS = np.array([0.78, -0.52, 0.36])
"""Direction from the robot to the camera."""
_LIGHT = np.array([0.55, -0.30, 0.78])
_ARM, _HAND, _FINGER = np.array([0.62, 0.66, 0.71]), np.array([0.36, 0.52, 0.72]), np.array([0.90, 0.55, 0.20])


def write_robot_picture(path: str | os.PathLike[str], robot: RobotDescription) -> None:
    """Draw a robot by its colliding shapes and write the picture; the file appears complete or not at all.

    Fingers are orange, the hand is blue. Red, green and blue lines are the axes x, y and z of the tool.

    Args:
        path: The .png to write.
        robot: The robot.

    Raises:
        MissingExtraError: If matplotlib is not installed.
        ConfigError: If the name is not that of a .png.
        StorageError: If it cannot be written.
    """
    model: Any = importlib.import_module("mujoco").MjModel.from_xml_string(robot.mjcf)
    poses = [("home", robot.home_joint_q, False)]
    if robot.gripper is not None:
        poses += [("gripper open", robot.with_opening(1.0), True), ("gripper closed", robot.with_opening(0.0), True)]
    size = (5.0 * len(poses), 5.2)
    with figure_file(path, size, what="picture", whole="the picture of a robot", like="arm.png") as figure:
        for k, (title, joint_q, close) in enumerate(poses):
            axes = figure.add_axes((k / len(poses), 0.0, 1.0 / len(poses), 0.92))
            axes.set_title(f"{robot.name}: {title}" if k == 0 else title, fontsize=11)
            _draw(axes, robot, model, joint_q, robot.hand_links if close else robot.link_names)


def _draw(axes: Any, robot: RobotDescription, model: Any, joint_q: Array, links: Sequence[str]) -> None:
    """Draw some links of a robot in a pose."""
    from matplotlib.collections import PolyCollection

    passive = [robot.joint_names.index(name) for name in robot.passive_joints]
    data = settled(model, model.qpos0 + joint_q, passive)
    fingers = {model.body(robot.joint_links[robot.joint_names.index(name)]).id for name in _gripper_joints(robot)}
    fingers |= {b for b in range(1, model.nbody) if _behind_any(model, b, fingers)}
    hand = {model.body(name).id for name in robot.hand_links}
    shown = [model.body(name).id for name in links]
    right = np.cross([0.0, 0.0, 1.0], _TOWARDS)
    right /= np.linalg.norm(right)
    towards = _TOWARDS / np.linalg.norm(_TOWARDS)
    view = np.stack([right, np.cross(towards, right), towards])
    triangles, colors = [], []
    for geom in colliding(model, [*shown, *([0] if len(shown) == model.nbody - 1 else [])]):
        corners = _triangles(model, geom) @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
        body = int(model.geom_bodyid[geom])
        color = _FINGER if body in fingers else _HAND if body in hand else _ARM
        shade = 0.45 + 0.55 * np.abs(normal @ _LIGHT) / np.linalg.norm(_LIGHT)
        triangles.append(corners @ view.T)
        colors.append(np.clip(shade[:, None] * color, 0.0, 1.0))
    if triangles:
        seen, paint = np.concatenate(triangles), np.concatenate(colors)
        order = np.argsort(seen[:, :, 2].mean(axis=1))
        axes.add_collection(PolyCollection(list(seen[order][:, :, :2]), facecolors=paint[order], linewidths=0.0))
    mount = data.xmat[model.body(robot.end_effector).id].reshape(3, 3)
    tool = data.xpos[model.body(robot.end_effector).id] + mount @ np.array(robot.tool[:3])
    turn = mount @ Rotation.from_quat(robot.tool[3:]).as_matrix()
    size = 0.15 * float(np.ptp(np.concatenate(triangles)[..., :2])) if triangles else 0.1
    for k, color in enumerate(("#d02020", "#109010", "#2040d0")):
        line = np.stack([tool, tool + size * turn[:, k]]) @ view.T
        axes.plot(line[:, 0], line[:, 1], color=color, linewidth=2.5)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.margins(0.06)
    axes.axis("off")


def _gripper_joints(robot: RobotDescription) -> Sequence[str]:
    return robot.gripper.joints if robot.gripper is not None else ()


def _behind_any(model: Any, link: int, links: set[int]) -> bool:
    """Return whether a link stands behind one of some others."""
    while (link := int(model.body_parentid[link])) > 0:
        if link in links:
            return True
    return False


def _triangles(model: Any, geom: int) -> Array:
    """Return the triangles of a shape in its own frame, (N, 3, 3) [m]."""
    mujoco = importlib.import_module("mujoco")
    kind, size = int(model.geom_type[geom]), np.asarray(model.geom_size[geom], float)
    mesh = int(model.geom_dataid[geom])
    if mesh >= 0 and kind == int(mujoco.mjtGeom.mjGEOM_MESH):
        vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
        faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
        return np.asarray(vertices, float)[faces]
    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    ball = np.concatenate([np.cos(a) * circle + [0.0, 0.0, np.sin(a)] for a in np.linspace(-1.5, 1.5, 11)])
    if kind == int(mujoco.mjtGeom.mjGEOM_SPHERE):
        points = size[0] * ball
    elif kind == int(mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        points = size * ball
    elif kind in (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)):
        end = size[0] * (ball if kind == int(mujoco.mjtGeom.mjGEOM_CAPSULE) else circle)
        points = np.concatenate([np.add(end, [0.0, 0.0, z]) for z in (-size[1], size[1])])
    else:
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3), axis=-1).reshape(-1, 3)
        points = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
    return points[ConvexHull(points).simplices]
