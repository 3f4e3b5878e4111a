"""The cameras of the table: in front of it, over all of it, and on the hand."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.robots.arm import ArmDescription
from softmode.robots.table_robot import TableRobot
from softmode.splats.raster.pinhole import PinholeCamera

Point = tuple[float, float, float]


def square_camera(name: str, edge: int, position: Point, target: Point, fov_y: float) -> PinholeCamera:
    """Return a camera with square pictures.

    Args:
        name: Name of the camera.
        edge: Edge of a picture [px].
        position: Where it stands [m].
        target: Where it looks [m].
        fov_y: Opening angle [rad].
    """
    return PinholeCamera.look_at(name, position=position, target=target, width=edge, height=edge, fov_y=fov_y)


def overview(name: str, edge: int) -> PinholeCamera:
    """Return the camera that sees the whole arm, with pictures of `edge` x `edge` pixels."""
    return square_camera(name, edge, (1.42, -1.20, 0.86), (0.34, 0.03, 0.35), 0.60)


def wrist_camera(name: str, edge: int, arm: ArmDescription | TableRobot | None = None) -> PinholeCamera:
    """Return the camera on the hand that looks between the fingers, with pictures of `edge` x `edge` pixels."""
    if isinstance(arm, TableRobot):
        # As far from the tool as that of the built-in arm.
        mount = Rotation.from_quat(arm.robot.tool[3:])
        place = mount.apply(arm.jaw.frame[:3]) + arm.robot.tool[:3]
        turn = mount * Rotation.from_quat(arm.jaw.frame[3:])
        eye, middle, up = turn.apply([[0.12, 0.0, -0.12], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
        position: Any = tuple((eye + place).tolist())
        target: Any = tuple((middle + place).tolist())
        upward: Any = tuple(up.tolist())
        return PinholeCamera.look_at(
            name,
            position=position,
            target=target,
            up=upward,
            width=edge,
            height=edge,
            fov_y=1.1,
            body=arm.robot.end_effector,
        )
    return PinholeCamera.look_at(
        name,
        position=(0.12, 0.0, 0.02),
        target=(0.0, 0.0, 0.14),
        up=(-1.0, 0.0, 0.0),
        width=edge,
        height=edge,
        fov_y=1.1,
        body="link7",
    )


class FollowCamera:
    """Keeps balls in the picture of a camera that looks in a fixed direction, without jerks; per world.

    Place and distance follow what would show all balls by a critically damped spring, so that neither jumps.

    Args:
        camera: Says direction, lens and size of the pictures.
        world_count: Number of worlds.
    """

    SECONDS = 0.2
    """Time constant of the spring [s]."""
    ROOM = 1.12
    """Width of the picture in units of what is to be seen."""

    def __init__(self, camera: PinholeCamera, world_count: int) -> None:
        """Start without a place."""
        self._axes = camera.world_to_camera[:3, :3]
        self._slope = self.ROOM * 2.0 * max(camera.fx / camera.width, camera.fy / camera.height)
        self._place = np.zeros((world_count, 3))  # of the camera, in its own axes
        self._speed = np.zeros((world_count, 3))
        self._time = np.full(world_count, np.inf)

    def forget(self, mask: NDArray[np.bool_]) -> None:
        """Let the cameras of the masked worlds jump to their next place, shape (world_count,)."""
        self._time[mask] = np.inf

    def matrices(self, balls: NDArray[np.float64], time: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the transforms from the world to the cameras, shape (world_count, 4, 4).

        Args:
            balls: Centres and radii of what is to be seen [m], shape (world_count, K, 4).
            time: Time in the episode [s], shape (world_count,); where it went back, the camera jumps.
        """
        at, radius = balls[..., :3] @ self._axes.T, balls[..., 3:]
        low, high = (at - radius).min(axis=1), (at + radius).max(axis=1)
        wanted = 0.5 * (low + high)
        half = 0.5 * (high - low)[:, :2].max(axis=1)
        wanted[:, 2] = low[:, 2] - half * self._slope
        fresh = time < self._time
        self._place[fresh], self._speed[fresh] = wanted[fresh], 0.0
        step = np.where(fresh, 0.0, time - self._time)[:, None]
        self._time = time.copy()
        rate = 2.0 / self.SECONDS
        offset, kept = self._place - wanted, np.exp(-rate * step)
        drive = self._speed + rate * offset
        self._place = wanted + (offset + drive * step) * kept
        self._speed = (self._speed - rate * drive * step) * kept
        made = np.tile(np.eye(4), (len(time), 1, 1))
        made[:, :3, :3], made[:, :3, 3] = self._axes, -self._place
        return made
