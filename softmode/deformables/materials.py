"""Hyperelastic materials: energy density, first Piola-Kirchhoff stress and projected Hessian, per point.

Each material is isotropic and a function of I_C = |F|^2 and J = det F. Lame's parameters are mu = E / (2 (1 + nu)) and
lambda = E nu / ((1 + nu) (1 - 2 nu)); every material agrees with Hooke's law to first order at F = I.

=====================  ==============================================================================================
stable_neo_hookean     mu/2 (I_C - 3) + (lambda+mu)/2 [(J - g)^2 - (1 - g)^2],  g = 1 + mu/(lambda+mu). FreeForm's
                       eq. (16) with the factor 1/2 on mu that its eq. (26) needs. F = 0 is a strict local minimum: a
                       body squeezed to a point stays there. Kept for parity with published results.
stable_neo_hookean_log m/2 (I_C - 3) + l/2 [(J - a)^2 - (1 - a)^2] - m/2 ln((I_C + 1)/4),  m = 4/3 mu,
                       l = lambda + 5/6 mu, a = 1 + m/l - m/(4 l). Smith, de Goes, Kim 2018, doi:10.1145/3180491: the
                       logarithm is the origin term that removes that minimum. The default.
=====================  ==============================================================================================

Both extend over inverted elements (J <= 0), so no line search has to guard the domain.
"""

from dataclasses import dataclass
from enum import IntEnum

import warp as wp

from softmode.errors import MaterialError

wp.set_module_options({"enable_backward": False})


class MaterialModel(IntEnum):
    """The energy density of a body."""

    STABLE_NEO_HOOKEAN_LOG = 0
    STABLE_NEO_HOOKEAN = 1


@dataclass(frozen=True, kw_only=True)
class Material:
    """Elastic and dissipative properties of one body.

    Raises:
        MaterialError: If a value lies outside its admissible range.
    """

    youngs_modulus: float = 1.0e5
    """E [Pa], > 0."""
    poissons_ratio: float = 0.4
    """nu, in (-1, 0.5)."""
    density: float = 300.0
    """rho [kg/m^3], > 0."""
    viscosity: float = 0.002
    """Relaxation time tau [s], >= 0, of the Kelvin-Voigt stress 2 mu tau dE/dt (E the Green strain): damps every
    deformation, and neither translation nor rotation."""
    mass_damping: float = 0.0
    """Rayleigh's mass coefficient alpha [1/s], >= 0: damps rigid motion too, as if in a thick fluid."""
    friction: float = 0.8
    """Coulomb coefficient of the surface, >= 0; a contact uses sqrt(friction of body * friction of shape)."""
    model: MaterialModel = MaterialModel.STABLE_NEO_HOOKEAN_LOG
    """The energy density."""

    def __post_init__(self) -> None:
        """Check every range."""
        for name in ("youngs_modulus", "density"):
            value = getattr(self, name)
            if not 0.0 < value < float("inf"):
                raise MaterialError(
                    f"{name} must be a finite number > 0, got {value!r}", hint=f"give {name} in SI units"
                )
        if not -1.0 < self.poissons_ratio < 0.5:
            raise MaterialError(
                f"poissons_ratio must lie in (-1, 0.5), got {self.poissons_ratio!r}",
                hint="use 0.49 for a nearly incompressible material",
            )
        for name in ("viscosity", "mass_damping", "friction"):
            value = getattr(self, name)
            if not 0.0 <= value < float("inf"):
                raise MaterialError(
                    f"{name} must be a finite number >= 0, got {value!r}", hint="use 0 to switch it off"
                )


@wp.struct
class MaterialParameters:
    """Material of one instance as the kernels read it."""

    model: int
    mu: wp.float64  # [Pa]
    lam: wp.float64  # [Pa]
    viscosity: wp.float64  # [s]


@wp.func
def lame(youngs_modulus: float, poissons_ratio: float):
    """Return Lame's parameters (mu, lambda) [Pa]."""
    e = wp.float64(youngs_modulus)
    nu = wp.float64(poissons_ratio)
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    return e / (two * (one + nu)), e * nu / ((one + nu) * (one - two * nu))


@wp.func
def cofactor(F: wp.mat33d):
    """Return cof F = dJ/dF = J F^-T, also for singular F."""
    return wp.mat33d(
        F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1],
        F[1, 2] * F[2, 0] - F[1, 0] * F[2, 2],
        F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0],
        F[0, 2] * F[2, 1] - F[0, 1] * F[2, 2],
        F[0, 0] * F[2, 2] - F[0, 2] * F[2, 0],
        F[0, 1] * F[2, 0] - F[0, 0] * F[2, 1],
        F[0, 1] * F[1, 2] - F[0, 2] * F[1, 1],
        F[0, 2] * F[1, 0] - F[0, 0] * F[1, 2],
        F[0, 0] * F[1, 1] - F[0, 1] * F[1, 0],
    )


@wp.func
def log_of_one_plus(x: wp.float64):
    """Return ln(1 + x) to full relative precision (Kahan's form)."""
    u = wp.float64(1.0) + x
    if u == wp.float64(1.0):
        return x
    return wp.log(u) * x / (u - wp.float64(1.0))


@wp.func
def invariant_derivatives(material: MaterialParameters, strain: wp.float64, j1: wp.float64):
    """Return psi and the coefficients (s, b, p, l) of its derivatives with respect to I_C and J.

    ``strain`` is I_C - 3 and ``j1`` is J - 1, both formed without cancellation. Stress: P = s F + p cof F. Hessian:
    s I + b f f^T + l g g^T + p dcof/dF with f = vec F, g = vec cof F.
    """
    half = wp.float64(0.5)
    one = wp.float64(1.0)
    if material.model == int(MaterialModel.STABLE_NEO_HOOKEAN):
        l = material.lam + material.mu
        # l/2 [(J - g)^2 - (1 - g)^2] = l/2 (J - 1)^2 - mu (J - 1)
        psi = half * material.mu * strain + half * l * j1 * j1 - material.mu * j1
        return psi, material.mu, wp.float64(0.0), l * j1 - material.mu, l
    m = wp.float64(4.0) / wp.float64(3.0) * material.mu
    l = material.lam + wp.float64(5.0) / wp.float64(6.0) * material.mu
    c = strain + wp.float64(4.0)  # I_C + 1
    slope = wp.float64(0.75) * m  # l (a - 1)
    psi = half * m * (strain - log_of_one_plus(strain / wp.float64(4.0))) + half * l * j1 * j1 - slope * j1
    return psi, m * (one - one / c), wp.float64(2.0) * m / (c * c), l * j1 - slope, l


@wp.func
def determinant_minus_one(G: wp.mat33d):
    """Return det(I + G) - 1 without the cancellation of 1 + small - 1."""
    minors = (
        G[0, 0] * G[1, 1]
        - G[0, 1] * G[1, 0]
        + G[1, 1] * G[2, 2]
        - G[1, 2] * G[2, 1]
        + G[0, 0] * G[2, 2]
        - G[0, 2] * G[2, 0]
    )
    return wp.trace(G) + minors + wp.determinant(G)


@wp.func
def strain_measure(G: wp.mat33d):
    """Return I_C - 3 of F = I + G without cancellation."""
    return wp.float64(2.0) * wp.trace(G) + wp.ddot(G, G)


@wp.func
def green_strain(G: wp.mat33d):
    """Return the Green strain (F^T F - I) / 2 of F = I + G."""
    return wp.float64(0.5) * (G + wp.transpose(G) + wp.transpose(G) * G)


@wp.func
def energy(material: MaterialParameters, G: wp.mat33d, G_start: wp.mat33d, dt: wp.float64):
    """Return the elastic energy density plus the step's dissipation potential [J/m^3] at F = I + G.

    Args:
        material: Parameters of the material.
        G: Displacement gradient at the end of the step.
        G_start: Displacement gradient at its start.
        dt: Duration of the step [s].
    """
    psi, _s, _b, _p, _l = invariant_derivatives(material, strain_measure(G), determinant_minus_one(G))
    rate = green_strain(G) - green_strain(G_start)
    return psi + material.mu * material.viscosity / dt * wp.ddot(rate, rate)


@wp.func
def stress(material: MaterialParameters, G: wp.mat33d, G_start: wp.mat33d, dt: wp.float64):
    """Return the first Piola-Kirchhoff stress [Pa], the derivative of :func:`energy` with respect to F."""
    F = wp.identity(n=3, dtype=wp.float64) + G
    _psi, s, _b, p, _l = invariant_derivatives(material, strain_measure(G), determinant_minus_one(G))
    rate = green_strain(G) - green_strain(G_start)
    viscous = wp.float64(2.0) * material.mu * material.viscosity / dt
    return s * F + p * cofactor(F) + viscous * (F * rate)


HessianBlocks = wp.types.matrix(shape=(18, 3), dtype=float)
"""The blocks C_cd (3x3, over the columns of F) of a symmetric 9x9 Hessian for (c, d) = 00, 01, 02, 11, 12, 22."""


@wp.func
def add_outer(C: HessianBlocks, weight: float, A: wp.mat33):
    """Return C + weight vec(A) vec(A)^T."""
    row = int(0)
    for c in range(3):
        for d in range(c, 3):
            for a in range(3):
                for b in range(3):
                    C[3 * row + a, b] += weight * A[c, a] * A[d, b]
            row += 1
    return C


@wp.func
def hessian(material: MaterialParameters, G: wp.mat33d, dt: wp.float64):
    """Return the Hessian of :func:`energy` [Pa], projected to positive semidefinite.

    With F = U diag(sigma) V^T the Hessian splits into three twists, three flips and a 3x3 block of scalings
    (Smith, de Goes, Kim 2019, doi:10.1145/3241041); negative eigenvalues are set to zero. The viscous part keeps its
    Gauss-Newton term. The direction needs no more than float32: energy and stress decide the answer in float64.
    """
    F = wp.mat33(wp.identity(n=3, dtype=wp.float64) + G)
    _psi, s64, b64, p64, l64 = invariant_derivatives(material, strain_measure(G), determinant_minus_one(G))
    s = float(s64)
    b = float(b64)
    p = float(p64)
    l = float(l64)
    C = HessianBlocks()

    U, sigma, V = wp.svd3(F)
    root = float(0.70710678)
    for k in range(3):
        i = (k + 1) % 3
        j = (k + 2) % 3
        ui = wp.vec3(U[0, i], U[1, i], U[2, i])
        uj = wp.vec3(U[0, j], U[1, j], U[2, j])
        vi = wp.vec3(V[0, i], V[1, i], V[2, i])
        vj = wp.vec3(V[0, j], V[1, j], V[2, j])
        A = root * wp.outer(ui, vj)
        B = root * wp.outer(uj, vi)
        C = add_outer(C, wp.max(s + p * sigma[k], 0.0), A - B)  # twist
        C = add_outer(C, wp.max(s - p * sigma[k], 0.0), A + B)  # flip

    g = wp.vec3(sigma[1] * sigma[2], sigma[2] * sigma[0], sigma[0] * sigma[1])
    S = b * wp.outer(sigma, sigma) + l * wp.outer(g, g) + s * wp.identity(n=3, dtype=float)
    S += p * wp.mat33(0.0, sigma[2], sigma[1], sigma[2], 0.0, sigma[0], sigma[1], sigma[0], 0.0)
    Q, eigenvalues = wp.eig3(S)
    for m in range(3):
        direction = wp.vec3(Q[0, m], Q[1, m], Q[2, m])
        C = add_outer(C, wp.max(eigenvalues[m], 0.0), U * wp.diag(direction) * wp.transpose(V))

    viscous = float(material.mu * material.viscosity / dt)
    if viscous > 0.0:
        # F sym(F^T dF): blocks of (F F^T dF + F dF^T F) / 2
        B = F * wp.transpose(F)
        row = int(0)
        for c in range(3):
            for d in range(c, 3):
                for a in range(3):
                    C[3 * row + a, a] += viscous * B[c, d]
                    for e in range(3):
                        C[3 * row + a, e] += viscous * F[c, e] * F[d, a]
                row += 1
    return C
