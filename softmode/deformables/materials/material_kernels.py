"""Device side of the materials: energy density and first Piola-Kirchhoff stress per point, in float64.

Everything is a function of the displacement gradient G = F - I. Near rest the energy is quadratic in the strain while
I_C - 3 and J - 1 are linear in it; their linear parts are cancelled by algebra here, not by rounding, so that a stiff
body keeps its energy to full relative precision at any strain. With the Green strain E = (F^T F - I)/2 and its
invariants t = tr E, e2 = (tr(E)^2 - E : E)/2, e3 = det E the identity is

    t - (J - 1) = (J - 1)^2/2 - 2 e2 - 4 e3,

because J^2 = det(I + 2 E). The formulas of the models are in :mod:`softmode.deformables.materials.material`.
"""

from enum import IntEnum

import warp as wp

from softmode.deformables.materials.singular_value_kernels import singular_values

wp.set_module_options({"enable_backward": False})


class MaterialModel(IntEnum):
    """The energy density of a body; formulas and domains: :mod:`softmode.deformables.materials.material`."""

    STABLE_NEO_HOOKEAN_LOG = 0
    """Stable Neo-Hookean with the origin term: keeps volume, recovers from any state, a point included. The default."""
    STABLE_NEO_HOOKEAN = 1
    """Stable Neo-Hookean without it, for parity with published results: a body squeezed to a point stays there."""
    ARAP = 2
    """As rigid as possible: resists stretch and shear but not a change of volume (Poisson's ratio acts as 0)."""
    COROTATED = 3
    """Fixed corotated: ARAP with a volume term; stress linear in the stretch, recovers from inversion."""
    STVK = 4
    """Saint Venant-Kirchhoff: Hooke's law in the Green strain; for large rotations with small strains. Softens in
    compression and gives way below a stretch of 1/sqrt(3)."""
    NEO_HOOKEAN = 5
    """Neo-Hookean with ln J: infinite energy at J <= 0, so that a body never inverts, nor starts inverted."""


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
def has_rotation(model: int):
    """Return whether the model has the term mu |F - R|^2."""
    return model == int(MaterialModel.ARAP) or model == int(MaterialModel.COROTATED)


@wp.func
def needs_volume(model: int):
    """Return whether the energy is infinite at J <= 0: a state then has to start with J > 0 everywhere."""
    return model == int(MaterialModel.NEO_HOOKEAN)


@wp.func
def hooke_lambda(material: MaterialParameters):
    """Return the lambda [Pa] of Hooke's law that the model obeys at small strain: 0 for ARAP."""
    if material.model == int(MaterialModel.ARAP):
        return wp.float64(0.0)
    return material.lam


@wp.func
def hooke_energy(material: MaterialParameters, E: wp.mat33d):
    """Return mu E : E + lambda/2 tr(E)^2 [J/m^3]."""
    trace = wp.trace(E)
    return material.mu * wp.ddot(E, E) + wp.float64(0.5) * hooke_lambda(material) * trace * trace


@wp.func
def hooke_stress(material: MaterialParameters, E: wp.mat33d):
    """Return 2 mu E + lambda tr(E) I [Pa]."""
    p = hooke_lambda(material) * wp.trace(E)
    return wp.float64(2.0) * material.mu * E + wp.diag(wp.vec3d(p, p, p))


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
def second_invariant(A: wp.mat33d):
    """Return (tr(A)^2 - tr(A^2)) / 2."""
    return (
        A[0, 0] * A[1, 1]
        - A[0, 1] * A[1, 0]
        + A[1, 1] * A[2, 2]
        - A[1, 2] * A[2, 1]
        + A[0, 0] * A[2, 2]
        - A[0, 2] * A[2, 0]
    )


@wp.func
def determinant_minus_one(G: wp.mat33d):
    """Return det(I + G) - 1 without the cancellation of 1 + small - 1."""
    return wp.trace(G) + second_invariant(G) + wp.determinant(G)


@wp.func
def strain_measure(G: wp.mat33d):
    """Return I_C - 3 of F = I + G without cancellation."""
    return wp.float64(2.0) * wp.trace(G) + wp.ddot(G, G)


@wp.func
def green_strain(G: wp.mat33d):
    """Return the Green strain (F^T F - I) / 2 of F = I + G."""
    return wp.float64(0.5) * (G + wp.transpose(G) + wp.transpose(G) * G)


@wp.func
def log_of_one_plus(x: wp.float64):
    """Return ln(1 + x) to full relative precision (Kahan's form)."""
    u = wp.float64(1.0) + x
    if u == wp.float64(1.0):
        return x
    return wp.log(u) * x / (u - wp.float64(1.0))


@wp.func
def excess_over_log(x: wp.float64):
    """Return x - ln(1 + x) to full relative precision: x s - 2 (s^3/3 + s^5/5 + ...), s = x / (2 + x), near 0."""
    one = wp.float64(1.0)
    if wp.abs(x) > wp.float64(0.05):
        return x - log_of_one_plus(x)
    s = x / (wp.float64(2.0) + x)
    q = s * s
    series = one / wp.float64(9.0) + q * one / wp.float64(11.0)
    series = one / wp.float64(3.0) + q * (one / wp.float64(5.0) + q * (one / wp.float64(7.0) + q * series))
    return x * s - wp.float64(2.0) * s * q * series


@wp.func
def invariant_energy(material: MaterialParameters, E: wp.mat33d, j1: wp.float64):
    """Return the part of Psi that depends on I_C = 3 + 2 tr E and J = 1 + j1 alone [J/m^3]."""
    half = wp.float64(0.5)
    volume = half * j1 * j1
    if material.model == int(MaterialModel.COROTATED):
        return material.lam * volume
    trace = wp.trace(E)
    # t - (J - 1), see the module's docstring.
    distortion = volume - wp.float64(2.0) * second_invariant(E) - wp.float64(4.0) * wp.determinant(E)
    if material.model == int(MaterialModel.STABLE_NEO_HOOKEAN_LOG):
        l = material.lam + wp.float64(5.0) / wp.float64(6.0) * material.mu
        origin = wp.float64(2.0) / wp.float64(3.0) * excess_over_log(half * trace)
        return material.mu * (distortion + origin) + l * volume
    if material.model == int(MaterialModel.STABLE_NEO_HOOKEAN):
        return material.mu * distortion + (material.lam + material.mu) * volume
    if material.model == int(MaterialModel.NEO_HOOKEAN):
        if j1 <= wp.float64(-1.0):
            return wp.float64(wp.inf)
        log = log_of_one_plus(j1)
        return material.mu * (distortion + excess_over_log(j1)) + half * material.lam * log * log
    return wp.float64(0.0)


@wp.func
def invariant_derivatives(material: MaterialParameters, strain: wp.float64, j1: wp.float64):
    """Return the coefficients (s + p, s, b, p, l) of the derivatives of :func:`invariant_energy` [Pa].

    ``strain`` is I_C - 3 and ``j1`` is J - 1. Stress: s F + p cof F. Hessian: s I + b f f^T + l g g^T + p dcof/dF with
    f = vec F, g = vec cof F. At rest s + p = 0: it is formed without cancellation. Where ln J is not defined the
    coefficients are those of J = 1e-9: finite, and pushing outward.
    """
    one = wp.float64(1.0)
    zero = wp.float64(0.0)
    mu = material.mu
    lam = material.lam
    if material.model == int(MaterialModel.STABLE_NEO_HOOKEAN_LOG):
        m = wp.float64(4.0) / wp.float64(3.0) * mu
        l = lam + wp.float64(5.0) / wp.float64(6.0) * mu
        c = strain + wp.float64(4.0)  # I_C + 1
        rest = l * j1 + mu / wp.float64(3.0) * strain / c
        return rest, m * (one - one / c), wp.float64(2.0) * m / (c * c), l * j1 - mu, l
    if material.model == int(MaterialModel.STABLE_NEO_HOOKEAN):
        l = lam + mu
        return l * j1, mu, zero, l * j1 - mu, l
    if material.model == int(MaterialModel.COROTATED):
        return lam * j1, zero, zero, lam * j1, lam
    if material.model == int(MaterialModel.NEO_HOOKEAN):
        d = wp.max(j1, wp.float64(1.0e-9) - one)
        j = one + d
        log = lam * log_of_one_plus(d)
        return (log + mu * d) / j, mu, zero, (log - mu) / j, (mu + lam - log) / (j * j)
    return zero, zero, zero, zero, zero


@wp.func
def stretch_minus_one(E: wp.mat33d, sigma: wp.vec3d, V: wp.mat33d):
    """Return V^T (S - I) V of the polar decomposition F = R S, from (S + I) (S - I) = 2 E.

    Small strains keep their relative precision. V diagonalises S up to rounding; what is left off the diagonal counts.
    """
    strain = wp.transpose(V) * E * V
    X = wp.mat33d()
    for i in range(3):
        for j in range(3):
            if i != j:
                X[i, j] = wp.float64(2.0) * strain[i, j] / wp.max(sigma[i] + sigma[j], wp.float64(0.5))
        if sigma[i] > wp.float64(-0.5):
            X[i, i] = wp.float64(2.0) * strain[i, i] / (sigma[i] + wp.float64(1.0))
        else:
            X[i, i] = sigma[i] - wp.float64(1.0)
    return X


@wp.func
def energy_and_stress(material: MaterialParameters, G: wp.mat33d, G_start: wp.mat33d, dt: wp.float64):
    """Return the energy density Psi [J/m^3] at F = I + G and the first Piola-Kirchhoff stress dPsi/dF [Pa].

    The energy density is the elastic one plus the step's dissipation potential.

    Args:
        material: Parameters of the material.
        G: Displacement gradient at the end of the step.
        G_start: Displacement gradient at its start.
        dt: Duration of the step [s].
    """
    zero = wp.float64(0.0)
    I = wp.identity(n=3, dtype=wp.float64)
    E = green_strain(G)
    j1 = determinant_minus_one(G)
    psi = invariant_energy(material, E, j1)
    rest, s, _b, p, _l = invariant_derivatives(material, strain_measure(G), j1)
    # s F + p cof F with the identity taken out of both: cof(I + G) = I + tr(G) I - G^T + cof G.
    P = s * G + p * (cofactor(G) - wp.transpose(G)) + (rest + p * wp.trace(G)) * I
    if has_rotation(material.model):
        U, sigma, V = singular_values(I + G)
        X = stretch_minus_one(E, sigma, V)
        psi += material.mu * wp.ddot(X, X)
        P += wp.float64(2.0) * material.mu * (U * X * wp.transpose(V))
    if material.model == int(MaterialModel.STVK):
        psi += hooke_energy(material, E)
        P += (I + G) * hooke_stress(material, E)
    if material.viscosity > zero:
        rate = material.viscosity / dt
        change = E - green_strain(G_start)
        psi += rate * hooke_energy(material, change)
        P += (I + G) * hooke_stress(material, rate * change)
    return psi, P


@wp.func
def energy(material: MaterialParameters, G: wp.mat33d, G_start: wp.mat33d, dt: wp.float64):
    """Return the energy density [J/m^3] of :func:`energy_and_stress`."""
    psi, _P = energy_and_stress(material, G, G_start, dt)
    return psi


@wp.func
def stress(material: MaterialParameters, G: wp.mat33d, G_start: wp.mat33d, dt: wp.float64):
    """Return the stress [Pa] of :func:`energy_and_stress`."""
    _psi, P = energy_and_stress(material, G, G_start, dt)
    return P
