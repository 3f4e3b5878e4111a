"""The standard splat formula over every splat in depth order, in NumPy float64: the rasteriser's oracle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from softmode.splats.splats import sh_basis

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4


@dataclass(frozen=True)
class DenseImage:
    """What one view shows."""

    rgb: NDArray[np.float64]
    depth: NDArray[np.float64]
    median_depth: NDArray[np.float64]
    alpha: NDArray[np.float64]
    object_id: NDArray[np.int64]
    margin: NDArray[np.float64]
    """Smallest relative distance of a decision (alpha cut, light stop, depth order) to its threshold, per pixel."""


def render_dense(
    means: NDArray[np.float64],
    covariances: NDArray[np.float64],
    opacities: NDArray[np.float64],
    sh: NDArray[np.float64],
    view: NDArray[np.float64],
    intrinsics: tuple[float, float, float, float],
    width: int,
    height: int,
    *,
    antialiased: bool = True,
    dilation: float | None = None,
    near: float = 0.01,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    mesh_rgb: NDArray[np.float64] | None = None,
    mesh_depth: NDArray[np.float64] | None = None,
    object_ids: NDArray[np.int64] | None = None,
    rotations: NDArray[np.float64] | None = None,
) -> DenseImage:
    """Render one view.

    Args:
        means: Centres in the world [m], shape (N, 3).
        covariances: Covariances in the world [m^2], shape (N, 3, 3).
        opacities: Opacities, shape (N,).
        sh: Colour coefficients, shape (N, K, 3).
        view: World-to-camera matrix, OpenCV axes, shape (4, 4).
        intrinsics: fx, fy, cx, cy [px].
        width: Image width [px].
        height: Image height [px].
        antialiased: Scale opacities by the share of the footprint that the pixel filter adds.
        dilation: Variance of the pixel filter [px^2]; None is 0.1 antialiased, 0.3 classic.
        near: Nearest visible forward depth [m].
        background: Colour behind everything.
        mesh_rgb: Colours of opaque meshes and of the sky around them, shape (H, W, 3).
        mesh_depth: Forward depths of the meshes [m], 0 where there is none, shape (H, W).
        object_ids: Object of each splat, shape (N,).
        rotations: Rotation from the rest frame of each splat's colour to the world, shape (N, 3, 3).
    """
    r, t = view[:3, :3], view[:3, 3]
    p = means @ r.T + t
    keep = p[:, 2] > near
    fx, fy, cx, cy = intrinsics
    z = np.where(keep, p[:, 2], 1.0)
    # The linearisation point is clamped to 1.3 times the view frustum, as in the original code, about the image.
    tx = np.clip(p[:, 0] / z, -(cx + 0.15 * width) / fx, (1.15 * width - cx) / fx) * z
    ty = np.clip(p[:, 1] / z, -(cy + 0.15 * height) / fy, (1.15 * height - cy) / fy) * z
    zero = np.zeros_like(z)
    jacobian = np.stack(
        [np.stack([fx / z, zero, -fx * tx / z**2], axis=-1), np.stack([zero, fy / z, -fy * ty / z**2], axis=-1)], axis=1
    )
    m = jacobian @ r
    s = m @ covariances @ m.transpose(0, 2, 1)
    det_sharp = s[:, 0, 0] * s[:, 1, 1] - s[:, 0, 1] ** 2
    if dilation is None:
        dilation = 0.1 if antialiased else 0.3
    a, b, c = s[:, 0, 0] + dilation, s[:, 0, 1], s[:, 1, 1] + dilation
    det = a * c - b * b
    opacity = opacities * (np.sqrt(np.maximum(det_sharp, 0.0) / det) if antialiased else 1.0)

    eye = -r.T @ t
    direction = means - eye
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    if rotations is not None:
        direction = np.einsum("nji,nj->ni", rotations, direction)
    color = np.maximum(0.5 + np.einsum("nk,nkc->nc", sh_basis(direction, sh.shape[1]), sh), 0.0)

    order = np.argsort(np.where(keep, p[:, 2], np.inf), kind="stable")
    order = order[keep[order]]
    ys, xs = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    xs, ys = xs.ravel(), ys.ravel()
    limit = np.full(len(xs), np.inf)
    if mesh_depth is not None:
        limit = np.where(mesh_depth.ravel() > 0.0, mesh_depth.ravel(), np.inf)
    transmittance = np.ones(len(xs))
    running = np.ones(len(xs), dtype=bool)
    rgb, depth = np.zeros((len(xs), 3)), np.zeros(len(xs))
    median = np.zeros(len(xs))
    best, identity = np.zeros(len(xs)), np.full(len(xs), -1)
    margin = np.full(len(xs), np.inf)
    previous = np.full(len(xs), -np.inf)
    for i in order:
        running &= p[i, 2] <= limit
        dx, dy = xs - (fx * p[i, 0] / z[i] + cx), ys - (fy * p[i, 1] / z[i] + cy)
        power = 0.5 * (c[i] * dx * dx + a[i] * dy * dy) / det[i] - b[i] / det[i] * dx * dy
        alpha = np.minimum(opacity[i] * np.exp(-power), ALPHA_MAX)
        margin = np.where(running, np.minimum(margin, np.abs(alpha / ALPHA_MIN - 1.0)), margin)
        hit = running & (alpha >= ALPHA_MIN)
        after = transmittance * (1.0 - alpha)
        margin = np.where(hit, np.minimum(margin, np.abs(after / TRANSMITTANCE_MIN - 1.0)), margin)
        running &= ~(hit & (after < TRANSMITTANCE_MIN))
        hit &= running
        weight = np.where(hit, alpha * transmittance, 0.0)
        # Single precision cannot order two splats whose depths agree to 1e-6; scaled so that this gap counts as 1e-3.
        margin = np.where(hit, np.minimum(margin, (p[i, 2] - previous) / p[i, 2] * 1e3), margin)
        previous = np.where(hit, p[i, 2], previous)
        rgb += weight[:, None] * color[i]
        depth += weight * p[i, 2]
        identity = np.where(weight > best, 0 if object_ids is None else object_ids[i], identity)
        best = np.maximum(best, weight)
        half = hit & (transmittance > 0.5) & (after <= 0.5)
        margin = np.where(hit, np.minimum(margin, np.abs(after / 0.5 - 1.0)), margin)
        median = np.where(half, p[i, 2], median)
        transmittance = np.where(hit, after, transmittance)
    back = np.tile(np.asarray(background, dtype=np.float64), (len(xs), 1))
    if mesh_depth is not None and mesh_rgb is not None:
        opaque = np.isfinite(limit)
        back = mesh_rgb.reshape(-1, 3)
        depth = depth + np.where(opaque, transmittance * np.where(opaque, limit, 0.0), 0.0)
        total = np.where(opaque, 1.0, 1.0 - transmittance)
        median = np.where(opaque & (transmittance > 0.5), limit, median)
    else:
        total = 1.0 - transmittance
    depth = np.where(total > 0.0, depth / np.maximum(total, 1e-6), 0.0)
    rgb += transmittance[:, None] * back
    shape = (height, width)
    return DenseImage(
        rgb=rgb.reshape(*shape, 3),
        depth=depth.reshape(shape),
        median_depth=median.reshape(shape),
        alpha=(1.0 - transmittance).reshape(shape),
        object_id=identity.reshape(shape),
        margin=margin.reshape(shape),
    )
