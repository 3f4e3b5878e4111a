"""Which shapes of a Newton model soft bodies meet, and the tables that contact reads of them."""

from typing import Any

import newton
import numpy as np
import warp as wp
from newton import GeoType

from softmode.deformables.contact.detection_kernels import Shapes
from softmode.deformables.contact.shape_query_kernels import SUPPORTED_SHAPES, Heightfields
from softmode.deformables.model.layout import Layout
from softmode.deformables.model.tables import allocate, host
from softmode.errors import ConfigError

MESHES = (int(GeoType.MESH), int(GeoType.CONVEX_MESH))


def solid_shapes(model: newton.Model) -> np.ndarray:
    """Return which shapes collide with particles, shape (shape_count,).

    Raises:
        ConfigError: If one of them has a form whose distance cannot be queried, or a friction that is not >= 0.
    """
    flags, kinds, scale = host(model.shape_flags), host(model.shape_type), host(model.shape_scale)
    solid = (flags & int(newton.ShapeFlags.COLLIDE_PARTICLES)) != 0
    for shape in np.flatnonzero(solid & ~np.isin(kinds, SUPPORTED_SHAPES)):
        raise ConfigError(
            f"{_name(model, shape)} is a {GeoType(int(kinds[shape])).name.lower()}, which a soft body cannot touch",
            hint="put a mesh or primitives (newton.ModelBuilder.approximate_meshes makes convex parts) in its place, "
            "or clear its COLLIDE_PARTICLES flag (ShapeConfig.has_particle_collision)",
        )
    friction = host(model.shape_material_mu)
    for shape in np.flatnonzero(solid & ~((friction >= 0.0) & np.isfinite(friction))):
        raise ConfigError(
            f"{_name(model, shape)} has friction {friction[shape]:g}, expected a finite number >= 0",
            hint="give ShapeConfig(mu=...) a Coulomb coefficient; 0 is without friction",
        )
    barrels = (kinds == int(GeoType.CYLINDER)) & (scale[:, 2] > 0.0)
    for shape in np.flatnonzero(solid & barrels):
        raise ConfigError(
            f"{_name(model, shape)} is a cylinder with a barrel_radius of {scale[shape, 2]:g}, "
            "which a soft body cannot touch",
            hint="use a straight cylinder or a mesh",
        )
    uneven = np.ptp(np.abs(scale), axis=1) > 1e-5 * np.abs(scale).max(axis=1)
    for shape in np.flatnonzero(solid & np.isin(kinds, MESHES) & uneven):
        raise ConfigError(
            f"{_name(model, shape)} is a mesh scaled by {scale[shape]}, whose distances a soft body cannot query",
            hint="scale the vertices of the mesh instead",
        )
    return solid


def mesh_sources(model: newton.Model, solid: np.ndarray) -> tuple[wp.array, list[Any]]:
    """Return the Warp meshes that contact queries, and what keeps them alive.

    A convex mesh stands for its hull, as in Newton. Replicas share their mesh, which is looked at once.

    Args:
        model: The model.
        solid: Which shapes soft bodies meet, shape (shape_count,).

    Raises:
        ConfigError: If a triangle mesh is not closed: it has no inside, and thus no side to be pushed out at.
    """
    kinds, source = host(model.shape_type), host(model.shape_source_ptr)
    hulls: dict[int, Any] = {}
    closed: set[int] = set()
    for shape in np.flatnonzero(solid & (kinds == int(GeoType.CONVEX_MESH))):
        mesh: Any = model.shape_source[shape]
        if id(mesh) not in hulls:
            hulls[id(mesh)] = mesh.compute_convex_hull()
        source[shape] = hulls[id(mesh)].finalize(device=model.device)
    for shape in np.flatnonzero(solid & (kinds == int(GeoType.MESH))):
        mesh: Any = model.shape_source[shape]
        if id(mesh) not in closed and not is_closed(mesh.vertices, mesh.indices):
            raise ConfigError(
                f"{_name(model, shape)} is a triangle mesh that is not closed, so it has no inside",
                hint="close it (trimesh.repair.fill_holes, or give a sheet a thickness), take its hull "
                "(add_shape_convex_hull), use a plane or a heightfield for the ground, or clear its COLLIDE_PARTICLES "
                "flag (ShapeConfig.has_particle_collision)",
            )
        closed.add(id(mesh))
    return wp.array(source, dtype=wp.uint64, device=model.device), list(hulls.values())


def is_closed(vertices: np.ndarray, indices: np.ndarray) -> bool:
    """Return whether every edge of a triangle mesh is met by an even number of triangles: rays then count sides.

    Vertices that agree to 1e-6 of the mesh's size are one.

    Args:
        vertices: Shape (N, 3).
        indices: Three per triangle, flat or of shape (M, 3).
    """
    x = np.asarray(vertices, dtype=np.float64).reshape(-1, 3)
    faces = np.asarray(indices).reshape(-1, 3)
    if len(faces) == 0 or not np.isfinite(x).all():
        return False
    size = np.ptp(x, axis=0).max()
    merged = np.unique(np.round((x - x.min(axis=0)) / max(1e-6 * size, 1e-30)), axis=0, return_inverse=True)[1]
    corners = merged.reshape(-1)[faces]
    edges = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges = edges[edges[:, 0] != edges[:, 1]]
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    return len(counts) > 0 and bool((counts % 2 == 0).all())


def heightfields(model: newton.Model) -> Heightfields:
    """Copy the heightfields of a model into :class:`softmode.deformables.contact.shape_query_kernels.Heightfields`."""
    table = host(model.heightfield_data)
    given = {
        "index": model.shape_heightfield_index,
        "elevation": model.heightfield_elevations,
        "grid": np.stack([table[name] for name in ("data_offset", "nrow", "ncol")], axis=-1),
        "extent": np.stack([table[name] for name in ("hx", "hy", "min_z", "max_z")], axis=-1),
    }
    return allocate(Heightfields, "", {}, model.device, given=given)


def shape_table(model: newton.Model) -> tuple[Shapes, list[Any]]:
    """Return what contact reads of the model's shapes, and what keeps its meshes alive."""
    shapes, alive = Shapes(), []
    if model.shape_count:
        shapes.kind, shapes.scale = model.shape_type, model.shape_scale
        shapes.source, alive = mesh_sources(model, solid_shapes(model))
        shapes.margin, shapes.friction = model.shape_margin, model.shape_material_mu
        shapes.lower, shapes.upper = model.shape_collision_aabb_lower, model.shape_collision_aabb_upper
        shapes.body, shapes.transform = model.shape_body, model.shape_transform
        shapes.fields = heightfields(model)
    shapes.body_com, shapes.body_mass = model.body_com, model.body_mass
    return shapes, alive


def _name(model: newton.Model, shape: int | np.integer) -> str:
    """Return how to call a shape in a message."""
    return f"shape {shape} ({model.shape_label[shape]!r})"


def candidate_shapes(model: newton.Model, layout: Layout) -> np.ndarray:
    """List, per instance, the shapes of its world that collide with particles; -1 pads.

    Raises:
        ConfigError: If a shape cannot be touched.
    """
    instance_count, world_count = layout.instance_count, layout.world_count
    if model.shape_count == 0:
        return np.full((instance_count, 1), -1)
    worlds = host(model.shape_world)
    solid = solid_shapes(model)
    moving = solid & (host(model.shape_body) >= 0) & (worlds == -1)
    if world_count > 1 and moving.any():
        raise ConfigError(
            f"shape {np.flatnonzero(moving)[0]} belongs to a body outside all worlds; every world would push it",
            hint="add the body to the builder that is replicated",
        )
    lists = [np.flatnonzero(solid & ((worlds == -1) | (worlds == w))) for w in layout.instance_world]
    out = np.full((instance_count, max(max(map(len, lists)), 1)), -1)
    for i, shapes in enumerate(lists):
        out[i, : len(shapes)] = shapes
    return out
