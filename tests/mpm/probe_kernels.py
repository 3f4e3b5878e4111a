"""Kernels through which the tests reach device functions of particles."""

import warp as wp

from softmode.mpm.spline_kernels import cell_of, spline, spline_slope
from softmode.mpm.stress_kernels import kirchhoff, kirchhoff_adjoint, polar_rotation

wp.set_module_options({"enable_backward": False})


@wp.kernel
def weigh(
    x: wp.array[wp.vec3d],
    origin: wp.vec3d,
    dx: wp.float64,
    # Out:
    weight: wp.array3d[wp.float64],  # (N, 3, 4)
    slope: wp.array3d[wp.float64],
):
    """Write the weights of the four nodes along each axis around every point, and their derivatives by the fraction."""
    i = wp.tid()
    _a, _b, _c, fraction = cell_of(x[i], origin, dx, wp.vec3i(0, 0, 0))
    for d in range(3):
        w = spline(fraction[d])
        s = spline_slope(fraction[d])
        for k in range(4):
            weight[i, d, k] = w[k]
            slope[i, d, k] = s[k]


@wp.kernel
def press(
    model: int,
    mu: wp.float64,
    lam: wp.float64,
    F: wp.array[wp.mat33d],
    bar: wp.array[wp.mat33d],
    # Out:
    tau: wp.array[wp.mat33d],
    F_bar: wp.array[wp.mat33d],
):
    """Write the Kirchhoff stress at every F, and dL/dF from bar = dL/dtau."""
    i = wp.tid()
    R = polar_rotation(model, F[i])
    tau[i] = kirchhoff(model, mu, lam, F[i], R)
    by_F, _by_mu, _by_lam = kirchhoff_adjoint(model, mu, lam, F[i], R, bar[i])
    F_bar[i] = by_F
