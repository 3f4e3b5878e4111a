"""Pictures of a coloured mesh from all around: what splats that stand for the mesh should look like.

Rays are traced with Warp's mesh query, on CPU or CUDA, several per pixel, unlit, colour averaged as the rasteriser
blends it (gamma-encoded), with exact shares of coverage. Newton's `SensorCamera`, which draws such pictures too, has
no vertex colours, one texture per shape and 8 bits per channel; the tests compare the two where both apply.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.model.declare import launch
from softmode.errors import ConfigError
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.fit import reference_view_kernels as kernels
from softmode.splats.raster.rasterizer import ViewArrays


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceViews:
    """Pictures and the cameras that took them: pinholes with OpenCV axes, as `ViewArrays` describes them."""

    world_to_camera: NDArray[np.float32]
    """Rigid transforms, shape (V, 4, 4)."""
    intrinsics: NDArray[np.float32]
    """fx, fy, cx, cy [px], shape (V, 4)."""
    rgb: wp.array
    """Colour times coverage, vec3, shape (V, height, width)."""
    alpha: wp.array
    """Coverage 0..1, shape (V, height, width)."""

    def view_arrays(self, chosen: ArrayLike, background: ArrayLike) -> ViewArrays:
        """Upload some of the cameras.

        Args:
            chosen: Indices of the views, shape (B,).
            background: Colour behind the object in each, shape (1 or B, 3).
        """
        index, device = np.asarray(chosen), self.rgb.device
        return ViewArrays(
            world_to_camera=wp.array(self.world_to_camera[index], dtype=wp.mat44, device=device),
            intrinsics=wp.array(self.intrinsics[index], dtype=wp.vec4, device=device),
            world=wp.zeros(len(index), dtype=wp.int32, device=device),
            background=wp.array(np.asarray(background, dtype=np.float32), dtype=wp.vec3, device=device),
        )

    def on(self, background: ArrayLike) -> NDArray[np.float32]:
        """Return the pictures before a background colour, shape (V, height, width, 3)."""
        behind = 1.0 - self.alpha.numpy()[..., None]
        return (self.rgb.numpy() + behind * np.asarray(background)).astype(np.float32)


def orbit_poses(count: int, distance: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return cameras that look at the origin from evenly spread directions (a Fibonacci lattice, turned at random).

    Args:
        count: Number of cameras V.
        distance: Their distance from the origin [m].
        rng: Turns the lattice and rolls the cameras.

    Returns:
        World-to-camera transforms, shape (V, 4, 4).
    """
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    azimuth = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - z * z)
    frame, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    forward = -np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1) @ frame.T
    right = np.cross(forward, rng.normal(size=(count, 3)))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    poses[:, 2, 3] = distance
    return poses.astype(np.float32)


def render_mesh(
    mesh: ColoredMesh,
    world_to_camera: ArrayLike,
    intrinsics: ArrayLike,
    *,
    width: int,
    height: int,
    samples: int = 4,
    device: str | wp.Device | None = None,
) -> ReferenceViews:
    """Draw a mesh, unlit, both sides of its triangles alike.

    Args:
        mesh: What to draw.
        world_to_camera: Rigid transforms to OpenCV camera axes, shape (V, 4, 4).
        intrinsics: fx, fy, cx, cy [px], shape (V, 4) or (4,).
        width: Image width [px].
        height: Image height [px].
        samples: Rays per pixel along each axis.
        device: Warp device.

    Raises:
        ConfigError: If a size or the number of samples is not positive.
    """
    if min(width, height, samples) < 1:
        raise ConfigError(f"images of {width} x {height} px with {samples} samples are empty", hint="give at least 1")
    poses = np.asarray(world_to_camera, dtype=np.float32)
    lenses = np.array(np.broadcast_to(np.asarray(intrinsics, dtype=np.float32), (len(poses), 4)))
    faces = len(mesh.corners)

    def upload(values: ArrayLike, dtype: Any) -> wp.array:
        return wp.array(np.asarray(values), dtype=dtype, device=device)

    corners = upload(mesh.corners.reshape(-1, 3), wp.vec3)
    solid = wp.Mesh(points=corners, indices=upload(np.arange(3 * faces, dtype=np.int32), wp.int32))
    sizes = [image.shape[0] * image.shape[1] for image in mesh.textures] or [1]
    firsts = np.cumsum([0, *sizes[:-1]])
    places = [(first, image.shape[1], image.shape[0]) for first, image in zip(firsts, mesh.textures, strict=False)]
    pixels = np.concatenate([image.reshape(-1, 3) for image in mesh.textures] or [np.zeros((1, 3), np.uint8)])
    shape = (len(poses), height, width)
    rgb = wp.zeros(shape, dtype=wp.vec3, device=device)
    alpha = wp.zeros(shape, dtype=wp.float32, device=device)
    launch(
        wp.get_device(device), kernels.trace_mesh, shape, solid.id,
        upload(mesh.corner_colors.reshape(-1, 3), wp.vec3), upload(mesh.corner_uvs.reshape(-1, 2), wp.vec2),
        upload(mesh.texture_index, wp.int32), upload(np.array(places or [(0, 1, 1)], dtype=np.int32), wp.vec3i),
        upload(pixels, wp.vec3ub), upload(poses, wp.mat44), upload(lenses, wp.vec4), samples, rgb, alpha,
    )  # fmt: skip
    return ReferenceViews(world_to_camera=poses, intrinsics=lenses, rgb=rgb, alpha=alpha)
