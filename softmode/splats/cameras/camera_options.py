"""How a camera's scene is lit and drawn."""

import math
from dataclasses import dataclass, field

from softmode.checks import require_fields, require_number
from softmode.errors import ConfigError
from softmode.splats.raster.pinhole import Vector


@dataclass(frozen=True, kw_only=True)
class ShadowOptions:
    """How dark and how fine the shadow is."""

    strength: float = 1.0
    """How dark full shadow is: 1 as dark as the shadow of a mesh, 0 not at all."""
    cells: int = 40
    """Cells of the depth map along each side; more where small objects lie far apart."""
    margin: float = 1.6
    """Width of the map in units of the extent of the splats across the light, at least 1."""
    softness: float = 1.3
    """Half width of the blurred rim [cells]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        require_number("strength", self.strength, at_least=0.0, at_most=1.0)
        require_fields(self, ("cells", "margin"), at_least=1)
        require_number("softness", self.softness, at_least=0.0, at_most=8.0)


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """How the scene is lit and drawn."""

    sky: tuple[Vector, Vector] = ((0.93, 0.94, 0.95), (0.62, 0.72, 0.83))
    """Background at and below the horizon, and straight up; sRGB 0..1."""
    light_direction: Vector = (-0.25, 0.5, -1.0)
    """Direction in which the sunlight travels."""
    light_color: Vector = (0.72, 0.70, 0.66)
    """Linear radiance of the sunlight."""
    ambient: tuple[Vector, Vector] = ((0.30, 0.31, 0.34), (0.16, 0.15, 0.14))
    """Linear ambient radiance from above and from below."""
    shadows: bool = True
    """Meshes cast shadows on meshes."""
    splat_shadow: ShadowOptions | None = field(default_factory=ShadowOptions)
    """Shadow that the splats cast on the meshes; None for none."""
    mesh_samples: int = 1
    """Samples per pixel for the meshes: 1, or 4 for smooth edges."""
    segmentation: bool = False
    """Write which object or shape is seen."""

    def __post_init__(self) -> None:
        """Check the numbers."""
        colors = (*self.sky, self.light_color, *self.ambient)
        if not all(math.isfinite(x) and x >= 0.0 for color in colors for x in color):
            raise ConfigError(f"sky, light_color and ambient must be finite and >= 0, got {colors}")
        length = math.hypot(*self.light_direction)
        if not (math.isfinite(length) and length > 1e-6):
            raise ConfigError(f"light_direction {self.light_direction} has no direction", hint="Down is (0, 0, -1)")
        if self.mesh_samples not in (1, 4):
            raise ConfigError(f"mesh_samples is {self.mesh_samples}", hint="Take 1, or 4 for smooth edges of meshes")
