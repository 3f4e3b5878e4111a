"""Device side of the principal axes of deformed splats."""

import warp as wp

from softmode.deformables.skinning.skinning_kernels import vec6

wp.set_module_options({"enable_backward": False})


@wp.kernel
def principal_axes(
    covariance: wp.array[vec6],  # (splat_count,), xx xy xz yy yz zz [m^2]
    # Out:
    scale_out: wp.array[wp.vec3],  # standard deviations [m]
    quat_out: wp.array[wp.quat],  # principal frame to world
):
    """Find R and s with R diag(s^2) R^T = Sigma; in float64, as thin splats have variances that float32 would lose."""
    i = wp.tid()
    c = covariance[i]
    xy = wp.float64(c[1])
    xz = wp.float64(c[2])
    yz = wp.float64(c[4])
    axes, variance = wp.eig3(wp.mat33d(wp.float64(c[0]), xy, xz, xy, wp.float64(c[3]), yz, xz, yz, wp.float64(c[5])))
    if wp.determinant(axes) < wp.float64(0.0):
        axes = -axes
    zero = wp.float64(0.0)
    scale_out[i] = wp.vec3(
        float(wp.sqrt(wp.max(variance[0], zero))),
        float(wp.sqrt(wp.max(variance[1], zero))),
        float(wp.sqrt(wp.max(variance[2], zero))),
    )
    quat_out[i] = wp.quat(wp.quat_from_matrix(axes))
