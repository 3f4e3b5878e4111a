"""`RerunOptions`: what a recording for the rerun viewer holds."""

from __future__ import annotations

from dataclasses import dataclass

from softmode.checks import require_fields, require_number
from softmode.scenes.meshes import PLANE_EXTENT


@dataclass(frozen=True, kw_only=True)
class RerunOptions:
    """What a recording holds."""

    splats: bool = True
    """Splats of the soft bodies, with their colours from all around (degree 0)."""
    covariance_tolerance: float = 0.05
    """Scales and orientations of an object's splats are written anew once the covariance of one of them has changed by
    more than this, relative to itself (Frobenius norm); 0 writes every change. Centres are in every frame."""
    surface: bool = True
    """Surface samples as points; hidden in the saved layout."""
    contacts: bool = True
    """Forces of the soft bodies on rigid bodies and the world as arrows."""
    force_scale: float = 0.02
    """Length of an arrow per force [m/N]."""
    images: bool = True
    """Colour and depth of the cameras; draws those of an environment."""
    jpeg_quality: int | None = 90
    """Quality of colour pictures, 1..95; None writes them exactly."""
    world_spacing: float = 1.5
    """Distance of the worlds of a recording of several [m]."""
    plane_extent: float = PLANE_EXTENT
    """Edge of the quad that stands for an infinite plane [m]."""
    eye: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1.05, -0.4, 0.42), (0.34, -0.02, 0.19))
    """Where the saved layout looks from and at [m]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_fields(self, ("covariance_tolerance", "force_scale", "world_spacing"), at_least=0.0)
        if self.jpeg_quality is not None:
            require_number("jpeg_quality", self.jpeg_quality, at_least=1, at_most=95, hint="None writes exactly")
