"""Meshes that the tests of mesh sampling and fitting share."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import SimpleMaterial


def smooth_texture(size: int = 256) -> NDArray[np.uint8]:
    """Return an image of a few slow waves that is asymmetric in both directions, shape (size, size, 3)."""
    v, u = np.mgrid[0:size, 0:size] / size
    waves = [
        0.5 + 0.4 * np.sin(2 * np.pi * (2 * u + 0.3 * np.sin(2 * np.pi * v))),
        0.5 + 0.4 * np.sin(2 * np.pi * (1.5 * v + 0.1)) * np.cos(2 * np.pi * u),
        0.2 + 0.6 * v + 0.15 * np.cos(6 * np.pi * u),
    ]
    return np.rint(255 * np.clip(np.stack(waves, axis=-1), 0, 1)).astype(np.uint8)


def checker_texture(size: int = 256) -> NDArray[np.uint8]:
    """Return the smooth image under a hard-edged checker of 16 x 8 fields, shape (size, size, 3)."""
    y, x = np.mgrid[0:size, 0:size] / size
    dark = ((np.floor(16 * x) + np.floor(8 * y)) % 2)[..., None]
    return np.rint(smooth_texture(size) * (1.0 - 0.55 * dark)).astype(np.uint8)


def bumpy_sphere(
    columns: int = 96, rows: int = 48, radius: float = 0.4, texture: NDArray[np.uint8] | None = None
) -> trimesh.Trimesh:
    """Return a closed sphere with bumps of a fifth of its radius and a texture, the smooth one by default."""
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    phi, theta = 2 * np.pi * u, np.pi * (1 - v)
    out = np.stack([np.cos(phi) * np.sin(theta), np.sin(phi) * np.sin(theta), np.cos(theta)], axis=-1)
    points = radius * out * (1 + 0.2 * np.sin(3 * theta) ** 3 * np.cos(4 * phi))[..., None]
    index = np.arange((columns + 1) * (rows + 1)).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    lower = np.stack([a, b, c], axis=-1)[1:].reshape(-1, 3)
    upper = np.stack([b, d, c], axis=-1)[:-1].reshape(-1, 3)
    image = Image.fromarray(smooth_texture() if texture is None else texture)
    material = SimpleMaterial(image=image, diffuse=[255] * 4)
    visual = TextureVisuals(uv=np.stack([u, v], axis=-1).reshape(-1, 2), material=material)
    return trimesh.Trimesh(points.reshape(-1, 3), np.concatenate([lower, upper]), visual=visual, process=False)


def painted_box() -> trimesh.Trimesh:
    """Return a box with a colour at each vertex."""
    box = trimesh.creation.box((0.5, 0.3, 0.2)).subdivide().subdivide().subdivide()
    span = (box.vertices - box.bounds[0]) / np.ptp(box.bounds, axis=0)
    colors = np.rint(255 * (0.15 + 0.7 * span)).astype(np.uint8)
    return trimesh.Trimesh(box.vertices, box.faces, vertex_colors=colors, process=False)


def two_objects() -> trimesh.Scene:
    """Return a scene of a painted box and, beside it, a turned and smaller textured sphere."""
    scene = trimesh.Scene()
    scene.add_geometry(painted_box())
    place = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]) @ np.diag([0.8, 0.8, 0.8, 1.0])
    place[:3, 3] = [1.0, 0.2, 0.0]
    scene.add_geometry(bumpy_sphere(48, 24), transform=place)
    return scene
