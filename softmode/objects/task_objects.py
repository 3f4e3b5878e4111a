"""Soft objects and materials that the tasks use: a beam, a cube, a pad to press, a rope.

Few functions, points and samples each, for training; `docs/objects.md` has what that costs in accuracy. The functions
are chosen by elastic energy, at the Poisson's ratio of the material.
"""

from softmode.deformables.materials.material import Material
from softmode.deformables.reduction.options import BuildOptions
from softmode.objects.config import ObjectConfig

BEAM = ObjectConfig(
    shape="box",
    extents=(0.30, 0.04, 0.04),
    surface_count=200,
    build=BuildOptions(function_count=30, poissons_ratio=0.3, cubature_count=256),
)
"""The beam of Isaac Lab's `Isaac-Lift-Soft-Franka`, lying along x."""
BEAM_MATERIAL = Material(youngs_modulus=2.0e5, poissons_ratio=0.3, density=1000.0)
"""Its material there."""

CUBE = ObjectConfig(
    shape="box",
    extents=(0.06, 0.06, 0.06),
    surface_count=200,
    build=BuildOptions(function_count=32, poissons_ratio=0.3, cubature_count=256),
)
"""A cube that fits between the fingers."""
CUBE_MATERIAL = Material(youngs_modulus=1.0e5, poissons_ratio=0.3, density=300.0)
"""Soft foam."""

PAD = ObjectConfig(
    shape="cylinder",
    extents=(0.10, 0.10, 0.03),
    surface_count=200,
    build=BuildOptions(function_count=32, poissons_ratio=0.4, cubature_count=256),
)
"""A flat disc to press on."""
PAD_MATERIAL = Material(youngs_modulus=5.0e4, poissons_ratio=0.4, density=500.0)
"""Soft foam rubber."""

ROPE = ObjectConfig(
    shape="capsule",
    extents=(0.40, 0.016, 0.016),
    surface_count=200,
    build=BuildOptions(function_count=48, poissons_ratio=0.3),
)
"""A rope along x, 8 mm in radius."""
ROPE_MATERIAL = Material(youngs_modulus=3.0e5, poissons_ratio=0.3, density=800.0)
"""Soft rubber: held in the middle, its ends hang down steeply."""
