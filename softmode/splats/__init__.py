"""Gaussian splats: arrays, files, a procedural plush, the batched rasteriser and the cameras.

Names are imported when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from softmode.lazy import lazy_names

if TYPE_CHECKING:
    from softmode.splats.cameras.camera import SplatCamera as SplatCamera
    from softmode.splats.cameras.camera_options import CameraOptions as CameraOptions
    from softmode.splats.cameras.camera_options import ShadowOptions as ShadowOptions
    from softmode.splats.cameras.camera_randomization import CameraRandomization as CameraRandomization
    from softmode.splats.cameras.camera_randomization import ViewVariation as ViewVariation
    from softmode.splats.cameras.rigid_splats import RigidSplats as RigidSplats
    from softmode.splats.cameras.rigid_splats import RigidSplatsSkin as RigidSplatsSkin
    from softmode.splats.colored_mesh import ColoredMesh as ColoredMesh
    from softmode.splats.components import split_components as split_components
    from softmode.splats.fit.reference_views import orbit_poses as orbit_poses
    from softmode.splats.fit.reference_views import render_mesh as render_mesh
    from softmode.splats.formats import CONVENTIONS as CONVENTIONS
    from softmode.splats.formats import READABLE as READABLE
    from softmode.splats.formats import WRITABLE as WRITABLE
    from softmode.splats.formats import read_splats as read_splats
    from softmode.splats.formats import write_ply as write_ply
    from softmode.splats.formats import write_splats as write_splats
    from softmode.splats.formats import write_usd as write_usd
    from softmode.splats.mesh_samples import sample_mesh as sample_mesh
    from softmode.splats.plush import make_plush as make_plush
    from softmode.splats.plush import plush_bounds as plush_bounds
    from softmode.splats.plush import plush_signed_distance as plush_signed_distance
    from softmode.splats.point_cloud import splats_from_points as splats_from_points
    from softmode.splats.raster.pinhole import PinholeCamera as PinholeCamera
    from softmode.splats.raster.posed_pictures import Lens as Lens
    from softmode.splats.raster.posed_pictures import PosedPicture as PosedPicture
    from softmode.splats.raster.posed_pictures import read_transforms as read_transforms
    from softmode.splats.raster.posed_pictures import write_transforms as write_transforms
    from softmode.splats.raster.rasterizer import RasterizerOptions as RasterizerOptions
    from softmode.splats.raster.rasterizer import SplatArrays as SplatArrays
    from softmode.splats.raster.rasterizer import SplatRasterizer as SplatRasterizer
    from softmode.splats.raster.rasterizer import ViewArrays as ViewArrays
    from softmode.splats.raster.rasterizer_adjoint import AdjointRasterizer as AdjointRasterizer
    from softmode.splats.raster.rasterizer_adjoint import RasterizerGradients as RasterizerGradients
    from softmode.splats.raster.rasterizer_torch import render as render
    from softmode.splats.splats import Splats as Splats
    from softmode.splats.splats import up_rotation as up_rotation

__getattr__, __dir__ = lazy_names(__name__)
