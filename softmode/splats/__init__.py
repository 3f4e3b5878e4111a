"""Gaussian splats: arrays, files, a procedural plush, the batched rasteriser and the cameras.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.splats.cameras.camera import SplatCamera
    from softmode.splats.cameras.camera_options import CameraOptions, ShadowOptions
    from softmode.splats.cameras.camera_randomization import CameraRandomization, ViewVariation
    from softmode.splats.cameras.rigid_splats import RigidSplats, RigidSplatsSkin
    from softmode.splats.colored_mesh import ColoredMesh
    from softmode.splats.components import split_components
    from softmode.splats.fit.reference_views import orbit_poses, render_mesh
    from softmode.splats.formats import CONVENTIONS, READABLE, WRITABLE, read_splats, write_ply, write_splats, write_usd
    from softmode.splats.mesh_samples import sample_mesh
    from softmode.splats.plush import make_plush, plush_bounds, plush_signed_distance
    from softmode.splats.point_cloud import splats_from_points
    from softmode.splats.raster.pinhole import PinholeCamera
    from softmode.splats.raster.rasterizer import RasterizerOptions, SplatArrays, SplatRasterizer, ViewArrays
    from softmode.splats.raster.rasterizer_adjoint import AdjointRasterizer, RasterizerGradients
    from softmode.splats.raster.rasterizer_torch import render
    from softmode.splats.splats import Splats, up_rotation

__all__ = [
    "CONVENTIONS",
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

__getattr__, __dir__ = lazy_names(__name__)
