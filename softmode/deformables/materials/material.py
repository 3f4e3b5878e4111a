"""Hyperelastic materials: energy density, first Piola-Kirchhoff stress and projected Hessian, per point.

Every material is isotropic; F is the deformation gradient, J = det F, I_C = |F|^2, E = (F^T F - I)/2, and F = R S is
its polar decomposition with the rotation R nearest to F. Lame's parameters are mu = Y / (2 (1 + nu)) and lambda = Y nu
/ ((1 + nu) (1 - 2 nu)) with Young's modulus Y and Poisson's ratio nu. All agree with Hooke's law mu |e|^2 + lambda/2
tr(e)^2 to second order in the small strain e (ARAP with lambda = 0).

====================== =============================================================================== ================
model                  energy density                                                                  domain
====================== =============================================================================== ================
STABLE_NEO_HOOKEAN_LOG m/2 (I_C - 3) + l/2 [(J - a)^2 - (1 - a)^2] - m/2 ln((I_C + 1)/4), m = 4/3 mu,  all F
                       l = lambda + 5/6 mu, a = 1 + m/l - m/(4 l). Smith, de Goes, Kim 2018,
                       doi:10.1145/3180491, eq. (14)
STABLE_NEO_HOOKEAN     mu/2 (I_C - 3) + (lambda+mu)/2 [(J - g)^2 - (1 - g)^2], g = 1 + mu/(lambda+mu). all F, but stays
                       FreeForm's eq. (16) with the factor 1/2 on mu that its eq. (26) needs           at a point
ARAP                   mu |F - R|^2                                                                    all F
COROTATED              mu |F - R|^2 + lambda/2 (J - 1)^2. Stomakhin et al. 2012,                       all F
                       doi:10.2312/SCA/SCA12/025-032
STVK                   mu E : E + lambda/2 tr(E)^2                                                     all F, soft below
                                                                                                       0.58 of length
NEO_HOOKEAN            mu/2 (I_C - 3) - mu ln J + lambda/2 ln(J)^2. Bonet and Wood 2008, eq. (6.28)    J > 0
====================== =============================================================================== ================

When to use which:

- STABLE_NEO_HOOKEAN_LOG, the default: rubber, flesh, foam under any load; keeps its volume as nu says, and comes back
  from flat, mirrored and point-like states.
- STABLE_NEO_HOOKEAN: parity with published results. F = 0 is a strict local minimum of it.
- ARAP: parity with shape-editing methods. It has no resistance to a change of volume: pressed to 60 % of its height
  between frictionless plates it keeps 60 % of its volume, where a Neo-Hookean with nu = 0.45 keeps 93 %.
- COROTATED: stress linear in the stretch; the usual choice of material point methods and of control.
- STVK: large rotations with small strains, as in plates and rods. In compression its force falls off from a stretch of
  1/sqrt(3) on, and a flat body has no stress at all.
- NEO_HOOKEAN: parity with finite-element codes that use ln J. Energy is infinite at J <= 0, which the line search never
  accepts; stress and Hessian there are finite, but the state must start with J > 0 everywhere.

Damping. The Kelvin-Voigt stress tau C : dE/dt with C Hooke's tensor (2 mu e + lambda tr(e) I) is Rayleigh's stiffness
damping beta K in a form that does not see rotations: with beta = ``viscosity`` and alpha = ``mass_damping`` a mode of
angular frequency omega of the body at rest has the damping ratio zeta = alpha / (2 omega) + beta omega / 2.
"""

import math
import warnings
from dataclasses import dataclass

from softmode.checks import require_fields, require_number
from softmode.deformables.materials.material_kernels import MaterialModel
from softmode.deformables.materials.paths import require_models
from softmode.errors import MaterialError


@dataclass(frozen=True, kw_only=True)
class Material:
    """Elastic and dissipative properties of one body.

    Raises:
        MaterialError: If a value lies outside its admissible range, or code that evaluates it does not know the model.
    """

    youngs_modulus: float = 1.0e5
    """E [Pa], > 0."""
    poissons_ratio: float = 0.4
    """nu, in (-1, 0.5)."""
    density: float = 300.0
    """rho [kg/m^3], > 0."""
    viscosity: float = 0.002
    """Relaxation time tau [s], >= 0, of the Kelvin-Voigt stress tau (2 mu dE/dt + lambda tr(dE/dt) I), E the Green
    strain: Rayleigh's stiffness coefficient beta. Damps every deformation, and neither translation nor rotation."""
    mass_damping: float = 0.0
    """Rayleigh's mass coefficient alpha [1/s], >= 0: damps rigid motion too, as if in a thick fluid."""
    friction: float = 0.8
    """Coulomb coefficient of the surface, >= 0; a contact uses sqrt(friction of body * friction of shape)."""
    model: MaterialModel = MaterialModel.STABLE_NEO_HOOKEAN_LOG
    """The energy density."""

    def __post_init__(self) -> None:
        """Check every range."""
        require_fields(self, ("youngs_modulus", "density"), above=0.0, hint="give it in SI units", error=MaterialError)
        hint = "use 0.49 for a nearly incompressible material"
        require_number("poissons_ratio", self.poissons_ratio, above=-1.0, below=0.5, hint=hint, error=MaterialError)
        rates = ("viscosity", "mass_damping", "friction")
        require_fields(self, rates, at_least=0.0, hint="use 0 to switch it off", error=MaterialError)
        require_models([self.model])


_USUAL = {
    "youngs_modulus": (1.0e2, 1.0e11, "Pa", 1.0e6, {"kPa": 1.0e3, "MPa": 1.0e6, "GPa": 1.0e9, "dyn/cm^2": 0.1}),
    "density": (5.0, 3.0e4, "kg/m^3", 1.0e3, {"g/cm^3": 1.0e3, "kg/mm^3": 1.0e9, "t/mm^3": 1.0e12, "g/m^3": 1.0e-3}),
}
"""Least and largest usual value, unit and typical value of a property, and how many units others are."""


def warn_of_units(material: Material, name: str) -> None:
    """Warn if Young's modulus or density is that of no solid, with the unit that it was likely meant in.

    Args:
        material: What something is made of.
        name: That something.
    """
    for field, (low, high, unit, typical, others) in _USUAL.items():
        value = getattr(material, field)
        if not low <= value <= high:
            likely = min(others, key=lambda other: abs(math.log10(value * others[other] / typical)))
            told = f"{name}: {field} is {value:g} {unit}, outside {low:g}..{high:g}"
            warnings.warn(f"{told}; if it is in {likely}, give {value * others[likely]:g}", stacklevel=3)
