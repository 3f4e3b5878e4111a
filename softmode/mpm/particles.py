"""ParticleBody: an object as particles of known mass, from shapes, meshes and reduced bodies (which splats become)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from softmode.checks import require_number
from softmode.deformables import Material, ReducedBody
from softmode.errors import AssetError, ConfigError, MaterialError
from softmode.mpm.particle_kernels import in_mesh

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class ParticleBody:
    """Particles that fill an object."""

    positions: Array
    """Rest positions [m], shape (N, 3)."""
    masses: Array
    """Masses [kg], shape (N,)."""
    material: Material = field(default_factory=Material)
    """Energy, Young's modulus and Poisson's ratio; density is in the masses, viscosity is not used."""
    yield_stress: float | None = None
    """Kirchhoff stress, J times that of Cauchy, at which a bar that is pulled begins to flow [Pa]: von Mises plasticity
    without hardening, which keeps volume. None is elastic."""

    def __post_init__(self) -> None:
        """Check shapes and values."""
        if self.positions.ndim != 2 or self.positions.shape[1] != 3 or not len(self.positions):
            raise AssetError(f"positions: expected shape (N, 3) with N > 0, got {self.positions.shape}")
        if self.masses.shape != (len(self.positions),):
            raise AssetError(f"masses: expected shape ({len(self.positions)},), got {self.masses.shape}")
        if not np.isfinite(self.positions).all():
            raise AssetError("positions: expected finite coordinates")
        if not (np.isfinite(self.masses).all() and (self.masses > 0.0).all()):
            raise AssetError("masses: expected finite values > 0")
        if self.yield_stress is not None:
            hint = "give it in Pa, or None for an elastic body"
            require_number("yield_stress", self.yield_stress, above=0.0, unit="Pa", hint=hint, error=MaterialError)

    @property
    def count(self) -> int:
        """Number of particles."""
        return len(self.positions)

    @property
    def mass(self) -> float:
        """Total mass [kg]."""
        return float(self.masses.sum())

    @property
    def centre(self) -> Array:
        """Centre of mass [m], shape (3,)."""
        return np.asarray(self.masses @ self.positions / self.masses.sum())

    def moved(self, offset: ArrayLike, scale: float = 1.0) -> ParticleBody:
        """Return the body scaled about the origin, then moved; masses stay.

        Args:
            offset: By how much [m], shape (3,).
            scale: Factor of all lengths.
        """
        return replace(self, positions=self.positions * scale + np.asarray(offset, dtype=np.float64))


def particles_from_shape(
    inside: Callable[[Array], ArrayLike],
    bounds: ArrayLike,
    *,
    spacing: float,
    material: Material | None = None,
    volume: float | None = None,
) -> ParticleBody:
    """Fill a shape with a lattice that begins at the lower corner of its bounds.

    Args:
        inside: Which of points (M, 3) [m] lie inside, shape (M,).
        bounds: Lower and upper corner [m], shape (2, 3).
        spacing: Distance h between particles [m].
        material: What it is made of.
        volume: The shape's volume V [m^3]: then masses sum to density x V; None takes density x h^3 for a particle.

    Raises:
        AssetError: If no lattice point lies inside.
        ConfigError: If the spacing or the bounds are out of range.
    """
    require_number("spacing", spacing, above=0.0, unit="m")
    low, high = np.asarray(bounds, dtype=np.float64)
    if not (np.isfinite([low, high]).all() and (high > low).all()):
        raise ConfigError(f"bounds: expected a finite lower and upper corner, got {low} and {high}")
    axes = [np.arange(a, b + 1e-9 * spacing, spacing) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    found = points[np.asarray(inside(points), dtype=bool)]
    if not len(found):
        raise AssetError("shape: no particle lies inside", hint="make the spacing smaller or check the bounds")
    made = material or Material()
    total = spacing**3 * len(found) if volume is None else volume
    return ParticleBody(positions=found, masses=np.full(len(found), made.density * total / len(found)), material=made)


def particles_from_mesh(
    vertices: ArrayLike, faces: ArrayLike, *, spacing: float, material: Material | None = None, exact: bool = True
) -> ParticleBody:
    """Fill a closed triangle mesh with a lattice that begins at the lower corner of its bounds.

    Args:
        vertices: Vertex positions [m], shape (V, 3).
        faces: Vertex indices of the triangles, shape (T, 3).
        spacing: Distance h between particles [m].
        material: What it is made of.
        exact: Whether masses sum to density x the mesh's volume; otherwise a particle has density x h^3.

    Raises:
        AssetError: If the mesh is empty, not finite, or holds no particle.
        ConfigError: If the spacing is out of range.
    """
    vertex, face = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
    if vertex.ndim != 2 or vertex.shape[1:] != (3,) or face.ndim != 2 or face.shape[1:] != (3,) or not len(face):
        raise AssetError(f"mesh: expected vertices (V, 3) and faces (T, 3), got {vertex.shape} and {face.shape}")
    if not np.isfinite(vertex).all() or face.min() < 0 or face.max() >= len(vertex):
        raise AssetError("mesh: vertices are not finite or faces name missing ones")
    corner = vertex[face]
    volume = float(np.einsum("ti,ti->", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))) / 6.0
    if not abs(volume) > 1e-9 * float(np.prod(np.ptp(vertex, axis=0))):
        raise AssetError("mesh: encloses no volume", hint="close or thicken the mesh")
    offset = vertex.mean(axis=0)
    mesh = wp.Mesh(
        wp.array((vertex - offset).astype(np.float32), dtype=wp.vec3, device="cpu"),
        wp.array(face.astype(np.int32).ravel(), dtype=int, device="cpu"),
        support_winding_number=True,
    )

    def inside(points: Array) -> NDArray[np.bool_]:
        """Ask for the winding number."""
        found = wp.zeros(len(points), dtype=wp.bool, device="cpu")
        at = wp.array((points - offset).astype(np.float32), dtype=wp.vec3, device="cpu")
        wp.launch(in_mesh, len(points), inputs=[mesh.id, at], outputs=[found], device="cpu")
        return np.asarray(found.numpy(), dtype=bool)

    bounds = np.stack([vertex.min(axis=0), vertex.max(axis=0)])
    return particles_from_shape(
        inside, bounds, spacing=spacing, material=material, volume=abs(volume) if exact else None
    )


def particles_from_body(
    body: ReducedBody, *, spacing: float | None = None, material: Material | None = None
) -> ParticleBody:
    """Return a body's quadrature points as particles, or fill its closed surface samples with a lattice; body frame.

    Args:
        body: A reduced body; inside is where its surface samples say so.
        spacing: Distance between the particles of the lattice [m]. None takes the points that the body was built from,
            each with its own volume: masses sum to density x the volume of the quadrature.
        material: What it is made of.

    Raises:
        AssetError: If no particle lies inside.
        ConfigError: If the body does not keep its quadrature points, or their material varies.
    """
    made = material or Material()
    if spacing is None:
        from softmode.deformables.reduction.sources import FIELDS, unpack_sources

        sources = unpack_sources(body)
        if any(getattr(sources, name) is not None for name in FIELDS):
            raise ConfigError(
                f"body {body.name!r}: its material varies, particles of a body have one material",
                hint="give a spacing, or build the body without fields",
            )
        points, volumes = sources.quadrature.points - body.offset, sources.quadrature.weights
        return ParticleBody(positions=points, masses=made.density * volumes, material=made)
    from softmode.deformables.quadrature.interior import winding_numbers

    surface = (body.surface.points, body.surface.normals, body.surface.areas)
    return particles_from_shape(
        lambda points: winding_numbers(points, *surface) > 0.5,
        body.bounds,
        spacing=spacing,
        material=made,
        volume=body.volume,
    )
