"""Device code of `rigid_splats`: splats that move with bodies."""

import warp as wp

from softmode.splats.raster.rasterizer_kernels import vec6

wp.set_module_options({"enable_backward": False})


@wp.kernel
def move_rigid_splats(
    # Rest, in the frame of the body:
    rest_mean: wp.array2d[wp.vec3],  # (1, count) [m]
    rest_covariance: wp.array2d[vec6],  # (1, count) [m^2]
    owner: wp.array[int],  # (count,) part
    body: wp.array2d[int],  # (world_count, part_count)
    # State in:
    body_q: wp.array[wp.transform],
    first_splat: int,
    # Out:
    mean_out: wp.array2d[wp.vec3],  # (world_count, splat_count) [m]
    covariance_out: wp.array2d[vec6],  # (world_count, splat_count) [m^2]
    rotation_out: wp.array2d[wp.quat],  # (1|world_count, 1|splat_count); of one column if colours do not depend on it
):
    """Place x = R X + t, Sigma = R S R^T, and note R for the colours."""
    world, i = wp.tid()
    pose = body_q[body[world, owner[i]]]
    k = first_splat + i
    mean_out[world, k] = wp.transform_point(pose, rest_mean[0, i])
    s = rest_covariance[0, i]
    r = wp.quat_to_matrix(wp.transform_get_rotation(pose))
    m = r * wp.mat33(s[0], s[1], s[2], s[1], s[3], s[4], s[2], s[4], s[5]) * wp.transpose(r)
    covariance_out[world, k] = vec6(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2])
    if world < rotation_out.shape[0] and k < rotation_out.shape[1]:
        rotation_out[world, k] = wp.transform_get_rotation(pose)
