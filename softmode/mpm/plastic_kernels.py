"""Device side of plasticity: the return of a deformation gradient to von Mises' yield surface, and its adjoint.

F = U diag(exp e) V^T holds what is elastic. It yields where |dev tau| > sqrt(2/3) times the yield stress, with tau the
Kirchhoff stress of any energy. What flows leaves the deviator of the logarithmic strain, e' = mean(e) + s dev(e), so
that det F stays; s in (0, 1) is the share at which |dev tau(e')| is at the limit (Simo 1992, doi:10.1016/0045-7825(92)
90123-2; where tau is linear in e, s = limit / |dev tau|, the radial return).
"""

from typing import Any

import warp as wp

from softmode.deformables.materials.material_kernels import has_rotation
from softmode.deformables.materials.singular_value_kernels import singular_values
from softmode.mpm.step_kernels import controlled, moves
from softmode.mpm.stress_kernels import kirchhoff, kirchhoff_adjoint, polar_rotation

wp.set_module_options({"enable_backward": False})

YIELD = wp.constant(wp.float64((2.0 / 3.0) ** 0.5))
"""|dev tau| over the stress of a bar that is pulled."""


@wp.func
def _deviator(tau: wp.mat33d):
    """Return a tensor without its mean."""
    return tau - (wp.trace(tau) / wp.float64(3.0)) * wp.identity(n=3, dtype=wp.float64)


@wp.func
def _size(tau: wp.mat33d):
    """Return the Frobenius norm."""
    return wp.sqrt(wp.ddot(tau, tau))


@wp.func
def _stretch(strain: wp.vec3d):
    """Return diag(exp e)."""
    return wp.diag(wp.vec3d(wp.exp(strain[0]), wp.exp(strain[1]), wp.exp(strain[2])))


@wp.func
def _unturned(model: int):
    """Return the rotation of a stretch, as :func:`polar_rotation` would."""
    if has_rotation(model):
        return wp.identity(n=3, dtype=wp.float64)
    return wp.mat33d()


@wp.func
def _shear(model: int, mu: wp.float64, lam: wp.float64, strain: wp.vec3d):
    """Return the deviator of the Kirchhoff stress at diag(exp e) [Pa]."""
    return _deviator(kirchhoff(model, mu, lam, _stretch(strain), _unturned(model)))


@wp.func
def _share(model: int, mu: wp.float64, lam: wp.float64, limit: wp.float64, mean: wp.vec3d, away: wp.vec3d):
    """Return s in (0, 1) at which |dev tau(mean + s away)| is at the limit, which it is above at 1 (Illinois)."""
    low = wp.float64(0.0)
    high = wp.float64(1.0)
    below = -limit
    above = _size(_shear(model, mu, lam, mean + away)) - limit
    s = high
    side = int(0)
    for _k in range(50):
        s = low - below * (high - low) / (above - below)
        over = _size(_shear(model, mu, lam, mean + s * away)) - limit
        if wp.abs(over) <= wp.float64(1.0e-13) * limit:
            break
        if over > wp.float64(0.0):
            if side > 0:
                below *= wp.float64(0.5)
            high = s
            above = over
            side = 1
        else:
            if side < 0:
                above *= wp.float64(0.5)
            low = s
            below = over
            side = -1
    return s


@wp.func
def _yields(model: int, mu: wp.float64, lam: wp.float64, limit: wp.float64, F: wp.mat33d):
    """Return whether a state lies outside of the yield surface; one turned inside out is not looked at."""
    if not (limit > wp.float64(0.0) and wp.determinant(F) > wp.float64(0.0)):
        return False
    return _size(_deviator(kirchhoff(model, mu, lam, F, polar_rotation(model, F)))) > limit


@wp.func
def _strain(sigma: wp.vec3d):
    """Return the mean of the logarithmic strain along each axis, and its deviator."""
    strain = wp.vec3d(wp.log(sigma[0]), wp.log(sigma[1]), wp.log(sigma[2]))
    third = (strain[0] + strain[1] + strain[2]) / wp.float64(3.0)
    mean = wp.vec3d(third, third, third)
    return mean, strain - mean


@wp.kernel(enable_backward=False, module="unique")
def return_to_yield(
    mass: wp.array2d[Any],
    mu: wp.array2d[Any],
    lam: wp.array2d[Any],
    yield_stress: wp.array2d[Any],  # 0 where nothing yields
    model: int,
    active: wp.array[int],
    # In and out:
    F_out: wp.array2d[Any],
):
    """Let what lies outside of the yield surface flow back to it; all other states keep their bits."""
    world, p = wp.tid()
    if mass[world, p] > type(mass[world, p])(0.0) and moves(active, world):
        F = wp.mat33d(F_out[world, p])
        m = wp.float64(mu[world, p])
        l = wp.float64(lam[world, p])
        limit = YIELD * wp.float64(yield_stress[world, p])
        if _yields(model, m, l, limit, F):
            U, sigma, V = singular_values(F)
            mean, away = _strain(sigma)
            s = _share(model, m, l, limit, mean, away)
            F_out[world, p] = F_out.dtype(U * _stretch(mean + s * away) * wp.transpose(V))


@wp.kernel(enable_backward=False, module="unique")
def return_to_yield_adjoint(
    # State in:
    F_in: wp.array2d[Any],
    control: wp.array2d[Any],
    C_next: wp.array2d[Any],
    material_control: int,
    dt: Any,
    smoothing: Any,
    # Particles:
    mass: wp.array2d[Any],
    mu: wp.array2d[Any],
    lam: wp.array2d[Any],
    yield_stress: wp.array2d[Any],
    model: int,
    # In: bar of what was returned; out: of what was tried.
    F_bar: wp.array2d[Any],
    # Out, added to:
    mu_bar: wp.array2d[Any],
    lam_bar: wp.array2d[Any],
    yield_bar: wp.array2d[Any],
):
    """Adjoint of :func:`return_to_yield`.

    In the frame of U and V, dF'_ij +- dF'_ji = (g_i -+ g_j) / (s_i -+ s_j) (dF_ij +- dF_ji), with s and g the stretches
    before and after. On the diagonal e' = mean(e) + s dev(e), and ds follows from |dev tau(e')| = limit.
    """
    world, p = wp.tid()
    if not mass[world, p] > type(dt)(0.0):
        return
    before = F_in[world, p]
    Fs = controlled(before, control[world, p], material_control)
    F = wp.mat33d((type(dt)(1.0) - smoothing) * (Fs + dt * (C_next[world, p] * Fs)) + smoothing * before)
    m = wp.float64(mu[world, p])
    l = wp.float64(lam[world, p])
    limit = YIELD * wp.float64(yield_stress[world, p])
    if not _yields(model, m, l, limit, F):
        return
    third = wp.float64(1.0) / wp.float64(3.0)
    U, sigma, V = singular_values(F)
    mean, away = _strain(sigma)
    s = _share(model, m, l, limit, mean, away)
    g = wp.get_diag(_stretch(mean + s * away))
    bar = wp.transpose(U) * wp.mat33d(F_bar[world, p]) * V
    # How |dev tau| changes with e', mu and lambda, and with it s.
    shear = _shear(model, m, l, mean + s * away)
    by_F, by_mu, by_lam = kirchhoff_adjoint(model, m, l, wp.diag(g), _unturned(model), shear / _size(shear))
    slope = wp.cw_mul(g, wp.get_diag(by_F))
    h = wp.cw_mul(g, wp.get_diag(bar))
    by_s = wp.dot(h, away) / wp.dot(slope, away)
    spread = third * (wp.float64(1.0) - s) * (h[0] + h[1] + h[2] - by_s * (slope[0] + slope[1] + slope[2]))
    out = wp.diag(wp.cw_div(s * (h - by_s * slope) + wp.vec3d(spread, spread, spread), sigma))
    for i in range(3):
        for j in range(i):
            # For s_i near s_j, g = exp((1 - s) mean) s_i^s is as good as its derivative.
            gap = sigma[j] - sigma[i]
            even = s * (g[i] + g[j]) / (sigma[i] + sigma[j])
            if gap > wp.float64(1.0e-6) * sigma[j]:
                even = (g[j] - g[i]) / gap
            odd = (g[i] + g[j]) / (sigma[i] + sigma[j])
            half = wp.float64(0.5) * even * (bar[i, j] + bar[j, i])
            turn = wp.float64(0.5) * odd * (bar[i, j] - bar[j, i])
            out[i, j] = half + turn
            out[j, i] = half - turn
    F_bar[world, p] = F_bar.dtype(U * out * wp.transpose(V))
    mu_bar[world, p] = mu_bar[world, p] - type(dt)(by_s * by_mu)
    lam_bar[world, p] = lam_bar[world, p] - type(dt)(by_s * by_lam)
    yield_bar[world, p] = yield_bar[world, p] + type(dt)(by_s * YIELD)
