"""`add_usd`: robots, props and soft bodies of an OpenUSD stage into a Newton builder."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.build.build_body import build_body
from softmode.deformables.build.cache import cached_body
from softmode.deformables.build.options import BuildOptions
from softmode.deformables.build.quadrature import quadrature_from_points, quadrature_from_splats
from softmode.deformables.build.quadrature_grid import Quadrature
from softmode.deformables.build.quadrature_mesh import quadrature_from_mesh
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import SCALE_MAX, SCALE_MIN, add_reduced_body, rotation_matrix
from softmode.deformables.skinning.skin_splats import average_basis
from softmode.errors import AssetError, BasisError, ConfigError, SoftmodeError
from softmode.objects.stage_asset import colored_mesh
from softmode.objects.stage_bundle import body_of
from softmode.objects.stage_scene import UsdDeformable, UsdScene, open_scene
from softmode.splats.mesh_samples import sample_mesh
from softmode.splats.splats import Splats, quats_from_rotations

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

RECIPE = 1
"""Raise it when a stage's body comes to be built in another way: cached bodies are keyed by it."""
_COVER = 8000
"""Points on a mesh that is not closed, whose inside is then what they enclose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class UsdBody:
    """A soft body of a stage in a model."""

    path: str
    """Path of its prim."""
    instance: int
    """Index of the instance in the builder, for `add_pins`, `attach`, and parameters of one world."""
    body: ReducedBody
    """The reduced body; bodies of equal shape share it."""
    material: Material
    """What it is made of."""
    position: Array
    """Where its centre of mass rests [m], shape (3,)."""
    rotation: Array
    """How it is turned, shape (3, 3)."""
    scale: float
    """Its size over that of `body`."""
    splats: Splats | None
    """Its splats in the body frame [m]: the stage's, else samples of its meshes; None for Points without either."""
    notes: tuple[str, ...] = ()
    """What was read in another way than it was meant."""

    def placed_splats(self) -> Splats | None:
        """Return its splats where the body rests [m]."""
        if self.splats is None:
            return None
        return self.splats.transformed(rotation=self.rotation, translation=self.position, scale=self.scale)

    def average_basis(self) -> tuple[Array, Array]:
        """Return its functions (N, n) and their gradients (N, n, 3) [1/m] averaged over its splats, for `SkinSplats`.

        Raises:
            ConfigError: If it has no splats.
        """
        if self.splats is None:
            raise ConfigError(f"{self.path}: has no splats", hint="put a splat prim or a Mesh beneath the body")
        return average_basis(lambda x: self.body.evaluate(x)[0], self.splats.means, self.splats.covariances())


@dataclass(frozen=True, kw_only=True, eq=False)
class UsdImport:
    """What `add_usd` added."""

    bodies: dict[str, UsdBody]
    """Soft bodies by prim path, in the order of the stage, which is that of their instances."""
    scene: UsdScene
    """What the stage says of them."""
    newton: dict[str, Any] = field(default_factory=dict)
    """What Newton's importer returned for the rest: `path_body_map`, `path_shape_map`, ..."""

    @property
    def reduced_bodies(self) -> list[ReducedBody]:
        """The bodies that a solver takes, each once."""
        return list({body.body.fingerprint: body.body for body in self.bodies.values()}.values())


def add_usd(
    builder: newton.ModelBuilder,
    path: str | os.PathLike[str],
    *,
    asset_root: str | os.PathLike[str] | None = None,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    rotation: ArrayLike | None = None,
    build_options: BuildOptions | None = None,
    material: Material | None = None,
    surface_count: int = 400,
    splat_count: int = 2000,
    contact_radius: float = 0.0,
    newton_options: dict[str, Any] | None = None,
    progress: bool | Progress | None = None,
) -> UsdImport:
    """Add everything in an OpenUSD stage to a world: soft bodies as reduced bodies, the rest through Newton's importer.

    The file is opened in a process of its own, which sends the soft bodies as arrays and writes the rest as one checked
    crate; Newton's importer reads that. Bodies are built once and kept in the cache. One that softmode wrote comes back
    as it was; it is not built again. Gravity of the stage, if it has a `PhysicsScene`, becomes the builder's, turned as
    the stage is.

    Args:
        builder: Builder of the world, Z up; it may be replicated afterwards.
        path: A `.usd`, `.usda`, `.usdc` or `.usdz` file.
        asset_root: Folder that holds whatever the stage may read; None for the file's own.
        position: Where the origin of the stage comes to lie [m].
        rotation: How the stage is turned, shape (3, 3); not at all when None.
        build_options: How bodies are reduced; defaults when None.
        material: Properties that the stage does not give; ``Material()`` when None.
        surface_count: Number of surface samples of each body.
        splat_count: Number of splats on a body that the stage shows by meshes.
        contact_radius: How far the surface that touches stands out from the body's [m].
        newton_options: Arguments for `newton.ModelBuilder.add_usd`, such as ``{"floating": False}``.
        progress: Passed to :func:`softmode.deformables.build.build_body.build_body`.

    Returns:
        The soft bodies by prim path and what Newton's importer says of the rest.

    Raises:
        AssetError: If the file is damaged, refers out of the root, or a body encloses no volume.
        MaterialError: If the stage gives a material property outside its range.
        ConfigError: If an option is out of range, or names what this function decides.
        MissingExtraError: If the extra `[usd]` is not installed.
    """
    options = dict(newton_options or {})
    decided = sorted(set(options) & {"source", "xform", "root_path", "apply_up_axis_from_stage"})
    if decided:
        raise ConfigError(
            f"newton_options: {', '.join(decided)} cannot be given",
            hint="leave them out; a stage has one place for all",
        )
    turn, shift = _place(position, rotation)
    if builder.up_axis != newton.Axis.Z:
        raise ConfigError(
            f"builder: its up axis is {builder.up_axis}", hint="use newton.ModelBuilder(), which has Z up"
        )
    with tempfile.TemporaryDirectory() as folder:
        scene = open_scene(path, asset_root, folder, copy=True)
        # All bodies are built before anything is added: one that cannot be leaves the builder as it was.
        ready = [
            _build(deformable, build_options or BuildOptions(), material, surface_count, splat_count, progress)
            for deformable in scene.deformables
        ]
        options["xform"] = wp.transform(wp.vec3(*shift), wp.quat(*quats_from_rotations(turn)))
        rest = _add_rest(builder, os.path.join(folder, "rest.usdc"), str(path), options)
    bodies = {}
    for made in ready:
        body = replace(made, position=turn @ made.position + shift, rotation=turn @ made.rotation)
        instance = add_reduced_body(
            builder,
            body.body,
            material=body.material,
            position=body.position.tolist(),
            rotation=body.rotation,
            contact_radius=contact_radius,
            scale=body.scale,
        )
        bodies[body.path] = replace(body, instance=instance)
    return UsdImport(bodies=bodies, scene=scene, newton=rest)


def _place(position: Sequence[float], rotation: ArrayLike | None) -> tuple[Array, Array]:
    """Return the rotation (3, 3) and translation (3,) of a stage, checked."""
    shift = np.asarray(position, dtype=np.float64)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise ConfigError(f"position must be three finite numbers, got {position!r}", hint="give metres")
    return np.eye(3) if rotation is None else rotation_matrix(rotation), shift


def _add_rest(builder: newton.ModelBuilder, crate: str, name: str, options: dict[str, Any]) -> dict[str, Any]:
    """Give the rest of a stage to Newton's importer, which raises whatever the content makes it raise."""
    try:
        return builder.add_usd(crate, **options)
    except (SoftmodeError, ImportError):
        raise
    except TypeError as error:
        if "unexpected keyword" in str(error):
            raise ConfigError(f"newton_options: {error}", hint="see newton.ModelBuilder.add_usd") from error
        raise AssetError(f"OpenUSD file {name}: Newton cannot import it ({error})", hint=_NEWTON_HINT) from error
    except (ValueError, RuntimeError, KeyError, IndexError, AttributeError, ArithmeticError) as error:
        raise AssetError(f"OpenUSD file {name}: Newton cannot import it ({error})", hint=_NEWTON_HINT) from error


_NEWTON_HINT = "Mend the rigid part of the stage, or read the soft bodies alone with read_usd_scene"


def _build(
    deformable: UsdDeformable,
    options: BuildOptions,
    default: Material | None,
    surface_count: int,
    splat_count: int,
    progress: bool | Progress | None,
) -> UsdBody:
    """Build or recall the body of a deformable, with its material, place and splats; its instance is yet to come."""
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
        body = build_deformable(deformable, options, surface_count=surface_count, progress=progress)
        offset = body.offset
    splats = deformable.splats
    if splats is None:
        splats = _mesh_splats(deformable, splat_count)
    if splats is not None and offset.any():
        splats = splats.transformed(translation=-offset)
    return UsdBody(
        path=deformable.path,
        instance=-1,
        body=body,
        material=deformable.material(body.volume * deformable.scale**3, default),
        position=deformable.translation + deformable.scale * (deformable.rotation @ offset),
        rotation=deformable.rotation,
        scale=deformable.scale,
        splats=splats,
        notes=deformable.notes,
    )


def build_deformable(
    deformable: UsdDeformable,
    options: BuildOptions | None = None,
    *,
    surface_count: int = 400,
    progress: bool | Progress | None = None,
) -> ReducedBody:
    """Build the body of a deformable, or recall it from the cache.

    A closed Mesh, and the boundary of a TetMesh, are integrated as they are; a mesh that is not closed stands for what
    it encloses; Points with widths fill a body, those without lie on its surface; splats are filled.

    Args:
        deformable: From `read_usd_scene`.
        options: How it is reduced; defaults when None.
        surface_count: Number of surface samples.
        progress: Passed to :func:`softmode.deformables.build.build_body.build_body`.

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
            return quadrature_from_mesh(surface.vertices, surface.faces, surface_count=surface_count)
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
    # Particles that fill a body: round splats as wide as their radius. Half opaque at 1.18 of it, they close the gaps
    # between particles that touch, and the volume of a lattice of them comes out to 2 %.
    quats = np.tile([0.0, 0.0, 0.0, 1.0], (len(points), 1))
    return quadrature_from_splats(
        points, np.tile(radii[:, None], (1, 3)), quats, np.ones(len(points)), surface_count=surface_count
    )


def _mesh_splats(deformable: UsdDeformable, count: int) -> Splats | None:
    """Return splats on the meshes that show a body: its visible ones, else its simulation geometry's surface."""
    meshes = [mesh for mesh in (deformable.meshes or (deformable.surface,)) if mesh is not None and len(mesh.faces)]
    if not meshes:
        return None
    return sample_mesh(colored_mesh(meshes, deformable.path), count)
