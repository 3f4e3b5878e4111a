"""Gaussian splats: arrays, files, a procedural plush, the batched rasteriser and the camera.

Importing this package is cheap; the device code lives in `softmode.splats.rasterizer` and `softmode.splats.camera`.
"""

from softmode.splats.components import split_components
from softmode.splats.formats import read_splats, write_ply, write_splats, write_usd
from softmode.splats.plush import make_plush, plush_bounds, plush_signed_distance
from softmode.splats.splats import Splats

__all__ = [
    "Splats",
    "make_plush",
    "plush_bounds",
    "plush_signed_distance",
    "read_splats",
    "split_components",
    "write_ply",
    "write_splats",
    "write_usd",
]
