"""Splat images as a PyTorch function, differentiated by the adjoint of the rasteriser. Needs the extra ``[rl]``."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import warp as wp

from softmode.errors import ConfigError, MissingExtraError
from softmode.splats.raster.rasterizer import SplatArrays, ViewArrays
from softmode.splats.raster.rasterizer_adjoint import AdjointRasterizer

if TYPE_CHECKING:
    from torch import Tensor

SPLAT_INPUTS = ("means", "covariances", "opacities", "sh", "rotations")
VIEW_INPUTS = ("world_to_camera", "intrinsics", "background")
INPUTS = (*SPLAT_INPUTS, *VIEW_INPUTS)


def render(
    adjoint: AdjointRasterizer,
    splats: SplatArrays,
    views: ViewArrays,
    *,
    mesh_rgb: wp.array | None = None,
    mesh_depth: wp.array | None = None,
    **inputs: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw a frame and return its images, differentiable by every tensor given.

    Tensors that are float32, contiguous and on the rasteriser's device are not copied; they must not be changed in
    place between this call and its backward pass. A frame that is differentiated after another was drawn is drawn
    again.

    Args:
        adjoint: Adjoint of the rasteriser that draws.
        splats: Arrays for what is not given as a tensor.
        views: Views for what is not given as a tensor.
        mesh_rgb: As in `SplatRasterizer.render`.
        mesh_depth: As in `SplatRasterizer.render`.
        **inputs: Any of ``means`` (1|W, N, 3), ``covariances`` (1|W, N, 6), ``opacities`` (1|W, N), ``sh``
            (1|W, N, K, 3), ``rotations`` (1|W, N, 4) unit quaternions xyzw, ``world_to_camera`` (V, 4, 4),
            ``intrinsics`` (V, 4) and ``background`` (1|V, 3), which replace the arrays of `splats` and `views`. Poses
            and quaternions have gradients along rigid motions only, those that keep them rigid and of unit length.

    Returns:
        rgb (V, H, W, 3), alpha (V, H, W) and depth [m] (V, H, W).

    Raises:
        ConfigError: If a name is unknown, the adjoint leaves out the camera though a pose or intrinsics want gradients,
            or an array has another shape than the buffers.
        MissingExtraError: If PyTorch is not installed.
    """
    unknown = set(inputs) - set(INPUTS)
    if unknown:
        raise ConfigError(f"unknown input {sorted(unknown)[0]!r}", hint=f"choose from {', '.join(INPUTS)}")
    if not adjoint.camera and any(inputs[k].requires_grad for k in inputs.keys() & {"world_to_camera", "intrinsics"}):
        raise ConfigError("the adjoint leaves out the camera", hint="use AdjointRasterizer(..., camera=True)")
    return _function().apply(adjoint, splats, views, mesh_rgb, mesh_depth, *(inputs.get(name) for name in INPUTS))


@functools.cache
def _function() -> Any:
    """Return the autograd function; made on first use, so that importing this module does not load PyTorch."""
    try:
        import torch
    except ImportError as error:
        raise MissingExtraError(
            "PyTorch is not installed", hint="install it with: pip install 'softmode[rl]'"
        ) from error

    def view(tensor: Tensor, like: wp.array) -> wp.array:
        """Return a tensor as a Warp array, sharing memory where it can."""
        there = tensor.detach().to(device=wp.device_to_torch(like.device), dtype=torch.float32).contiguous()
        return wp.from_torch(there, dtype=like.dtype, requires_grad=False)

    def pose_gradient(twist: Tensor, pose: Tensor) -> Tensor:
        """Return a matrix whose product with every rigid change of the pose is that of the twist's gradient."""
        v, w = twist[:, :3], twist[:, 3:]
        h = w - torch.linalg.cross(pose[:, :3, 3], v)
        out = torch.zeros_like(pose)
        # dR = [w]x R: column by column a cross product, and every direction stands in two places.
        out[:, :3, :3] = 0.5 * torch.linalg.cross(h[:, :, None].expand(-1, 3, 3), pose[:, :3, :3], dim=1)
        out[:, :3, 3] = v
        return out

    def quaternion_gradient(turn: Tensor, quat: Tensor) -> Tensor:
        """Return 2 (g, 0) q, the tangent of the unit quaternions that a rotation vector's gradient g stands for."""
        xyz, w = quat[..., :3], quat[..., 3:]
        vector = w * turn + torch.linalg.cross(turn, xyz)
        return 2.0 * torch.cat([vector, -(turn * xyz).sum(-1, keepdim=True)], dim=-1)

    class Render(torch.autograd.Function):
        @staticmethod
        def forward(
            ctx: Any,
            adjoint: AdjointRasterizer,
            splats: SplatArrays,
            views: ViewArrays,
            mesh_rgb: wp.array | None,
            mesh_depth: wp.array | None,
            *values: Tensor | None,
        ) -> Any:
            given = {name: value for name, value in zip(INPUTS, values, strict=True) if value is not None}
            splats = replace(splats, **{k: view(given[k], getattr(splats, k)) for k in SPLAT_INPUTS if k in given})
            views = replace(views, **{k: view(given[k], getattr(views, k)) for k in VIEW_INPUTS if k in given})
            rasterizer = adjoint.rasterizer
            rasterizer.render(splats, views, mesh_rgb=mesh_rgb, mesh_depth=mesh_depth)
            ctx.frame = rasterizer.frame
            ctx.adjoint, ctx.splats, ctx.views, ctx.meshes = adjoint, splats, views, (mesh_rgb, mesh_depth)
            ctx.kinds = [None if value is None else (value.dtype, value.device) for value in values]
            return tuple(wp.to_torch(image).clone() for image in (rasterizer.rgb, rasterizer.alpha, rasterizer.depth))

        @staticmethod
        def backward(ctx: Any, *losses: Tensor) -> Any:
            adjoint, splats, views = ctx.adjoint, ctx.splats, ctx.views
            mesh: dict[str, Any] = dict(zip(("mesh_rgb", "mesh_depth"), ctx.meshes, strict=True))
            rasterizer = adjoint.rasterizer
            if rasterizer.frame is not ctx.frame:
                rasterizer.render(splats, views, **mesh)
                ctx.frame = rasterizer.frame
            images = (rasterizer.rgb, rasterizer.alpha, rasterizer.depth)
            rgb, alpha, depth = (view(loss, image) for loss, image in zip(losses, images, strict=True))
            found = adjoint.backward(splats, views, loss_rgb=rgb, loss_alpha=alpha, loss_depth=depth, **mesh)
            out: list[Any] = [None] * 5
            for name, kind in zip(INPUTS, ctx.kinds, strict=True):
                if kind is None:
                    out.append(None)
                    continue
                value = wp.to_torch(found.twist if name == "world_to_camera" else getattr(found, name)).clone()
                if name == "world_to_camera":
                    value = pose_gradient(value, wp.to_torch(views.world_to_camera).to(value.dtype))
                elif name == "rotations":
                    value = quaternion_gradient(value, wp.to_torch(splats.rotations))
                out.append(value.to(dtype=kind[0], device=kind[1]))
            return tuple(out)

    return Render
