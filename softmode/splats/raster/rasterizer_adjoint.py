"""Gradients of splat images: the adjoint of `rasterizer`, written by hand; no tape, no host read-back, capturable.

    images -> blend adjoint -> projected splats -> projection adjoint -> splats, camera, background

A frame is differentiated as it was drawn: the decisions of the forward pass (which splats a pixel sees, where it ends,
what is clamped) are constants. The derivative is that of Kerbl et al. 2023 (doi:10.1145/3592433, appendix A) with the
pixel filter's compensation of Yu et al. 2024 (arXiv:2311.16493); `docs/rendering_gradients.md` lists the rules.
"""

import functools
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm

from softmode.deformables.model.declare import launch
from softmode.splats.raster import blend_adjoint_cpu_kernels, blend_adjoint_cuda_kernels, projection_adjoint_kernels
from softmode.splats.raster.blend_cuda_kernels import BLOCK_DIM
from softmode.splats.raster.rasterizer import SplatArrays, SplatRasterizer, ViewArrays, require_shapes
from softmode.splats.raster.rasterizer_kernels import ImageLoss


def exp_twist(twist: ArrayLike) -> NDArray[np.float64]:
    """Return the rigid motion exp(v, w), shape (4, 4), of a twist v [m], w [rad], shape (6,).

    A step of gradient descent on a camera is ``pose = exp_twist(-rate * gradients.twist) @ pose``.
    """
    v, w = np.asarray(twist, dtype=np.float64).reshape(2, 3)
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = np.cross(np.eye(3), w), v
    return np.asarray(expm(generator), dtype=np.float64)


UNTOUCHED = ("object_index", "spanning")
"""Arrays of `SplatArrays` that have no gradient."""


@dataclass(frozen=True, kw_only=True)
class RasterizerGradients:
    """Derivatives of the loss, on the rasteriser's device; each is summed over the views that share its array."""

    means: wp.array
    """By the centres [1/m], vec3, (1|world_count, N)."""
    covariances: wp.array
    """By the six stored entries [1/m^2], vec6, (1|world_count, N); an off-diagonal one is in two places."""
    opacities: wp.array
    """By the opacities, (1|world_count, N)."""
    sh: wp.array
    """By the colour coefficients, vec3, (1|world_count, N, K)."""
    rotations: wp.array
    """By a rotation vector phi of the colours' frame, exp([phi]x) R, vec3, shape of `SplatArrays.rotations`; zero at
    degree 0."""
    twist: wp.array
    """By a rigid motion of the world in the camera's frame, spatial_vectord, (view_count,): linear part v [1/m], then
    angular part w [1/rad], where world_to_camera becomes exp(v, w) world_to_camera: a point p in the camera's frame
    moves by v + w x p."""
    intrinsics: wp.array
    """By fx, fy, cx, cy [1/px], vec4d, (view_count,)."""
    background: wp.array
    """By the colour behind everything, vec3d, shape of `ViewArrays.background`; zero where meshes replace it."""

    def numpy(self) -> dict[str, NDArray[Any]]:
        """Return copies on the host."""
        return {f.name: getattr(self, f.name).numpy() for f in fields(self)}


class AdjointRasterizer:
    """Differentiates the last frame of a rasteriser.

    Call `rasterizer.render(splats, views, ...)`, then `backward` with the same arrays. All buffers are allocated here,
    44 bytes per splat and view, 84 with the camera; on a CPU two runs give the same bits, on CUDA sums over views and
    pixels are atomic and differ by rounding.

    Args:
        rasterizer: The rasteriser whose frames are differentiated.
        splats: Arrays of the shapes that will be rendered.
        views: Views of the shapes that will be rendered.
        camera: Compute `twist` and `intrinsics`; zero without it.
    """

    def __init__(
        self, rasterizer: SplatRasterizer, splats: SplatArrays, views: ViewArrays, *, camera: bool = True
    ) -> None:
        """Allocate the buffers."""
        self.rasterizer, self.camera = rasterizer, camera
        self.device = rasterizer.device
        allocate = functools.partial(wp.zeros, device=self.device)
        view_count, count = rasterizer.view_count, rasterizer.splat_count
        self._center = allocate(view_count * count, dtype=wp.vec4)
        self._shape = allocate(view_count * count, dtype=wp.vec4)
        self._color = allocate(view_count * count, dtype=wp.vec3)
        self._camera = allocate((view_count, count) if camera else (1, 1), dtype=projection_adjoint_kernels.vec10)
        self._lanes = 1 if self.device.is_cpu else 64
        self.gradients = RasterizerGradients(
            means=wp.zeros_like(splats.means, requires_grad=False),
            covariances=wp.zeros_like(splats.covariances, requires_grad=False),
            opacities=wp.zeros_like(splats.opacities, requires_grad=False),
            sh=wp.zeros_like(splats.sh, requires_grad=False),
            rotations=allocate(splats.rotations.shape, dtype=wp.vec3),
            twist=allocate(view_count, dtype=wp.spatial_vectord),
            intrinsics=allocate(view_count, dtype=wp.vec4d),
            background=allocate(views.background.shape, dtype=wp.vec3d),
        )
        """What `backward` writes, overwritten by every call."""

    def backward(
        self,
        splats: SplatArrays,
        views: ViewArrays,
        *,
        loss_rgb: wp.array,
        loss_alpha: wp.array | None = None,
        loss_depth: wp.array | None = None,
        mesh_rgb: wp.array | None = None,
        mesh_depth: wp.array | None = None,
    ) -> RasterizerGradients:
        """Carry the loss from the images of the last frame to everything it was made of.

        Args:
            splats: The splats as rendered.
            views: The cameras as rendered.
            loss_rgb: Derivative of the loss by `rgb`, vec3, shape (view_count, height, width).
            loss_alpha: Derivative of the loss by `alpha`, shape (view_count, height, width); None for zero.
            loss_depth: Derivative of the loss by `depth` [1/m], same shape; None for zero.
            mesh_rgb: As rendered. Its own gradient is (1 - alpha) loss_rgb.
            mesh_depth: As rendered; nothing behind the meshes has a gradient.

        Returns:
            `gradients`, on the device.

        Raises:
            ConfigError: If an array has another shape than the images or the gradients.
        """
        r, out = self.rasterizer, self.gradients
        images = (r.view_count, r.height, r.width)
        meshes = None if mesh_rgb is None and mesh_depth is None else images
        expected = (
            ("loss_rgb", loss_rgb, images),
            ("loss_alpha", loss_alpha, None if loss_alpha is None else images),
            ("loss_depth", loss_depth, None if loss_depth is None else images),
            ("mesh_rgb", mesh_rgb, meshes),
            ("mesh_depth", mesh_depth, meshes),
            *((f"splats.{k}", v, getattr(out, k).shape) for k, v in vars(splats).items() if k not in UNTOUCHED),
            ("views.world_to_camera", views.world_to_camera, (r.view_count,)),
            ("views.background", views.background, out.background.shape),
        )
        require_shapes(expected, "Give the arrays of the last render, and build the adjoint for their shapes")
        for array in (self._center, self._shape, self._color, *(getattr(out, f.name) for f in fields(out))):
            array.zero_()
        self._blend(views, loss_rgb, loss_alpha, loss_depth, mesh_rgb, mesh_depth)
        self._project(splats, views)
        if mesh_rgb is None:
            dim, seen = (r.view_count, self._lanes), (r.alpha, loss_rgb, self._lanes)
            launch(self.device, projection_adjoint_kernels.background_adjoint, dim, *seen, out.background)
        return out

    def _blend(
        self,
        views: ViewArrays,
        loss_rgb: wp.array,
        loss_alpha: wp.array | None,
        loss_depth: wp.array | None,
        mesh_rgb: wp.array | None,
        mesh_depth: wp.array | None,
    ) -> None:
        r = self.rasterizer
        variant = (mesh_depth is not None, loss_depth is not None)
        blend = blend_adjoint_cpu_kernels if self.device.is_cpu else blend_adjoint_cuda_kernels
        dim, out = r._cover.shape[0] * blend.TILE_THREADS, (self._center, self._shape, self._color)
        images = ImageLoss()
        images.depth, images.alpha = r.depth, r.alpha
        images.loss_rgb, images.loss_alpha, images.loss_depth = loss_rgb, loss_alpha, loss_depth
        frame = r._frame(views, mesh_rgb, mesh_depth)
        launch(self.device, blend.blend_adjoint_kernel(*variant), dim, frame, images, *out, block_dim=BLOCK_DIM)

    def _project(self, splats: SplatArrays, views: ViewArrays) -> None:
        r, out = self.rasterizer, self.gradients
        launch(
            self.device, projection_adjoint_kernels.project_adjoint, (r.view_count, r.splat_count),
            *r._projected(splats, views),
            wp.vec2i(r.width, r.height), r.options.pixel_variance, r.options.antialiased, self.camera,
            r._color, self._center, self._shape, self._color,
            out.means, out.covariances, out.opacities, out.sh, out.rotations, self._camera,
        )  # fmt: skip
        if self.camera:
            dim, given = (r.view_count, self._lanes), (self._camera, self._lanes)
            launch(self.device, projection_adjoint_kernels.camera_adjoint, dim, *given, out.twist, out.intrinsics)
