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
    """Keeps balls in the picture of a camera, as large as they can be, without jerks; per world.

    Place, distance and heading follow what would show all balls by a critically damped spring, so that none jumps.

    Args:
        camera: Says direction, lens and size of the pictures.
        world_count: Number of worlds.
        room: Width of the picture in units of what is to be seen.
        seconds: Time constant of the spring [s].
    """

    TURN_SECONDS = 0.35
    """Time constant of the heading [s]."""

    def __init__(self, camera: PinholeCamera, world_count: int, *, room: float = 1.25, seconds: float = 0.1) -> None:
        """Start without a place."""
        self._axes = camera.world_to_camera[:3, :3]
        self._slopes = room * 2.0 * np.array([camera.fx / camera.width, camera.fy / camera.height])
        self._place = np.zeros((world_count, 3))  # of the camera, in its own axes
        self._speed = np.zeros((world_count, 3))
        self._turn = np.zeros((world_count, 1))  # about the vertical, from the camera's direction
        self._spin = np.zeros((world_count, 1))
        self._time = np.full(world_count, np.inf)
        self.seconds = seconds
        """Time constant of the spring [s]."""

    def forget(self, mask: NDArray[np.bool_]) -> None:
        """Let the cameras of the masked worlds jump to their next place, shape (world_count,)."""
        self._time[mask] = np.inf

    def matrices(
        self, balls: NDArray[np.float64], time: NDArray[np.float64], across: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the transforms from the world to the cameras, shape (world_count, 4, 4).

        Args:
            balls: Centres and radii of what is to be seen [m], shape (world_count, K, 4).
            time: Time in the episode [s], shape (world_count,); where it went back, the camera jumps.
            across: Directions that lie across the picture [m], shape (world_count, 3); None for any.
        """
        fresh, middle = time < self._time, balls[..., :3].mean(axis=1)
        step = np.where(fresh, 0.0, time - self._time)[:, None]
        self._time = time.copy()
        self._turn[fresh], self._spin[fresh], before = 0.0, 0.0, self._rows()
        if across is not None:
            off = np.arctan2(across[:, 1], across[:, 0]) - np.arctan2(self._axes[0, 1], self._axes[0, 0])
            # either side will do: the nearer one
            wanted = self._turn + (np.remainder(off[:, None] - self._turn + 0.5 * np.pi, np.pi) - 0.5 * np.pi)
            self._turn[fresh] = wanted[fresh]
            self._turn, self._spin = _damped(self._turn, self._spin, wanted, step, self.TURN_SECONDS)
        axes = self._rows()
        self._place += np.einsum("wab,wb->wa", axes - before, middle)  # the camera goes round the middle
        at, radius = np.einsum("wab,wkb->wka", axes, balls[..., :3]), balls[..., 3:]
        # Each side of the picture is a plane through the camera that no ball is beyond.
        low = (at[..., 2:] - self._slopes * (radius + at[..., :2])).min(axis=1)
        high = (at[..., 2:] - self._slopes * (radius - at[..., :2])).min(axis=1)
        aim = np.column_stack([0.5 * (high - low) / self._slopes, (0.5 * (low + high)).min(axis=1)])
        self._place[fresh], self._speed[fresh] = aim[fresh], 0.0
        self._place, self._speed = _damped(self._place, self._speed, aim, step, self.seconds)
        made = np.tile(np.eye(4), (len(time), 1, 1))
        made[:, :3, :3], made[:, :3, 3] = axes, -self._place
        return made

    def _rows(self) -> NDArray[np.float64]:
        """Return the axes of the cameras as rows, shape (world_count, 3, 3)."""
        return self._axes @ Rotation.from_euler("z", -self._turn).as_matrix()


def _damped(
    value: NDArray[np.float64], speed: NDArray[np.float64], aim: NDArray[np.float64], step: Any, seconds: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return value and speed of a critically damped spring after a step [s]."""
    rate = 2.0 / seconds
    offset, kept = value - aim, np.exp(-rate * step)
    drive = speed + rate * offset
    return aim + (offset + drive * step) * kept, (speed - rate * drive * step) * kept
