"""Splats from a mesh: sampled on its surface, then fitted to pictures of it by gradient descent."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from softmode.objects.mesh_file import read_mesh
from softmode.splats.colored_mesh import ColoredMesh
from softmode.splats.fit.picture_fit import FitOptions, fit_splats
from softmode.splats.fit.reference_views import render_mesh
from softmode.splats.mesh_samples import sample_mesh
from softmode.splats.splats import Splats

if TYPE_CHECKING:
    import os

    import trimesh


@dataclass(frozen=True)
class MeshFit:
    """Splats that stand for a mesh, and how well they do."""

    splats: Splats
    """In the frame and unit of the mesh."""
    psnr: float
    """Mean peak signal-to-noise ratio over the held-out pictures, before white [dB]."""
    history: tuple[tuple[int, float], ...]
    """Iteration and PSNR [dB] from the sampled splats (0) to the result."""


def splats_from_mesh(
    mesh: "ColoredMesh | trimesh.Trimesh | trimesh.Scene | str | os.PathLike[str]",
    *,
    count: int = 10_000,
    options: FitOptions | None = None,
    device: wp.DeviceLike = None,
    progress: Callable[[int, float], None] | None = None,
) -> MeshFit:
    """Cover a mesh with splats and fit them to its pictures.

    Splats sampled on the surface (`sample_mesh`) are fitted to pictures of the unlit mesh from all around
    (`softmode.splats.fit.picture_fit.fit_splats`).

    Args:
        mesh: A file of any kind that trimesh reads, a trimesh mesh or scene, or a `ColoredMesh`.
        count: Number of splats.
        options: Pictures and steps.
        device: Warp device.
        progress: Called with the iteration and the loss after every step.

    Returns:
        The splats, of spherical-harmonic degree 0, and their PSNR.

    Raises:
        AssetError: If the mesh cannot be read or has no surface.
        ConfigError: If an option is out of range.
    """
    options = options if options is not None else FitOptions()
    if not isinstance(mesh, ColoredMesh):
        loaded = hasattr(mesh, "visual") or hasattr(mesh, "graph")
        mesh = ColoredMesh.from_trimesh(mesh) if loaded else read_mesh(mesh)  # type: ignore[arg-type]
    unit, center, radius = mesh.normalized()
    spacing = float(np.sqrt(unit.area / count))
    size = {"width": options.size, "height": options.size, "samples": options.samples}
    draw = partial(render_mesh, unit, device=device, **size)
    fitted, history = fit_splats(
        sample_mesh(unit, count, seed=options.seed), spacing, draw, options, device=device, progress=progress
    )
    return MeshFit(
        replace(fitted.transformed(scale=radius, translation=center), name=mesh.name), history[-1][1], history
    )
