"""The serial chain from a robot's base to its tool on the host: kinematics, Jacobian, inverse, reach.

A pose is a product of exponentials (Lynch and Park, *Modern Robotics*, 2017, eq. 4.14): every joint turns about, or
slides along, an axis that is known in the base frame at zero coordinates.
"""

from __future__ import annotations

import functools
import importlib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.errors import ConfigError
from softmode.robots.description import RobotDescription, ToolPose, followed

Array = NDArray[np.float64]
STILL = 1.0e-13
"""Motion of an iteration of the inverse that is rounding [rad or m]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SerialChain:
    """The joints between base and tool, in the base frame at zero coordinates; poses are made for many rows at once."""

    joints: tuple[int, ...]
    """Which joint coordinates of the robot these are."""
    axis: Array
    """Directions of the joints, shape (n, 3)."""
    anchor: Array
    """Points on the axes of hinges [m], shape (n, 3)."""
    slide: NDArray[np.bool_]
    """Which joints slide, shape (n,)."""
    lower: Array
    """Lower limits [rad or m], shape (n,)."""
    upper: Array
    """Upper limits, shape (n,)."""
    home: Array
    """Coordinates of the home pose, shape (n,)."""
    leader: NDArray[np.int64]
    """Which joint of the chain each one follows, itself for most, shape (n,)."""
    ratio: Array
    """Travel of each for a unit of its leader's, shape (n,)."""
    offset: Array
    """Coordinate of each where its leader's is zero [rad or m], shape (n,)."""
    tool_position: Array
    """Tool at zero coordinates [m], shape (3,)."""
    tool_rotation: Array
    """Its rotation matrix."""

    @property
    def span(self) -> tuple[Array, Array]:
        """Finite limits: a joint without one turns by half a turn to either side."""
        return np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)

    @property
    def follows(self) -> NDArray[np.bool_]:
        """Which joints follow another, shape (n,)."""
        return self.leader != np.arange(len(self.leader))

    def followed(self, q: Array) -> Array:
        """Return coordinates (B, n) with those of followers where their ties have them."""
        return followed(q, self.leader, self.ratio, self.offset)

    def _folded(self, jacobian: Array) -> Array:
        """Return a Jacobian whose columns of leaders have those of their followers, which become zero."""
        for k in np.flatnonzero(self.follows):
            jacobian[:, :, self.leader[k]] += self.ratio[k] * jacobian[:, :, k]
            jacobian[:, :, k] = 0.0
        return jacobian

    def forward(self, q: Array) -> tuple[Array, Array]:
        """Return positions (B, 3) [m] and rotations (B, 3, 3) of the tool at coordinates of shape (B, n)."""
        position, rotation, _, _ = self._sweep(q)
        return position, rotation

    def lowest(self, q: Array) -> Array:
        """Return the height of the lowest joint but the first over the base [m], shape (B,)."""
        return self._sweep(q)[3][:, 1:, 2].min(axis=1, initial=math.inf)

    def jacobian(self, q: Array) -> Array:
        """Return d(position, rotation)/dq in the base frame, shape (B, 6, n)."""
        position, _, axes, anchors = self._sweep(q)
        return self._slopes(position, axes, anchors)

    def _slopes(self, position: Array, axes: Array, anchors: Array) -> Array:
        """Return the Jacobian where the tool, and axes and anchors of all joints, are these."""
        lever = np.cross(axes, position[:, None] - anchors)
        linear = np.where(self.slide[:, None], axes, lever)
        angular = np.where(self.slide[:, None], 0.0, axes)
        return np.concatenate([linear, angular], axis=2).transpose(0, 2, 1)

    def _sweep(self, q: Array) -> tuple[Array, Array, Array, Array]:
        """Return the tool, and axes and anchors of all joints."""
        count = len(q)
        rotation, position = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
        axes, anchors = np.empty((count, len(self.axis), 3)), np.empty((count, len(self.axis), 3))
        for k, (axis, anchor) in enumerate(zip(self.axis, self.anchor, strict=True)):
            axes[:, k] = rotation @ axis
            anchors[:, k] = rotation @ anchor + position
            if self.slide[k]:
                position = position + axes[:, k] * q[:, k, None]
            else:
                turn = Rotation.from_rotvec(q[:, k, None] * axis).as_matrix()
                position = position + np.einsum("bij,bj->bi", rotation, anchor - turn @ anchor)
                rotation = rotation @ turn
        return rotation @ self.tool_position + position, rotation @ self.tool_rotation, axes, anchors

    def inverse(
        self, position: Array, rotation: Array, start: Array, *, iterations: int = 150, length: float = 0.3
    ) -> tuple[Array, Array]:
        """Return coordinates that bring the tool to poses, by damped least squares within the limits.

        A row is done when it moves by no more than `STILL`.

        Args:
            position: Wanted positions [m], shape (B, 3).
            rotation: Wanted rotation matrices, shape (B, 3, 3).
            start: Where the iteration begins, shape (n,) or (B, n).
            iterations: How many steps at most.
            length: By how much a rotation error counts [m/rad].

        Returns:
            The coordinates, shape (B, n), and the error that is left [m], shape (B,).
        """
        low, high = self.span
        q = self.followed(np.array(np.broadcast_to(np.clip(start, low, high), (len(position), len(low)))))
        weight = np.array([1.0] * 3 + [length] * 3)[:, None]
        moving = np.arange(len(q))
        for _ in range(iterations):
            at, turned, axes, anchors = self._sweep(q[moving])
            error = _pose_error(at, turned, position[moving], rotation[moving], length)
            jacobian = self._folded(weight * self._slopes(at, axes, anchors))
            size = np.linalg.norm(error, axis=1)
            damping = (0.05 * np.minimum(1.0, size / 0.05) + 1.0e-4) ** 2
            normal = jacobian @ jacobian.transpose(0, 2, 1) + damping[:, None, None] * np.eye(6)
            step = np.einsum("bij,bi->bj", jacobian, np.linalg.solve(normal, error[..., None])[..., 0])
            before = q[moving]
            q[moving] = self.followed(np.clip(before + np.clip(step, -0.4, 0.4), low, high))
            moving = moving[np.abs(q[moving] - before).max(axis=1) > STILL]
            if not len(moving):
                break
        return q, np.linalg.norm(_pose_error(*self.forward(q), position, rotation, length), axis=1)

    @functools.cached_property
    def reach(self) -> float:
        """Largest distance of the tool from the first joint within the limits [m], by a search from random poses."""
        low, high = self.span
        first = self.anchor[0]

        def distance(q: Array) -> Array:
            return np.linalg.norm(self.forward(self.followed(q))[0] - first, axis=1)

        random = np.random.default_rng(0)
        q = low + (high - low) * random.random((4000, len(low)))
        q = np.concatenate([q[np.argsort(distance(q))[-15:]], self.home[None]])
        best, step = distance(q), 0.4
        moves = np.concatenate([np.eye(len(low)), -np.eye(len(low))])
        while step > 1.0e-4:  # the best step of any one joint, while there is one
            trial = np.clip(q[:, None] + step * moves, low, high)
            far = distance(trial.reshape(-1, len(low))).reshape(len(q), -1)
            better = far.max(axis=1) > best + 1.0e-9
            q[better] = trial[better, far.argmax(axis=1)[better]]
            best = np.maximum(best, far.max(axis=1))
            step = step if better.any() else 0.5 * step
        return float(best.max())


def _pose_error(at: Array, turned: Array, position: Array, rotation: Array, length: float) -> Array:
    """Return what is missing from a pose to a wanted one, position and rotation vector times a length, (B, 6) [m]."""
    turn = Rotation.from_matrix(rotation @ turned.transpose(0, 2, 1)).as_rotvec()
    return np.concatenate([position - at, length * turn], axis=1)


def serial_chain(robot: RobotDescription, frame: ToolPose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) -> SerialChain:
    """Return the chain from the base of a robot to its tool.

    Args:
        robot: The robot.
        frame: Pose of the point that is to be moved in the tool's frame.

    Raises:
        ConfigError: If no joint moves the tool.
    """
    mujoco: Any = importlib.import_module("mujoco")
    model = robot.model
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    link = end = model.body(robot.end_effector).id
    path: list[int] = []
    while link > 0:
        first = int(model.body_jntadr[link])
        path += range(first + int(model.body_jntnum[link]) - 1, first - 1, -1) if first >= 0 else []
        link = int(model.body_parentid[link])
    joints = path[::-1]
    if not joints:
        raise ConfigError(
            f"no joint moves the end effector {robot.end_effector!r} of robot {robot.name!r}",
            hint="name a link or site at the end of an arm, or put the hand upon one: load(arm, hand=...)",
        )
    mount = data.xmat[end].reshape(3, 3)
    inside = Rotation.from_quat(robot.tool[3:])
    place = np.array(robot.tool[:3]) + inside.apply(frame[:3])
    turn = (inside * Rotation.from_quat(frame[3:])).as_matrix()
    leader, ratio, offset = np.arange(len(joints)), np.ones(len(joints)), np.zeros(len(joints))
    leads, slope, shift = robot.bound
    for k, j in enumerate(joints):
        # The first joint of the chain that has the same leader, which may stand elsewhere, leads here.
        first = next(i for i in range(k + 1) if leads[joints[i]] == leads[j])
        leader[k], ratio[k] = first, slope[j] / slope[joints[first]]
        offset[k] = shift[j] - ratio[k] * shift[joints[first]]
    return SerialChain(
        joints=tuple(joints),
        axis=data.xaxis[joints].copy(),
        anchor=data.xanchor[joints].copy(),
        slide=model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_SLIDE),
        lower=np.array(robot.joint_lower)[joints],
        upper=np.array(robot.joint_upper)[joints],
        home=np.array(robot.home)[joints],
        leader=leader,
        ratio=ratio,
        offset=offset,
        tool_position=data.xpos[end] + mount @ place,
        tool_rotation=mount @ turn,
    )
