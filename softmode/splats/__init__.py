"""Gaussian splats: arrays, files, a procedural plush, the batched rasteriser and the cameras.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.splats.camera import CameraOptions, SplatCamera
    from softmode.splats.camera_randomization import CameraRandomization, ViewVariation
    from softmode.splats.colored_mesh import ColoredMesh
    from softmode.splats.components import split_components
    from softmode.splats.formats import READABLE, WRITABLE, read_splats, write_ply, write_splats, write_usd
    from softmode.splats.mesh_samples import sample_mesh
    from softmode.splats.pinhole import PinholeCamera
    from softmode.splats.plush import make_plush, plush_bounds, plush_signed_distance
    from softmode.splats.point_cloud import splats_from_points
    from softmode.splats.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
    from softmode.splats.rasterizer_adjoint import AdjointRasterizer, RasterizerGradients
    from softmode.splats.rasterizer_torch import render
    from softmode.splats.reference_views import orbit_poses, render_mesh
    from softmode.splats.rigid_splats import RigidSplats, RigidSplatsSkin
    from softmode.splats.shadow import ShadowOptions
    from softmode.splats.splats import Splats, up_rotation
    from softmode.splats.threaded_rasterizer import ThreadedRasterizer

__all__ = [
    "READABLE",
    "WRITABLE",
    "AdjointRasterizer",
    "CameraOptions",
    "CameraRandomization",
    "ColoredMesh",
    "PinholeCamera",
    "RasterizerGradients",
    "RasterizerOptions",
    "RigidSplats",
    "RigidSplatsSkin",
    "ShadowOptions",
    "SplatArrays",
    "SplatCamera",
    "SplatRasterizer",
    "Splats",
    "ThreadedRasterizer",
    "ViewArrays",
    "ViewVariation",
    "make_plush",
    "orbit_poses",
    "plush_bounds",
    "plush_signed_distance",
    "read_splats",
    "render",
    "render_mesh",
    "sample_mesh",
    "splats_from_points",
    "split_components",
    "up_rotation",
    "write_ply",
    "write_splats",
    "write_usd",
]

__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "READABLE": ".formats",
        "WRITABLE": ".formats",
        "AdjointRasterizer": ".rasterizer_adjoint",
        "CameraOptions": ".camera",
        "CameraRandomization": ".camera_randomization",
        "ColoredMesh": ".colored_mesh",
        "PinholeCamera": ".pinhole",
        "RasterizerGradients": ".rasterizer_adjoint",
        "RasterizerOptions": ".rasterizer",
        "RigidSplats": ".rigid_splats",
        "RigidSplatsSkin": ".rigid_splats",
        "ShadowOptions": ".shadow",
        "SplatArrays": ".rasterizer",
        "SplatCamera": ".camera",
        "SplatRasterizer": ".rasterizer",
        "Splats": ".splats",
        "ThreadedRasterizer": ".threaded_rasterizer",
        "ViewArrays": ".rasterizer",
        "ViewVariation": ".camera_randomization",
        "make_plush": ".plush",
        "orbit_poses": ".reference_views",
        "plush_bounds": ".plush",
        "plush_signed_distance": ".plush",
        "read_splats": ".formats",
        "render": ".rasterizer_torch",
        "render_mesh": ".reference_views",
        "sample_mesh": ".mesh_samples",
        "splats_from_points": ".point_cloud",
        "split_components": ".components",
        "up_rotation": ".splats",
        "write_ply": ".formats",
        "write_splats": ".formats",
        "write_usd": ".formats",
    },
)
