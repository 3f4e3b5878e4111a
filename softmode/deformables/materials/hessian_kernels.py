"""Device side of the materials: the Hessian of the energy density, projected to positive semidefinite.

With F = U diag(sigma) V^T (U, V rotations) and dF = U D V^T the Hessian of an isotropic energy couples the diagonal of
D by a 3x3 block of *scalings*, and each pair (D_ij, D_ji) by a 2x2 block, whose eigenvectors are a *twist* (D_ij =
-D_ji) and a *flip* (D_ij = D_ji) with the eigenvalues (Psi_i + Psi_j) / (sigma_i + sigma_j) and (Psi_i - Psi_j) /
(sigma_i - sigma_j), Psi_i = dPsi/dsigma_i (Smith, de Goes, Kim 2019, doi:10.1145/3241041). Negative eigenvalues are set
to zero. An infinitesimal rotation of a stress-free body is a sum of twists, whose eigenvalues vanish there: their
precision is what lets a stiff body turn freely, so all of this is float64; only the result is rounded to float32.
"""

import warp as wp

from softmode.deformables.materials.material_kernels import (
    MaterialModel,
    MaterialParameters,
    cofactor,
    determinant_minus_one,
    green_strain,
    has_rotation,
    hooke_lambda,
    hooke_stress,
    invariant_derivatives,
    strain_measure,
)
from softmode.deformables.materials.singular_value_kernels import positive_part, singular_values

wp.set_module_options({"enable_backward": False})

HessianBlocks = wp.types.matrix(shape=(18, 3), dtype=float)
"""The blocks C_cd (3x3, over the columns of F) of a symmetric 9x9 Hessian for (c, d) = 00, 01, 02, 11, 12, 22."""


@wp.func
def _rotation_stiffness(sigma_sum: wp.float64):
    """Return 2 - 4 / (sigma_i + sigma_j), the twist eigenvalue of |F - R|^2, bounded where it falls to -infinity."""
    return wp.float64(2.0) - wp.float64(4.0) / wp.max(sigma_sum, wp.float64(1.0e-6))


@wp.func
def principal_hessian(material: MaterialParameters, G: wp.mat33d, sigma: wp.vec3d):
    """Return the eigenvalues of the twists and flips (index k for the pair without k) and the block of scalings [Pa].

    Args:
        material: Parameters of the material; viscosity is left out.
        G: Displacement gradient F - I.
        sigma: Singular values of F as :func:`singular_values` gives them.
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    I = wp.identity(n=3, dtype=wp.float64)
    x = sigma[0]
    y = sigma[1]
    z = sigma[2]
    strain = strain_measure(G)
    minors = wp.vec3d(y * z, z * x, x * y)
    if material.model == int(MaterialModel.STVK):
        mean = wp.float64(0.5) * material.lam * strain
        squares = wp.vec3d(y * y + z * z - one, z * z + x * x - one, x * x + y * y - one)
        S = material.lam * wp.outer(sigma, sigma) + mean * I
        S += material.mu * (wp.float64(3.0) * wp.diag(wp.cw_mul(sigma, sigma)) - I)
        shared = wp.vec3d(mean, mean, mean)
        return material.mu * (squares - minors) + shared, material.mu * (squares + minors) + shared, S
    _rest, s, b, p, l = invariant_derivatives(material, strain, determinant_minus_one(G))
    S = s * I + b * wp.outer(sigma, sigma) + l * wp.outer(minors, minors)
    S += p * wp.mat33d(zero, z, y, z, zero, x, y, x, zero)
    uniform = wp.vec3d(s, s, s)
    twist = uniform + p * sigma
    flip = uniform - p * sigma
    if has_rotation(material.model):
        mu = material.mu
        twist += mu * wp.vec3d(_rotation_stiffness(y + z), _rotation_stiffness(z + x), _rotation_stiffness(x + y))
        flip += wp.vec3d(two * mu, two * mu, two * mu)
        S += two * mu * I
    return twist, flip, S


@wp.func
def _block(scaling: wp.mat33d, exchange: wp.mat33d, direct: wp.mat33d, V: wp.mat33d, u: wp.vec3d, w: wp.vec3d):
    """Return the 3x3 block of the Hessian for the rows u, w of U.

    In principal axes d2Psi / dD_ij dD_kl is ``scaling``_ik for i = j, k = l; ``direct``_ij for the same entry; and
    ``exchange``_ij for D_ij with D_ji.
    """
    M = wp.cw_mul(scaling, wp.outer(u, w)) + wp.cw_mul(exchange, wp.outer(w, u))
    M += wp.diag(wp.transpose(direct) * wp.cw_mul(u, w))
    return V * M * wp.transpose(V)


@wp.func
def hooke_strain(material: MaterialParameters, G: wp.mat33d, G_start: wp.mat33d, dt: wp.float64):
    """Return what Hooke's law acts on, E of STVK plus tau/dt (E - E_n) of damping, after its derivative by E."""
    strain = wp.mat33d()
    rate = wp.float64(0.0)
    if material.viscosity > wp.float64(0.0):
        rate = material.viscosity / dt
        strain = rate * (green_strain(G) - green_strain(G_start))
    if material.model == int(MaterialModel.STVK):
        rate += wp.float64(1.0)
        strain += green_strain(G)
    return rate, strain


@wp.func
def hessian_of_invariants(material: MaterialParameters, G: wp.mat33d, G_start: wp.mat33d, dt: wp.float64):
    """Return the Hessian of an energy in the invariants of F [Pa], not projected: a polynomial in F and cof F.

    Block C_cd has the entries d2Psi / dF_ci dF_dj. A strain's S = 2 mu E + lambda tr(E) I, times a rate, adds
    S_ij delta_cd + lambda F_ci F_dj + mu (F_cj F_di + (F F^T)_cd delta_ij).
    """
    F = wp.identity(n=3, dtype=wp.float64) + G
    cof = cofactor(F)
    B = F * wp.transpose(F)
    _rest, s, b, p, l = invariant_derivatives(material, strain_measure(G), determinant_minus_one(G))
    rate, strain = hooke_strain(material, G, G_start, dt)
    S = hooke_stress(material, strain)
    m = rate * material.mu
    b += rate * hooke_lambda(material)
    C = HessianBlocks()
    row = int(0)
    for c in range(3):
        for d in range(c, 3):
            for i in range(3):
                for j in range(3):
                    entry = b * F[c, i] * F[d, j] + l * cof[c, i] * cof[d, j] + m * F[c, j] * F[d, i]
                    if i == j:
                        entry += m * B[c, d]
                    if c == d:
                        entry += S[i, j]
                    if c == d and i == j:
                        entry += s
                    # p dcof/dF: the sign is that of the permutation (c, d, e) times that of (i, j, k)
                    if c != d and i != j:
                        if (d - c + 3) % 3 == (j - i + 3) % 3:
                            entry += p * F[3 - c - d, 3 - i - j]
                        else:
                            entry -= p * F[3 - c - d, 3 - i - j]
                    C[3 * row + i, j] = float(entry)
            row += 1
    return C


@wp.func
def hessian(material: MaterialParameters, G: wp.mat33d, G_start: wp.mat33d, dt: wp.float64, project: int):
    """Return the Hessian of :func:`softmode.deformables.materials.material_kernels.energy` [Pa].

    Args:
        material: Parameters of the material.
        G: Displacement gradient F - I.
        G_start: Displacement gradient at the start of the step.
        dt: Duration of the step [s].
        project: Whether negative eigenvalues of the elastic part become zero and the viscous part keeps its
            Gauss-Newton term only, the Hessian at E = E_n.
    """
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    if project == 0 and not has_rotation(material.model):
        return hessian_of_invariants(material, G, G_start, dt)
    U, sigma, V = singular_values(wp.identity(n=3, dtype=wp.float64) + G)
    twist, flip, S = principal_hessian(material, G, sigma)
    if project != 0:
        S = positive_part(S)
        twist = wp.max(twist, wp.vec3d())
        flip = wp.max(flip, wp.vec3d())
    even = half * (flip + twist)
    odd = half * (flip - twist)
    direct = wp.mat33d(zero, even[2], even[1], even[2], zero, even[0], even[1], even[0], zero)
    exchange = wp.mat33d(zero, odd[2], odd[1], odd[2], zero, odd[0], odd[1], odd[0], zero)
    viscous = wp.mat33d()
    if material.viscosity > zero:
        # F (2 m sym(F^T dF) + n tr(F^T dF) I), F diagonal: m (sigma_i^2 D_ij + sigma_i sigma_j D_ji) + n sigma_i tr.
        m = material.viscosity / dt * material.mu
        n = material.viscosity / dt * hooke_lambda(material)
        products = wp.outer(sigma, sigma)
        S += n * products
        exchange += m * products
        for i in range(3):
            for j in range(3):
                direct[i, j] = direct[i, j] + m * products[i, i]
        if project == 0:
            # the stress F S of the viscous S changes by dF S too
            rate = green_strain(G) - green_strain(G_start)
            viscous = hooke_stress(material, material.viscosity / dt * rate)
    C = HessianBlocks()
    row = int(0)
    for c in range(3):
        for d in range(c, 3):
            u = wp.vec3d(U[c, 0], U[c, 1], U[c, 2])
            w = wp.vec3d(U[d, 0], U[d, 1], U[d, 2])
            block = _block(S, exchange, direct, V, u, w)
            if c == d:
                block += viscous
            for a in range(3):
                for b in range(3):
                    C[3 * row + a, b] = float(block[a, b])
            row += 1
    return C


@wp.func
def cofactor_derivative(F: wp.mat33d, dF: wp.mat33d):
    """Return dcof(F)[dF], from cof(F)^T = F^2 - tr(F) F + (tr(F)^2 - tr(F^2))/2 I (Cayley and Hamilton)."""
    diagonal = wp.trace(F) * wp.trace(dF) - wp.trace(F * dF)
    product = F * dF + dF * F - wp.trace(F) * dF - wp.trace(dF) * F
    return wp.transpose(product) + wp.diag(wp.vec3d(diagonal, diagonal, diagonal))


@wp.func
def invariant_stress_derivative(material: MaterialParameters, G: wp.mat33d, dF: wp.mat33d):
    """Return what an energy's part in the invariants of F has of :func:`stress_derivative` [Pa]."""
    F = wp.identity(n=3, dtype=wp.float64) + G
    _rest, s, b, p, l = invariant_derivatives(material, strain_measure(G), determinant_minus_one(G))
    cof = cofactor(F)
    return s * dF + b * wp.ddot(F, dF) * F + l * wp.ddot(cof, dF) * cof + p * cofactor_derivative(F, dF)


@wp.func
def stress_derivative(material: MaterialParameters, G: wp.mat33d, G_start: wp.mat33d, dt: wp.float64, dF: wp.mat33d):
    """Return dP[dF] [Pa], the derivative of :func:`.material_kernels.stress`, not projected."""
    F = wp.identity(n=3, dtype=wp.float64) + G
    dP = invariant_stress_derivative(material, G, dF)
    if has_rotation(material.model):
        # dR = U W V^T with W_ij = (D_ij - D_ji) / (sigma_i + sigma_j), D = U^T dF V.
        U, sigma, V = singular_values(F)
        D = wp.transpose(U) * dF * V
        W = wp.mat33d()
        for i in range(3):
            for j in range(3):
                if i != j:
                    W[i, j] = (D[i, j] - D[j, i]) / (sigma[i] + sigma[j])
        dP += wp.float64(2.0) * material.mu * (dF - U * W * wp.transpose(V))
    rate, strain = hooke_strain(material, G, G_start, dt)
    dE = wp.float64(0.5) * (wp.transpose(F) * dF + wp.transpose(dF) * F)
    return dP + dF * hooke_stress(material, strain) + rate * F * hooke_stress(material, dE)
