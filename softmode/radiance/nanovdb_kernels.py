"""Device code of `formats`: the values of NanoVDB grids."""

import warp as wp

from softmode.quiet import quieten_warp

quieten_warp()
wp.set_module_options({"enable_backward": False})


@wp.kernel
def read_values(
    density: wp.uint64,
    color: wp.uint64,  # 0 for none
    low: wp.vec3i,  # first voxel
    # Out:
    density_out: wp.array3d[float],
    color_out: wp.array3d[wp.vec3],  # left as it is where there is no colour
):
    """Copy a box of voxels."""
    i, j, k = wp.tid()
    x = low[0] + i
    y = low[1] + j
    z = low[2] + k
    density_out[i, j, k] = wp.volume_lookup_f(density, x, y, z)
    if color != wp.uint64(0):
        color_out[i, j, k] = wp.volume_lookup_v(color, x, y, z)
