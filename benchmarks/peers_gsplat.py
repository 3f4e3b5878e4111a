"""gsplat 1.5.3 on the scenes of `camera_scene`, deformation included: what a user of torch would write.

Needs a CUDA device, torch and gsplat (whose CUDA sources are built by nvcc at the first import). The deformation is
one matrix product, since [x | F L] with Sigma = L L^T is affine in q, and a few elementwise operations, either as torch
runs them or through ``torch.compile``. gsplat copies a count to the host in every frame, so no frame can be captured.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.camera_scene import DILATION, HandleScene, intrinsics, orbit
from softmode.splats.splats import SH_DC, rotations_from_quats

NEAR = 0.01
TILES = (16, 8)
"""Tiles of the low-level calls that are tried [px]; the public interface keeps its default, 16."""


Split = Callable[[Any], tuple[Any, Any]]
"""What turns the product into centres and covariances."""


class PeerUnavailable(RuntimeError):
    """gsplat cannot run here."""


def load() -> None:
    """Import gsplat and its CUDA code.

    Raises:
        PeerUnavailable: If torch, a CUDA device, gsplat or its compiled code is missing.
    """
    try:
        import torch
    except ImportError as error:
        raise PeerUnavailable("torch is not installed") from error
    if not torch.cuda.is_available():
        raise PeerUnavailable("torch sees no CUDA device")
    try:
        from gsplat.cuda import _backend  # pyright: ignore[reportMissingImports]
    except Exception as error:  # the import builds CUDA code, which fails in many ways
        raise PeerUnavailable(f"gsplat cannot be imported: {type(error).__name__}: {str(error)[:200]}") from error
    if _backend._C is None:
        raise PeerUnavailable("gsplat found neither compiled code nor a CUDA toolkit to build it with")


def deformation_rows(scene: HandleScene) -> np.ndarray:
    """Return the matrix B of [x | F L] = [q^T, I] B, shape (K + 3, 4 N); columns of a splat are x, L."""
    basis, gradients = scene.basis()
    scales = scene.splats.scales.astype(np.float64)
    factor = rotations_from_quats(scene.splats.quats) * scales[:, None, :]
    count, functions = basis.shape
    rows = np.zeros((functions + 3, count, 4))
    rows[:functions, :, 0] = basis.T
    rows[:functions, :, 1:] = np.einsum("nkb,nbc->knc", gradients, factor)
    rows[functions:, :, 0] = scene.splats.means.T
    rows[functions:, :, 1:] = factor.transpose(1, 0, 2)
    return rows.reshape(functions + 3, 4 * count)


def split(deformed: Any) -> tuple[Any, Any]:
    """Return centres (W, N, 3) and the six entries of F L L^T F^T from [x | F L], shape (W, 3, N, 4)."""
    import torch

    r = deformed[..., 1:].unbind(1)
    pairs = itertools.combinations_with_replacement(range(3), 2)
    six = torch.stack([(r[i] * r[j]).sum(-1) for i, j in pairs], -1)
    return deformed[..., 0].transpose(1, 2).contiguous(), six


def split_full(deformed: Any) -> tuple[Any, Any]:
    """Return centres (W, N, 3) and full covariances (W, N, 3, 3), as the public interface wants them."""
    means, six = split(deformed)
    return means, six[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(-1, (3, 3))


class GsplatCamera:
    """gsplat drawing a scene: one view per world.

    Args:
        scene: What to draw.
        size: Image edge [px].
        antialiased: Scale opacities by the share of the footprint that the pixel filter adds.
        device: Device of torch; without CUDA only the deformation works.
    """

    def __init__(self, scene: HandleScene, size: int, *, antialiased: bool = True, device: str = "cuda") -> None:
        """Upload the scene."""
        import torch

        torch.backends.cuda.matmul.allow_tf32 = False
        worlds, count = scene.world_count, scene.splats.count

        def upload(array: Any) -> Any:
            return torch.tensor(np.ascontiguousarray(array), dtype=torch.float32, device=device)

        self.size, self.worlds, self.count = size, worlds, count
        self.mode = "antialiased" if antialiased else "classic"
        self.rows = upload(deformation_rows(scene))
        self.q = upload(scene.coordinates())
        self.identity = torch.eye(3, device=device).expand(worlds, 3, 3)
        rgb = np.clip(0.5 + SH_DC * scene.splats.sh[:, 0], 0.0, None)
        self.rgb = upload(rgb).expand(worlds, count, 3).contiguous()
        self.opacity = upload(scene.splats.opacities).expand(worlds, count).contiguous()
        self.views = upload(np.stack([orbit(i, worlds) for i in range(worlds)]))[:, None]
        fx, fy, cx, cy = intrinsics(size)
        lens = upload([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        self.lens = lens.expand(worlds, 1, 3, 3).contiguous()

    def deform(self, finish: Split = split) -> tuple[Any, Any]:
        """Return centres and covariances of all worlds."""
        import torch

        left = torch.cat([self.q.transpose(1, 2), self.identity], 2).reshape(3 * self.worlds, -1)
        return finish((left @ self.rows).view(self.worlds, 3, self.count, 4))

    def public(self, means: Any, covariances: Any) -> Any:
        """Return images (W, size, size, 3) through ``gsplat.rasterization``."""
        from gsplat import rasterization  # pyright: ignore[reportMissingImports]

        images, _, _ = rasterization(
            means, None, None, self.opacity, self.rgb, self.views, self.lens, self.size, self.size,
            near_plane=NEAR, eps2d=DILATION, packed=False, rasterize_mode=self.mode, covars=covariances,
        )  # fmt: skip
        return images.reshape(self.worlds, self.size, self.size, 3)

    def low_level(self, means: Any, six: Any, tile: int = TILES[0]) -> Any:
        """Return images (W, size, size, 3) through the calls that the public interface is made of."""
        from gsplat import (  # pyright: ignore[reportMissingImports]
            fully_fused_projection,
            isect_offset_encode,
            isect_tiles,
            rasterize_to_pixels,
        )

        size = self.size
        edge = -(-size // tile)
        radii, centers, depths, conics, compensation = fully_fused_projection(
            means, six, None, None, self.views, self.lens, size, size,
            eps2d=DILATION, near_plane=NEAR, packed=False,
            calc_compensations=self.mode == "antialiased", opacities=self.opacity,
        )  # fmt: skip
        _, ids, flat = isect_tiles(centers, radii, depths, tile, edge, edge, packed=False, n_images=self.worlds)
        offsets = isect_offset_encode(ids, self.worlds, edge, edge).reshape(self.worlds, 1, edge, edge)
        opacity = self.opacity[:, None]
        images, _ = rasterize_to_pixels(
            centers, conics, self.rgb[:, None], opacity if compensation is None else opacity * compensation,
            size, size, tile, offsets, flat, packed=False,
        )  # fmt: skip
        return images.reshape(self.worlds, size, size, 3)

    def frames(self, *, compiled: bool = True) -> dict[str, Callable[[], Any]]:
        """Return the ways to draw a frame, deformation included.

        Args:
            compiled: Whether to add those whose deformation goes through ``torch.compile``.
        """
        splits: dict[str, tuple[Split, Split]] = {"": (split, split_full)}
        if compiled:
            splits[", compiled"] = compiled_splits()
        ways: dict[str, Callable[[], Any]] = {}
        for suffix, (six, full) in splits.items():
            ways["public" + suffix] = lambda full=full: self.public(*self.deform(full))
            for tile in TILES:
                name = f"low level, tile {tile}{suffix}"
                ways[name] = lambda six=six, tile=tile: self.low_level(*self.deform(six), tile)
        return ways


@functools.cache
def compiled_splits() -> tuple[Split, Split]:
    """Return `split` and `split_full` through ``torch.compile``; compiled once for all sizes."""
    import torch

    return torch.compile(split, dynamic=True), torch.compile(split_full, dynamic=True)
