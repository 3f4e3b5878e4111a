"""Pictures of a task's observation."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
import numpy as np
import warp as wp

from softmode.errors import ConfigError
from softmode.scenes.table_scene import TableScene
from softmode.splats.cameras.camera import Output


class Pictures:
    """What the cameras of a task's scene draw.

    Args:
        scene: The scene.
        edge: Edge of a pixel observation [px]; None for observations without pictures.
        outputs: What they hold beside colours.
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
        *,
        keep_last: bool = False,
    ) -> None:
        """Find the arrays of the cameras."""
        self._scene, self._edge = scene, edge
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
        if (edge := self._edge) is None:
            return {}
        labels = self._scene.cameras[edge, edge].labels
        return {name: picture_space(name, edge, len(labels)) for name in self.images}


def picture_space(name: str, edge: int, label_count: int | None = None) -> gym.Space:
    """Return the space of a picture of one world.

    Args:
        name: pixels, depth or segmentation.
        edge: Its edge [px].
        label_count: How many labels a segmentation has.

    Raises:
        ConfigError: If it is a segmentation and the number is not given.
    """
    if name == "pixels":
        return gym.spaces.Box(0, 255, (edge, edge, 3), np.uint8)
    if name == "depth":
        return gym.spaces.Box(0.0, 10.0, (edge, edge), np.float32)
    if label_count is None:
        raise ConfigError("the labels of a segmentation are those of a scene", hint="make the environment")
    return gym.spaces.Box(-1, label_count, (edge, edge), np.int32)
