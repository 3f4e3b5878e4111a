"""What `camera` and its peers draw: flat splats on a bumpy sphere, bent by handles, seen from an orbit.

The splats, handles and cameras, and the order of the random numbers, are those of the measurements that the targets
came from. Every world has its own handle motions Z; x(X) = X + sum_j W_j(X) Z_j [X; 1].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from softmode.deformables.skinning.skin_splats import SkinSplats
from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
from softmode.splats.splats import SH_DC, Splats, quats_from_rotations

FIELD_OF_VIEW = 0.8
"""Vertical field of view [rad]."""
DILATION = 0.3
"""Variance of the pixel filter [px^2]: gsplat's, and more work than softmode's own 0.1."""
HANDLE_COUNT = 16
HANDLE_VARIANCE = 0.09
"""Variance of the handles' Gaussian kernels [m^2]."""
MOTION = 0.08
"""Standard deviation of the entries of Z."""


def blob(count: int, seed: int = 0, radius: float = 0.5) -> Splats:
    """Return flat splats of random colour on a bumpy sphere."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    bump = 1 + 0.15 * np.sin(5 * d[:, 0]) * np.cos(4 * d[:, 1] + 1) + 0.1 * np.sin(7 * d[:, 2])
    means = d * (0.8 * radius * bump)[:, None]
    spacing = 0.8 * radius * math.sqrt(4 * np.pi / count)
    up = np.where(np.abs(d[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    t1 = np.cross(d, up)
    t1 /= np.linalg.norm(t1, axis=1, keepdims=True)
    turn = rng.uniform(0, 2 * np.pi, count)[:, None]
    u = np.cos(turn) * t1 + np.sin(turn) * np.cross(d, t1)
    frames = np.stack([u, np.cross(d, u), d], axis=-1)
    along = [spacing * rng.lognormal(-0.35, 0.35, count) for _ in range(2)]
    scales = np.stack([*along, np.full(count, 0.15 * spacing)], axis=1)
    opacities = np.clip(rng.beta(4, 1.2, count), 0.05, 0.995)
    phase = np.stack([6 * means[:, 0] + 1, 7 * means[:, 1] + 2, 8 * means[:, 2] + 3], axis=1) / radius * 0.5
    rgb = np.clip(0.5 + 0.5 * np.sin(phase) + 0.08 * rng.normal(size=(count, 3)), 0.02, 0.98)
    return Splats(
        means=means,
        quats=quats_from_rotations(frames),
        scales=scales,
        opacities=opacities,
        sh=((rgb - 0.5) / SH_DC)[:, None],
    )


def orbit(view: int, view_count: int, distance: float = 1.6, elevation: float = 0.35) -> np.ndarray:
    """Return the world-to-camera matrix of one of the views around the origin, OpenCV axes."""
    angle = 2 * np.pi * view / view_count + 0.3
    level = math.cos(elevation)
    eye = distance * np.array([level * math.cos(angle), level * math.sin(angle), math.sin(elevation)])
    z = -eye / np.linalg.norm(eye)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(z, x), z])
    matrix[:3, 3] = -matrix[:3, :3] @ eye
    return matrix


def intrinsics(size: int) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy [px] of a square image."""
    focal = 0.5 * size / math.tan(0.5 * FIELD_OF_VIEW)
    return focal, focal, 0.5 * size, 0.5 * size


@dataclass(frozen=True, kw_only=True)
class HandleScene:
    """Splats, the handles' weights at their centres, and the motions of every world."""

    splats: Splats
    weights: np.ndarray
    """W, shape (N, m)."""
    weight_gradients: np.ndarray
    """Gradients of W [1/m], shape (N, m, 3)."""
    motions: np.ndarray
    """Z, shape (world_count, m, 3, 4)."""

    @property
    def world_count(self) -> int:
        """Number of worlds."""
        return len(self.motions)

    def basis(self) -> tuple[np.ndarray, np.ndarray]:
        """Return b_(j,c) = W_j [X; 1]_c and its gradients, shapes (N, 4 m) and (N, 4 m, 3)."""
        x = self.splats.means.astype(np.float64)
        one = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        values = self.weights[:, :, None] * one[:, None, :]
        gradients = self.weight_gradients[:, :, None, :] * one[:, None, :, None]
        gradients[:, :, :3] += self.weights[:, :, None, None] * np.eye(3)
        return values.reshape(len(x), -1), gradients.reshape(len(x), -1, 3)

    def coordinates(self) -> np.ndarray:
        """Return the q of every world that belong to the basis [m], shape (world_count, 4 m, 3)."""
        return self.motions.transpose(0, 1, 3, 2).reshape(self.world_count, -1, 3)

    def deformed(self, world: int) -> tuple[np.ndarray, np.ndarray]:
        """Return centres and covariances of one world in float64, by the explicit sum."""
        x = self.splats.means.astype(np.float64)
        one = np.concatenate([x, np.ones((len(x), 1))], axis=1)
        z = self.motions[world]
        moved = np.einsum("jab,nb->nja", z, one)
        f = np.eye(3) + np.einsum("nja,njb->nab", moved, self.weight_gradients)
        f += np.einsum("nj,jab->nab", self.weights, z[:, :, :3])
        means = x + np.einsum("nj,nja->na", self.weights, moved)
        return means, f @ self.splats.covariances() @ f.transpose(0, 2, 1)


def handle_scene(splats: Splats, world_count: int, seed: int = 0) -> HandleScene:
    """Place handles at random among the splats and draw every world's motions."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-0.4, 0.4, (HANDLE_COUNT, 3))
    d = splats.means.astype(np.float64)[:, None] - centers
    kernel = np.exp(-0.5 * (d**2).sum(axis=-1) / HANDLE_VARIANCE)
    total = kernel.sum(axis=1, keepdims=True)
    gradient = kernel[..., None] * (-d / HANDLE_VARIANCE)
    return HandleScene(
        splats=splats,
        weights=kernel / total,
        weight_gradients=gradient / total[..., None]
        - kernel[..., None] * gradient.sum(axis=1, keepdims=True) / total[..., None] ** 2,
        motions=MOTION * rng.normal(size=(world_count, HANDLE_COUNT, 3, 4)),
    )


class SceneCamera:
    """Softmode drawing a scene: one view per world, deformed by `SkinSplats` and drawn by `SplatRasterizer`."""

    def __init__(self, scene: HandleScene, size: int, *, device: Any, antialiased: bool = True) -> None:
        """Upload the scene."""
        self.scene, self.size = scene, size
        self.device = wp.get_device(device)
        worlds, count = scene.world_count, scene.splats.count
        basis, gradients = scene.basis()
        self.skin = SkinSplats(
            scene.splats.means, scene.splats.covariances(), basis, gradients, stretch_limit=np.inf, device=self.device
        )
        q = scene.coordinates()
        self.q = wp.array(q.reshape(-1, 3), dtype=wp.vec3d, device=self.device)
        self.start = wp.array(np.arange(worlds) * q.shape[1], dtype=wp.int32, device=self.device)
        self.splats = SplatArrays.from_splats([scene.splats], world_count=worlds, device=self.device)
        views = np.stack([orbit(i, worlds) for i in range(worlds)]).astype(np.float32)
        lens = np.tile(np.asarray(intrinsics(size), dtype=np.float32), (worlds, 1))
        self.views = ViewArrays(
            world_to_camera=wp.array(views, dtype=wp.mat44, device=self.device),
            intrinsics=wp.array(lens, dtype=wp.vec4, device=self.device),
            world=wp.array(np.arange(worlds), dtype=wp.int32, device=self.device),
            background=wp.zeros(1, dtype=wp.vec3, device=self.device),
        )
        self.rasterizer = SplatRasterizer(
            count,
            worlds,
            size,
            size,
            options=RasterizerOptions(antialiased=antialiased, dilation=DILATION),
            device=self.device,
        )

    def deform(self) -> None:
        """Skin the splats of all worlds."""
        self.skin.launch(self.q, self.start, self.splats.means, self.splats.covariances)

    def draw(self) -> None:
        """Draw all views."""
        self.rasterizer.render(self.splats, self.views)

    def frame(self) -> None:
        """Deform and draw."""
        self.deform()
        self.draw()
