"""Device side of a morph's pictures: splats at points that ride along."""

import warp as wp

from softmode.deformables.skinning.skinning_kernels import limited_stretch, vec6

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def ride(
    x: wp.array[wp.vec3],
    F: wp.array[wp.mat33],
    rest: wp.array[wp.mat33],
    stretch_limit: float,
    # Out:
    means: wp.array2d[wp.vec3],
    covariances: wp.array2d[vec6],
):
    """Write x and F Sigma F^T, the stretch limited."""
    i = wp.tid()
    f = limited_stretch(F[i], stretch_limit)
    s = f * rest[i] * wp.transpose(f)
    means[0, i] = x[i]
    covariances[0, i] = vec6(s[0, 0], s[0, 1], s[0, 2], s[1, 1], s[1, 2], s[2, 2])
