"""Pictures of a task: those of an observation, and the film that people watch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
import warp as wp
from numpy.typing import NDArray

from softmode.envs.cameras import FollowCamera
from softmode.scenes.table_scene import TableScene
from softmode.splats.cameras.camera import Output
from softmode.splats.raster.pinhole import PinholeCamera

HAND = 0.07
"""Radius about the tool that the following camera shows [m]."""
MARKER = 0.02
"""Radius about the goal that the following camera shows [m]."""


class Pictures:
    """What the cameras of a task's scene draw.

    Args:
        scene: The scene.
        edge: Edge of a pixel observation [px]; None for observations without pictures.
        outputs: What they hold beside colours.
        follow: The camera of the film that keeps object, hand and goal in its picture.
        keep_last: Whether the last pictures of episodes are kept, before the reset of SAME_STEP.

    Attributes:
        images: Pictures of the observation by key: pixels, depth, segmentation; worlds first.
        final_images: The last ones of episodes that ended.
    """

    def __init__(
        self,
        scene: TableScene,
        edge: int | None,
        outputs: Sequence[Output],
        follow: PinholeCamera,
        *,
        keep_last: bool = False,
    ) -> None:
        """Find the arrays of the cameras."""
        self._scene, self._edge = scene, edge
        self._follow = FollowCamera(follow, scene.world_count)
        self.images: dict[str, wp.array] = {}
        self.final_images: dict[str, wp.array] = {}
        if edge is not None:
            camera = scene.cameras[edge, edge]
            self.images = {"pixels": camera.images("pixels")}
            self.images |= {name: camera.images("pixels", name) for name in outputs}
            if keep_last:
                self.final_images = {name: wp.zeros_like(image) for name, image in self.images.items()}

    def draw(self) -> None:
        """Draw the pictures of an observation; capturable."""
        if self._edge is not None:
            self._scene.draw(self._scene.cameras[self._edge, self._edge])

    def keep_last(self) -> None:
        """Draw the last pictures of episodes that end, and keep them; capturable."""
        self.draw()
        for name, image in self.images.items():
            wp.copy(self.final_images[name], image)

    def spaces(self) -> dict[str, gym.Space]:
        """Return the spaces of the pictures of one world by key."""
        edge, spaces = self._edge, {}
        for name in self.images:
            assert edge is not None
            if name == "pixels":
                spaces[name] = gym.spaces.Box(0, 255, (edge, edge, 3), np.uint8)
            elif name == "depth":
                spaces[name] = gym.spaces.Box(0.0, 10.0, (edge, edge), np.float32)
            else:
                count = len(self._scene.cameras[edge, edge].labels)
                spaces[name] = gym.spaces.Box(-1, count, (edge, edge), np.int32)
        return spaces

    def draw_film(self, scale: NDArray[Any], time: NDArray[Any]) -> NDArray[np.uint8]:
        """Return the pictures of the film cameras side by side, uint8 (world_count, edge, cameras * edge, 3).

        Args:
            scale: Size of the objects of each world.
            time: Time in the episode [s], shape (world_count,).
        """
        scene, film = self._scene, self._scene.film
        if film is not None:
            film.aim(film.cameras[0].name, self._follow.matrices(self._in_focus(scale), time))
        pictures = scene.draw_film().numpy()
        cameras = pictures.reshape(-1, scene.world_count, *pictures.shape[1:])
        return np.concatenate(list(cameras), axis=2)

    def forget_film(self, mask: NDArray[np.bool_]) -> None:
        """Let the following camera jump to its place in the masked worlds, shape (world_count,)."""
        self._follow.forget(mask)

    def _in_focus(self, scale: NDArray[Any]) -> NDArray[np.float64]:
        """Return balls (x, y, z, radius) [m] about object 0, the hand and the marker, shape (world_count, K, 4)."""
        scene = self._scene
        radius: Any = np.array([thing.radius for thing in scene.occupancy.choices])[scene.occupancy.rows] * scale
        balls = [(scene.object_position.numpy()[:, 0], radius), (scene.controller.tool_pose.numpy()[:, :3], HAND)]
        if scene.marker is not None:
            balls.append((scene.marker_place.numpy()[:, :3], MARKER))
        return np.stack([np.column_stack([x, np.broadcast_to(r, len(x))]) for x, r in balls], axis=1)
