"""`add_usd`: robots, props and soft bodies of an OpenUSD stage into a Newton builder."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import newton
import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.reduced_body import ReducedBody
from softmode.deformables.materials.material import Material
from softmode.deformables.model.authoring import rotation_matrix
from softmode.deformables.quadrature.surface_samples import SURFACE_COUNT
from softmode.deformables.reduction.options import BuildOptions
from softmode.errors import AssetError, ConfigError, SoftmodeError
from softmode.objects.loader import Progress
from softmode.objects.placed import Placed
from softmode.objects.stage.scene import UsdScene, open_scene
from softmode.objects.stage_body import place_deformable
from softmode.splats.splats import quats_from_rotations

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class UsdImport:
    """What `add_usd` added."""

    bodies: dict[str, Placed]
    """Soft bodies by prim path, in the order of the stage; those of equal shape share a `ReducedBody`."""
    instances: dict[str, int]
    """Index of each in the builder by prim path, for `add_pins`, `attach`, and parameters of one world."""
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
    only: str | Sequence[str] | None = None,
    skip: str | Sequence[str] = (),
    asset_root: str | os.PathLike[str] | None = None,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    rotation: ArrayLike | None = None,
    build_options: BuildOptions | None = None,
    material: Material | None = None,
    surface_count: int = SURFACE_COUNT,
    splat_count: int = 2000,
    contact_radius: float = 0.0,
    newton_options: dict[str, Any] | None = None,
    progress: Progress = None,
) -> UsdImport:
    """Add everything in an OpenUSD stage to a world: soft bodies as reduced bodies, the rest through Newton's importer.

    The file is opened in a process of its own, which sends the soft bodies as arrays and writes the rest as one checked
    crate; Newton's importer reads that. Bodies are built once and kept in the cache. One that softmode wrote comes back
    as it was; it is not built again. Gravity of the stage, if it has a `PhysicsScene`, becomes the builder's, turned as
    the stage is.

    Args:
        builder: Builder of the world, Z up; it may be replicated afterwards.
        path: A `.usd`, `.usda`, `.usdc` or `.usdz` file.
        only: Paths of the deformables that softmode takes, or patterns as `fnmatch` has them; what lies beneath a path
            belongs to it. None for every one that is a soft solid: cables, cloth (a surface deformable that is not
            closed) and points of an MPM scene are left to Newton's importer. What is named here is taken as a solid.
        skip: Paths or patterns of deformables that are left to Newton's importer. To have one left out altogether, name
            it in ``newton_options={"ignore_paths": [...]}`` too.
        asset_root: Folder that holds whatever the stage may read; None for the file's own.
        position: Where the origin of the stage comes to lie [m].
        rotation: How the stage is turned, shape (3, 3); not at all when None.
        build_options: How bodies are reduced; defaults when None.
        material: Properties that the stage does not give; ``Material()`` when None.
        surface_count: Number of surface samples of each body.
        splat_count: Number of splats on a body that the stage shows by meshes.
        contact_radius: How far the surface that touches stands out from the body's [m].
        newton_options: Arguments for `newton.ModelBuilder.add_usd`, such as ``{"floating": False}``.
        progress: Passed to :func:`softmode.deformables.reduction.build_body.build_body`.

    Returns:
        The soft bodies by prim path and what Newton's importer says of the rest.

    Raises:
        AssetError: If the file is damaged, refers out of the root, a body encloses no volume, or ``only`` or ``skip``
            match no deformable.
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
        chosen = {"only": _patterns(only), "skip": _patterns(skip) or []}
        scene = open_scene(path, asset_root, folder, copy=True, **chosen)
        # All bodies are built before anything is added: one that cannot be leaves the builder as it was.
        ready = {
            deformable.path: place_deformable(
                deformable,
                build_options,
                material=material,
                surface_count=surface_count,
                splat_count=splat_count,
                contact_radius=contact_radius,
                progress=progress,
            )
            for deformable in scene.deformables
        }
        options["xform"] = wp.transform(wp.vec3(*shift), wp.quat(*quats_from_rotations(turn)))
        rest = _add_rest(builder, os.path.join(folder, "rest.usdc"), str(path), options)
    bodies = {path: _moved(placed, turn, shift) for path, placed in ready.items()}
    instances = {path: placed.add_to(builder) for path, placed in bodies.items()}
    return UsdImport(bodies=bodies, instances=instances, scene=scene, newton=rest)


def _patterns(given: str | Sequence[str] | None) -> list[str] | None:
    """Return patterns as a list."""
    return None if given is None else [given] if isinstance(given, str) else list(given)


def _moved(placed: Placed, turn: Array, shift: Array) -> Placed:
    """Return an object after the stage has been turned (3, 3) and shifted (3,) [m]."""
    x, y, z = (turn @ placed.position + shift).tolist()
    return replace(placed, position=(x, y, z), rotation=turn @ placed.rotation)


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
    except (TypeError, ValueError, RuntimeError, KeyError, IndexError, AttributeError, ArithmeticError) as error:
        if isinstance(error, TypeError) and "unexpected keyword" in str(error):
            raise ConfigError(f"newton_options: {error}", hint="see newton.ModelBuilder.add_usd") from error
        raise AssetError(f"OpenUSD file {name}: Newton cannot import it ({error})", hint=_NEWTON_HINT) from error


_NEWTON_HINT = "Mend the rigid part of the stage, or read the soft bodies alone with read_usd_scene"
