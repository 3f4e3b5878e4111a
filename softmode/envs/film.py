"""`TaskFilm`: the pictures of a task that people look at: one camera that follows the object, one that has the arm."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from softmode.envs.cameras import FollowCamera
from softmode.envs.markers import GREEN

FINGERS = 0.045
"""Radius about the tool that the following camera shows [m]."""
POINT = 0.006
"""Radius about points of the object's surface that it shows [m]."""
RING = 1.12
"""Radius of the ring about the goal, over that of the object."""


class TaskFilm:
    """Aims the film cameras of a task's scene in every frame.

    The first camera shows object 0 and the fingers; where the task asks for it, it looks across the direction in which
    they close. Others show the arm, the object and the goal, as near as that allows.

    Args:
        task: The task, a `Task`.
    """

    def __init__(self, task: Any) -> None:
        """Start without a place."""
        near, *others = task.render_cameras()
        self._near = FollowCamera(near, task.world_count)
        self._far = [FollowCamera(camera, task.world_count, room=1.12, seconds=0.35) for camera in others]

    def forget(self, mask: NDArray[np.bool_]) -> None:
        """Let the cameras jump to their place in the masked worlds, shape (world_count,)."""
        for camera in (self._near, *self._far):
            camera.forget(mask)

    def draw(self, task: Any) -> NDArray[np.uint8]:
        """Return the pictures of the task side by side, uint8 (world_count, edge, 2 * edge, 3)."""
        scene = task.scene
        film, goal = scene.film, scene.marker_place.numpy()[:, :3].astype(float)
        if film is not None:
            time = task.episodes.elapsed.numpy() / task.config.scene.control_hz
            tool, thing = scene.controller.tool_pose.numpy().astype(float), _points(task)
            closing = Rotation.from_quat(tool[:, 3:]).apply([0.0, 1.0, 0.0]) if task.filmed_across else None
            near = np.concatenate([thing, _balls(tool[:, None, :3], FINGERS)], axis=1)
            far = np.concatenate([_balls(film.corners(scene.state), 0.0), thing], axis=1)
            if scene.marker is not None:
                far = np.concatenate([far, _balls(goal[:, None], 0.02)], axis=1)
            film.aim(film.cameras[0].name, self._near.matrices(near, time, closing))
            for seen, camera in zip(film.cameras[1:], self._far, strict=True):
                film.aim(seen.name, camera.matrices(far, time))
            if task.goal_ring:
                scale = task.table.values.numpy()[:, task.table.column("scale")]
                radius = np.array([thing.radius for thing in scene.occupancy.choices])[scene.occupancy.rows] * scale
                film.circle(goal, RING * radius, GREEN)
        pictures = scene.draw_film().numpy()
        return np.concatenate(list(pictures.reshape(-1, task.world_count, *pictures.shape[1:])), axis=2)


def _points(task: Any) -> NDArray[np.float64]:
    """Return balls (x, y, z, radius) [m] about points of the surface of object 0, shape (world_count, K, 4)."""
    first = task.state.particle_start.numpy()[:: task.state.stride, None]
    return _balls(
        task.scene.state.particle_q.numpy()[first + task.points_of_choices[task.scene.occupancy.rows]].astype(float),
        POINT,
    )


def _balls(centers: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Return balls (x, y, z, radius) [m], shape (..., 4)."""
    return np.concatenate([centers, np.full((*centers.shape[:-1], 1), radius)], axis=-1)
