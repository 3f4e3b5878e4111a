"""Device side of a particle's stress: the Kirchhoff stress of any energy, and its product with an adjoint."""

from typing import Any

import warp as wp

from softmode.deformables.materials.hessian_kernels import invariant_stress_derivative, stress_derivative
from softmode.deformables.materials.material_kernels import (
    MaterialParameters,
    cofactor,
    determinant_minus_one,
    has_rotation,
    invariant_derivatives,
    strain_measure,
    stress,
)

wp.set_module_options({"enable_backward": False})


@wp.func
def _material(model: int, mu: wp.float64, lam: wp.float64):
    """Return parameters without viscosity: the grid has damping of its own."""
    material = MaterialParameters()
    material.model = model
    material.mu = mu
    material.lam = lam
    material.viscosity = wp.float64(0.0)
    return material


@wp.func
def _nearest_rotation(F: wp.mat33d):
    """Return the rotation of the polar decomposition of F, det F > 0, by Newton's iteration (Higham 1986)."""
    R = F
    for _k in range(12):
        half = wp.float64(0.5) * (R + wp.transpose(wp.inverse(R)))
        moved = half - R
        R = half
        if wp.ddot(moved, moved) < wp.float64(1.0e-18):
            break
    return R


@wp.func
def polar_rotation(model: int, F: Any):
    """Return the rotation R of F = R S where the energy has the term |F - R|^2 and R is well defined, else zero.

    Newton's iteration then takes a sixth of the time of singular values, which the materials need for inverted states.
    """
    Fd = wp.mat33d(F)
    if has_rotation(model) and wp.determinant(Fd) > wp.float64(0.02):
        return _nearest_rotation(Fd)
    return wp.mat33d()


@wp.func
def _is_rotation(R: wp.mat33d):
    """Return whether :func:`polar_rotation` found one."""
    return wp.ddot(R, R) > wp.float64(0.0)


@wp.func
def first_piola(material: MaterialParameters, F: wp.mat33d, R: wp.mat33d):
    """Return the first Piola-Kirchhoff stress P [Pa] at F, R from :func:`polar_rotation`."""
    G = F - wp.identity(n=3, dtype=wp.float64)
    if _is_rotation(R):
        _rest, s, _b, p, _l = invariant_derivatives(material, strain_measure(G), determinant_minus_one(G))
        return (wp.float64(2.0) * material.mu) * (F - R) + s * F + p * cofactor(F)
    return stress(material, G, wp.mat33d(), wp.float64(1.0))


@wp.func
def kirchhoff(model: int, mu: Any, lam: Any, F: Any, R: wp.mat33d):
    """Return the Kirchhoff stress tau = P F^T [Pa] at F, R from :func:`polar_rotation`."""
    Fd = wp.mat33d(F)
    return type(F)(first_piola(_material(model, wp.float64(mu), wp.float64(lam)), Fd, R) * wp.transpose(Fd))


@wp.func
def kirchhoff_adjoint(model: int, mu: Any, lam: Any, F: Any, R: wp.mat33d, bar: Any):
    """Return dL/dF, dL/dmu and dL/dlambda from bar = dL/dtau, R from :func:`polar_rotation`.

    dL/dF = H[bar F] + bar^T P with H the (symmetric) derivative of P. Every energy is linear in mu and lambda. The
    derivative of the rotation is dR = R skew(K^-1 v), K = tr(S) I - S with F = R S, v the axial vector of R^T dF.
    """
    one = wp.float64(1.0)
    zero = wp.float64(0.0)
    Fd = wp.mat33d(F)
    b = wp.mat33d(bar)
    bF = b * Fd
    m = _material(model, wp.float64(mu), wp.float64(lam))
    I = wp.identity(n=3, dtype=wp.float64)
    P_mu = first_piola(_material(model, one, zero), Fd, R)
    P_lam = first_piola(_material(model, zero, one), Fd, R)
    H = wp.mat33d()
    if _is_rotation(R):
        S = wp.transpose(R) * Fd
        A = wp.transpose(R) * bF
        v = wp.inverse(wp.trace(S) * I - S) * wp.vec3d(A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1])
        H = (wp.float64(2.0) * m.mu) * (bF - R * wp.skew(v)) + invariant_stress_derivative(m, Fd - I, bF)
    else:
        H = stress_derivative(m, Fd - I, wp.mat33d(), one, bF)
    return (
        type(F)(H + wp.transpose(b) * (m.mu * P_mu + m.lam * P_lam)),
        type(mu)(wp.ddot(bF, P_mu)),
        type(mu)(wp.ddot(bF, P_lam)),
    )
