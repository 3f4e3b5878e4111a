"""Device side of filling a mesh with particles."""

import warp as wp


@wp.kernel(enable_backward=False)
def in_mesh(mesh: wp.uint64, points: wp.array[wp.vec3], found: wp.array[wp.bool]):
    """Say which points lie inside a mesh, by its winding number."""
    p = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[p], 1.0e9)
    found[p] = query.result and query.sign < 0.0
