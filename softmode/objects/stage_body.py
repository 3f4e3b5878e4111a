"""The deformables of a stage as soft objects at their places."""

from __future__ import annotations

from typing import Any

import numpy as np

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material, warn_of_units
from softmode.deformables.model.authoring import SCALE_MAX, SCALE_MIN
from softmode.deformables.quadrature.quadrature import quadrature_from_points, quadrature_from_splats
from softmode.deformables.quadrature.quadrature_grid import Quadrature
from softmode.deformables.quadrature.quadrature_mesh import cap_holes, quadrature_from_mesh
from softmode.deformables.quadrature.surface_samples import SURFACE_COUNT
from softmode.deformables.reduction.build_body import build_body
from softmode.deformables.reduction.cache import cached_body
from softmode.deformables.reduction.options import BuildOptions
from softmode.errors import AssetError, BasisError
from softmode.objects.loader import Progress
from softmode.objects.placed import Placed
from softmode.objects.soft_object import SoftObject
from softmode.objects.stage.bundle import body_of
from softmode.objects.stage.scene import UsdDeformable
from softmode.objects.stage_asset import colored_mesh
from softmode.splats.mesh_samples import sample_mesh
from softmode.splats.splats import Splats

RECIPE = 5
"""Raise it when a stage's body comes to be built in another way: cached bodies are keyed by it."""
_COVER = 8000
"""Points on a mesh that is not closed, whose inside is then what they enclose."""


def place_deformable(
    deformable: UsdDeformable,
    options: BuildOptions | None = None,
    *,
    material: Material | None = None,
    surface_count: int = SURFACE_COUNT,
    splat_count: int = 2000,
    contact_radius: float = 0.0,
    progress: Progress = None,
) -> Placed:
    """Build or recall the body of a deformable, and return it where the stage has it, in metres with z up.

    A body that softmode wrote comes back as it was. Its splats are the stage's, else samples of its meshes; Points
    without either have none.

    Args:
        deformable: From `read_usd_scene`.
        options: How its body is reduced; defaults when None, for the Poisson's ratio of its material.
        material: Properties that the stage does not give; ``Material()`` when None.
        surface_count: Number of surface samples.
        splat_count: Number of splats on a body that the stage shows by meshes.
        contact_radius: How far the surface that touches stands out from the body's [m].
        progress: Passed to :func:`softmode.deformables.reduction.build_body.build_body`.

    Raises:
        AssetError: If it encloses no volume, or is a body of softmode scaled outside 0.25..4.
        MaterialError: If the stage gives a material property outside its range.
    """
    if deformable.bundle is not None:
        if not SCALE_MIN <= deformable.scale <= SCALE_MAX:
            raise AssetError(
                f"{deformable.path}: a body of softmode is scaled by {deformable.scale:g}, outside "
                f"{SCALE_MIN}..{SCALE_MAX}",
                hint="It is in metres: scale it by 1 / metersPerUnit where it is referred to in other units",
            )
        body = body_of(deformable.bundle, deformable.path)
        offset = np.zeros(3)  # the prim's frame is the body frame
    else:
        ratio = deformable.material(1.0, material).poissons_ratio
        chosen = (options or BuildOptions()).for_ratio(ratio)
        body = build_deformable(deformable, chosen, surface_count=surface_count, progress=progress)
        offset = body.offset
    splats = deformable.splats or _mesh_splats(deformable, splat_count)
    if splats is not None and offset.any():
        splats = splats.transformed(translation=-offset)
    made_of = deformable.material(body.volume * deformable.scale**3, material)
    warn_of_units(made_of, deformable.path)
    x, y, z = (deformable.translation + deformable.scale * (deformable.rotation @ offset)).tolist()
    return Placed(
        object=SoftObject(
            body=body,
            splats=splats,
            material=made_of,
            contact_radius=contact_radius,
            notes=deformable.notes,
        ),
        position=(x, y, z),
        rotation=deformable.rotation,
        scale=deformable.scale,
        name=deformable.path.rpartition("/")[2],
    )


def build_deformable(
    deformable: UsdDeformable,
    options: BuildOptions | None = None,
    *,
    surface_count: int = SURFACE_COUNT,
    progress: Progress = None,
) -> ReducedBody:
    """Build the body of a deformable, or recall it from the cache.

    A closed Mesh, and the boundary of a TetMesh, are integrated as they are; a mesh that is not closed stands for what
    it encloses; Points with widths fill a body, those without lie on its surface; splats are filled.

    Args:
        deformable: From `read_usd_scene`.
        options: How it is reduced; defaults when None.
        surface_count: Number of surface samples.
        progress: Passed to :func:`softmode.deformables.reduction.build_body.build_body`.

    Returns:
        The body, named after its prim.

    Raises:
        AssetError: If it encloses no volume.
    """
    chosen = options or BuildOptions()
    name = deformable.path.rpartition("/")[2]
    splats = deformable.splats
    shape: tuple[Any, ...]
    if deformable.surface is not None:
        shape = (deformable.surface.vertices, deformable.surface.faces)
    elif deformable.kind == "Points":
        shape = (deformable.points, deformable.point_radii)
    elif splats is not None:
        shape = (splats.means, splats.scales, splats.quats, splats.opacities)
    else:
        raise AssetError(f"{deformable.path}: its splats are invisible", hint="Make them visible, or add a mesh")

    def build() -> ReducedBody:
        try:
            quadrature = _integrate(deformable, surface_count)
            return build_body(quadrature, chosen, name=name, progress=progress)
        except (AssetError, BasisError) as error:
            raise AssetError(f"{deformable.path}: {error.message}", hint=error.hint) from error

    return cached_body(("usd", RECIPE, name, deformable.kind, *shape, surface_count, chosen), build)


def _integrate(deformable: UsdDeformable, surface_count: int) -> Quadrature:
    """Integrate the shape of a deformable."""
    surface, splats = deformable.surface, deformable.splats
    if surface is not None:
        try:
            vertices, faces, _ = cap_holes(surface.vertices, surface.faces)
            return quadrature_from_mesh(vertices, faces, surface_count=surface_count)
        except AssetError:
            cover = sample_mesh(colored_mesh([surface], deformable.path), _COVER)
            return quadrature_from_points(cover.means, surface_count=surface_count)
    if splats is not None and deformable.kind != "Points":
        return quadrature_from_splats(
            splats.means, splats.scales, splats.quats, splats.opacities, surface_count=surface_count
        )
    points, radii = deformable.points, deformable.point_radii
    if not radii.any():
        return quadrature_from_points(points, surface_count=surface_count)
    # Particles that fill a body: round splats as wide as their radius, whose surface lies a radius outside.
    quats = np.tile([0.0, 0.0, 0.0, 1.0], (len(points), 1))
    return quadrature_from_splats(
        points,
        np.tile(radii[:, None], (1, 3)),
        quats,
        np.ones(len(points)),
        outset=radii,
        surface_count=surface_count,
    )


def _mesh_splats(deformable: UsdDeformable, count: int) -> Splats | None:
    """Return splats on the meshes that show a body: its visible ones, else its simulation geometry's surface."""
    meshes = [mesh for mesh in (deformable.meshes or (deformable.surface,)) if mesh is not None and len(mesh.faces)]
    if not meshes:
        return None
    return sample_mesh(colored_mesh(meshes, deformable.path), count)
