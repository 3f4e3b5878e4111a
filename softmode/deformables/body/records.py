"""Records of a reduced body: its cubature, its surface, its regions.

Its kernels and its handles are records of their own files, `BasisRKPM` or `BasisQGMLS` and `SkinningWeights`.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from softmode.deformables.body.regions import Envelope, Region
from softmode.errors import ConfigError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class BodyCubature:
    """Points at which elastic energy is summed, with what it takes there."""

    points: Array
    """Positions [m], shape (P, 3)."""
    weights: Array
    """Their volumes [m^3], > 0, sum = the body's volume, shape (P,)."""
    grad_basis: NDArray[np.float32]
    """Gradients of the functions at the points [1/m], shape (P, n, 3), float32."""
    stiffness_scale: Array
    """Shear modulus relative to the body's, shape (P,); Young's modulus too where Poisson's ratio does not vary."""
    lame_ratio: Array = field(default_factory=lambda: np.zeros(0))
    """lambda / mu relative to the body's, shape (P,); empty where Poisson's ratio does not vary."""

    def moduli(self, youngs_modulus: float, poissons_ratio: float) -> tuple[Array, Array]:
        """Return Young's modulus [Pa] and Poisson's ratio at the points, (P,), of a body with these: 0 < nu < 0.5."""
        if not len(self.lame_ratio):
            return youngs_modulus * self.stiffness_scale, np.full(len(self.points), poissons_ratio)
        half = self.lame_ratio * poissons_ratio / (1.0 - 2.0 * poissons_ratio)
        nu = half / (1.0 + 2.0 * half)
        return youngs_modulus * self.stiffness_scale * (1.0 + nu) / (1.0 + poissons_ratio), nu


@dataclass(frozen=True, kw_only=True)
class BodySurface:
    """Samples of the surface, which contact and pressure act on."""

    points: Array
    """Positions [m], shape (S, 3)."""
    normals: Array
    """Outward unit normals, shape (S, 3)."""
    areas: Array
    """Areas [m^2], sum = surface area, shape (S,)."""
    basis: NDArray[np.float32]
    """Functions at the samples, shape (S, n), float32."""


@dataclass(frozen=True, kw_only=True)
class BodyRegions:
    """Regions that were known when the body was built, and what drives them."""

    parts: tuple[Region, ...]
    """The regions, R of them, in the body frame."""
    points: Array
    """Points that sample them [m], shape (N, 3)."""
    index: Indices
    """Region of each of these points, int64, shape (N,)."""
    weights: Array
    """Their volumes [m^3], of soft regions times relative Young's modulus; corners of exact ones have none; (N,)."""
    drive: Array
    """q[:r] = drive @ u for displacements u of the points: least squares, shape (r, N)."""
    drive_affine: Array
    """q[:r] = sum_i drive_affine[i] @ vstack([(A_i - I)^T, t_i]) for regions moved by x = A_i X + t_i, (R, r, 4)."""
    envelope_length: float = 0.0
    """Distance from exact regions at which the envelope of the functions is one [m]; 0 without such regions, and in
    files of versions 2 and 3, whose envelope is d / (d + the body's `length`)."""
    gap_blends: bool = True
    """Whether blends between exact regions change over the whole gap; in files before version 5 they do not."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the regions."""
        return tuple(region.name for region in self.parts)

    @property
    def stiffness(self) -> Array:
        """Stiffness kappa / E [1/m^2] of soft regions, 0 for exact ones, shape (R,)."""
        return np.array([region.stiffness or 0.0 for region in self.parts], dtype=np.float64)

    def envelope(self, length: float) -> Envelope | None:
        """Return what makes the functions vanish on exact regions, or None without any.

        Args:
            length: The body's unit of length [m], for files of versions 2 and 3.
        """
        exact = tuple(region for region in self.parts if region.stiffness is None)
        if not exact:
            return None
        return Envelope(exact, self.envelope_length or length, not self.envelope_length, self.gap_blends)

    def rows(self, name: str) -> NDArray[np.intp]:
        """Return which points sample a region.

        Raises:
            ConfigError: If the body has no region of that name.
        """
        if name not in self.names:
            raise ConfigError(f"name: expected one of {self.names}, got {name!r}")
        return np.flatnonzero(self.index == self.names.index(name))

    def driven_coordinates(self, displacements: ArrayLike) -> Array:
        """Return the driven coordinates (r, 3) [m] nearest to displacements (N, 3) [m] of the points."""
        u = np.asarray(displacements, dtype=np.float64)
        if u.shape != self.points.shape:
            raise ConfigError(f"displacements: expected shape {self.points.shape}, got {u.shape}")
        return self.drive @ u

    def driven_affine(self, matrices: ArrayLike, translations: ArrayLike) -> Array:
        """Return the driven coordinates (r, 3) [m] of regions moved by x = A X + t, each its own, body frame.

        Args:
            matrices: A of every region, shape (R, 3, 3); those of soft regions are not used.
            translations: t of every region [m], shape (R, 3).
        """
        a, t = np.asarray(matrices, dtype=np.float64), np.asarray(translations, dtype=np.float64)
        count = len(self.parts)
        if a.shape != (count, 3, 3) or t.shape != (count, 3):
            raise ConfigError(f"matrices ({count}, 3, 3), translations ({count}, 3): got {a.shape} and {t.shape}")
        motion = np.concatenate([(a - np.eye(3)).transpose(0, 2, 1), t[:, None]], axis=1)
        return np.einsum("irk,ikc->rc", self.drive_affine, motion)
