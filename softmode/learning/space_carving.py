"""`contradicted`: the patch of a solid's surface that some pictures show in one colour and others in another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from softmode.splats.raster.posed_pictures import PosedPicture

TWO, NEARER, MARGIN = 2, 0.3, 0.03
"""Pictures that a colour takes; how much further than the nearest node a node is still seen [voxels], and by how much
two colours differ at least."""


def contradicted(
    pictures: Sequence[PosedPicture],
    images: NDArray[np.floating],
    full: NDArray[np.bool_],
    middle: NDArray[np.float64],
    half: float,
) -> tuple[NDArray[np.bool_], float]:
    """Return the largest patch of a solid's surface that pictures contradict, and its share of the surface.

    As in space carving (Kutulakos and Seitz 2000). Single nodes are contradicted on a true surface, too.

    A node has any of the colours within a voxel around where a picture shows it. It is contradicted if two pictures
    have only lighter ones than two others, in a channel.

    Args:
        pictures: The pictures; their cameras are as far from the solid, about.
        images: What they show at one exposure, shape (V, height, width, 3).
        full: The solid at the nodes of a cube, shape (n, n, n).
        middle: Middle of the cube.
        half: Half of its edge.
    """
    line, eye = np.linspace(-half, half, len(full)), pictures[0].camera
    core: Any = ndimage.binary_erosion(full)
    surface = np.argwhere(full & ~core)
    places, voxel = line[surface] + middle, line[1] - line[0]
    wide = voxel * eye.fx / float(np.linalg.norm(np.asarray(eye.position) - middle))
    window, cell = 2 * max(round(wide), 1) + 1, max(round(1.4 * wide), 1)
    soft = ndimage.gaussian_filter(images, (0.0, 0.7, 0.7, 0.0))
    darkest, lightest = np.full((TWO, len(places), 3), -np.inf), np.full((TWO, len(places), 3), np.inf)
    for picture, image in zip(pictures, soft, strict=True):
        c = picture.camera
        column, row = np.floor(picture.project(places)).astype(int).T
        depth = places @ c.world_to_camera[2, :3] + c.world_to_camera[2, 3]
        there = (row >= 0) & (row < c.height) & (column >= 0) & (column < c.width)
        near = np.full((c.height // cell + 1, c.width // cell + 1), np.inf)
        np.minimum.at(near, (row[there] // cell, column[there] // cell), depth[there])
        at = row.clip(0, c.height - 1), column.clip(0, c.width - 1)
        seen = there & (depth < near[at[0] // cell, at[1] // cell] + NEARER * voxel)
        least = np.where(seen[:, None], ndimage.minimum_filter(image, (window, window, 1))[at], -np.inf)
        most = np.where(seen[:, None], ndimage.maximum_filter(image, (window, window, 1))[at], np.inf)
        darkest = np.sort(np.concatenate([darkest, least[None]]), axis=0)[1:]
        lightest = np.sort(np.concatenate([lightest, most[None]]), axis=0)[:-1]
    wrong = np.zeros_like(full)
    wrong[tuple(surface.T)] = (darkest[0] > lightest[-1] + MARGIN).any(axis=1)
    patches: Any = ndimage.label(wrong, np.ones((3, 3, 3)))
    sizes = np.bincount(patches[0].ravel(), minlength=2)
    return wrong & (patches[0] == 1 + sizes[1:].argmax()), float(sizes[1:].max() / max(len(surface), 1))
